"""What one log has more than the model, where that is known: a weighed payload."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import mujoco

from sipe_bayes.core.parameters import ParameterSpace
from sipe_bayes.envs.target import Target, TargetError
from sipe_bayes.envs.targets import bind, split


@dataclass(frozen=True)
class Added:
    """What is added to a number of the model in one log, whatever a parameter makes of that number.

    Args:
        log: its name.
        target: ``body:NAME.mass``; the body's inertia grows in proportion.
        value: in kg.
    """

    log: str
    target: str
    value: float


@dataclass(frozen=True)
class AddedValues:
    """All of them, bound to a model."""

    model: mujoco.MjModel
    added: tuple[Added, ...]
    parameters: ParameterSpace

    @cached_property
    def _of_log(self) -> dict[str, dict[str, float]]:
        out: dict[str, dict[str, float]] = {}
        for one in self.added:
            out.setdefault(one.log, {})[one.target] = one.value
        return out

    @cached_property
    def unwritten(self) -> tuple[Target, ...]:
        """Targets that no parameter writes, bound to the model."""
        written = {target for parameter in self.parameters for target in parameter.targets}
        return tuple(bind(self.model, t) for t in dict.fromkeys(one.target for one in self.added) if t not in written)

    def to(self, target: Target, log: str | None) -> float:
        """What is added to a target in a log."""
        return self._of_log.get(log or "", {}).get(target.spec, 0.0)


def check_added(model: mujoco.MjModel, added: Iterable[Added]) -> tuple[Added, ...]:
    """The same; raises TargetError for what is no mass of the model."""
    added = tuple(added)
    for one in added:
        kind, _, attribute = split(one.target, f"log {one.log!r}")
        if (kind, attribute) != ("body", "mass"):
            raise TargetError(f"log {one.log!r}: only masses can be added, 'body:NAME.mass', got {one.target!r}")
        bind(model, one.target)
    return added


def of_logs(entries: Sequence[tuple[str, dict[str, float]]]) -> tuple[Added, ...]:
    """From the names of logs with what is added in them, by target."""
    return tuple(Added(log, target, value) for log, added in entries for target, value in added.items())
