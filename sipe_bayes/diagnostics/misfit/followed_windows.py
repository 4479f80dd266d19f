r"""Windows that a model follows through impacts: of these alone its residuals tell whether it lacks something.

An impact that the simulation misses, or meets a little late, leaves more than any missing physics would, also where the
model is right: between two valleys of the likelihood no slope leads, and in some windows every search ends in the wrong
one. What is left there says nothing of the model, and it draws the estimate to where the other windows fit less well.
But most windows are followed, and around their own optimum they change as smoothly as their slopes say.

So theta is moved to the optimum of the windows that are followed, as in least trimmed squares (P. Rousseeuw, "Least
median of squares regression", 1984, https://doi.org/10.1080/01621459.1984.10477105): choose them, take a step with
their starts, let the other windows' starts follow, choose again.

Samples that lie far from the others, by robust sds of their channel, are those of an impact that is met a little
late, or of a body that chatters where it lies; they are left out, and the windows where they are many. Noise that lets
the samples of a channel follow one another as :math:`\rho` leaves of n samples

.. math:: n' = n (1 - \rho) / (1 + \rho)

that count (G. Bayley, J. Hammersley, "The 'effective' number of independent observations in an autocorrelated time
series", 1946, https://doi.org/10.2307/2983560), and mean squares that are about chi-square with n' degrees of freedom.
A window is followed where no channel's mean square is larger than the largest of all windows and channels would be by
chance.

What moves parameters that only the other windows tell is then not known, so theta is held as by a uniform prior.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.stats

from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray
from sipe_bayes.core.options import Options, option
from sipe_bayes.diagnostics.misfit.probed_logs import MISFIT
from sipe_bayes.diagnostics.thinning import spread_windows
from sipe_bayes.inference.laplace.levenberg_marquardt import DampingRule, descend
from sipe_bayes.inference.laplace.options import GrowingTuning
from sipe_bayes.inference.laplace.windows.energy import WindowEnergy, WindowPoint
from sipe_bayes.inference.laplace.windows.growing_windows import ManyStarts
from sipe_bayes.likelihood.noise import NORMAL_MAD, Noise, coefficients
from sipe_bayes.likelihood.quadratic_prior import UNIFORM_PRECISION, QuadraticPrior
from sipe_bayes.likelihood.restricted import Pulls, estimate_noise
from sipe_bayes.likelihood.windows import Linearisation, Windows

_GROWING = GrowingTuning()
_FLAT = 1e-6  # precision that keeps information invertible where a direction is open


@dataclass(frozen=True)
class FollowedOptions(Options):
    """Which windows count as followed, and how few say nothing."""

    chance: float = option(0.05, "that a right model's noise leaves any window out", above=0)
    far: float = option(4.0, "from which a sample is left out: noise alone lies there once in 16,000", "sds", above=0)
    most_far: float = option(0.25, "of a window's samples of a channel: with more it is not followed", above=0, most=1)
    least: int = option(2, "samples that count in a window, however long they remember", "samples", least=1)
    rounds: int = option(6, "in which windows are chosen; but for the last a step follows each", least=1)
    settled: float = option(0.1, "that a step has to promise", "nats", above=0)
    fewest: int = option(4, "followed windows that say something", least=1)
    share: float = option(0.25, "of the windows that has to be followed: fewer are those that happen to fit", above=0)


FOLLOWED = FollowedOptions()


@dataclass(frozen=True)
class AskedWindows:
    """Windows whose residuals are asked what the model lacks.

    Args:
        windows: those.
        theta: (N,) the estimate.
        starts: (W, D) there.
        noise: (C,) of these windows.
        prior: of theta.
        lin: at theta and starts, where it is known.
    """

    windows: Windows
    theta: FloatArray
    starts: FloatArray
    noise: Noise
    prior: QuadraticPrior
    lin: Linearisation | None


def followed_cost(windows: Windows) -> int:
    """Rollouts of ``followed_windows`` at most."""
    each = 1 + windows.num_theta + windows.num_start + 2 * len(_GROWING.shares)
    return FOLLOWED.rounds * each * len(windows.trajectories)


def followed_windows(asked: AskedWindows, options: FollowedOptions = FOLLOWED) -> AskedWindows | None:
    """Those of some windows that the model follows, with the noise that they have by themselves.

    Costs ``options.rounds`` linearisations. Of long or many logs some windows are looked at, spread evenly.

    Args:
        asked: at an optimum.
        options: which count as followed.

    Returns:
        At their own optimum; None where there are too few to say anything.

    Raises:
        ValueError: where the simulation diverges at theta.
    """
    some = spread_windows(asked.windows, MISFIT.steps)
    windows, theta, starts = asked.windows.part(some), asked.theta, asked.starts[some]
    own, prior = asked.noise, _within_cube(asked.prior, asked.theta)
    for number in range(options.rounds):
        lin = windows.linearise(theta, starts)
        if not lin.valid:
            raise ValueError("theta: the simulation diverges at the estimate; nothing can be said of its residuals")
        counts, level = _followed(windows, lin.residual, own.tau, options)
        kept = np.flatnonzero(counts.any((1, 2)))
        if len(kept) < max(options.fewest, options.share * windows.num_windows):
            return None
        part, here = windows.part(kept, counts[kept]), _of(lin, kept, counts)
        own = _noise(part, theta, starts[kept], Noise(level, own.tau), prior, here)
        at = AskedWindows(part, theta, starts[kept], own, prior, here)
        step = _towards_their_optimum(at, options) if number + 1 < options.rounds else None
        if step is None:
            break
        starts = _follow(windows, lin, theta, starts, step.theta, own)
        starts[kept], theta = step.starts, step.theta
    return at


def _towards_their_optimum(at: AskedWindows, options: FollowedOptions) -> WindowPoint | None:
    """A step of theta and the starts downhill; None where nothing is to be gained."""
    assert at.lin is not None
    energy, point = WindowEnergy(at.windows, at.noise, at.prior), WindowPoint(at.theta, at.starts, at.lin.residual)
    linearised = ManyStarts(energy, point, at.windows.moments(at.lin), _GROWING.shares)
    rule = DampingRule()
    return descend(linearised, rule.first, options.settled, rule).point


def _follow(
    windows: Windows, lin: Linearisation, theta: FloatArray, starts: FloatArray, moved: FloatArray, noise: Noise
) -> FloatArray:
    """Starts (W, D) at a theta (N,) that has moved: each takes the share of its own step that serves it best."""
    n, white, precision = windows.num_theta, Noise(noise.sd, np.zeros_like(noise.tau)), windows.start_precision
    left = (lin.residual - lin.jacobian[..., :n] @ (moved - theta)) / noise.sd
    rows = lin.jacobian[..., n:] / noise.sd[:, None]
    inner = np.einsum("wlci,wlcj->wij", rows, rows) + np.diag(precision)
    force = np.einsum("wlci,wlc->wi", rows, left) - precision * starts
    change = np.linalg.solve(inner, force[..., None])[..., 0]
    change = np.where(np.isfinite(change), change, 0.0)  # of a window that all but diverges
    energy = WindowEnergy(windows, white, QuadraticPrior(moved, np.zeros((n, n))))
    point, moments = WindowPoint(theta, starts, lin.residual), windows.moments(lin, white=True)
    return ManyStarts(energy, point, moments, _GROWING.shares).simulated(moved, change)[0].starts


def _followed(
    windows: Windows, residual: FloatArray, tau: FloatArray, options: FollowedOptions
) -> tuple[BoolArray, FloatArray]:
    """Samples (W, L, C) that count, none in windows that are not followed, and the noise's robust sd (C,)."""
    observed = windows.observed
    size = np.where(observed, np.abs(residual), np.nan)
    sd = np.maximum(NORMAL_MAD * np.nan_to_num(np.nanmedian(size, axis=(0, 1))), windows.rounding)
    counts = observed & (np.abs(residual) <= options.far * sd)
    every, some = observed.sum(1), counts.sum(1)  # (W, C)
    rho = coefficients(np.full(len(tau), float(windows.dt.min())), tau)
    freedom = np.maximum(some * (1 - rho) / (1 + rho), options.least)
    most = scipy.stats.chi2.isf(options.chance / max(1, int((every > 0).sum())), freedom) / freedom
    square = np.where(counts, residual**2, 0.0).sum(1) / np.maximum(some, 1)
    followed = (every == 0) | ((square <= sd**2 * most) & (every - some <= options.most_far * every))
    return counts & followed.all(1)[:, None, None], sd


def _of(lin: Linearisation, kept: IntArray, counts: BoolArray) -> Linearisation:
    """Of the windows that are kept and the samples (W, L, C) that count."""
    own = counts[kept]
    jacobian = np.where(own[..., None], lin.jacobian[kept], 0.0)
    return Linearisation(np.where(own, lin.residual[kept], 0.0), jacobian, True)


def _noise(
    windows: Windows, theta: FloatArray, starts: FloatArray, noise: Noise, prior: QuadraticPrior, lin: Linearisation
) -> Noise:
    """As the windows have it by themselves, searched from one; theta and starts follow."""
    n = windows.num_theta
    pulls = Pulls(
        prior.precision + _FLAT * np.eye(n),
        prior.pull(theta),
        windows.start_precision,
        -windows.start_precision * starts,
        np.ones(n, bool),
    )
    span = float(windows.dt.min()), windows.trajectories.longest
    coloured = bool((noise.tau > 0).any())
    own = estimate_noise(windows.moments(lin), noise, pulls, windows.fixed_sd, coloured, *span, windows.scales)
    return Noise(np.maximum(own.sd, windows.rounding), own.tau)


def _within_cube(prior: QuadraticPrior, theta: FloatArray) -> QuadraticPrior:
    """A prior beside which theta (N,) is known as a uniform one has it, with the same pull there."""
    precision = prior.precision + UNIFORM_PRECISION * np.eye(len(theta))
    return QuadraticPrior(theta + np.linalg.solve(precision, prior.pull(theta)), precision)
