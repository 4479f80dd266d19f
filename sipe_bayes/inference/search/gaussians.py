"""Gaussians over theta: draws restricted to the cube, log density, and the relative entropy of two."""

from __future__ import annotations

import numpy as np
from scipy.linalg import solve_triangular

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.posterior.truncated_normal import interval_quantile

LEAST_VARIANCE = 1e-10  # of a search's Gaussian: sd 1e-5 of the range, a tenth of where a search has converged


def draw_in_cube(
    mean: FloatArray, covariance: FloatArray, count: int, random: np.random.Generator, sweeps: int = 10
) -> FloatArray:
    """Draws of a Gaussian restricted to the unit cube.

    Draws inside stay; the others walk into it by Gibbs sampling, one coordinate after another from its truncated
    conditional.

    Args:
        mean: (N,), inside the cube or not.
        covariance: (N, N), positive definite.
        count: how many.
        random: the generator.
        sweeps: of Gibbs sampling.

    Returns:
        Draws (count, N).
    """
    factor = np.linalg.cholesky(covariance)
    theta = mean + random.standard_normal((count, len(mean))) @ factor.T
    out = ((theta < 0) | (theta > 1)).any(1)
    inside = np.clip(theta[out], 0.0, 1.0)
    precision = np.linalg.inv(covariance)
    sd = np.diag(precision) ** -0.5
    for u in random.uniform(size=(sweeps, len(mean), len(inside))) if len(inside) else ():
        for j in range(len(mean)):
            centre = inside[:, j] - (inside - mean) @ precision[j] * sd[j] ** 2
            drawn = centre + sd[j] * interval_quantile(-centre / sd[j], (1 - centre) / sd[j], u[j])
            inside[:, j] = np.clip(drawn, 0.0, 1.0)
    theta[out] = inside
    return theta


def log_normal(theta: FloatArray, mean: FloatArray, covariance: FloatArray) -> FloatArray:
    """Log density (n,) of the untruncated Gaussian at theta (n, N)."""
    factor = np.linalg.cholesky(covariance)
    white = solve_triangular(factor, (theta - mean).T, lower=True)
    return -0.5 * (white**2).sum(0) - np.log(np.diag(factor)).sum() - 0.5 * len(mean) * np.log(2 * np.pi)


def gaussian_kl(mean: FloatArray, covariance: FloatArray, old_mean: FloatArray, old_covariance: FloatArray) -> float:
    """KL(new || old) of two untruncated Gaussians, in nats."""
    factor = np.linalg.cholesky(old_covariance)
    white = solve_triangular(factor, np.linalg.cholesky(covariance), lower=True)
    shift = solve_triangular(factor, mean - old_mean, lower=True)
    log_ratio = np.log(np.abs(np.diag(white))).sum()
    return float(0.5 * ((white**2).sum() + shift @ shift - len(mean)) - log_ratio)
