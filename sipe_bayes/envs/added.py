"""What one log has more than the model, where that is known: a weighed payload."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import mujoco

from sipe_bayes.envs.target import Target, TargetError
from sipe_bayes.envs.targets import bind, split


@dataclass(frozen=True)
class Added:
    """What is added to a number of the model in one log, whatever a parameter makes of that number.

    Args:
        log: its name.
        target: ``body:NAME.mass``; the body's inertia grows in proportion, where no parameter writes it.
        value: in kg.
    """

    log: str
    target: str
    value: float


@dataclass(frozen=True)
class AddedValues:
    """All of them, bound to a model, among the writes of its parameters: (parameter, multiplier, target)."""

    model: mujoco.MjModel
    added: tuple[Added, ...]
    targets: tuple[tuple[int, float, Target], ...]

    @cached_property
    def _of_log(self) -> dict[str, dict[str, float]]:
        out: dict[str, dict[str, float]] = {}
        for one in self.added:
            out.setdefault(one.log, {})[one.target] = one.value
        return out

    @cached_property
    def writes(self) -> list[tuple[int | None, float, Target]]:
        """All writes in the order they must be done; no parameter for a target that none writes."""
        written = {target.spec for _, _, target in self.targets}
        alone = [spec for spec in dict.fromkeys(one.target for one in self.added) if spec not in written]
        return sorted([*self.targets, *((None, 1.0, bind(self.model, s)) for s in alone)], key=lambda w: w[2].order)

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
