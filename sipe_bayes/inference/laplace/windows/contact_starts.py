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
from scipy.stats import bartlett

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.inference.laplace.levenberg_marquardt import descend
from sipe_bayes.inference.laplace.options import ContactTuning
from sipe_bayes.inference.laplace.screening import screen
from sipe_bayes.inference.laplace.strategy import SearchProblem
from sipe_bayes.inference.laplace.windows.energy import (
    LinearisedWindows,
    WindowEnergy,
    WindowPoint,
    beyond_start_noise,
    judging_channels,
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
        attempts: screenings of candidates while none fits.
        robust: whether the first go downhill by Student's t before.
        judges: whether the noise of the known starts tells when a place fits.
    """

    horizons: tuple[int, ...]
    widest: float
    attempts: int
    robust: bool
    judges: bool

    @classmethod
    def of(cls, problem: SearchProblem, windows: Windows) -> _Plan | None:
        """As the windows ask for; None where they are searched as they are."""
        tuning, longest = problem.options.tuning.contact, int(windows.steps.max())
        if begins_in_contact(windows):
            horizons = [1]
            while horizons[-1] < longest:
                horizons.append(min(longest, math.ceil(tuning.growth * horizons[-1])))
            judges = bool(judging_channels(windows).any())
            return cls(tuple(horizons), tuning.widest, tuning.attempts, robust=True, judges=judges)
        if windows.num_start or not isinstance(windows.simulator, Simulator) or longest < tuning.long:
            return None
        return cls(tuple(int(longest * 2.0 ** (k / 2)) for k in range(-8, 0)), 0.0, 1, robust=False, judges=False)


@dataclass(frozen=True)
class _Rest:
    """Where a search came to rest.

    Args:
        theta: (N,).
        misfit: what it minimises there.
        covariance: (N, N), of theta.
        fits: whether no more is left than the noise of the known starts; not where that is unknown.
    """

    theta: FloatArray
    misfit: float
    covariance: FloatArray
    fits: bool

    @property
    def sd(self) -> FloatArray:
        """(N,), of theta."""
        return np.sqrt(np.diag(self.covariance))

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

    None where windows are searched as they are, the budget is too small, or all diverge.
    """
    plan = _Plan.of(problem, windows)
    if plan is None:
        return None
    options, tuning = problem.options, problem.options.tuning.contact
    growth = _Growth.of(problem, windows, plan)
    rests, whole = growth.in_turn() if plan.judges else (growth.together(growth.first_rests()), True)
    if not whole:
        rests = growth.together(rests)
    hopeless = tuning.hopeless * windows.observed.sum()
    kept = [rest.theta for rest in rests[: options.restarts] if rest.misfit < rests[0].misfit + hopeless]
    return np.stack(kept) if kept else None


@dataclass(frozen=True)
class _Growth:
    """Searches on beginnings that grow, within a limit of rollouts."""

    problem: SearchProblem
    windows: Windows
    plan: _Plan
    begun: int
    generator: torch.Generator

    @classmethod
    def of(cls, problem: SearchProblem, windows: Windows, plan: _Plan) -> _Growth:
        """One that has not begun."""
        return cls(problem, windows, plan, windows.rollouts, torch.Generator().manual_seed(problem.seed))

    @property
    def tuning(self) -> ContactTuning:
        """How it is done."""
        return self.problem.options.tuning.contact

    @property
    def used(self) -> float:
        """Share of the budget that is spent."""
        return (self.windows.rollouts - self.begun) / max(self.windows.budget - self.begun, 1)

    def in_turn(self) -> tuple[list[_Rest], bool]:
        """One candidate after the other on ever longer beginnings, each as long as it fits.

        Returns:
            Where those that fit to the end do so, the best first, or else where the one ends that fits longest; and
            whether any fits at all.
        """
        tuning, chains, first = self.tuning, list[list[_Rest]](), list[_Rest]()
        fitting = list[_Rest]()
        try:
            for _ in range(self.plan.attempts):
                for point in self._screened():
                    rest = self._first(point)
                    if rest is None or any(one.holds(rest) for one in first):
                        continue
                    first = _with(first, rest)
                    chains.append(self._followed(rest) if rest.fits else [rest])
                    fitting = _with(fitting, chains[-1][-1] if self._whole(chains[-1]) else None)
                    if fitting and self.used > tuning.fitting_share:
                        return fitting, True
                if fitting or self.used > tuning.first_share:
                    break
        except BudgetExhausted:
            pass
        longest = max(chains, key=_reach, default=[])
        return fitting or (longest[-1:] if len(longest) > 1 else first), len(longest) > 1

    def first_rests(self) -> list[_Rest]:
        """Where searches from candidates end on the first beginnings, the best first."""
        rests = list[_Rest]()
        try:
            for point in self._screened():
                rests = _with(rests, self._first(point))
        except BudgetExhausted:
            pass
        return rests

    def together(self, rests: list[_Rest]) -> list[_Rest]:
        """Where the better half of the rests end on ever longer beginnings, until the budget ends."""
        try:
            for horizon in self.plan.horizons[1:]:
                before, after = rests[: max(self.problem.options.restarts, len(rests) // 2)], list[_Rest]()
                for one in before:
                    after = _with(after, self._longer(one, horizon))
                rests = after
        except BudgetExhausted:
            pass
        return rests

    def _first(self, point: FloatArray) -> _Rest | None:
        """Where a search from a candidate (N,) ends on the first beginning."""
        widest, horizon = np.full(len(point), self.plan.widest), self.plan.horizons[0]
        if not self.plan.robust:
            return self._rest(horizon, point, widest)
        robust = self._rest(horizon, point, widest, robust=True)
        return None if robust is None else self._rest(horizon, robust.theta, np.minimum(robust.sd, widest))

    def _longer(self, rest: _Rest, horizon: int) -> _Rest | None:
        """Where a search from a rest ends on longer beginnings."""
        return self._rest(horizon, rest.theta, np.minimum(rest.sd, self.plan.widest))

    def _followed(self, first: _Rest) -> list[_Rest]:
        """From a rest on the first beginnings to one on the longest, or to the first that does not fit.

        An impact that is missed may bring hardly any misfit, until beginnings are longer. So there are searches from
        around each rest as well; one that comes to a better place is followed instead.
        """
        chain = self._straight([first])
        try:
            for number in range(self.tuning.nearby):
                if self._whole(chain) and (number or self.used > self.tuning.nearby_share):
                    break
                chain = self._beside(chain)
        except BudgetExhausted:
            pass
        return chain

    def _beside(self, chain: list[_Rest]) -> list[_Rest]:
        """The chain, or one that leaves it for a better place.

        Raises:
            BudgetExhausted: where the budget ends.
        """
        for k in range(1, len(chain)):
            before = chain[k - 1]
            normal = torch.randn(len(before.theta), generator=self.generator, dtype=torch.float64).numpy()
            moved = before.theta + self.tuning.away * np.linalg.cholesky(before.covariance) @ normal
            widths = np.minimum(before.sd, self.plan.widest)
            other = self._rest(self.plan.horizons[k], np.clip(moved, 0.0, 1.0), widths)
            if other is None or other.misfit > chain[k].misfit - 1 or chain[k].holds(other):
                continue
            onward = self._straight([*chain[:k], other])
            if _reach(onward) > _reach(chain):
                return onward
        return chain

    def _straight(self, chain: list[_Rest]) -> list[_Rest]:
        """The chain with what follows its last rest, as long as that fits and the budget lasts."""
        chain = list(chain)
        try:
            while len(chain) < len(self.plan.horizons) and chain[-1].fits:
                rest = self._longer(chain[-1], self.plan.horizons[len(chain)])
                if rest is None:
                    break
                chain.append(rest)
        except BudgetExhausted:
            pass
        return chain

    def _whole(self, chain: list[_Rest]) -> bool:
        """Whether it fits to the end."""
        return len(chain) == len(self.plan.horizons) and chain[-1].fits

    def _rest(self, horizon: int, theta: FloatArray, widths: FloatArray, robust: bool = False) -> _Rest | None:
        limit = self.begun + self.tuning.budget_share * (self.windows.budget - self.begun)
        return _rest(self.problem, self.windows, horizon, limit, theta, widths, robust)

    def _screened(self) -> FloatArray:
        """The best (S, N) of the model as given and draws of the prior, by the first beginnings.

        Raises:
            BudgetExhausted: where the budget ends.
        """
        tuning, count, windows = self.tuning, self.problem.options.candidates, self.windows
        count = max(count, tuning.candidates) if count else 0
        draws = self.problem.prior.sample((count,), generator=self.generator).numpy()
        points = np.concatenate([self.problem.space.default_theta[None], draws])
        limit = self.begun + tuning.budget_share * (windows.budget - self.begun)
        view, share = _beginning(windows, self.plan.horizons[0], limit)
        residual, valid = view.residuals(points, np.tile(view.no_starts(), (len(points), 1, 1)))
        windows.rollouts += math.ceil(view.rollouts * share)
        misfits = [_misfit(view, one) if good else np.inf for one, good in zip(residual, valid, strict=True)]
        return points[np.argsort(misfits, kind="stable")[: min(tuning.followed, int(valid.sum()))]]


def _reach(chain: list[_Rest]) -> tuple[int, float]:
    """Of two chains the better one's is larger."""
    return len(chain), -chain[-1].misfit


def _with(rests: list[_Rest], new: _Rest | None) -> list[_Rest]:
    """The rests with a new one, the best first, of those in one place the best alone."""
    every = sorted(rests if new is None else [*rests, new], key=lambda rest: rest.misfit)
    return [one for k, one in enumerate(every) if not any(better.holds(one) for better in every[:k])]


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
    return _Rest(theta, _misfit(view, residual), covariance, _fits(view, residual))


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


def _fits(windows: Windows, residual: FloatArray) -> bool:
    """Whether residuals (W, L, C) are no more than the noise of the known starts, and no larger in some windows."""
    noise, observed = present_noise(windows, residual), windows.observed
    if not judging_channels(windows).any() or beyond_start_noise(windows, noise.sd) is not None:
        return False
    parts = [row[seen] for row, seen in zip(residual / noise.sd, observed, strict=True) if seen.sum() > 1]
    return len(parts) < 2 or bool(bartlett(*parts).pvalue > THRESHOLDS.start_noise)


def _misfit(windows: Windows, residual: FloatArray) -> float:
    """-log likelihood of residuals (W, L, C) under white noise of their own size, up to a constant."""
    noise, counts = present_noise(windows, residual), windows.observed.sum(axis=(0, 1))
    return float(0.5 * windows.chi_square(residual[None], noise)[0] + counts @ np.log(noise.sd))
