"""Replay buffer with hindsight, for environments that are stepped together.

A ring of rows, one for each control step, with a column for each environment; an observation is stored once, as the
next row holds what followed. The row of an episode's last observation holds no transition and is passed over when
sampling.

Hindsight, strategy "future" with k = 4 (Andrychowicz et al., "Hindsight Experience Replay", 2017,
https://arxiv.org/abs/1707.01495): k of every k + 1 transitions sampled get the goal that was reached at a later,
uniformly drawn sample of their own episode, and the reward that the task gives for it. It is done when sampling, with
probability k / (k + 1), and an episode that still runs counts as far as it has come: both deviations from the paper,
which stores the k copies once an episode is over.

Returns over n steps (Sutton, "Learning to Predict by the Methods of Temporal Differences", 1988,
https://doi.org/10.1007/BF00115009) are summed when sampling, too, and stop at an episode's end. They are not corrected
for the policy having changed since.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sipe_bayes.core.arrays import FloatArray, IntArray
from sipe_bayes.core.files import LineError, read_arrays, reading, replacing
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.simulation.episodes import Step

GoalReward = Callable[[FloatArray, FloatArray], FloatArray]
"""Rewards (...,) of achieved and desired goals (..., G)."""

_DRAWS = 100  # times that places are drawn anew before a buffer counts as empty
_STORED = ("observations", "actions", "rewards", "terminated", "transition", "ends", "achieved")


class ReplayError(LineError):
    """A replay buffer's file that cannot be used."""


@dataclass(frozen=True)
class Batch:
    """Transitions to learn from, in float32 where they are learnt from.

    Args:
        observations: (B, O).
        actions: (B, A).
        returns: of the steps up to the next observations (B,).
        discounts: of the value of the next observation (B,): 0 where the episode terminated.
        next_observations: (B, O).
    """

    observations: Tensor
    actions: Tensor
    returns: Tensor
    discounts: Tensor
    next_observations: Tensor


class Replay:
    """The last steps, in float32.

    Args:
        observation_size: O.
        action_size: A.
        capacity: steps, of all environments together.
        num_envs: L.
        discount: of a reward one step later.
        n_step: steps that a return sums.
        goal_size: G; the desired goal is the observation's last numbers.
        hindsight: k, 0 for none.
        goal_reward: what the task gives for a goal.
        device: torch's name of where observations, actions and rewards lie.

    Raises:
        ValueError: for a capacity without room, or hindsight without goals.
    """

    def __init__(
        self,
        observation_size: int,
        action_size: int,
        capacity: int,
        num_envs: int = 1,
        discount: float = 0.99,
        n_step: int = 1,
        goal_size: int = 0,
        hindsight: int = 0,
        goal_reward: GoalReward | None = None,
        device: str = "cpu",
    ) -> None:
        if capacity < 2 * num_envs:
            raise ValueError(f"capacity: expected at least 2 steps for each of {num_envs} environments, got {capacity}")
        if hindsight and (goal_reward is None or not goal_size):
            raise ValueError(f"hindsight: expected 0 for a task without goals, got {hindsight}")
        self.rows, self.num_envs, self.goal_size = capacity // num_envs, num_envs, goal_size
        self.discount, self.n_step, self.hindsight, self._goal_reward = discount, n_step, hindsight, goal_reward
        self._device, shape = device, (self.rows, num_envs)
        self.observations, self.actions, self.rewards, self.achieved = (
            torch.from_numpy(np.zeros((*shape, *more), np.float32)).to(device)  # NumPy takes memory as it is filled
            for more in ((observation_size,), (action_size,), (), (goal_size,))
        )
        self.terminated, self.transition = np.zeros(shape, bool), np.zeros(shape, bool)
        self.ends = np.full(shape, -1)  # the step of the episode's last observation; -1 while it runs
        self.head = 0  # the step of the newest observation, of which nothing followed yet
        self._starts, self._over = np.zeros(num_envs, int), np.zeros(num_envs, bool)

    def __len__(self) -> int:
        """Transitions that may be sampled."""
        return int(self.transition.sum())

    def begin(self, step: Step) -> None:
        """The first observations of all environments; what was stored is forgotten."""
        self.head, self._starts[:], self._over[:] = 0, 0, False
        self.transition[:] = False
        self._observe(step.observations, step.achieved_goals)

    def add(self, actions: FloatArray, step: Step) -> None:
        """What actions led to; environments whose episode was over have begun a new one instead.

        Args:
            actions: (L, A).
            step: what followed.
        """
        row = self.head % self.rows
        self._keep(self.actions, row, actions)
        self._keep(self.rewards, row, step.rewards)
        self.terminated[row], self.transition[row] = step.terminated, step.valid & ~self._over
        ended = (step.terminated | step.truncated) & ~self._over
        for env in np.flatnonzero(ended):
            passed = np.arange(max(self._starts[env], self.head - self.rows + 1), self.head + 1)
            self.ends[passed % self.rows, env] = self.head + bool(step.valid[env])
        self._starts[self._over] = self.head + 1
        self._over = ended
        self.head += 1
        self._observe(step.observations, step.achieved_goals)

    def add_trajectories(self, trajectories: Trajectories, achieved: FloatArray | None = None) -> None:
        """Fill an empty buffer, one column for each trajectory, as far as that is valid.

        Args:
            trajectories: B of them, with rewards.
            achieved: (B, T+1, G) where there are goals.

        Raises:
            ValueError: for trajectories without rewards, or for which there is no room.
        """
        batch, horizon = trajectories.actions.shape[:2]
        if batch != self.num_envs or horizon >= self.rows:
            raise ValueError(
                f"capacity: expected {batch} columns of more than {horizon} rows, got {self.num_envs} of {self.rows}"
            )
        if trajectories.rewards is None:
            raise ValueError("trajectories: expected rewards, got none; record them from a task")
        count = trajectories.valid.sum(1) - 1
        steps = np.arange(horizon)[:, None]
        after, before = slice(0, horizon + 1), slice(0, horizon)
        self._keep(self.observations, after, np.nan_to_num(trajectories.observations.swapaxes(0, 1)))
        self._keep(self.actions, before, trajectories.actions.swapaxes(0, 1))
        self._keep(self.rewards, before, trajectories.rewards.swapaxes(0, 1))
        if self.goal_size:
            self._keep(self.achieved, after, np.nan_to_num(np.asarray(achieved).swapaxes(0, 1)))
        self.transition[:horizon] = steps < count
        self.ends[:horizon] = np.where(steps < count, count, -1)
        self.head = horizon

    def sample(self, rng: np.random.Generator, count: int) -> Batch:
        """Transitions, drawn uniformly and with replacement.

        Args:
            rng: of the draws.
            count: how many.

        Raises:
            ValueError: where there are none.
        """
        # which transitions, and where their episodes end
        steps, envs = self._draw(rng, count)
        ends = self.ends[steps % self.rows, envs]
        ends = np.where(ends < 0, self.head, ends)
        last = np.minimum(steps + self.n_step, ends)  # the step at which the value of what follows is asked for
        observations, following = (self._at(self.observations, when, envs) for when in (steps, last))
        goals = None
        if self.hindsight:
            goals = self._relabel(rng, steps, envs, ends, observations, following)
        # sum the rewards up to there, those of other goals where hindsight has exchanged them
        returns, factor = torch.zeros(count, dtype=torch.float64, device=self._device), np.ones(count)
        for ahead in range(self.n_step):
            inside = steps + ahead < ends
            rewards = self._at(self.rewards, steps + ahead, envs)
            if goals is not None and self._goal_reward is not None:
                reached = self._at(self.achieved, steps + ahead + 1, envs)
                given: Any = (reached.cpu().numpy(), goals.cpu().numpy())  # single precision
                rewards = self._on_device(self._goal_reward(*given))
            returns += self._on_device(np.where(inside, factor, 0.0)) * rewards
            factor = np.where(inside, factor * self.discount, factor)
        factor *= ~self.terminated[(last - 1) % self.rows, envs]
        actions = self._at(self.actions, steps, envs)
        return Batch(observations, actions, returns.float(), self._on_device(factor).float(), following)

    def save(self, path: Path) -> None:
        """Write an npz file of what is filled, atomically."""
        used = min(self.head + 1, self.rows)
        filled = {name: torch.as_tensor(getattr(self, name)[:used]) for name in _STORED}
        arrays: dict[str, Any] = {name: part.cpu().numpy() for name, part in filled.items()}
        arrays |= {"head": np.array(self.head), "starts": self._starts, "over": self._over, "rows": np.array(self.rows)}
        with replacing(path) as temporary, temporary.open("wb") as file:
            np.savez(file, **arrays)

    def load(self, path: Path) -> None:
        """Read what ``save`` wrote into a buffer of the same shape; raises ReplayError for anything else."""
        with reading(path, "a whole replay buffer", "start training again", ReplayError):
            arrays: dict[str, Any] = read_arrays(path)
            head, rows = int(arrays["head"]), int(arrays["rows"])
            stored = {name: arrays[name] for name in _STORED}
            starts, over = arrays["starts"], arrays["over"]
            used = min(head + 1, self.rows)
            shapes = {name: (used, *getattr(self, name).shape[1:]) for name in _STORED}
            shapes |= {"starts": self._starts.shape, "over": self._over.shape}
            for name, expected in shapes.items():
                if rows != self.rows or arrays[name].shape != expected or arrays[name].dtype.kind not in "fiub":
                    raise ValueError(
                        f"{name}: expected {expected} of {self.rows} rows, got {arrays[name].shape} of {rows}"
                    )
        for name, value in stored.items():
            own = getattr(self, name)
            own[:used] = torch.from_numpy(value).to(self._device) if isinstance(own, Tensor) else value
        self.head, self._starts, self._over = head, starts.copy(), over.copy()

    def _observe(self, observations: FloatArray, achieved: FloatArray | None) -> None:
        row = self.head % self.rows
        self.transition[row], self.ends[row] = False, -1
        self._keep(self.observations, row, observations)
        if achieved is not None and self.goal_size:
            self._keep(self.achieved, row, achieved)

    def _keep(self, stored: Tensor, rows: int | slice, values: FloatArray) -> None:
        stored[rows].copy_(torch.from_numpy(values.astype(np.float32)))

    def _at(self, stored: Tensor, steps: IntArray, envs: IntArray) -> Tensor:
        """What is stored (n, ...) of steps (n,) of environments (n,)."""
        return stored.flatten(0, 1).index_select(0, self._on_device(steps % self.rows * self.num_envs + envs))

    def _on_device(self, array: NDArray[np.generic]) -> Tensor:
        return torch.from_numpy(array).to(self._device)

    def _draw(self, rng: np.random.Generator, count: int) -> tuple[IntArray, IntArray]:
        """Steps and columns (count,) of transitions: places are drawn anew until enough of them hold one."""
        oldest = max(0, self.head - self.rows + 1)
        held = (self.head - oldest) * self.num_envs
        drawn = np.empty(0, int)
        for _ in range(_DRAWS):
            places = rng.integers(held, size=count) if held else drawn
            rows, envs = (oldest + places // self.num_envs) % self.rows, places % self.num_envs
            drawn = np.concatenate([drawn, places[self.transition[rows, envs]]])
            if len(drawn) >= count:
                drawn = drawn[:count]
                return oldest + drawn // self.num_envs, drawn % self.num_envs
        raise ValueError("replay: holds no transitions to sample; add some first")

    def _relabel(
        self,
        rng: np.random.Generator,
        steps: IntArray,
        envs: IntArray,
        ends: IntArray,
        observations: Tensor,
        following: Tensor,
    ) -> Tensor:
        """Goals (B, G), most of them reached later, also written into the observations."""
        later = steps + 1 + (rng.random(len(steps)) * (ends - steps)).astype(int)
        chosen = rng.random(len(steps)) < self.hindsight / (self.hindsight + 1)
        reached = self._at(self.achieved, later, envs)
        goals = torch.where(self._on_device(chosen)[:, None], reached, observations[:, -self.goal_size :])
        observations[:, -self.goal_size :] = following[:, -self.goal_size :] = goals
        return goals
