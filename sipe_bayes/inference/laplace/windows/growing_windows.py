"""Windows through impacts: their beginnings first, ever longer, and each window's start the best of several.

Of bodies that tumble, a measured pose tells nearly where a window starts, and its first tenth of a second, followed by
the model, ten times nearer. But an impact magnifies what is left, the next one that, and a simulation that misses a
corner's touch has no slope towards the one that does not. A beginning with one impact is nearly smooth; fitted, it
foretells the next impact nearly enough (H. U. Voss, J. Timmer, J. Kurths, "Nonlinear dynamical system identification
from uncertain and indirect measurements", 2004, https://doi.org/10.1142/S0218127404010345). So theta and the starts
descend together on beginnings that grow. And since windows meet in theta alone, each takes as much of a step of its
start as serves it best: one that misses an impact on the way holds back itself, not the search.

A joint that strikes a stop, or a ball that a slide carries, is magnified alike, if its contacts come and go; and what
stays on the ground, as a rover on its wheels, where it slips and sticks there: simulations then are steeper over short
changes of the parameters than over wide ones (``simulation.contacts``).

Contact that chatters (a body that lies or is pushed) jumps over short differences, whose slopes then say nothing, and
starts would follow them anywhere. So theta moves alone at first, by those starts, over wide differences. They
shrink where nothing is left to gain over them, as long as the slopes do not grow with that.

The noise meanwhile is white, of the size that the samples' roughness shows whatever the model.

Through impacts the likelihood has valleys within valleys, each far narrower than they lie apart, and no search is sure
to end in the deepest. So the curvature where it ended says little of how well theta is known. Groups of windows are
fitted apart, each from starts of their own. Where their estimates scatter by more than the curvature says, the
posterior is a normal half way between their mean and the estimate of all windows together. Its covariance is that of a
mean of so few (batch means, as Student's t has it), and holds both of these. Of the windows that the model follows far
more is known: where their own optimum stands (``followed_posterior``), it takes the place of that normal.
"""

from __future__ import annotations

import math
from dataclasses import replace
from enum import StrEnum

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.findings import Code, Finding, finding
from sipe_bayes.envs.poses import inertial_joints
from sipe_bayes.inference.laplace.levenberg_marquardt import DampingRule, descend
from sipe_bayes.inference.laplace.options import GrowingTuning
from sipe_bayes.inference.laplace.windows.energy import LinearisedWindows, WindowEnergy, WindowPoint
from sipe_bayes.inference.laplace.windows.state import Kept, Phase, Position, WindowOptimum
from sipe_bayes.likelihood.moments import Moments
from sipe_bayes.likelihood.noise import NORMAL_MAD, Noise, noise_level, pooled
from sipe_bayes.likelihood.quadratic_prior import QuadraticPrior
from sipe_bayes.likelihood.restricted import marginal
from sipe_bayes.likelihood.starts.estimates import STATE_STEP
from sipe_bayes.likelihood.windows import Windows


class Doubt(StrEnum):
    """Why the scatter of groups is the posterior, and not the optimum of the windows that are followed."""

    UNASKED = "the budget left no room to choose the windows that the model follows"
    DIVERGES = "the simulation diverges where the windows that the model follows were looked for"
    LOST = "the model does not follow the windows"
    FEW = "the model follows too few windows, or jumps there"
    SANDWICH = 'of the windows that the model follows nothing is known with noise = "sandwich"'
    UNSETTLED = "no search came to the optimum of the windows that the model follows"
    APART = "the windows that the model follows ask for different values"
    WIDER = "the windows that the model follows tell less"


class ManyStarts(LinearisedWindows):
    """As ``LinearisedWindows``; of a step each window's start takes the best of several shares."""

    def __init__(self, of: WindowEnergy, point: WindowPoint, moments: Moments, shares: tuple[float, ...]) -> None:
        super().__init__(of, point, moments)
        self.shares = np.array(shares)

    def simulated(self, theta: FloatArray, change: FloatArray) -> tuple[WindowPoint, float]:
        """The point at theta (N,) with the starts changed by shares of (W, D), and its energy."""
        windows, noise = self.of.windows, self.of.noise
        tried = self.point.starts + self.shares[:, None, None] * change
        predicted, _ = windows.predict(np.tile(theta, (len(tried), 1)), tried)
        residual = np.where(windows.observed, windows.measured - predicted, 0.0)
        square = ((residual / noise.sd) ** 2).sum((2, 3)) + tried**2 @ windows.start_precision
        square = np.where(np.isfinite(square), square, np.inf)  # NaN where a window diverged
        best, each = square.argmin(0), np.arange(windows.num_windows)
        point = WindowPoint(theta, tried[best, each], residual[best, each])
        if not np.isfinite(square.min(0)).all():
            return point, np.inf
        return point, self.of(theta, point.starts, point.residual)


def grows(windows: Windows) -> bool:
    """Whether windows are searched by their beginnings: bodies that tumble or strike something, or slip on it.

    With starts to estimate.
    """
    return windows.grows


def first_horizon(windows: Windows, tuning: GrowingTuning) -> int:
    """Control steps of the first beginnings."""
    return max(2, math.ceil(tuning.first * int(windows.steps.max())))


def first_beginnings(
    windows: Windows, here: Position, tuning: GrowingTuning, after: Position | None = None
) -> Position:
    """A starting point on the first beginnings, theta alone; after a search without jumps, over short differences."""
    horizon, jumps = first_horizon(windows, tuning), after is not None and after.jumps
    here = replace(
        here, phase=Phase.GROW, horizon=horizon, jumps=jumps, starts=told_starts(windows, here.theta, tuning)
    )
    return here if after is not None and not jumps else replace(here, theta_step=tuning.widest, alone=True)


def level(windows: Windows) -> Noise:
    """White noise of the size that the samples' roughness shows, or as given."""
    rough = noise_level(windows.trajectories, windows.settings, windows.simulator)[windows.channels]
    rough = pooled(np.maximum(rough, windows.rounding), windows.scales)
    return Noise(np.where(np.isnan(windows.fixed_sd), rough, windows.fixed_sd), np.zeros(len(rough)))


def grown(
    windows: Windows, part: Windows, prior: QuadraticPrior, here: Position, tuning: GrowingTuning, rule: DampingRule
) -> Position:
    """The search after a step on the present beginnings; then on longer ones, or in the phase that follows.

    Args:
        windows: all of them, which count the rollouts.
        part: those that are searched.
        prior: of theta.
        here: where the search stands.
        tuning: how they grow.
        rule: how steps are damped.

    Raises:
        BudgetExhausted: where there is no budget for the step.
    """
    longest = int(part.steps.max())
    view = part.beginnings(here.horizon)
    before = windows.rollouts
    view.rollouts, view.budget = before, windows.budget
    size = np.clip(here.theta_step, view.theta_step, tuning.widest)
    of_starts = start_steps(view, size) if size > view.theta_step else STATE_STEP
    lin = view.linearise(here.theta, here.starts, with_starts=not here.alone, theta_step=size, start_step=of_starts)
    if here.alone:
        fixed = np.zeros((*lin.residual.shape, windows.num_start))
        lin = replace(lin, jacobian=np.concatenate([lin.jacobian, fixed], axis=-1))
    noise = level(windows)
    slope = float(np.sqrt(((lin.jacobian[..., : windows.num_theta] / noise.sd[:, None]) ** 2).sum()))
    point = WindowPoint(here.theta, here.starts, lin.residual)
    energy = WindowEnergy(view, noise, prior)
    linearised = ManyStarts(energy, point, view.moments(lin, white=True), tuning.shares)
    if here.slope and slope > tuning.rougher * here.slope and size < tuning.widest:  # these differences are luck
        counted(windows, view, before)
        return replace(here, theta_step=size * tuning.finer, slope=0.0, jumps=True)
    fit = descend(linearised, here.damping, max(tuning.enough * linearised.energy, 0.02), rule)
    counted(windows, view, before)
    point, steps = fit.point or point, here.iteration + 1
    here = replace(here, theta=point.theta, starts=point.starts, damping=fit.damping, iteration=steps)
    on = fit.converged or fit.gained < tuning.enough * linearised.energy or steps >= tuning.most_steps
    if not on and lin.valid:
        return replace(here, slope=0.0)
    if lin.valid and here.alone:
        return replace(here, alone=False, damping=rule.first, iteration=0, slope=0.0)
    if lin.valid and size > view.theta_step and not here.jumps:
        return replace(here, theta_step=max(size / tuning.finer, view.theta_step), slope=slope, iteration=0)
    here = replace(here, slope=0.0)
    damping = min(here.damping, tuning.damping)
    if here.horizon >= longest or not lin.valid:
        return replace(here, phase=Phase.ROUGH, damping=damping, iteration=0, kept=Kept())
    horizon = min(longest, math.ceil(tuning.growth * here.horizon))
    return replace(here, horizon=horizon, damping=damping, iteration=0)


def start_steps(windows: Windows, size: float) -> FloatArray:
    """Differences (D,) of the starts beside ``size`` of theta: positions, then velocities."""
    half = windows.num_start // 2
    return size * np.concatenate([np.full(half, 0.05), np.full(windows.num_start - half, 0.5)])


def tells_starts(windows: Windows) -> bool:
    """Whether first moments tell starts: of windows that grow, but of bodies that are only felt (an inertial unit)."""
    if not grows(windows):
        return False
    return not inertial_joints(windows.simulator.model, windows.simulator.environment.poses)


def told_starts(windows: Windows, theta: FloatArray, tuning: GrowingTuning) -> FloatArray:
    """Starts (W, D) that the first moments of the windows tell of at a fixed theta (N,): of what follows nothing.

    The measured ones where ``tells_starts`` says no.
    """
    if not tells_starts(windows):
        return windows.no_starts()
    steps, before = math.ceil(tuning.telling / float(windows.dt.min())), windows.rollouts
    view = windows.beginnings(max(tuning.fewest_steps, steps))
    starts = grown_starts(view, theta, level(windows), replace(tuning, first=1.0))
    counted(windows, view, before)
    return starts


def measured_starts(windows: Windows, theta: FloatArray, near: FloatArray | None = None) -> FloatArray:
    """Starts (B, W, D) of theta (B, N): zero is what was measured; of bodies that tumble their first moments tell more.

    Of these the starts of ``near`` (N,) serve all, default each theta its own.
    """
    if tells_starts(windows) and windows.trajectories.states is None:
        own = [told_starts(windows, at, GrowingTuning()) for at in (theta if near is None else near[None])]
        return np.broadcast_to(np.stack(own), (len(theta), *own[0].shape))
    return np.tile(windows.no_starts(), (len(theta), 1, 1))


def lent(windows: Windows, view: Windows) -> int:
    """Let a view of the windows, which simulates a share of them, spend what they have left; the rollouts until now."""
    before, share = windows.rollouts, float(view.steps.sum() / windows.steps.sum())
    view.rollouts, view.budget = before, before + (windows.budget - before) / share
    return before


def counted(windows: Windows, view: Windows, before: int) -> None:
    """Count the rollouts of a view of the windows, which simulates a share of them, since there were ``before``."""
    windows.rollouts = before + math.ceil((view.rollouts - before) * (view.steps.sum() / windows.steps.sum()))


def grown_starts(
    windows: Windows, theta: FloatArray, noise: Noise, tuning: GrowingTuning, first: int | None = None
) -> FloatArray:
    """Starts (W, D) that fit best at a fixed theta (N,), found on beginnings that grow, each for itself.

    first: control steps of the first beginnings; default as ``tuning`` has it.
    """
    starts, horizon = windows.no_starts(), first or first_horizon(windows, tuning)
    white, flat = Noise(noise.sd, np.zeros_like(noise.tau)), QuadraticPrior(theta, np.zeros((len(theta), len(theta))))
    while True:
        view = windows.beginnings(horizon)
        before, energy = lent(windows, view), WindowEnergy(view, white, flat)
        try:
            for _ in range(tuning.start_steps):
                lin = view.linearise(theta, starts, with_theta=False)
                if not lin.valid:
                    return starts
                moments = view.moments(lin, white=True)
                linearised = ManyStarts(energy, WindowPoint(theta, starts, lin.residual), moments, tuning.shares)
                change = marginal(moments, white, starts, view.start_precision)[1]
                point, after = linearised.simulated(theta, change)
                gained = linearised.energy - after
                starts = point.starts if gained > 0 else starts
                if gained < tuning.enough * linearised.energy:
                    break
        finally:
            counted(windows, view, before)
        if horizon >= windows.steps.max():
            return starts
        horizon = math.ceil(tuning.growth * horizon)


def num_groups(windows: Windows, tuning: GrowingTuning) -> int:
    """How many groups of windows are fitted apart; zero where there are too few, or parameters of single logs."""
    count = min(tuning.groups, windows.num_windows // 2)
    shared = all(p.log is None for p in windows.simulator.space)
    return count if shared and count >= tuning.fewest else 0


def group(windows: Windows, number: int, count: int) -> Windows:
    """The windows of one group, taken in turn."""
    return windows.part(np.arange(number, windows.num_windows, count))


def scattered(
    optimum: WindowOptimum, estimates: FloatArray, tuning: GrowingTuning, slips: bool = False
) -> WindowOptimum:
    """The optimum with the normal that the scatter of estimates (G, N) gives, where the linearisation's is too narrow.

    In no direction is it narrower than that: what the logs leave open, every search leaves where it began.

    What slips all along (``slips``) is not believed: its jumps steepen every slope, also along a ridge, where all
    groups then stay together, however far off.
    """
    if slips:
        optimum = replace(optimum, finding=finding(Code.SLIPS, groups=len(estimates)))
    kept = _reliable(estimates, tuning)
    n, freedom = estimates.shape[1], len(kept) - 1
    covariance = np.atleast_2d(np.cov(kept.T)) / len(kept)
    excess = float(np.trace(np.linalg.solve(optimum.covariance, covariance))) / n
    if excess < tuning.rough:
        return optimum
    if freedom < 2 * n:  # so few say nothing of correlations
        covariance = np.diag(np.diag(covariance))
    covariance = not_below(covariance * freedom / (freedom - 2), optimum.covariance)  # of Student's t
    half = 0.5 * (kept.mean(0) - optimum.theta)
    covariance = covariance + np.outer(half, half)
    reason = optimum.finding if slips else scatter_finding(estimates, tuning, Doubt.UNASKED)
    return replace(optimum, mean=optimum.theta + half, covariance=covariance, finding=reason)


def scatter_finding(estimates: FloatArray, tuning: GrowingTuning, why: Doubt) -> Finding:
    """That the normal is that of the scatter of groups' estimates (G, N), and why."""
    lost = len(estimates) - len(_reliable(estimates, tuning))
    return finding(Code.SCATTER, groups=len(estimates), lost=lost, why=why)


def _reliable(estimates: FloatArray, tuning: GrowingTuning) -> FloatArray:
    """Without those far from the others, whose search was lost, while ``tuning.reliable`` are left."""
    gap = np.abs(estimates - np.median(estimates, axis=0))
    scale = NORMAL_MAD * np.median(gap, axis=0)
    kept = estimates[(gap <= tuning.lost * np.maximum(scale, 1e-9)).all(1)]
    return estimates if len(kept) < tuning.reliable else kept


def not_below(covariance: FloatArray, least: FloatArray) -> FloatArray:
    """The smallest covariance (N, N), along axes common to both, that has no smaller variance than either anywhere."""
    scale = np.sqrt(np.diag(least))
    squares, own = np.linalg.eigh(least / np.outer(scale, scale))
    lengths = np.sqrt(np.maximum(squares, 1e-12))  # a ridge may be singular to rounding
    white = (own / lengths).T / scale
    eigenvalues, axes = np.linalg.eigh(white @ covariance @ white.T)
    axes = scale[:, None] * own * lengths @ axes
    return np.asarray((axes * np.maximum(eigenvalues, 1.0)) @ axes.T)
