"""The snooker move keeps a density that is known, by itself and beside a bound."""

from __future__ import annotations

import emcee
import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.posterior.snooker import SnookerMove

COVARIANCE = np.array([[1.0, 0.8, 0.3], [0.8, 2.0, 0.1], [0.3, 0.1, 0.5]])
PRECISION = np.linalg.inv(COVARIANCE)
WALKERS, STEPS = 64, 1600


def chain(bounded: bool) -> FloatArray:
    """Draws of a normal of three dimensions, or of its half with a positive first one."""

    def log_density(x: FloatArray) -> FloatArray:
        level = -0.5 * np.einsum("wi,ij,wj->w", x, PRECISION, x)
        return np.where((x[:, 0] < 0) & bounded, -np.inf, level)

    start = np.random.default_rng(0).multivariate_normal(np.zeros(3), COVARIANCE, WALKERS)
    start[:, 0] = np.abs(start[:, 0])
    state = emcee.State(start, random_state=np.random.RandomState(1).get_state())
    sampler = emcee.EnsembleSampler(WALKERS, 3, log_density, vectorize=True, moves=[(SnookerMove(), 1.0)])
    sampler.run_mcmc(state, STEPS)
    draws: FloatArray = sampler.get_chain(discard=200)
    return draws


def test_a_normals_covariance_is_kept() -> None:
    """Within 5 of the standard errors that 20 batches of the chain give: a false alarm in 100,000."""
    parts = np.array([np.cov(batch.reshape(-1, 3).T) for batch in np.array_split(chain(False), 20)])
    error = parts.std(0, ddof=1) / np.sqrt(len(parts))
    print(parts.mean(0), error)
    assert error.max() < 0.05
    assert (np.abs(parts.mean(0) - COVARIANCE) < 5 * error).all()


def test_a_bound_is_kept() -> None:
    """A half-normal of sd 1 has the mean sqrt(2 / pi)."""
    parts = np.array([batch[..., 0].mean() for batch in np.array_split(chain(True), 20)])
    error = parts.std(ddof=1) / np.sqrt(len(parts))
    print(parts.mean(), error)
    assert error < 0.03
    assert abs(parts.mean() - np.sqrt(2 / np.pi)) < 5 * error
