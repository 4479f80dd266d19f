"""Segments: the energy of theta and initial states, the noise that it is for, and the normal at an optimum.

The energy, -log of likelihood x prior, is half the whitened squares of the residuals plus the priors. The noise is
given, of the size of present residuals, or maximises the restricted likelihood (``sipe_bayes.likelihood.restricted``).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.stats import chi2

from sipe_bayes.core.arrays import FloatArray, IntArray
from sipe_bayes.core.findings import Finding
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.inference.laplace.strategy import Optimum, SearchProblem, StrategyState
from sipe_bayes.likelihood import Eliminated, Linearisation, Noise
from sipe_bayes.likelihood.moments import Moments
from sipe_bayes.likelihood.noise import pooled
from sipe_bayes.likelihood.quadratic_prior import FLAT_PRECISION, QuadraticPrior, free_to_move
from sipe_bayes.likelihood.restricted import (
    Pulls,
    noise_cloud,
    restricted,
    sandwich,
)
from sipe_bayes.likelihood.windows import Windows
from sipe_bayes.simulation.simulator import Simulator

_SAME_NOISE = 0.03  # relative: a change of an sd that moves no optimum


@dataclass(frozen=True)
class WindowEnergy:
    """The energy of theta and the starts for one noise of the residuals."""

    windows: Windows
    noise: Noise
    prior: QuadraticPrior

    def __call__(self, theta: FloatArray, starts: FloatArray, residual: FloatArray) -> float:
        """At theta (N,) and starts (W, D), of the residual (W, L, C) there."""
        fit = 0.5 * float(self.windows.chi_square(residual[None], self.noise)[0])
        return fit + self.prior.energy(theta) + 0.5 * float((starts**2 @ self.windows.start_precision).sum())


def pulls(windows: Windows, prior: QuadraticPrior, theta: FloatArray, starts: FloatArray, force: FloatArray) -> Pulls:
    """Priors and bounds at theta (N,) and starts (W, D); force (N,) of the data may press theta against a bound."""
    pull, precision = prior.pull(theta), prior.precision + FLAT_PRECISION * np.eye(len(theta))
    free = free_to_move(theta, force + pull)
    return windows.pulls(precision, pull, starts, free)


def present_noise(windows: Windows, residual: FloatArray) -> Noise:
    """White noise with the root-mean-square of a residual (W, L, C), or the given sds."""
    fixed, counts = windows.fixed_sd, windows.observed.sum(axis=(0, 1))
    size = pooled(np.sqrt((residual**2).sum(axis=(0, 1)) / np.maximum(counts, 1)), windows.scales)
    return Noise(np.where(np.isnan(fixed), np.maximum(size, windows.rounding), fixed), np.zeros(len(size)))


def updated_noise(
    windows: Windows,
    moments: Moments,
    before: Noise,
    theta: FloatArray,
    starts: FloatArray,
    prior: QuadraticPrior,
    coloured: bool,
) -> Noise:
    """Noise that maximises the restricted likelihood of one linearisation, at theta (N,) and starts (W, D).

    The search for it begins at ``before``; coloured: whether correlation times are estimated.
    """
    solved = windows.eliminate(moments.normal(before), moments.num_theta, starts)
    noise = windows.estimate_noise(moments, before, pulls(windows, prior, theta, starts, solved.gradient), coloured)
    sd = np.where(np.isnan(windows.fixed_sd), np.maximum(noise.sd, windows.rounding), noise.sd)
    return Noise(sd, noise.tau)


def beyond_rounding(windows: Windows, noise: Noise) -> Noise:
    """The noise with channels at the least sd, the simulation's rounding, as if they were one sample."""
    least, counts = windows.rounding * (1 + _SAME_NOISE), windows.observed.sum(axis=(0, 1))
    least = np.where(np.isnan(windows.fixed_sd), least, 0.0)
    return Noise(np.where(noise.sd <= least, noise.sd * np.sqrt(np.maximum(counts, 1)), noise.sd), noise.tau)


def free_noise(windows: Windows) -> IntArray:
    """Which of (log sd (C), log tau (C)) are unknown."""
    free = np.isnan(windows.fixed_sd)
    return np.flatnonzero(np.concatenate([free, np.full(len(free), windows.settings.noise != "white")]))


def gain_of_noise(moments: Moments, before: Noise, after: Noise) -> float:
    """Nats by which the log-likelihood of a residual differs between two noises; slow ones hardly tell how slow."""
    both = [float(moments.normal(n)[:, -1, -1].sum()) + moments.log_determinant(n) for n in (before, after)]
    return 0.5 * abs(both[1] - both[0])


def start_noise(windows: Windows) -> FloatArray:
    """Noise (W, C) of the measurements of known starts; NaN where a channel measures no coordinate of the state."""
    out = np.full((windows.num_windows, len(windows.channels)), np.nan)
    if windows.num_start or not isinstance(windows.simulator, Simulator):
        return out
    columns = windows.simulator.environment.state_columns(windows.simulator.model)
    for c, channel in enumerate(windows.channels):
        if (column := columns[channel]) is not None:
            out[:, c] = windows.measured[:, 0, c] - windows.reference[:, column]
    return out


def beyond_known_noise(windows: Windows, sd: FloatArray, residual: FloatArray) -> float | None:
    """How many times the noise that is known a residual (W, L, C) is; None where no more than it.

    Of functions the noise that they state. Of logs with known initial states that of the measurements there, or the
    scatter of the samples where these are few, which noise sds (C,) of the fit are held against. A thousandth of a
    channel's spread is no matter; of channels whose noise is less, as in simulations without noise, nothing is asked.
    """
    if not isinstance(windows.simulator, Simulator) and (given := windows.fixed_sd > 0).any():
        square = float(((residual / np.where(given, windows.fixed_sd, np.inf)) ** 2).sum())
        count = int(windows.observed[..., given].sum())
        return float(np.sqrt(square / count)) if chi2.sf(square, count) < THRESHOLDS.start_noise else None
    noise, spread = start_noise(windows), np.maximum(windows.spread, 1e-300)
    known = np.isfinite(noise) & np.isnan(windows.fixed_sd)
    size = np.sqrt(np.where(known, noise**2, 0.0).sum(0) / np.maximum(known.sum(0), 1))
    known &= size > 1e-3 * spread
    if windows.impacts and not windows.num_start and known.sum() < 10:  # so few tell noise to a quarter at best
        free = np.isnan(windows.fixed_sd) & (sd > 1e-3 * windows.spread)
        times = float(np.where(free, sd / windows.level.sd, 0.0).max())
        return times if times > 1.3 else None  # a hundred samples tell their scatter to a tenth
    if not known.any():
        return None
    share = np.where(known, noise**2 + (1e-3 * spread) ** 2, 0.0) / np.maximum(sd, 1e-300) ** 2
    count, total = int(known.sum()), float(share.sum())
    return float(np.sqrt(count / total)) if chi2.cdf(total, count) < THRESHOLDS.start_noise else None


@dataclass(frozen=True)
class WindowOptimum(Optimum):
    """An optimum of segments.

    Args:
        starts: (W, D), initial states.
        slope: (W, D, N): initial states follow theta by minus this.
        finding: why its intervals are not to be trusted; None where they may be.
        early: whether it is of a stage on the way, perhaps of fewer samples than the end.
    """

    starts: FloatArray
    slope: FloatArray
    finding: Finding | None = None
    early: bool = False


@dataclass(frozen=True)
class WindowState(StrategyState[Any]):
    """A search over segments.

    Args:
        wild: (k, 3), samples that are left out; see ``likelihood.wild_samples``.
        longer: whether the search has gone on from where longer segments led.
    """

    optima: tuple[WindowOptimum, ...] = ()
    wild: IntArray = field(default_factory=lambda: np.zeros((0, 3), np.int64))
    longer: bool = False


def summarised(
    problem: SearchProblem,
    windows: Windows,
    theta: FloatArray,
    starts: FloatArray,
    noise: Noise,
    moments: Moments,
    lin: Linearisation,
) -> WindowOptimum:
    """The normal at theta (N,) and starts (W, D) over the noise's uncertainty, and the evidence.

    moments: of the linearisation ``lin`` there.
    """
    prior = problem.quadratic_prior
    sandwiched = windows.settings.noise == "sandwich"
    solved = windows.eliminate(moments.normal(noise), moments.num_theta, starts)
    here = pulls(windows, prior, theta, starts, solved.gradient)
    prior_energy = prior.energy(theta) + 0.5 * float((starts**2 @ windows.start_precision).sum())
    evidence = restricted(moments, noise, replace(here, free=np.full(len(theta), True)))[0] - prior_energy
    white = noise.sd
    if sandwiched:
        noise = updated_noise(windows, moments, noise, theta, starts, prior, coloured=True)
    mean, covariance = np.zeros(len(theta)), np.zeros((len(theta), len(theta)))
    centres = []
    # moments of the normals of a few weighted noise values
    for weight, point in noise_cloud(moments, noise, here, free_noise(windows), windows.trajectories.longest):
        if sandwiched:
            middle = sandwich(lin.jacobian, solved.slope, white, windows.sequences, point)
            centre, spread = problem.normal(theta, _sandwiched(solved, middle), np.zeros(len(theta)))
        else:
            point = beyond_rounding(windows, point)
            inner = windows.eliminate(moments.normal(point), moments.num_theta, starts)
            centre, spread = problem.normal(theta, inner.precision, inner.gradient)
        mean += weight * centre
        covariance += weight * spread
        centres.append((weight, centre))
    for weight, centre in centres:
        covariance += weight * np.outer(centre - mean, centre - mean)
    return WindowOptimum(theta, mean, covariance, evidence, noise.sd, noise.tau, starts, solved.slope)


def _sandwiched(solved: Eliminated, middle: FloatArray) -> FloatArray:
    """Precision (N, N) of plain least squares when the residuals' covariance gives ``middle`` (N, N)."""
    precision = solved.precision @ np.linalg.pinv(middle, rcond=1e-12, hermitian=True) @ solved.precision
    # rounding leaves some of an open direction negative
    eigenvalues, axes = np.linalg.eigh(0.5 * (precision + precision.T))
    return np.asarray((axes * np.maximum(eigenvalues, 0.0)) @ axes.T)


def not_followed(windows: Windows, sd: FloatArray) -> tuple[str, float] | None:
    """The channel that a fit with noise sds (C,) does not follow, and its noise over the scatter of its samples.

    Noise that is a good part of what a channel does is none where the samples do not scatter by it, whatever its time.
    """
    excess = np.where(sd > THRESHOLDS.gross * windows.spread, sd / windows.level.sd, 0.0)
    worst = int(excess.argmax())
    return (windows.fitted[worst], float(excess[worst])) if excess[worst] > THRESHOLDS.noise_excess else None
