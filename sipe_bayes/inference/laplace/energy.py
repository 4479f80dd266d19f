"""The energy of theta and the windows' starts, -log of likelihood x prior, and the noise that it is for.

For given noise it is half the whitened squares of the residuals plus the priors; its normal equations are an arrow, of
which the starts are eliminated (``sipe_bayes.likelihood.restricted``). The noise itself is given, of the size of
present residuals, or maximises the restricted likelihood.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.likelihood.moments import Moments
from sipe_bayes.likelihood.noise import Noise, pooled
from sipe_bayes.likelihood.quadratic_prior import FLAT_PRECISION, QuadraticPrior, free_to_move
from sipe_bayes.likelihood.restricted import Pulls
from sipe_bayes.likelihood.windows import Windows
from sipe_bayes.simulation.simulator import Simulator

_SCATTERS = 1.3  # times what samples scatter by: a hundred of them tell that to a tenth
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

    def each(self, thetas: FloatArray, starts: FloatArray, residuals: FloatArray) -> FloatArray:
        """At thetas (B, N) and the same starts (W, D), of their residuals (B, W, L, C)."""
        return np.array([self(theta, starts, residual) for theta, residual in zip(thetas, residuals, strict=True)])


def pulls(
    windows: Windows,
    prior: QuadraticPrior,
    theta: FloatArray,
    starts: FloatArray,
    force: FloatArray,
) -> Pulls:
    """Priors and bounds at theta (N,) and starts (W, D).

    force (N,): that of the data on theta, which may press it against a bound.
    """
    pull = prior.pull(theta)
    flat = FLAT_PRECISION * np.eye(len(theta))
    return windows.pulls(prior.precision + flat, pull, starts, free_to_move(theta, force + pull))


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


def same_noise(a: Noise, b: Noise) -> bool:
    """Whether two are as good as equal."""
    return bool(np.allclose(a.sd, b.sd, rtol=_SAME_NOISE) and np.allclose(a.tau, b.tau, rtol=3 * _SAME_NOISE))


def misfit(windows: Windows, residual: FloatArray) -> float:
    """Root mean square of residuals (W, L, C), in units of the spread of each channel that has one."""
    spread = windows.spread
    moves = spread > 1e-9 * spread.max()
    size = np.where(moves, spread, np.inf) if moves.any() else np.ones_like(spread)
    return float(np.sqrt(((residual / size)[windows.observed] ** 2).mean())) or 1e-300


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


def judging_channels(windows: Windows) -> BoolArray:
    """Of which windows and channels (W, C) a measurement of a known start tells noise."""
    noise = start_noise(windows)
    known = np.isfinite(noise) & np.isnan(windows.fixed_sd)
    size = np.sqrt(np.where(known, noise**2, 0.0).sum(0) / np.maximum(known.sum(0), 1))
    return np.asarray(known & (size > 1e-3 * np.maximum(windows.spread, 1e-300)))


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
    noise, known = start_noise(windows), judging_channels(windows)
    if windows.impacts and not windows.num_start and known.sum() < 10:  # so few tell noise to a quarter at best
        free = np.isnan(windows.fixed_sd) & (sd > 1e-3 * windows.spread)
        times = float(np.where(free, sd / windows.level.sd, 0.0).max())
        return times if times > _SCATTERS else None
    if not known.any():
        return None
    spread = np.maximum(windows.spread, 1e-300)
    share = np.where(known, noise**2 + (1e-3 * spread) ** 2, 0.0) / np.maximum(sd, 1e-300) ** 2
    count, total = int(known.sum()), float(share.sum())
    return float(np.sqrt(count / total)) if chi2.cdf(total, count) < THRESHOLDS.start_noise else None
