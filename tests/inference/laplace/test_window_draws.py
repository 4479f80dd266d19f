"""Several optima that share the posterior: draws around each, against a grid."""

from __future__ import annotations

import numpy as np
import torch

import sipe_bayes as sipe
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.inference.laplace import Laplace

SD, SEEN = 0.15, np.array([0.3, 0.6])
VALLEY = np.log(1.9) / 1.5


def outputs(values: FloatArray) -> FloatArray:
    """Of (B, 2): the first tells how far p is from the valley, not on which side."""
    first, second = values.T
    return np.stack([(np.exp(1.5 * first) - 1.9) ** 2, 0.3 * first + second], axis=1)


def test_two_skewed_optima_are_those_of_a_grid() -> None:
    """Mass on one side, and quantiles, in the mean of eight fits.

    Some 100 effective draws a fit: their sds in the mean are .012 for the mass and .004 to .01 for the quantiles. The
    two normals alone put the 5 % quantile at .06 in place of .12.
    """
    axis = np.linspace(0, 1, 1001)
    both = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1)
    off = ((outputs(both.reshape(-1, 2)) - SEEN) / SD).reshape(*both.shape)
    density = np.exp(-0.5 * np.square(off).sum(-1)).sum(1)
    density /= density.sum()
    levels, seen = [0.05, 0.5, 0.95], []
    exact = [density[axis < VALLEY].sum(), *np.interp(levels, np.cumsum(density), axis)]
    space = sipe.ParameterSpace([sipe.Parameter("p", 0.0, 1.0), sipe.Parameter("q", 0.0, 1.0)])
    simulator = sipe.CallableSimulator(outputs, space, likelihood=SD)
    for seed in range(8):
        estimator = Laplace(simulator, seed=seed)
        posterior = estimator.fit(SEEN)
        assert not estimator.findings.blocking
        drawn = posterior.sample((4000,), generator=torch.Generator().manual_seed(seed)).numpy()[:, 0]
        seen.append([(drawn < VALLEY).mean(), *np.quantile(drawn, levels)])
    print(np.mean(seen, axis=0), exact, np.std(seen, axis=0))
    assert (np.abs(np.mean(seen, axis=0) - exact) < [0.045, 0.02, 0.035, 0.02]).all()
