"""The recorded trajectory that a cell of the benchmark is given, and which parameters it determines.

A trajectory is what ``sipe.demonstrations`` gives: an expert's, or an excitation policy's where no expert is installed;
noise-free, with recorded states. It depends on task, variant, seed, length and split alone, so every estimator gets the
same one.

A parameter counts as determined where the Fisher information of the trajectory's control steps at the truth, under
noise of 0.1 % of each channel's spread, leaves less than half of the prior's sd, whatever the methods say.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from sipe_bayes.core.arrays import BoolArray, FloatArray
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.datasets.acting import Split
from sipe_bayes.datasets.demonstrations import NoAgentWarning, demonstrations
from sipe_bayes.envs.registry import make_task
from sipe_bayes.envs.task import Variant
from sipe_bayes.likelihood import Segments, bind
from sipe_bayes.posterior import prior
from sipe_bayes.simulation.simulator import Simulator

_NOISE = 1e-3  # assumed of noise-free logs, of each channel's spread


@dataclass(frozen=True)
class Log:
    """What a cell is given, and what it is scored by.

    Args:
        truth: theta (N,).
        trajectories: one.
        determined: (N,); None out of distribution.
        source: "expert" or "excitation".
    """

    truth: FloatArray
    trajectories: Trajectories
    determined: BoolArray | None
    source: str


@lru_cache(maxsize=4)
def recorded(task: str, variant: Variant, seed: int, steps: int, split: Split = "reference") -> Log:
    """The log of a task's variant.

    Args:
        task: of ``sipe envs``.
        variant: whose theta is the truth.
        seed: of the trajectory.
        steps: its control steps.
        split: of the trajectories.
    """
    made = make_task(task)
    simulator = Simulator(made, num_threads=1)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        trajectories = demonstrations(simulator, split=split, variant=variant, count=1, seed=seed, steps=steps)
    source = "excitation" if any(issubclass(w.category, NoAgentWarning) for w in caught) else "expert"
    truth = made.theta(variant)
    inside = bool(((truth >= 0) & (truth <= 1)).all())
    return Log(truth, trajectories, determined(simulator, truth, trajectories) if inside else None, source)


def one_step(simulator: Simulator) -> Segments:
    """Windows of one control step from recorded states."""
    return Segments(simulator.dt, noise="white", starts="recorded")


def determined(simulator: Simulator, truth: FloatArray, trajectories: Trajectories) -> BoolArray:
    """Which parameters (N,) trajectories determine; see the module.

    Args:
        simulator: of the task.
        truth: theta (N,).
        trajectories: with recorded states.
    """
    windows = bind(one_step(simulator), simulator, trajectories)
    jacobian = windows.linearise(truth, windows.no_starts()).jacobian
    spread = np.concatenate([t.observations for t in trajectories]).std(0)
    sd = _NOISE * np.maximum(spread, _NOISE * np.median(spread[spread > 0]))
    rows = (jacobian / sd[:, None]).reshape(-1, len(truth))
    before = prior(simulator.space)
    information = rows.T @ rows + np.diag(1 / before.variance.numpy())
    left = np.sqrt(np.diag(np.linalg.inv(information)))
    return np.asarray(left < THRESHOLDS.task_determines * before.stddev.numpy())
