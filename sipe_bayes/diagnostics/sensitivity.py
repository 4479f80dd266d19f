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
from sipe_bayes.core.options import Options, option
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.diagnostics.identifiability import GRID
from sipe_bayes.envs.task import Task
from sipe_bayes.simulation.simulator import Simulator


@dataclass(frozen=True)
class SensitivityOptions(Options):
    """The episodes in which parameters are changed."""

    change: float = option(0.1, "large against rounding, small against what is not linear", "of the value", above=0)
    episodes: int = option(8, "starts and random actions", least=1)
    steps: int = option(25, "of an episode: contacts multiply any change in the long run", least=1)
    least_spread: float = option(1e-3, "of a channel that hardly varies", "m, rad, m/s, N, ...", above=0)


_OPTIONS = SensitivityOptions()


@dataclass(frozen=True)
class Sensitivity:
    """How much each parameter moves what is observed.

    Args:
        moved: (5, N) at theta = GRID the change of the observations that a 10 % change of each parameter makes, in
            units of their spread.
        names: (N,) of the parameters.
    """

    moved: FloatArray
    names: tuple[str, ...]

    @property
    def dead(self) -> list[str]:
        """Parameters that change nothing, in words."""
        columns = zip(self.names, THRESHOLDS.sensitivity > self.moved.T, strict=True)
        return [name for name, idle in columns if idle.all()]

    @property
    def dead_ranges(self) -> dict[str, list[float]]:
        """For parameters that matter elsewhere: the levels of theta at which they change nothing."""
        columns = zip(self.names, THRESHOLDS.sensitivity > self.moved.T, strict=True)
        levels = np.array(GRID)
        return {name: levels[idle].tolist() for name, idle in columns if idle.any() and not idle.all()}


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
    n, steps = len(task.space), min(_OPTIONS.steps, task.episode_steps)
    starts, goals = task.initial_states(rng, _OPTIONS.episodes)
    actions = rng.uniform(task.action_low, task.action_high, (_OPTIONS.episodes, steps, task.num_actions))

    def observe(theta: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Observations (L, episodes, steps, O) of theta (L, N) and where they are valid."""
        batch = np.repeat(theta, _OPTIONS.episodes, axis=0)
        tile = len(theta)
        targets = None if goals is None else np.tile(goals, (tile, 1))
        motion = simulator.rollout(
            batch, np.tile(actions, (tile, 1, 1)), np.tile(starts, (tile, 1)), goals=targets, allow_outside=True
        )
        shape = (tile, _OPTIONS.episodes, steps + 1)
        return motion.observations.reshape(*shape, -1)[:, :, 1:], motion.valid.reshape(shape)[:, :, 1:]

    middle, _ = observe(np.full((1, n), 0.5))
    spread = np.maximum(middle[0].std(axis=(0, 1)), _OPTIONS.least_spread)
    moved = np.empty((len(GRID), n))
    for row, level in enumerate(GRID):
        given, changed = np.full((n, n), 0.5), np.full((n, n), 0.5)
        for j, parameter in enumerate(task.space):
            given[j, j] = level
            sign = -1.0 if level == GRID[-1] else 1.0
            changed[j, j] = parameter.normalise(float(parameter.value(level)) * (1 + sign * _OPTIONS.change))
        (a, good_a), (b, good_b) = observe(given), observe(changed)
        change = np.minimum(np.abs(b - a) / spread, 1.0)
        change = np.where((good_a & good_b)[..., None], change, np.nan)
        moved[row] = np.sqrt(np.nanmean(change**2, axis=(1, 2, 3)))
    return Sensitivity(moved, task.space.names)
