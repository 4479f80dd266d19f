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
the samples of a channel follow one another as :math:`\rho` leaves, for the mean of their squares, of n samples

.. math:: n' = n (1 - \rho^2) / (1 + \rho^2)

that count (G. Bayley, J. Hammersley, "The 'effective' number of independent observations in an autocorrelated time
series", 1946, https://doi.org/10.2307/2983560), and mean squares that are about chi-square with n' degrees of freedom.
A window is followed where no channel's mean square is larger than the largest of all windows and channels would be by
chance. Nor is one whose slopes over short changes of theta are not those over wider ones: there simulations jump, and
one such window would hold theta anywhere.

What moves parameters that only the other windows tell is then not known: around the estimate theta is held by as much
as a uniform prior would.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.stats

from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray
from sipe_bayes.core.checkpoint import NOTHING_KEPT, Kept
from sipe_bayes.core.options import Options, option
from sipe_bayes.diagnostics.misfit.probed_logs import MISFIT, ProbedLogs
from sipe_bayes.diagnostics.thinning import spread_windows
from sipe_bayes.inference.laplace.levenberg_marquardt import DampingRule, descend
from sipe_bayes.inference.laplace.options import GrowingTuning
from sipe_bayes.inference.laplace.windows.energy import WindowEnergy, WindowPoint, updated_noise
from sipe_bayes.inference.laplace.windows.growing_windows import ManyStarts, grows
from sipe_bayes.inference.recorded import Tell, silent
from sipe_bayes.likelihood.noise import NORMAL_MAD, Noise, coefficients
from sipe_bayes.likelihood.quadratic_prior import UNIFORM_PRECISION, QuadraticPrior
from sipe_bayes.likelihood.windows import Linearisation, Windows

_GROWING = GrowingTuning()


@dataclass(frozen=True)
class FollowedOptions(Options):
    """Which windows count as followed, and how few say nothing."""

    chance: float = option(0.05, "that a right model's noise leaves any window out", above=0)
    far: float = option(4.0, "from which a sample is left out: noise alone lies there once in 16,000", "sds", above=0)
    most_far: float = option(0.25, "of a window's samples of a channel: with more it is not followed", above=0, most=1)
    least: int = option(2, "samples that count in a window, however long they remember", "samples", least=1)
    wider: float = option(1e-3, "change of theta over which slopes are compared", "of the cube", above=0)
    differs: float = option(0.5, "of the larger slope, by which the two may differ in a window", above=0)
    matters: float = option(1.0, "that a parameter moves a window over its range: smaller slopes", "sds", above=0)
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
        among: how many windows they were chosen from.
    """

    windows: Windows
    theta: FloatArray
    starts: FloatArray
    noise: Noise
    prior: QuadraticPrior
    lin: Linearisation | None
    among: int

    def probed(self, tell: Tell = silent, kept: Kept = NOTHING_KEPT) -> ProbedLogs:
        """With what extensions would do to them; of what follows impacts, noise may be larger for a while.

        Args:
            tell: called with what is being done.
            kept: keeps what extensions do, and draws of the null.
        """
        steady = not grows(self.windows)
        return ProbedLogs(
            self.windows, self.theta, self.noise, self.starts, self.prior, self.lin, tell, kept, steady=steady
        )


def followed_cost(windows: Windows) -> int:
    """Rollouts of ``followed_windows`` as a rule, where no step is refused."""
    each = 1 + 2 * windows.num_theta + windows.num_start + 2 * len(_GROWING.shares)
    return FOLLOWED.rounds * each * len(windows.trajectories)


def followed_windows(asked: AskedWindows, options: FollowedOptions = FOLLOWED) -> AskedWindows | None:
    """Those of some windows that the model follows, with the noise that they have by themselves, at their own optimum.

    Costs up to ``options.rounds`` linearisations. Of long or many logs some windows are looked at, spread evenly.

    Args:
        asked: at an optimum of all.
        options: which count as followed.

    Returns:
        None where there are too few to say anything, or where they leave a channel out.

    Raises:
        ValueError: where the simulation diverges at theta.
    """
    some = spread_windows(asked.windows, MISFIT.steps)
    windows, theta, starts = asked.windows.part(some), asked.theta, asked.starts[some]
    noise, prior, at = asked.noise, _held(asked.prior, asked.theta), None
    for number in range(options.rounds):
        lin = windows.linearise(theta, starts)
        if not lin.valid and at is None:
            raise ValueError("theta: the simulation diverges at the estimate; nothing can be said of its residuals")
        if not lin.valid:  # by a window that is not followed, where theta has moved
            return at
        counted, sd = _counted(windows, lin.residual, noise.tau, options)
        counted &= _smooth(windows, lin, theta, starts, sd, options)[:, None, None]
        kept = np.flatnonzero(counted.any((1, 2)))
        if len(kept) < max(options.fewest, options.share * windows.num_windows):
            return None
        if not (counted.any((0, 1)) | ~windows.observed.any((0, 1))).all():
            return None
        part, own = windows.part(kept, counted[kept]), _trimmed(lin, kept, counted)
        first, coloured = Noise(sd, noise.tau), bool((noise.tau > 0).any())
        noise = updated_noise(part, part.moments(own), first, theta, starts[kept], prior, coloured, False)
        at = AskedWindows(part, theta, starts[kept], noise, prior, own, windows.num_windows)
        step = _downhill(at, options) if number + 1 < options.rounds else None
        if step is None:
            break
        starts = _starts_at(windows, lin, theta, starts, step.theta, noise)
        starts[kept], theta = step.starts, step.theta
    return at


def _held(prior: QuadraticPrior, theta: FloatArray) -> QuadraticPrior:
    """A prior beside which theta (N,) is held as by a uniform one, with the same pull there."""
    precision = prior.precision + UNIFORM_PRECISION * np.eye(len(theta))
    return QuadraticPrior(theta + np.linalg.solve(precision, prior.pull(theta)), precision)


def _counted(
    windows: Windows, residual: FloatArray, tau: FloatArray, options: FollowedOptions
) -> tuple[BoolArray, FloatArray]:
    """Samples (W, L, C) that count, none in windows that are not followed, and the noise's robust sd (C,)."""
    observed = windows.observed
    size = np.where(observed, np.abs(residual), np.nan)
    measured = observed.any((0, 1))
    middle = np.nanmedian(np.where(measured, size, 0.0), axis=(0, 1))
    sd = np.maximum(NORMAL_MAD * middle, np.nan_to_num(windows.rounding))
    near = observed & (np.abs(residual) <= options.far * sd)
    every, some = observed.sum(1), near.sum(1)  # (W, C)
    square = coefficients(windows.dt[:, None], tau) ** 2
    freedom = np.maximum(some * (1 - square) / (1 + square), options.least)
    most = scipy.stats.chi2.isf(options.chance / max(1, int((every > 0).sum())), freedom) / freedom
    mean = np.where(near, residual**2, 0.0).sum(1) / np.maximum(some, 1)
    followed = (every == 0) | ((mean <= sd**2 * most) & (every - some <= options.most_far * every))
    return near & followed.all(1)[:, None, None], sd


def _smooth(
    windows: Windows,
    lin: Linearisation,
    theta: FloatArray,
    starts: FloatArray,
    sd: FloatArray,
    options: FollowedOptions,
) -> BoolArray:
    """In which windows (W,) slopes over short changes of theta are those over wider ones, where they matter."""
    wider = windows.linearise(theta, starts, with_starts=False, residual=lin.residual, theta_step=options.wider)
    scale = np.maximum(sd, np.finfo(float).tiny)[:, None]
    short, wide = lin.jacobian[..., : windows.num_theta] / scale, wider.jacobian / scale
    apart, larger = (np.sqrt((x**2).sum((1, 2))) for x in (short - wide, np.maximum(np.abs(short), np.abs(wide))))
    return np.asarray((apart <= np.maximum(options.differs * larger, options.matters)).all(1))


def _trimmed(lin: Linearisation, kept: IntArray, counted: BoolArray) -> Linearisation:
    """Of the windows that are kept, and the samples (W, L, C) that count."""
    own = counted[kept]
    jacobian = np.where(own[..., None], lin.jacobian[kept], 0.0)
    return Linearisation(np.where(own, lin.residual[kept], 0.0), jacobian, True)


def _downhill(at: AskedWindows, options: FollowedOptions) -> WindowPoint | None:
    """A step of theta and the starts; None where nothing is to be gained."""
    assert at.lin is not None
    energy, point = WindowEnergy(at.windows, at.noise, at.prior), WindowPoint(at.theta, at.starts, at.lin.residual)
    linearised, rule = ManyStarts(energy, point, at.windows.moments(at.lin), _GROWING.shares), DampingRule()
    return descend(linearised, rule.first, options.settled, rule).point


def _starts_at(
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
