"""The noise of windows: what of it is given or free, and its estimates along a search."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sipe_bayes.inference.laplace.least_squares import FLAT_PRECISION, QuadraticPrior
from sipe_bayes.likelihood.moments import Moments
from sipe_bayes.likelihood.noise import Noise
from sipe_bayes.likelihood.restricted import Pulls, eliminate_starts, estimate_noise
from sipe_bayes.likelihood.state_space.chain import Chain
from sipe_bayes.likelihood.windows import Windows

FloatArray = NDArray[np.float64]

_SAME_NOISE = 0.03  # relative


def pulls(windows: Windows, prior: QuadraticPrior, theta: FloatArray, starts: FloatArray, force: FloatArray) -> Pulls:
    """Prior and bounds at (theta, starts); ``force`` (N,): the data's pull on theta, which holds it at a bound."""
    flat = FLAT_PRECISION * np.eye(len(theta))
    total = force + prior.pull(theta)
    held = ((theta <= 0) & (total < 0)) | ((theta >= 1) & (total > 0))
    return Pulls(
        prior.precision + flat,
        prior.pull(theta),
        windows.start_precision,
        -windows.start_precision * starts,
        ~held,
    )


def present_noise(windows: Windows, residual: FloatArray) -> Noise:
    """White noise with the root-mean-square of a residual (W, L, C), or the given sds."""
    fixed, counts = windows.fixed_sd, windows.observed.sum(axis=(0, 1))
    size = np.sqrt((residual**2).sum(axis=(0, 1)) / np.maximum(counts, 1))
    return Noise(np.where(np.isnan(fixed), np.maximum(size, windows.rounding), fixed), np.zeros(len(size)))


def noise_at_least(windows: Windows, noise: Noise, residuals: FloatArray) -> Noise:
    """The noise with sds no less than the root-mean-squares of residuals (B, W, L, C) of as good points, the given ones kept."""
    if not len(residuals):
        return noise
    size = np.max([present_noise(windows, r).sd ** 2 for r in residuals], axis=0) ** 0.5
    return Noise(np.where(np.isnan(windows.fixed_sd), np.maximum(noise.sd, size), noise.sd), noise.tau)


def updated_noise(
    windows: Windows,
    moments: Moments,
    before: Noise,
    theta: FloatArray,
    starts: FloatArray,
    prior: QuadraticPrior,
    coloured: bool,
) -> Noise:
    start_pull = -windows.start_precision * starts
    solved = eliminate_starts(moments.normal(before), moments.num_theta, windows.start_precision, start_pull)
    context = pulls(windows, prior, theta, starts, solved.gradient)
    shortest, longest = float(windows.dt.min()), windows.trajectories.longest
    found = estimate_noise(moments, before, context, windows.fixed_sd, coloured, shortest, longest)
    sd = np.where(np.isnan(windows.fixed_sd), np.maximum(found.sd, windows.rounding), found.sd)
    return Noise(sd, found.tau)


def beyond_rounding(windows: Windows, noise: Noise) -> Noise:
    """The noise with channels at the least sd, the simulation's rounding, as if they were one sample."""
    least, counts = windows.rounding * (1 + _SAME_NOISE), windows.observed.sum(axis=(0, 1))
    least = np.where(np.isnan(windows.fixed_sd), least, 0.0)
    return Noise(np.where(noise.sd <= least, noise.sd * np.sqrt(np.maximum(counts, 1)), noise.sd), noise.tau)


def free_noise(windows: Windows) -> NDArray[np.int64]:
    """Which of (log sd (C), log tau (C)) are unknown; none of a chain of states, whose noise stays at its optimum."""
    if isinstance(windows, Chain):
        return np.empty(0, int)
    free = np.isnan(windows.fixed_sd)
    return np.flatnonzero(np.concatenate([free, np.full(len(free), windows.settings.noise != "white")]))


def same_noise(a: Noise, b: Noise) -> bool:
    return bool(np.allclose(a.sd, b.sd, rtol=_SAME_NOISE) and np.allclose(a.tau, b.tau, rtol=3 * _SAME_NOISE))
