"""Any simulator that is a Python function, for the estimators that learn from simulations of the prior."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sipe_bayes.parameters import ParameterSpace
from sipe_bayes.trajectory import Trajectories

FloatArray = NDArray[np.float64]
Function = Callable[[FloatArray, FloatArray, np.random.Generator], FloatArray]


@dataclass(frozen=True)
class FunctionEnvironment:
    """What a FunctionSimulator observes and takes: names of the O channels, number A of actions."""

    channels: tuple[str, ...]
    num_actions: int


class FunctionSimulator:
    """``function(values (B, N), actions (B, T, A), rng) -> observations (B, T+1, O)``, NaN where a simulation failed.

    values are physical, rng is its only source of randomness: drawn anew for every batch from ``seed`` and the batch, so that
    the same theta give the same observations. name: of the function and its settings, told apart in caches and
    checkpoints. For ``npe``, ``bayessim``, ``abc``, ``maml`` and ``regression``; it has no states, so it starts as the
    function does.
    """

    def __init__(
        self,
        function: Function,
        space: ParameterSpace,
        channels: Sequence[str],
        num_actions: int = 0,
        *,
        name: str,
        seed: int = 0,
    ) -> None:
        self.function, self.space, self.name, self.seed = function, space, name, seed
        self.environment = FunctionEnvironment(tuple(channels), num_actions)

    def checksum(self) -> str:
        """SHA-256 of the name, channels and seed: a changed function wants another name."""
        plain = (self.name, self.environment.channels, self.environment.num_actions, self.seed)
        return hashlib.sha256(repr(plain).encode()).hexdigest()

    def first_states(self, trajectories: Trajectories) -> FloatArray:
        """No states (R, 0)."""
        return np.empty((len(trajectories), 0))

    def replay(self, theta: FloatArray, trajectories: Trajectories, starts: Any = None) -> Trajectories:
        """As ``Simulator.replay``: the recorded actions for every theta (B, N)."""
        theta, count = np.atleast_2d(np.asarray(theta, float)), len(trajectories)
        values = np.repeat(self.space.values(theta), count, axis=0)
        actions = np.tile(trajectories.actions, (len(theta), 1, 1))
        digest = hashlib.sha256(np.ascontiguousarray(theta).tobytes()).digest()[:8]
        rng = np.random.default_rng([self.seed, int.from_bytes(digest, "little")])
        observations = np.asarray(self.function(values, actions, rng), float)
        expected = (len(values), actions.shape[1] + 1, len(self.environment.channels))
        if observations.shape != expected:
            raise ValueError(f"function {self.name!r}: expected observations {expected}, got {observations.shape}")
        length = np.tile(trajectories.length, len(theta))
        inside = np.arange(expected[1]) <= length[:, None]
        valid = np.logical_and.accumulate(np.isfinite(observations).all(-1) | ~inside, axis=1) & inside
        return Trajectories(
            np.where(inside[..., None], observations, np.nan),
            actions,
            np.tile(trajectories.dt, len(theta)),
            length,
            valid,
            None,
            tuple(trajectories.names) * len(theta),
            self.environment.channels,
        )
