"""What is made of the place where a search over windows ended: a normal in theta, its evidence, and what is around it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sipe_bayes.core.arrays import BoolArray, FloatArray
from sipe_bayes.inference.laplace.least_squares import energy_of
from sipe_bayes.inference.laplace.pattern_search import Surroundings, nearest_points, pattern_search, pattern_size
from sipe_bayes.inference.laplace.strategy import SearchProblem
from sipe_bayes.inference.laplace.window_noise import (
    beyond_rounding,
    free_noise,
    noise_at_least,
    pulls,
    updated_noise,
)
from sipe_bayes.inference.laplace.window_state import WindowOptimum
from sipe_bayes.likelihood.block_tridiagonal import Eliminated
from sipe_bayes.likelihood.moments import Moments
from sipe_bayes.likelihood.noise import Noise
from sipe_bayes.likelihood.noise_spread import noise_cloud, sandwich
from sipe_bayes.likelihood.restricted import eliminate_starts, restricted
from sipe_bayes.likelihood.windows import Windows

_RANK = 1e-12  # of the largest singular value: rounding
_RIDGE_TRIALS = np.array([0.0, 1.0, 0.5, 0.25])  # of the way to the middle of a ridge; the first is the optimum itself


@dataclass(frozen=True)
class Ending:
    """Where a search stood still: theta (N,), starts (W, D), noise, and the Jacobian (W, L, C, N + D) there with its
    moments."""

    theta: FloatArray
    starts: FloatArray
    noise: Noise
    moments: Moments
    jacobian: FloatArray


def summarised(problem: SearchProblem, windows: Windows, ending: Ending) -> WindowOptimum:
    """The normal over the noise's uncertainty, and the evidence."""
    theta, starts, noise, moments = ending.theta, ending.starts, ending.noise, ending.moments
    prior, start_pull, sandwiched = problem.quadratic_prior, -windows.start_precision * starts, sandwiches(windows)
    solved = eliminate_starts(moments.normal(noise), moments.num_theta, windows.start_precision, start_pull)
    here = pulls(windows, prior, theta, starts, solved.gradient)
    prior_energy = prior.energy(theta) + 0.5 * float((starts**2 @ windows.start_precision).sum())
    evidence = restricted(moments, noise, replace(here, free=np.full(len(theta), True))) - prior_energy
    white = noise.sd
    if sandwiched:
        noise = updated_noise(windows, moments, noise, theta, starts, prior, coloured=True)
    mean, covariance = np.zeros(len(theta)), np.zeros((len(theta), len(theta)))
    centres = []
    # moments of the normals of a few weighted noise values
    for weight, point in noise_cloud(moments, noise, here, free_noise(windows), windows.trajectories.longest):
        if sandwiched:
            middle = sandwich(ending.jacobian, solved.slope, white, windows.sequences, point)
            centre, spread = problem.normal(theta, *_sandwiched(solved, middle))
        else:
            point = beyond_rounding(windows, point)
            inner = eliminate_starts(moments.normal(point), moments.num_theta, windows.start_precision, start_pull)
            centre, spread = problem.normal(theta, inner.precision, inner.gradient)
        mean += weight * centre
        covariance += weight * spread
        centres.append((weight, centre))
    for weight, centre in centres:
        covariance += weight * np.outer(centre - mean, centre - mean)
    return WindowOptimum(
        theta=theta,
        mean=mean,
        covariance=covariance,
        evidence=evidence,
        sd=noise.sd,
        tau=noise.tau,
        starts=starts,
        slope=solved.slope,
        guessed=False,
        finding=None,
    )


def sandwiches(windows: Windows) -> bool:
    """Whether the width comes from other noise than the optimum."""
    return windows.settings.noise == "sandwich"


def _sandwiched(solved: Eliminated, middle: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Precision and gradient of plain least squares when the residuals' covariance gives ``middle`` (N, N)."""
    shift = np.linalg.pinv(solved.precision, rcond=_RANK, hermitian=True) @ solved.gradient
    precision = solved.precision @ np.linalg.pinv(middle, rcond=_RANK, hermitian=True) @ solved.precision
    # rounding leaves some of an open direction negative
    eigenvalues, axes = np.linalg.eigh(0.5 * (precision + precision.T))
    precision = (axes * np.maximum(eigenvalues, 0.0)) @ axes.T
    return precision, precision @ shift


def surroundings(
    problem: SearchProblem, windows: Windows, theta: FloatArray, noise: Noise, covariance: FloatArray
) -> Surroundings | None:
    """What a pattern search sees around an optimum; None where starts are searched too, or the budget leaves no room."""
    tuning = problem.options.tuning.pattern
    if windows.num_start:
        return None
    if windows.rollouts + pattern_size(len(theta), tuning) * len(windows.trajectories) >= windows.budget:
        return None
    starts, prior = windows.no_starts(), problem.quadratic_prior

    def simulated(thetas: FloatArray) -> tuple[FloatArray, BoolArray]:
        return windows.residuals(thetas, np.tile(starts, (len(thetas), 1, 1)))

    near = nearest_points(theta)
    residual, valid = simulated(near)
    noise = noise_at_least(windows, noise, residual[valid])

    def energies(thetas: FloatArray) -> FloatArray:
        residual, valid = simulated(thetas)
        values = [energy_of(windows, noise, prior, t, starts, r) for t, r in zip(thetas, residual, strict=True)]
        return np.where(valid, values, np.inf)

    levels = [energy_of(windows, noise, prior, t, starts, r) for t, r in zip(near[valid], residual[valid], strict=True)]
    return pattern_search(energies, theta, covariance, tuning, max(levels) if levels else -np.inf)


def middle_of_ridge(problem: SearchProblem, windows: Windows, optimum: WindowOptimum) -> FloatArray | None:
    """Where the search goes on: the middle of a ridge, so that the width across it does not depend on the start.

    Returns:
        theta (N,); None where no direction is open or the middle does not fit as well.
    """
    tuning = problem.options.tuning.windows
    theta, starts, noise = optimum.theta, optimum.starts, Noise(optimum.sd, optimum.tau)
    eigenvalues, axes = np.linalg.eigh(optimum.covariance)
    open_axes = axes[:, eigenvalues > tuning.open_sd**2]
    move = open_axes @ (open_axes.T @ (optimum.mean - theta))
    if not len(move) or np.abs(move).max() < tuning.off_centre:
        return None
    trials = np.clip(theta + _RIDGE_TRIALS[:, None] * move, 0, 1)
    if windows.rollouts + len(trials) * len(windows.trajectories) > windows.budget:
        return None
    prior = problem.quadratic_prior
    residual, valid = windows.residuals(trials, np.tile(starts, (len(trials), 1, 1)))
    values = [energy_of(windows, noise, prior, t, starts, r) for t, r in zip(trials, residual, strict=True)]
    good = [k for k in range(1, len(trials)) if valid[k] and values[k] < values[0] + tuning.as_good]
    return trials[good[0]] if good else None
