r"""Windows that a model follows through impacts: of these alone its residuals tell whether it lacks something.

An impact that the simulation misses, or meets a little late, leaves more than any missing physics would, also where the
model is right: between two valleys of the likelihood no slope leads, and in some windows every search ends in the wrong
one. What is left there says nothing of the model. But most windows are followed, and around their optimum they change
as smoothly as their slopes say.

Noise that lets the samples of a channel follow one another as :math:`\rho` leaves of n samples

.. math:: n' = n (1 - \rho) / (1 + \rho)

that count (G. Bayley, J. Hammersley, "The 'effective' number of independent observations in an autocorrelated time
series", 1946, https://doi.org/10.2307/2983560), and mean squares that are about chi-square with n' degrees of freedom.
The noise's level is that of the median window. A window is followed where no channel's mean square is larger than one
of all windows' and channels' would be by chance, more often than one time in ``1 / chance``.

What moves parameters that only the other windows tell is then not known, so theta is held as by a uniform prior.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.stats

from sipe_bayes.core.arrays import FloatArray, IntArray
from sipe_bayes.core.options import Options, option
from sipe_bayes.diagnostics.misfit.probed_logs import MISFIT
from sipe_bayes.diagnostics.thinning import spread_windows
from sipe_bayes.likelihood.noise import Noise, coefficients
from sipe_bayes.likelihood.quadratic_prior import UNIFORM_PRECISION, QuadraticPrior
from sipe_bayes.likelihood.restricted import Pulls, estimate_noise
from sipe_bayes.likelihood.windows import Linearisation, Windows

_FLAT = 1e-6  # precision that keeps information invertible where a direction is open


@dataclass(frozen=True)
class FollowedOptions(Options):
    """Which windows count as followed, and how few say nothing."""

    chance: float = option(0.05, "that a right model's noise leaves any window out", above=0)
    least: int = option(2, "samples that count in a window, however long they remember", "samples", least=1)
    rounds: int = option(2, "in which windows are chosen and their noise is estimated", least=1)
    fewest: int = option(4, "followed windows that say something", least=1)
    share: float = option(0.25, "of the windows that has to be followed: fewer are those that happen to fit", above=0)


_OPTIONS = FollowedOptions()


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


def followed_windows(asked: AskedWindows, options: FollowedOptions = _OPTIONS) -> AskedWindows | None:
    """Those of some windows that the model follows, with the noise that they have by themselves.

    Costs a linearisation. Of long or many logs some windows are looked at, spread evenly.

    Args:
        asked: at an optimum.
        options: which count as followed.

    Returns:
        None where there are too few to say anything.

    Raises:
        ValueError: where the simulation diverges at theta.
    """
    some = spread_windows(asked.windows, MISFIT.steps)
    windows, theta, starts = asked.windows.part(some), asked.theta, asked.starts[some]
    lin, own, prior = windows.linearise(theta, starts), asked.noise, _within_cube(asked.prior, theta)
    if not lin.valid:
        raise ValueError("theta: the simulation diverges at the estimate; nothing can be said of its residuals")
    for _ in range(options.rounds):
        kept, level = _followed(windows, lin.residual, own.tau, options)
        if len(kept) < max(options.fewest, options.share * windows.num_windows):
            return None
        part, here = windows.part(kept), Linearisation(lin.residual[kept], lin.jacobian[kept], True)
        own = _noise(part, theta, starts[kept], Noise(level, own.tau), prior, here)
    return AskedWindows(part, theta, starts[kept], own, prior, here)


def _followed(
    windows: Windows, residual: FloatArray, tau: FloatArray, options: FollowedOptions
) -> tuple[IntArray, FloatArray]:
    """Numbers of the windows that are followed, and the noise's sd (C,) by the median window."""
    count = windows.observed.sum(1)  # (W, C)
    square = np.where(windows.observed, residual**2, 0.0).sum(1) / np.maximum(count, 1)
    square = np.where(count > 0, square, np.nan)
    rho = coefficients(np.full(len(tau), float(windows.dt.min())), tau)
    freedom = np.maximum(count * (1 - rho) / (1 + rho), options.least)
    variance = np.nanmedian(square * freedom / scipy.stats.chi2.median(freedom), axis=0)
    sd = np.maximum(np.sqrt(np.nan_to_num(variance)), windows.rounding)
    most = scipy.stats.chi2.isf(options.chance / max(1, int((count > 0).sum())), freedom) / freedom
    return np.flatnonzero(((square <= sd**2 * most) | (count == 0)).all(1)), sd


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
