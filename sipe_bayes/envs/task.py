"""The benchmark's tasks: an Environment with starting states, rewards, goals, variants and documented parameters.

A task is one file of a robot family plus one line in ``sipe_bayes.envs.registry``. Subclass ``Task``; define
``compile``, ``observe``, ``initial_states`` and ``reward``, and where they apply ``control``, ``terminated``,
``success`` and ``bind``; all are pure functions of batches. A function in the same file returns the instance with its
parameters, each of which describes itself: name, unit, default, bounds, the MuJoCo field it writes, what it does to the
motion and what it trades off against.
"""

from __future__ import annotations

import math
import zlib
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Literal

import mujoco
import numpy as np

from sipe_bayes.core.arrays import BoolArray, FloatArray
from sipe_bayes.core.parameters import Parameter, ParameterSpace
from sipe_bayes.envs.base import Environment
from sipe_bayes.envs.target import Target
from sipe_bayes.envs.targets import bind

Variant = Literal["default", "in_distribution", "out_of_distribution"]
VARIANTS: tuple[Variant, ...] = ("default", "in_distribution", "out_of_distribution")

_VARIANT_DISTANCES = {  # least and greatest
    "in_distribution": (0.1, 0.4),  # of theta from 0.5
    "out_of_distribution": (0.05, 0.2),  # of theta from the bounds
}


@dataclass(frozen=True)
class Transition:
    """Control steps of any leading shape (...,), and what followed.

    Args:
        states: (..., S).
        derived: (..., D) or None.
        actions: (..., A).
        next_states: (..., S).
        next_derived: (..., D) or None.
        goals: (..., G) or None.
    """

    states: FloatArray
    derived: FloatArray | None
    actions: FloatArray
    next_states: FloatArray
    next_derived: FloatArray | None
    goals: FloatArray | None = None


@dataclass(frozen=True)
class Solved:
    """When a task counts as solved.

    Args:
        measure: the mean return of an episode, or the share of successful ones.
        threshold: what it has to reach.
    """

    measure: Literal["return", "success"]
    threshold: float


@dataclass(frozen=True, eq=False)
class Task(Environment):
    """One of the benchmark's environments. Immutable and picklable.

    Args:
        name: as in the registry.
        parameters: theta = 0.5 is the model as published.
        summary: one sentence.
        episode_steps: control steps of an episode.
        solved: its threshold.
        reference: the published environment that theta = 0.5 reproduces.
        action_low: least value of each action.
        action_high: greatest value of each action.
        outside_sign: per parameter -1 or 1, the side on which the out-of-distribution variant lies; default by a seed
            of the name.
    """

    name: str
    parameters: ParameterSpace
    summary: str
    episode_steps: int
    solved: Solved
    reference: str = ""
    action_low: float = -1.0
    action_high: float = 1.0
    outside_sign: tuple[int, ...] | None = None

    @property
    def space(self) -> ParameterSpace:  # type: ignore[override]
        """The parameters."""
        return self.parameters

    def row(self) -> dict[str, object]:
        """What `sipe envs` prints of it among others, as JSON has it."""
        return {
            "name": self.name,
            "id": f"sipe/{self.name}-v0",
            "summary": self.summary,
            "parameters": len(self.space),
            "observations": len(self.channels),
            "actions": self.num_actions,
            "episode_steps": self.episode_steps,
            "solved_by": self.solved.measure,
            "solved_at": self.solved.threshold,
            "reproduces": self.reference,
        }

    def to_dict(self) -> dict[str, object]:
        """Its row, with the parameters, channels and variants in full."""
        kept = ("name", "unit", "default", "low", "high", "description")
        parameters = [{key: getattr(p, key) for key in kept} | {"writes": list(p.targets)} for p in self.space]
        variants = {v: self.theta(v).round(6).tolist() for v in VARIANTS}
        return {**self.row(), "observation": list(self.channels), "parameters": parameters, "variants": variants}

    @abstractmethod
    def initial_states(self, rng: np.random.Generator, count: int) -> tuple[FloatArray, FloatArray | None]:
        """Starting states (count, S) and goals (count, G), if the task has goals."""

    @abstractmethod
    def reward(self, step: Transition) -> FloatArray:
        """What each of the steps earns, (...,)."""

    def rewards(
        self, states: FloatArray, derived: FloatArray | None, actions: FloatArray, goals: FloatArray | None
    ) -> FloatArray:
        """``reward`` of every control step, (B, T)."""
        before, after = (None, None) if derived is None else (derived[:, :-1], derived[:, 1:])
        targets = None if goals is None else goals[:, None]
        return self.reward(Transition(states[:, :-1], before, actions, states[:, 1:], after, targets))

    def terminated(self, step: Transition) -> BoolArray:
        """(...,): whether the episode ends there; by default never."""
        return np.zeros(step.actions.shape[:-1], bool)

    def hopeless(self, states: FloatArray) -> BoolArray:
        """Whether a training may end an episode that the task does not, (...,) of states (..., S); never by default."""
        return np.zeros(states.shape[:-1], bool)

    def success(self, step: Transition) -> BoolArray | None:
        """(...,): whether the task is done at the end of the step; None where only the return counts."""
        return None

    def excitation(self, observations: FloatArray, rng: np.random.Generator) -> FloatArray | None:
        """Actions that show the task's parameters where smooth random ones would not.

        Args:
            observations: (B, O).
            rng: where their noise comes from.

        Returns:
            (B, A), or None where smooth random ones do.
        """
        return None

    def achieved_goals(self, states: FloatArray, derived: FloatArray | None) -> FloatArray | None:
        """(..., G): where a goal would have been reached; None without goals."""
        return None

    def goal_reward(self, achieved: FloatArray, goals: FloatArray) -> FloatArray:
        """(...,) of achieved and desired goals (..., G), for hindsight relabelling."""
        raise ValueError(f"goals: {self.name} has none; take the rewards of its steps")

    def control(self, model: mujoco.MjModel, states: FloatArray, actions: FloatArray) -> FloatArray:
        """By default the actions themselves."""
        return actions

    def state_columns(self, model: mujoco.MjModel) -> tuple[int | None, ...]:
        """By default no channel is known to be a column of the state."""
        return (None,) * len(self.channels)

    @cached_property
    def published(self) -> mujoco.MjModel:
        """The mujoco.MjModel at theta = 0.5; not to be written to."""
        return self.compile()

    def bind(self, target: str) -> Target:
        """How a parameter's target is written; override for targets of the family's own, such as links."""
        return bind(self.published, target)

    @cached_property
    def _writes(self) -> list[tuple[int, float, Target]]:
        """(parameter, multiplier, target) in the order they must be done; several targets keep their proportions."""
        lasting = []
        for j, parameter in enumerate(self.parameters):
            targets = [self.bind(t) for t in parameter.targets]
            lasting += [(j, target.value / targets[0].value, target) for target in targets]
        return sorted(lasting, key=lambda item: item[2].order)

    @property
    def needs_constants(self) -> bool:
        """Whether MuJoCo's derived constants depend on any of the parameters."""
        return any(target.constants for _, _, target in self._writes)

    def write(self, model: mujoco.MjModel, values: FloatArray, log: str | None = None) -> bool:
        """Write all targets of the parameters; see ``Environment.write``."""
        physical = True
        for j, multiplier, target in self._writes:
            value = multiplier * float(values[j])
            if math.isclose(value, target.value, rel_tol=1e-15):
                value = target.value  # theta = 0.5 is the published model to the last bit
            physical &= value >= target.minimum
            target.write(model, value)
        return physical

    def theta(self, variant: str) -> FloatArray:
        """Theta (N,) of a variant; raises ValueError for an unknown one."""
        if variant not in VARIANTS:
            raise ValueError(f"variant: no {variant!r}; expected one of {', '.join(VARIANTS)}")
        n = len(self.parameters)
        if variant == "default":
            return np.full(n, 0.5)
        rng = np.random.default_rng(zlib.crc32(f"{self.name}/{variant}".encode()))
        sign, distances = rng.choice((-1.0, 1.0), n), _VARIANT_DISTANCES[variant]
        if variant == "in_distribution":
            return 0.5 + sign * rng.uniform(*distances, n)
        sign = sign if self.outside_sign is None else np.array(self.outside_sign, float)
        return 0.5 + sign * (0.5 + rng.uniform(*distances, n))

    def states(self, qpos: FloatArray, qvel: FloatArray) -> FloatArray:
        """States at time 0, activations and memory zero.

        Args:
            qpos: (B, nq).
            qvel: (B, nv).

        Returns:
            (B, S).
        """
        model, count = self.published, len(qpos)
        rest = np.zeros((count, model.na + model.nhistory + self.memory_size))
        return np.concatenate([np.zeros((count, 1)), qpos, qvel, rest], axis=1)

    def __getstate__(self) -> dict[str, object]:
        return {f.name: getattr(self, f.name) for f in fields(self)}

    def __setstate__(self, state: dict[str, object]) -> None:
        self.__dict__.update(state)


def scaled(
    name: str, default: float, targets: Sequence[str], unit: str, description: str, low: float = 0.5, high: float = 1.5
) -> Parameter:
    """A parameter whose published value is theta = 0.5.

    Args:
        name: its name.
        default: the published value.
        targets: what it writes.
        unit: of the value.
        description: what it does to the motion, and what it trades off against.
        low: lower bound, times the published value.
        high: upper bound, times the published value.
    """
    return Parameter(
        name, low * default, high * default, default, unit, targets=tuple(targets), description=description
    )
