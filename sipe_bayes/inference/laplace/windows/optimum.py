"""What is made of where a search over windows ended: a normal in theta, its evidence, and what is around it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sipe_bayes.core.arrays import BoolArray, FloatArray
from sipe_bayes.core.findings import Code, finding
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.inference.laplace.strategy import SearchProblem
from sipe_bayes.inference.laplace.windows.contact_starts import begins_in_contact
from sipe_bayes.inference.laplace.windows.energy import (
    WindowEnergy,
    beyond_rounding,
    beyond_start_noise,
    free_noise,
    misfit,
    noise_at_least,
    pulls,
    unevenly_left,
    updated_noise,
)
from sipe_bayes.inference.laplace.windows.growing_windows import level
from sipe_bayes.inference.laplace.windows.pattern_search import (
    Surroundings,
    nearest_points,
    pattern_search,
    pattern_size,
)
from sipe_bayes.inference.laplace.windows.state import WindowOptimum
from sipe_bayes.likelihood.block_tridiagonal import Eliminated
from sipe_bayes.likelihood.moments import Moments
from sipe_bayes.likelihood.noise import Noise
from sipe_bayes.likelihood.noise_spread import noise_cloud, sandwich
from sipe_bayes.likelihood.restricted import eliminate_starts, restricted
from sipe_bayes.likelihood.windows import Windows

_HELD = 1e-6  # of the cube: a parameter that the search left on its bound


@dataclass(frozen=True)
class Ending:
    """Where a search stood still, and how it came there.

    Args:
        theta: (N,).
        starts: (W, D).
        noise: for which theta and starts are best.
        moments: of the linearisation there.
        residual: (W, L, C), likewise.
        jacobian: (W, L, C, N + D), likewise.
        begin: (N,), the starting point.
        steps: from there.
        first_misfit: of the residuals at the starting point, in units of the channels' spread.
        refused: nats that the last steps were to gain, none of which gained anything.
        tells: whether that is a finding: not where the surroundings are looked at. The normal stays where the search
            ended, and reaches as far as was promised, either way.
        settled: whether nothing moved any more.
        cut_short: whether the budget ends.
        bettered: the optimum before, from which a pattern search led here; this one is to be no narrower.
    """

    theta: FloatArray
    starts: FloatArray
    noise: Noise
    moments: Moments
    residual: FloatArray
    jacobian: FloatArray
    begin: FloatArray
    steps: int
    first_misfit: float
    refused: float
    tells: bool
    settled: bool
    cut_short: bool
    bettered: WindowOptimum | None


def is_broken(problem: SearchProblem, windows: Windows, theta: FloatArray, refused: float) -> bool:
    """Whether a linearisation at theta (N,) promises what no simulation keeps.

    Steps of theta and the starts that were to gain more than rounding, ``refused`` nats, have gained nothing.
    """
    return windows.num_start > 0 and refused > problem.options.tuning.windows.most_drift


def summarised(problem: SearchProblem, windows: Windows, ending: Ending) -> WindowOptimum:
    """The normal over the noise's uncertainty, and the evidence."""
    theta, starts, noise, moments = ending.theta, ending.starts, ending.noise, ending.moments
    prior, start_pull, sandwiched = problem.quadratic_prior, -windows.start_precision * starts, sandwiches(windows)
    solved = eliminate_starts(moments.normal(noise), moments.num_theta, windows.start_precision, start_pull)
    held = is_broken(problem, windows, theta, ending.refused)
    here = pulls(windows, prior, theta, starts, solved.gradient, held)
    prior_energy = prior.energy(theta) + 0.5 * float((starts**2 @ windows.start_precision).sum())
    evidence = restricted(moments, noise, replace(here, free=np.full(len(theta), True)))[0] - prior_energy
    white = noise.sd
    if sandwiched:
        noise = updated_noise(windows, moments, noise, theta, starts, prior, coloured=True, held=held)
    mean, covariance = np.zeros(len(theta)), np.zeros((len(theta), len(theta)))
    centres = []
    # moments of the normals of a few weighted noise values
    for weight, point in noise_cloud(moments, noise, here, free_noise(windows), windows.trajectories.longest):
        if sandwiched:
            middle = sandwich(ending.jacobian, solved.slope, white, windows.sequences, point)
            centre, spread = problem.normal(theta, *_sandwiched(solved, middle, here.free))
        else:
            point = beyond_rounding(windows, point)
            inner = eliminate_starts(moments.normal(point), moments.num_theta, windows.start_precision, start_pull)
            centre, spread = problem.normal(theta, inner.precision, inner.gradient)
        mean += weight * centre
        covariance += weight * spread
        centres.append((weight, centre))
    for weight, centre in centres:
        covariance += weight * np.outer(centre - mean, centre - mean)
    return WindowOptimum(theta, mean, covariance, evidence, noise.sd, noise.tau, starts, solved.slope)


def sandwiches(windows: Windows) -> bool:
    """Whether the width comes from other noise than the optimum."""
    return windows.settings.noise == "sandwich"


def _sandwiched(solved: Eliminated, middle: FloatArray, free: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Precision and gradient of plain least squares when the residuals' covariance gives ``middle`` (N, N).

    Parameters that a bound holds, not ``free`` (N,), stay there: the sandwich does not say where others would follow.
    """
    shift, inner = np.zeros(len(free)), solved.precision[np.ix_(free, free)]
    shift[free] = np.linalg.pinv(inner, rcond=1e-12, hermitian=True) @ solved.gradient[free]
    precision = solved.precision @ np.linalg.pinv(middle, rcond=1e-12, hermitian=True) @ solved.precision
    # rounding leaves some of an open direction negative
    eigenvalues, axes = np.linalg.eigh(0.5 * (precision + precision.T))
    precision = (axes * np.maximum(eigenvalues, 0.0)) @ axes.T
    return precision, precision @ shift


def surroundings(
    problem: SearchProblem, windows: Windows, theta: FloatArray, noise: Noise, covariance: FloatArray
) -> Surroundings | None:
    """What a pattern search sees around an optimum; None where starts are searched too or the budget has no room."""
    tuning = problem.options.tuning.pattern
    if windows.num_start:
        return None
    if not windows.has_room(pattern_size(len(theta), tuning)):
        return None
    starts = windows.no_starts()

    def simulated(thetas: FloatArray) -> tuple[FloatArray, BoolArray]:
        return windows.residuals(thetas, np.tile(starts, (len(thetas), 1, 1)))

    near = nearest_points(theta)
    residual, valid = simulated(near)
    noise = noise_at_least(windows, noise, residual[valid])
    energy = WindowEnergy(windows, noise, problem.quadratic_prior)

    def energies(thetas: FloatArray) -> FloatArray:
        residual, valid = simulated(thetas)
        return np.where(valid, energy.each(thetas, starts, residual), np.inf)

    level = float(energy.each(near[valid], starts, residual[valid]).max(initial=-np.inf))
    return pattern_search(energies, theta, covariance, tuning, level)


def middle_of_ridge(problem: SearchProblem, windows: Windows, optimum: WindowOptimum) -> FloatArray | None:
    """The middle (N,) of a ridge, to go on from, so that the width across it does not depend on the start.

    None where no direction is open or the middle does not fit as well.
    """
    tuning = problem.options.tuning.windows
    theta, starts, noise = optimum.theta, optimum.starts, Noise(optimum.sd, optimum.tau)
    eigenvalues, axes = np.linalg.eigh(optimum.covariance)
    open_axes = axes[:, eigenvalues > tuning.open_sd**2]
    move = open_axes @ (open_axes.T @ (optimum.mean - theta))
    if not len(move) or np.abs(move).max() < tuning.off_centre:
        return None
    trials = np.clip(theta + np.array([[0.0], [1.0], [0.5], [0.25]]) * move, 0, 1)  # first the optimum itself
    if not windows.has_room(len(trials)):
        return None
    residual, valid = windows.residuals(trials, np.tile(starts, (len(trials), 1, 1)))
    values = WindowEnergy(windows, noise, problem.quadratic_prior).each(trials, starts, residual)
    good = [k for k in range(1, len(trials)) if valid[k] and values[k] < values[0] + tuning.as_good]
    return trials[good[0]] if good else None


def judged(
    problem: SearchProblem, windows: Windows, optimum: WindowOptimum, around: Surroundings | None, ending: Ending
) -> WindowOptimum:
    """The optimum as wide as its surroundings ask for, with what is to be said against it.

    ``around`` is None where they were not looked at.
    """
    most, covariance, reason = problem.options.tuning.windows.most_drift, optimum.covariance, optimum.finding
    unsmooth, gain, off = ending.tells and ending.refused > most, ending.refused, optimum.mean - ending.theta
    if windows.num_start and sandwiches(windows):  # in nats of its own width
        gain = 0.5 * float(off @ np.linalg.pinv(covariance, rcond=1e-12, hermitian=True) @ off)
    if ending.cut_short and not ending.settled:
        reason = finding(Code.SEARCH_CUT_SHORT)
    elif not ending.settled:
        reason = finding(Code.SEARCH_UNSETTLED, steps=ending.steps)
    elif unsmooth and gain > most:
        reason = finding(Code.NOT_SMOOTH, gain=gain)
    elif (times := beyond_start_noise(windows, optimum.sd)) is not None:
        reason = finding(Code.BEYOND_START_NOISE, times=times, which="all")
    elif begins_in_contact(windows) and (times := unevenly_left(windows, ending.residual)) is not None:
        reason = finding(Code.BEYOND_START_NOISE, times=times, which="some")
    if around is not None:
        covariance = around.covariance
        reason = finding(Code.ROUGH_EVERYWHERE) if around.rough else reason
    elif not windows.num_start:
        reason = reason or finding(Code.NOT_LOOKED_AROUND)
    if around is None and ending.bettered is not None:
        covariance = covariance + ending.bettered.covariance
    guessed = (ending.cut_short and not ending.settled) or (unsmooth and not windows.num_start)
    guessed = guessed or (around is not None and around.rough)
    guessed = guessed or (reason is not None and reason.code is Code.BEYOND_START_NOISE)
    if guessed:
        left = misfit(windows, ending.residual) / ending.first_misfit
        way = float(np.sqrt(((ending.theta - ending.begin) ** 2).mean()))
        covariance = covariance + (way * min(1.0, left)) ** 2 * np.eye(len(ending.theta))
    if is_broken(problem, windows, ending.theta, ending.refused):
        # the normal's middle lies where a slope led that no simulation follows
        refused = _within_cube(ending.theta, optimum.mean - ending.theta)
        optimum, covariance = replace(optimum, mean=ending.theta), covariance + np.outer(refused, refused)
    heavier = around is not None and around.heavier
    return replace(optimum, covariance=covariance, guessed=guessed, heavier=heavier, finding=reason)


def _within_cube(theta: FloatArray, way: FloatArray) -> FloatArray:
    """As much of a way (N,) from theta (N,) as the cube leaves, along it; parameters at a bound are held there."""
    room = np.where(way > 0, 1 - theta, theta)
    moves = (room > _HELD) & (np.abs(way) > 0)
    share = min(1.0, float((room[moves] / np.abs(way[moves])).min(initial=1.0)))
    return np.where(moves, share * way, 0.0)


def not_followed(windows: Windows, sd: FloatArray) -> tuple[str, float] | None:
    """The channel that a fit with noise sds (C,) does not follow, and its noise over the scatter of its samples.

    Noise that is a good part of what a channel does is none where the samples do not scatter by it, whatever its time.
    """
    excess = np.where(sd > THRESHOLDS.gross * windows.spread, sd / level(windows).sd, 0.0)
    worst = int(excess.argmax())
    return (windows.fitted[worst], float(excess[worst])) if excess[worst] > THRESHOLDS.noise_excess else None
