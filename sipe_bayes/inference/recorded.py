"""What an estimator takes as recorded, and what tells recordings apart."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Protocol, TypeAlias

import numpy as np
import torch

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.core.trajectory import Trajectories, Trajectory

if TYPE_CHECKING:
    from sipe_bayes.envs.task import Task
    from sipe_bayes.posterior import Posterior
    from sipe_bayes.simulation.simulator import Simulator

Progress = Callable[[str, int, int], None]
"""Called with (what is being done, rollouts so far, budget)."""


class GymnasiumEnvironment(Protocol):
    """What ``sipe.make`` returns, wrapped or not."""

    @property
    def unwrapped(self) -> object:
        """The environment without its wrappers."""


Observed = FloatArray | Iterable[float]
Recorded: TypeAlias = (
    "Trajectory | Iterable[Trajectory] | Trajectories | Observed | str | Task | Simulator | GymnasiumEnvironment"
)
"""One or several trajectories, what a function was observed to give, or an environment: a task's name, a Task, a
Simulator of one, ``sipe.make(...)``."""


def digest(trajectories: Trajectories) -> str:
    """SHA-256 of what was recorded: the same trajectories have the same, others another."""
    hashed = hashlib.sha256()
    states = np.empty(0) if trajectories.states is None else trajectories.states
    for array in (trajectories.observations, trajectories.actions, trajectories.dt, trajectories.length, states):
        hashed.update(np.ascontiguousarray(array).tobytes())
    return hashed.hexdigest()


def at_bounds(posterior: Posterior, prior: Posterior) -> list[str]:
    """Names of parameters that are known and lie at a bound."""
    middle = posterior.quantile(torch.tensor([0.5], dtype=torch.float64))[0].numpy()
    narrow = posterior.stddev.numpy() <= (1 - THRESHOLDS.not_determined) * prior.stddev.numpy()
    near = np.minimum(middle, 1 - middle) < THRESHOLDS.at_bound
    return list(np.array(posterior.space.names)[narrow & near].tolist())
