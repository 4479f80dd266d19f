"""How much each parameter of a task moves what is observed, and what changes nothing.

From the same starts and under the same random actions, a parameter's value is changed by 10 % while the others stay at
theta = 0.5; its sensitivity is the root-mean-square change of the observations, each in units of its own spread over
the undisturbed episodes (at least 0.001 of its unit) and at most 1, so that a channel that hardly varies does not drown
the others. What random actions never touch, such as an object out of reach, counts as changing nothing. Episodes are
short, since a contact-rich simulation multiplies any change in the long run.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sipe_bayes.core.arrays import BoolArray, FloatArray
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.envs.task import Task
from sipe_bayes.simulation.simulator import Simulator

LEVELS = (0.0, 0.25, 0.5, 0.75, 1.0)  # of theta
_CHANGE = 0.1  # of the value: large against rounding, small against what is not linear
_EPISODES, _STEPS = 8, 25  # short: contacts multiply any change in the long run
_LEAST_SPREAD = 1e-3  # m, rad, m/s, N, ...


@dataclass(frozen=True)
class Sensitivity:
    """How much each parameter moves what is observed.

    Args:
        moved: (5, N) at theta = LEVELS the change of the observations that a 10 % change of each parameter makes, in
            units of their spread.
        names: (N,) of the parameters.
    """

    moved: FloatArray
    names: tuple[str, ...]

    @property
    def dead(self) -> list[str]:
        """Parameters that change nothing, in words."""
        return [
            name
            for name, column in zip(self.names, self.moved.T, strict=True)
            if (column < THRESHOLDS.sensitivity).all()
        ]

    @property
    def dead_ranges(self) -> dict[str, list[float]]:
        """For parameters that matter elsewhere: the levels of theta at which they change nothing."""
        dead = {}
        for name, column in zip(self.names, self.moved.T, strict=True):
            if (column < THRESHOLDS.sensitivity).any() and not (column < THRESHOLDS.sensitivity).all():
                dead[name] = [
                    level for level, moved in zip(LEVELS, column, strict=True) if moved < THRESHOLDS.sensitivity
                ]
        return dead


def sensitivity(simulator: Simulator, seed: int = 0) -> Sensitivity:
    """Measure a task's sensitivities by 2 N x 5 x 8 short rollouts.

    Args:
        simulator: of a task.
        seed: of starts and actions.

    Raises:
        ValueError: for an environment without starting states.
    """
    task = simulator.environment
    if not isinstance(task, Task):
        raise ValueError(f"sensitivity: expected a task of `sipe envs`, got {type(task).__name__}")
    rng = np.random.default_rng(seed)
    n, steps = len(task.space), min(_STEPS, task.episode_steps)
    starts, goals = task.initial_states(rng, _EPISODES)
    actions = rng.uniform(task.action_low, task.action_high, (_EPISODES, steps, task.num_actions))

    def observe(theta: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Observations (L, episodes, steps, O) of theta (L, N) and where they are valid."""
        batch = np.repeat(theta, _EPISODES, axis=0)
        tile = len(theta)
        targets = None if goals is None else np.tile(goals, (tile, 1))
        motion = simulator.rollout(
            batch, np.tile(actions, (tile, 1, 1)), np.tile(starts, (tile, 1)), goals=targets, allow_outside=True
        )
        shape = (tile, _EPISODES, steps + 1)
        return motion.observations.reshape(*shape, -1)[:, :, 1:], motion.valid.reshape(shape)[:, :, 1:]

    middle, _ = observe(np.full((1, n), 0.5))
    spread = np.maximum(middle[0].std(axis=(0, 1)), _LEAST_SPREAD)
    moved = np.empty((len(LEVELS), n))
    for row, level in enumerate(LEVELS):
        given, changed = np.full((n, n), 0.5), np.full((n, n), 0.5)
        for j, parameter in enumerate(task.space):
            given[j, j] = level
            sign = -1.0 if level == LEVELS[-1] else 1.0
            changed[j, j] = parameter.normalise(float(parameter.value(level)) * (1 + sign * _CHANGE))
        (a, good_a), (b, good_b) = observe(given), observe(changed)
        change = np.minimum(np.abs(b - a) / spread, 1.0)
        change = np.where((good_a & good_b)[..., None], change, np.nan)
        moved[row] = np.sqrt(np.nanmean(change**2, axis=(1, 2, 3)))
    return Sensitivity(moved, task.space.names)
