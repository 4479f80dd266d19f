"""Two sums of two parameters with normal noise, whose posterior a grid gives."""

from __future__ import annotations

import numpy as np
import torch
from scipy import stats

import sipe_bayes as sipe
from sipe_bayes.core.parameters import Parameter, ParameterSpace
from sipe_bayes.likelihood import Segments
from sipe_bayes.posterior import IndependentPrior
from sipe_bayes.simulation.callable_simulator import CallableSimulator

SD = 0.08  # of the noise, theta units
QUIET = Segments(noise_sd=(0.0, 0.0))  # the function makes its own noise
SPACE = ParameterSpace([Parameter("a", 0.0, 1.0), Parameter("b", 0.0, 1.0)])


def linear() -> CallableSimulator:
    """``x = (a, (a + b) / 2)`` plus normal noise of sd 0.08."""

    def function(values: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        return np.stack([values[:, 0], values.mean(1)], axis=1) + SD * rng.standard_normal(values.shape)

    return CallableSimulator(function, SPACE, name="linear")


def seen(x: float, y: float) -> sipe.Trajectory:
    return sipe.Trajectory(np.array([[0.0, 0.0], [x, y]]), np.zeros((1, 0)), 1.0)


def exact(x: float, y: float, prior: IndependentPrior | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Mean and sd (2,) of the posterior, by a fine grid."""
    grid = (np.arange(600) + 0.5) / 600
    a, b = np.meshgrid(grid, grid, indexing="ij")
    density = stats.norm.pdf(x, a, SD) * stats.norm.pdf(y, (a + b) / 2, SD)
    if prior is not None:
        density *= prior.log_prob(torch.from_numpy(np.stack([a, b], -1))).exp().numpy()
    density /= density.sum()
    mean = np.array([(density * a).sum(), (density * b).sum()])
    return mean, np.sqrt(np.array([(density * a**2).sum(), (density * b**2).sum()]) - mean**2)
