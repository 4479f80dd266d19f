r"""Windows that a model follows through impacts: of these alone it is known what the parameters are, and what it lacks.

An impact that the simulation misses, or meets a little late, leaves more than any missing physics would, also where the
model is right: between two valleys of the likelihood no slope leads, and in some windows every search ends in the wrong
one. What is left there says nothing of the model, and it draws the estimate to where the other windows fit less well.
But most windows are followed, and around their own optimum they change as smoothly as their slopes say.

So theta is moved to the optimum of the windows that are followed, as in least trimmed squares (P. Rousseeuw, "Least
median of squares regression", 1984, https://doi.org/10.1080/01621459.1984.10477105): choose them, take a step with
their starts, look for the other windows' starts anew, from their first moments on, choose again.

Samples that lie far from the others, by robust sds of their channel, are those of an impact that is met a little
late, or of a body that chatters where it lies; they are left out, and the windows where they are many. Noise that lets
the samples of a channel follow one another as :math:`\rho` leaves, for the mean of their squares, of n samples

.. math:: n' = n (1 - \rho^2) / (1 + \rho^2)

that count (G. Bayley, J. Hammersley, "The 'effective' number of independent observations in an autocorrelated time
series", 1946, https://doi.org/10.2307/2983560), and mean squares that are about chi-square with n' degrees of freedom.
A window is followed where no channel's mean square is larger than the largest of all windows and channels would be by
chance. Nor is one whose slopes over short changes of theta are not those over wider ones: there simulations jump, and
one such window would hold theta anywhere.

What moves parameters that only the other windows tell is then not known: on the way theta is held by as much as a
uniform prior would, around where it stands.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.stats

from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray
from sipe_bayes.inference.laplace.levenberg_marquardt import DampingRule, Descent, descend
from sipe_bayes.inference.laplace.options import FollowedTuning, GrowingTuning
from sipe_bayes.inference.laplace.windows.energy import WindowEnergy, WindowPoint, updated_noise
from sipe_bayes.inference.laplace.windows.growing_windows import Doubt, ManyStarts, counted, grown_starts, lent, level
from sipe_bayes.inference.laplace.windows.state import Followed
from sipe_bayes.likelihood.noise import NORMAL_MAD, Noise, coefficients
from sipe_bayes.likelihood.quadratic_prior import QuadraticPrior
from sipe_bayes.likelihood.restricted import eliminate_starts
from sipe_bayes.likelihood.windows import Linearisation, Windows

FOLLOWED, _GROWING, _RULE = FollowedTuning(), GrowingTuning(), DampingRule()
_LOST = 0.2  # share of the windows that is looked for anew, as a rule


@dataclass(frozen=True)
class FollowedLook:
    """What is followed at a point, and the linearisation there.

    Args:
        at: that.
        windows: those that are followed.
        lin: of them.
        every: of all windows.
    """

    at: Followed
    windows: Windows
    lin: Linearisation
    every: Linearisation


def followed_cost(windows: Windows, tuning: FollowedTuning = FOLLOWED) -> int:
    """Rollouts of ``followed_windows`` as a rule, where no step is refused."""
    start_step = 1 + windows.num_start + len(_GROWING.shares)
    whole = _GROWING.start_steps / (1 - 1 / _GROWING.growth)  # steps that those on all beginnings of a window make
    each = 1 + 2 * windows.num_theta + windows.num_start + len(_GROWING.shares) + round(_LOST * whole * start_step)
    return tuning.rounds * each * len(windows.trajectories)


def followed_windows(
    windows: Windows,
    theta: FloatArray,
    starts: FloatArray,
    noise: Noise,
    prior: QuadraticPrior,
    tuning: FollowedTuning = FOLLOWED,
) -> FollowedLook | Doubt:
    """Those of some windows that the model follows, with the noise that they have by themselves, at their own optimum.

    Costs up to ``tuning.rounds`` linearisations, and the search for the starts of windows that are not (``regrown``).

    Args:
        windows: from which they are chosen.
        theta: (N,) an optimum of all.
        starts: (W, D) there.
        noise: (C,) there.
        prior: of theta.
        tuning: which count as followed.

    Returns:
        Why there are none, where they are too few to say anything or leave a channel out.
    """
    look = followed_at(windows, theta, starts, noise, prior, tuning)
    for number in range(tuning.rounds - 1):
        if look is Doubt.LOST and not number:
            again = regrown(windows, np.arange(windows.num_windows), theta, starts, noise, tuning)
            if again is None:
                return look
            look = followed_at(windows, theta, again, noise, prior, tuning)
            continue
        step = None if isinstance(look, Doubt) else onward(windows, look, prior, tuning)
        if isinstance(look, Doubt) or step is None:
            return look
        look = followed_at(windows, *step, look.at.noise, prior, tuning)
    return look


def followed_at(
    windows: Windows,
    theta: FloatArray,
    starts: FloatArray,
    noise: Noise,
    prior: QuadraticPrior,
    tuning: FollowedTuning = FOLLOWED,
) -> FollowedLook | Doubt:
    """Those that are followed at theta (N,) and starts (W, D); else as ``followed_windows``."""
    lin = windows.linearise(theta, starts)
    if not lin.valid:
        return Doubt.DIVERGES
    near, sd = _near(windows, lin.residual, noise.tau, tuning)
    if near.any((1, 2)).sum() < tuning.share * windows.num_windows:
        return Doubt.LOST
    near &= _smooth(windows, lin, theta, starts, sd, tuning)[:, None, None]
    at = Followed(near, theta, starts, Noise(sd, noise.tau))
    few = len(at.kept) < max(tuning.fewest, tuning.share * windows.num_windows)
    if few or not (near.any((0, 1)) | ~windows.observed.any((0, 1))).all():
        return Doubt.LOST if _loose(windows, sd, tuning) else Doubt.FEW
    part, own, coloured = at.of(windows), _trimmed(lin, at), bool((noise.tau > 0).any())
    moments, held = part.moments(own), at.held(prior)
    noise = updated_noise(part, moments, at.noise, theta, starts[at.kept], held, coloured, False)
    return FollowedLook(Followed(near, theta, starts, noise), part, own, lin)


def onward(
    windows: Windows,
    look: FollowedLook,
    prior: QuadraticPrior,
    tuning: FollowedTuning = FOLLOWED,
    growing: GrowingTuning = _GROWING,
) -> tuple[FloatArray, FloatArray] | None:
    """Theta (N,) and starts (W, D) after a step downhill; None where nothing is to be gained, or a window diverges.

    Starts of windows that are not followed are looked for anew there.
    """
    at = look.at
    step = _step(windows, look, at.held(prior), tuning, growing).point
    if step is None:
        return None
    moved = at.starts.copy()
    moved[at.kept] = step.starts
    lost = np.setdiff1d(np.arange(windows.num_windows), at.kept)
    starts = regrown(windows, lost, step.theta, moved, at.noise, tuning, growing)
    return None if starts is None else (step.theta, starts)


def regrown(
    windows: Windows,
    lost: IntArray,
    theta: FloatArray,
    starts: FloatArray,
    noise: Noise,
    tuning: FollowedTuning = FOLLOWED,
    growing: GrowingTuning = _GROWING,
) -> FloatArray | None:
    """Starts (W, D) of which those of the windows that are lost (K,) are looked for anew, from their first moments on.

    A search over the whole of a window ends in a wrong valley where it misses an impact; at a theta (N,) that is nearly
    right, beginnings that grow meet one impact after the other. Each window keeps the start that fits it better; None
    where one diverges from both.
    """
    starts = starts.copy()
    if not len(lost):
        return starts
    part = windows.part(lost)
    before = lent(windows, part)
    try:
        tried = np.stack([starts[lost], grown_starts(part, theta, noise, growing, tuning.first)])
        predicted, _ = part.predict(np.tile(theta, (2, 1)), tried)
    finally:
        counted(windows, part, before)
    residual = np.where(part.observed, (part.measured - predicted) / noise.sd, 0.0)
    square = np.nan_to_num((residual**2).sum((2, 3)), nan=np.inf)  # NaN where a window diverged
    starts[lost] = tried[square.argmin(0), np.arange(len(lost))]
    return starts if np.isfinite(square.min(0)).all() else None


def _step(
    windows: Windows, look: FollowedLook, prior: QuadraticPrior, tuning: FollowedTuning, growing: GrowingTuning
) -> Descent[WindowPoint]:
    """A step downhill of theta and the starts of what is followed."""
    at, part = look.at, look.windows
    before = lent(windows, part)
    energy, point = WindowEnergy(part, at.noise, prior), WindowPoint(at.theta, at.starts[at.kept], look.lin.residual)
    linearised = ManyStarts(energy, point, part.moments(look.lin), growing.shares)
    descent = descend(linearised, _RULE.first, tuning.settled, _RULE)
    counted(windows, part, before)
    return descent


def agreement(look: FollowedLook, groups: int) -> float:
    """Chance that groups of windows that are followed would ask for as different values: small where a model is wrong.

    Each group's theta is that of its linearisation; what they leave less than one theta for all does is chi-square
    (W. G. Cochran, "The combination of estimates from different experiments", 1954, https://doi.org/10.2307/3001666).

    Args:
        look: at the optimum of all of them.
        groups: at most, of two windows or more, taken in turn.
    """
    at, windows, kept = look.at, look.windows, look.at.starts[look.at.kept]
    count, n = min(groups, len(kept) // 2), len(look.at.theta)
    precision, gradient, gained = np.zeros((n, n)), np.zeros(n), 0.0
    for number in range(count):
        own = np.arange(number, len(kept), count)
        lin = Linearisation(look.lin.residual[own], look.lin.jacobian[own], True)
        moments = windows.part(own).moments(lin)
        pull = -windows.start_precision * kept[own]
        solved = eliminate_starts(moments.normal(at.noise), n, windows.start_precision, pull)
        gained += _explained(solved.precision, solved.gradient)
        precision, gradient = precision + solved.precision, gradient + solved.gradient
    return float(scipy.stats.chi2.sf(gained - _explained(precision, gradient), n * (count - 1)))


def _explained(precision: FloatArray, gradient: FloatArray) -> float:
    """Twice the nats that a step gains; none of directions that nothing tells."""
    return float(gradient @ np.linalg.pinv(precision, rcond=1e-12, hermitian=True) @ gradient)


def _near(
    windows: Windows, residual: FloatArray, tau: FloatArray, tuning: FollowedTuning
) -> tuple[BoolArray, FloatArray]:
    """Samples (W, L, C) that count, none in windows that are not followed, and the noise's robust sd (C,)."""
    observed = windows.observed
    size = np.where(observed, np.abs(residual), np.nan)
    measured = observed.any((0, 1))
    middle = np.nanmedian(np.where(measured, size, 0.0), axis=(0, 1))
    sd = np.maximum(NORMAL_MAD * middle, np.nan_to_num(windows.rounding))
    near = observed & (np.abs(residual) <= tuning.far * sd)
    every, some = observed.sum(1), near.sum(1)  # (W, C)
    square = coefficients(windows.dt[:, None], tau) ** 2
    freedom = np.maximum(some * (1 - square) / (1 + square), tuning.least)
    most = scipy.stats.chi2.isf(tuning.chance / max(1, int((every > 0).sum())), freedom) / freedom
    mean = np.where(near, residual**2, 0.0).sum(1) / np.maximum(some, 1)
    followed = (every == 0) | ((mean <= sd**2 * most) & (every - some <= tuning.most_far * every))
    return near & followed.all(1)[:, None, None], sd


def _loose(windows: Windows, sd: FloatArray, tuning: FollowedTuning) -> bool:
    """Whether noise sds (C,) hide as much as the samples scatter by; not of a channel that rests."""
    scatter = level(windows).sd
    return bool(((scatter > tuning.moves * windows.rounding) & (sd > tuning.loose * scatter)).any())


def _smooth(
    windows: Windows,
    lin: Linearisation,
    theta: FloatArray,
    starts: FloatArray,
    sd: FloatArray,
    tuning: FollowedTuning,
) -> BoolArray:
    """In which windows (W,) slopes over short changes of theta are those over wider ones, where they matter."""
    wider = windows.linearise(theta, starts, with_starts=False, residual=lin.residual, theta_step=tuning.wider)
    scale = np.maximum(sd, np.finfo(float).tiny)[:, None]
    short, wide = lin.jacobian[..., : windows.num_theta] / scale, wider.jacobian / scale
    apart, larger = (np.sqrt((x**2).sum((1, 2))) for x in (short - wide, np.maximum(np.abs(short), np.abs(wide))))
    return np.asarray((apart <= np.maximum(tuning.differs * larger, tuning.matters)).all(1))


def _trimmed(lin: Linearisation, at: Followed) -> Linearisation:
    """Of the windows that are followed, and the samples that count."""
    own = at.counted[at.kept]
    jacobian = np.where(own[..., None], lin.jacobian[at.kept], 0.0)
    return Linearisation(np.where(own, lin.residual[at.kept], 0.0), jacobian, True)
