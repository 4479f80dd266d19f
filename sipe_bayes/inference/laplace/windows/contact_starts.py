"""Starting points through contact, where every window begins at a known state: one control step first, ever more.

A window's error is magnified by each impact, and the simulation jumps where one is missed: at a hundredth of the cube
from the truth five control steps of a half-cheetah are off by five times the noise, at a tenth by twenty, with an
optimum behind every jump. A single control step from a known state is nearly smooth, costs little and tells most. So
the best of many candidates go downhill on the first control step of all windows; the better half of the places where
they come to rest on longer beginnings, and so on, until the windows are whole.

Differences are wide at first: a short one across a jump is a slope of jump by length. They shrink where nothing is left
to gain over them, and begin on longer beginnings as long as theta is still open. Each channel counts by the size of
what is left of it: what is minimised is the sum of these sizes' logarithms, by the number of samples. Single control
steps go downhill twice, first by Student's t (K. L. Lange, R. J. A. Little, J. M. G. Taylor 1989, "Robust Statistical
Modeling Using the t Distribution", JASA 84), which bears the few windows that are still beyond an impact.

Where nothing touches, a whole log that begins at a known state is all the same hard to fit from afar: small errors of
theta grow with the time that is simulated, until a search stops in a side valley, or takes dozens of steps along the
bottom of one. There too the search goes downhill on beginnings of the log, from a sixteenth on, every other one twice
as long; the simulation is smooth, so that beginnings need neither wide differences nor single control steps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.inference.laplace.levenberg_marquardt import descend
from sipe_bayes.inference.laplace.screening import screen
from sipe_bayes.inference.laplace.strategy import SearchProblem
from sipe_bayes.inference.laplace.windows.energy import (
    LinearisedWindows,
    WindowEnergy,
    WindowPoint,
    beyond_start_noise,
    present_noise,
)
from sipe_bayes.likelihood.noise import NORMAL_MAD, Noise
from sipe_bayes.likelihood.quadratic_prior import QuadraticPrior
from sipe_bayes.likelihood.settings import BudgetExhausted
from sipe_bayes.likelihood.windows import Linearisation, Windows
from sipe_bayes.simulation.contacts import may_touch
from sipe_bayes.simulation.simulator import Simulator


@dataclass(frozen=True)
class _Plan:
    """How beginnings grow.

    Args:
        horizons: their control steps.
        widest: differences at first, of the cube.
        attempts: how often the search begins anew while more than the starts' noise is left.
        robust: whether the first go downhill by Student's t before.
    """

    horizons: tuple[int, ...]
    widest: float
    attempts: int
    robust: bool

    @classmethod
    def of(cls, problem: SearchProblem, windows: Windows) -> _Plan | None:
        """As the windows ask for; None where they are searched as they are."""
        tuning, longest = problem.options.tuning.contact, int(windows.steps.max())
        if begins_in_contact(windows):
            horizons = [1]
            while horizons[-1] < longest:
                horizons.append(min(longest, math.ceil(tuning.growth * horizons[-1])))
            return cls(tuple(horizons), tuning.widest, tuning.attempts, robust=True)
        if windows.num_start or not isinstance(windows.simulator, Simulator) or longest < tuning.long:
            return None
        return cls(tuple(int(longest * 2.0 ** (k / 2)) for k in range(-8, 0)), 0.0, 1, robust=False)


@dataclass(frozen=True)
class _Rest:
    """Where a search came to rest.

    Args:
        theta: (N,).
        misfit: what it minimises there.
        sd: (N,), of theta.
        fits: whether no more is left than the noise of the known starts.
    """

    theta: FloatArray
    misfit: float
    sd: FloatArray
    fits: bool

    def holds(self, other: _Rest) -> bool:
        """Whether another search came to rest in the same place."""
        return bool((np.abs(other.theta - self.theta) < self.sd).all())


@dataclass(frozen=True)
class _WeighedEnergy(WindowEnergy):
    """The energy where the residuals count by the squares of ``root`` (W, L, C)."""

    root: FloatArray

    def __call__(self, theta: FloatArray, starts: FloatArray, residual: FloatArray) -> float:
        """See ``WindowEnergy``."""
        return super().__call__(theta, starts, residual * self.root)


def begins_in_contact(windows: Windows) -> bool:
    """Whether windows begin at known states of a model in which something may touch."""
    simulator = windows.simulator
    return not windows.num_start and isinstance(simulator, Simulator) and may_touch(simulator.model)


def starting_points(problem: SearchProblem, windows: Windows) -> FloatArray:
    """Starting points (R, N): those given, those that beginnings lead to, or else by screening.

    Raises:
        ValueError: where every one diverges.
    """
    points = problem.options.initial
    if points is None:
        points = grown_starts(problem, windows)
    return screen(problem, windows) if points is None else points


def grown_starts(problem: SearchProblem, windows: Windows) -> FloatArray | None:
    """Starting points (R, N), the best first.

    None where windows are searched as they are, the budget is too small, or all diverge. The search begins anew from
    other candidates where the best one leaves more than the noise of the known starts.
    """
    plan = _Plan.of(problem, windows)
    if plan is None:
        return None
    options, tuning = problem.options, problem.options.tuning.contact
    limit, rests = windows.rollouts + tuning.budget_share * (windows.budget - windows.rollouts), list[_Rest]()
    generator = torch.Generator().manual_seed(problem.seed)
    for _ in range(plan.attempts):
        new, whole = _attempt(problem, windows, plan, limit, generator)
        for one in new if whole or not rests else []:
            rests = _with(rests, one)
        if not whole or (rests and rests[0].fits):
            break
    hopeless = tuning.hopeless * windows.observed.sum()
    kept = [rest.theta for rest in rests[: options.restarts] if rest.misfit < rests[0].misfit + hopeless]
    return np.stack(kept) if kept else None


def _attempt(
    problem: SearchProblem, windows: Windows, plan: _Plan, limit: float, generator: torch.Generator
) -> tuple[list[_Rest], bool]:
    """Where searches from some candidates come to rest, the best first, and whether all beginnings were fitted."""
    rests, first = list[_Rest](), plan.horizons[0]
    widest = np.full(windows.num_theta, plan.widest)
    try:
        for point in _screened(problem, windows, first, limit, generator):
            if not plan.robust:
                rests = _with(rests, _rest(problem, windows, first, limit, point, widest))
                continue
            robust = _rest(problem, windows, first, limit, point, widest, robust=True)
            if robust is not None:
                widths = np.minimum(robust.sd, widest)
                rests = _with(rests, _rest(problem, windows, first, limit, robust.theta, widths))
        for horizon in plan.horizons[1:]:
            before, after = rests[: max(problem.options.restarts, len(rests) // 2)], list[_Rest]()
            for one in before:
                widths = np.minimum(one.sd, widest)
                after = _with(after, _rest(problem, windows, horizon, limit, one.theta, widths))
            rests = after
    except BudgetExhausted:
        return rests, False
    return rests, True


def _with(rests: list[_Rest], new: _Rest | None) -> list[_Rest]:
    """The rests with a new one, the best first, of those in one place the best alone."""
    every = sorted(rests if new is None else [*rests, new], key=lambda rest: rest.misfit)
    return [one for k, one in enumerate(every) if not any(better.holds(one) for better in every[:k])]


def _screened(
    problem: SearchProblem, windows: Windows, horizon: int, limit: float, generator: torch.Generator
) -> FloatArray:
    """The best (S, N) of the model as given and draws of the prior, by the first control steps of every window.

    Raises:
        BudgetExhausted: where the budget ends.
    """
    tuning, count = problem.options.tuning.contact, problem.options.candidates
    count = max(count, tuning.candidates) if count else 0
    draws = problem.prior.sample((count,), generator=generator).numpy()
    points = np.concatenate([problem.space.default_theta[None], draws])
    view, share = _beginning(windows, horizon, limit)
    residual, valid = view.residuals(points, np.tile(view.no_starts(), (len(points), 1, 1)))
    windows.rollouts += math.ceil(view.rollouts * share)
    misfits = [_misfit(view, one) if good else np.inf for one, good in zip(residual, valid, strict=True)]
    return points[np.argsort(misfits, kind="stable")[: min(tuning.followed, int(valid.sum()))]]


def _rest(
    problem: SearchProblem,
    windows: Windows,
    horizon: int,
    limit: float,
    theta: FloatArray,
    widths: FloatArray,
    robust: bool = False,
) -> _Rest | None:
    """Where a search from theta (N,) on beginnings comes to rest; None where it diverges.

    widths: (N,), of the first differences. robust: by Student's t.

    Raises:
        BudgetExhausted: where the budget ends.
    """
    view, share = _beginning(windows, horizon, limit)
    tuning, rule, starts = problem.options.tuning.contact, problem.options.tuning.damping, view.no_starts()
    least = np.maximum(max(view.theta_step, tuning.narrowest), view.least_steps(theta))
    size = np.maximum(widths, least)
    damping, residual = rule.first, np.zeros(0)
    try:
        for number in range(tuning.most_steps):
            lin = view.linearise(theta, starts, residual=residual if number else None, theta_step=size)
            if not lin.valid:
                return None
            linearised = _linearised(view, lin, theta, problem.quadratic_prior, tuning.freedom if robust else None)
            covariance = problem.normal(theta, linearised.model(0.0).hessian, np.zeros(len(theta)))[1]
            tolerance = tuning.enough * linearised.energy
            fit = descend(linearised, damping, tolerance, rule)
            point = fit.point or linearised.point
            theta, residual, damping = point.theta, point.residual, fit.damping
            if fit.gained < tolerance:
                if (size <= least).all():
                    break
                size, damping = np.maximum(size / tuning.finer, least), rule.first
    finally:
        windows.rollouts += math.ceil(view.rollouts * share)
    fits = beyond_start_noise(view, present_noise(view, residual).sd) is None
    return _Rest(theta, _misfit(view, residual), np.sqrt(np.diag(covariance)), fits)


def _beginning(windows: Windows, horizon: int, limit: float) -> tuple[Windows, float]:
    """The first control steps of all windows, with a count and a budget of their own; and how much of whole ones."""
    view = windows.part(np.arange(windows.num_windows)).beginnings(horizon)
    share = float(view.steps.sum() / windows.steps.sum())
    view.rollouts, view.budget = 0, (limit - windows.rollouts) / share
    return view, share


def _linearised(
    windows: Windows, lin: Linearisation, theta: FloatArray, prior: QuadraticPrior, freedom: float | None
) -> LinearisedWindows:
    """The energy for noise of the present residuals' size, or with weights of Student's t of so many degrees."""
    point, noise = WindowPoint(theta, windows.no_starts(), lin.residual), present_noise(windows, lin.residual)
    if freedom is None:
        return LinearisedWindows(WindowEnergy(windows, noise, prior), point, windows.moments(lin, white=True))
    sizes = np.where(windows.observed, np.abs(lin.residual), np.nan)
    sd = np.maximum(NORMAL_MAD * np.nanmedian(sizes, axis=(0, 1)), windows.rounding)
    root = np.sqrt((freedom + 1) / (freedom + (lin.residual / sd) ** 2))
    lin = replace(lin, residual=root * lin.residual, jacobian=root[..., None] * lin.jacobian)
    energy = _WeighedEnergy(windows, Noise(sd, noise.tau), prior, root)
    return LinearisedWindows(energy, point, windows.moments(lin, white=True))


def _misfit(windows: Windows, residual: FloatArray) -> float:
    """-log likelihood of residuals (W, L, C) under white noise of their own size, up to a constant."""
    noise, counts = present_noise(windows, residual), windows.observed.sum(axis=(0, 1))
    return float(0.5 * windows.chi_square(residual[None], noise)[0] + counts @ np.log(noise.sd))
