"""The energy of theta and the windows' starts, -log of likelihood x prior, and the noise that it is for.

For given noise it is half the whitened squares of the residuals plus the priors; its normal equations are an arrow, of
which the starts are eliminated (``sipe_bayes.likelihood.restricted``). The noise itself is given, of the size of
present residuals, or maximises the restricted likelihood.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.stats import chi2

from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.inference.laplace.levenberg_marquardt import Descent, QuadraticModel
from sipe_bayes.inference.laplace.options import WindowTuning
from sipe_bayes.likelihood.moments import Moments
from sipe_bayes.likelihood.noise import Noise, pooled
from sipe_bayes.likelihood.quadratic_prior import FLAT_PRECISION, QuadraticPrior, free_to_move
from sipe_bayes.likelihood.restricted import Pulls, eliminate_starts, estimate_noise
from sipe_bayes.likelihood.windows import Windows
from sipe_bayes.simulation.simulator import Simulator

_SAME_NOISE = 0.03  # relative: a change of an sd that moves no optimum


@dataclass(frozen=True)
class WindowPoint:
    """theta (N,), starts (W, D), and the residual (W, L, C) of the simulation there."""

    theta: FloatArray
    starts: FloatArray
    residual: FloatArray


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


class LinearisedWindows:
    """A ``LinearisedEnergy`` of windows; ``moments`` are of the linearisation at the point, or at an earlier one."""

    def __init__(self, of: WindowEnergy, point: WindowPoint, moments: Moments) -> None:
        self.of, self.point, self.moments = of, point, moments
        self.theta, self.energy = point.theta, of(point.theta, point.starts, point.residual)

    @cached_property
    def _normal(self) -> FloatArray:
        return self.moments.normal(self.of.noise)

    def model(self, damping: float) -> QuadraticModel:
        """The quadratic model in theta, the starts eliminated."""
        precision, prior = self.of.windows.start_precision, self.of.prior
        pull = -precision * self.point.starts
        solved = eliminate_starts(self._normal, self.moments.num_theta, precision, pull, damping)
        hessian, gradient = solved.precision + prior.precision, solved.gradient + prior.pull(self.theta)
        return QuadraticModel(hessian, gradient, solved.explained, solved.blocks)

    def simulated(self, theta: FloatArray, change: FloatArray) -> tuple[WindowPoint, float]:
        """The point at theta (N,) with the starts changed by (W, D), and its energy."""
        starts = self.point.starts + change
        residual, valid = self.of.windows.residuals(theta[None], starts[None])
        point = WindowPoint(theta, starts, residual[0])
        return point, self.of(theta, starts, residual[0]) if valid[0] else np.inf


def pulls(
    windows: Windows,
    prior: QuadraticPrior,
    theta: FloatArray,
    starts: FloatArray,
    force: FloatArray,
    held: bool = False,
) -> Pulls:
    """Priors and bounds at theta (N,) and starts (W, D); held as ``Pulls`` has it.

    force (N,): that of the data on theta, which may press it against a bound.
    """
    pull = prior.pull(theta)
    flat = FLAT_PRECISION * np.eye(len(theta))
    start_pull = -windows.start_precision * starts
    free = free_to_move(theta, force + pull)
    return Pulls(prior.precision + flat, pull, windows.start_precision, start_pull, free, held)


def present_noise(windows: Windows, residual: FloatArray) -> Noise:
    """White noise with the root-mean-square of a residual (W, L, C), or the given sds."""
    fixed, counts = windows.fixed_sd, windows.observed.sum(axis=(0, 1))
    size = pooled(np.sqrt((residual**2).sum(axis=(0, 1)) / np.maximum(counts, 1)), windows.scales)
    return Noise(np.where(np.isnan(fixed), np.maximum(size, windows.rounding), fixed), np.zeros(len(size)))


def noise_at_least(windows: Windows, noise: Noise, residuals: FloatArray) -> Noise:
    """The noise with sds no less than the root-mean-squares of residuals (B, W, L, C), the given ones kept."""
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
    held: bool,
) -> Noise:
    """Noise that maximises the restricted likelihood of one linearisation, at theta (N,) and starts (W, D).

    The search for it begins at ``before``; coloured: whether correlation times are estimated; held: whether the
    linearisation promises what no simulation keeps.
    """
    start_pull = -windows.start_precision * starts
    solved = eliminate_starts(moments.normal(before), moments.num_theta, windows.start_precision, start_pull)
    context = pulls(windows, prior, theta, starts, solved.gradient, held)
    noise = estimated(windows, moments, before, context, coloured)
    sd = np.where(np.isnan(windows.fixed_sd), np.maximum(noise.sd, windows.rounding), noise.sd)
    return Noise(sd, noise.tau)


def estimated(windows: Windows, moments: Moments, before: Noise, context: Pulls, coloured: bool) -> Noise:
    """``likelihood.restricted.estimate_noise`` of windows."""
    shortest, longest = float(windows.dt.min()), windows.trajectories.longest
    return estimate_noise(moments, before, context, windows.fixed_sd, coloured, shortest, longest, windows.scales)


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


def foretold(fit: Descent[WindowPoint], tuning: WindowTuning) -> bool:
    """Whether a step gained what the linearisation foretold."""
    return abs(fit.gained - fit.expected) < tuning.foretold * max(fit.expected, tuning.tolerance)


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


def unevenly_left(windows: Windows, residual: FloatArray) -> float | None:
    """How many times the middle window's size a residual (W, L, C) has in the worst window; None where by chance.

    Of windows from known starts, in channels whose noise these tell: one that misses an impact is left with more. The
    worst window's mean square over the middle one's is held against chi-square over its degrees, of which tails and
    memory leave fewer: by one half of the excess kurtosis within windows (G. E. P. Box, S. L. Andersen 1955,
    "Permutation Theory in the Derivation of Robust Criteria", J. R. Stat. Soc. B 17) and by the correlation of
    neighbouring samples.
    """
    channels = judging_channels(windows).any(axis=0)
    sd = np.maximum(present_noise(windows, residual).sd, 1e-300)
    seen = windows.observed & channels
    scaled = np.where(seen, residual / sd, 0.0)
    counts = seen.sum(axis=(1, 2))
    squares = (scaled**2).sum(axis=(1, 2)) / np.maximum(counts, 1)
    some = (counts > 1) & (squares > 0)
    if some.sum() < 2:
        return None
    own = scaled[some] / np.sqrt(squares[some])[:, None, None]
    excess = max(float((own**4).sum() / counts[some].sum()) - 3.0, 0.0)
    both = seen[some, 1:] & seen[some, :-1]
    memory = float((own[:, 1:] * own[:, :-1] * both).sum()) / max(int(both.sum()), 1)
    memory = min(memory**2, 0.99)
    fewer = (1 + 0.5 * excess) * (1 + memory) / (1 - memory)
    ratios, degrees = squares[some] / np.median(squares[some]), counts[some] / fewer
    chance = chi2.sf(ratios * degrees, degrees).min() * some.sum()
    return None if chance > THRESHOLDS.start_noise else float(np.sqrt(ratios.max()))


def beyond_start_noise(windows: Windows, sd: FloatArray) -> float | None:
    """How many times noise sds (C,) are the noise of the measurements of known starts; None where no more than it.

    A thousandth of a channel's spread is no matter, whatever the noise of the starts; of channels whose noise there is
    less, as in simulations without noise, nothing is asked.
    """
    noise, known = start_noise(windows), judging_channels(windows)
    if not known.any():
        return None
    spread = np.maximum(windows.spread, 1e-300)
    share = np.where(known, noise**2 + (1e-3 * spread) ** 2, 0.0) / np.maximum(sd, 1e-300) ** 2
    count, total = int(known.sum()), float(share.sum())
    return float(np.sqrt(count / total)) if chi2.cdf(total, count) < THRESHOLDS.start_noise else None
