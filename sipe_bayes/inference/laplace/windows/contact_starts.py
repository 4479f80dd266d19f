"""Starting points through contact, where every window begins at a known state: one control step first, ever more.

A window's error is magnified by each impact, and the simulation jumps where one is missed: at a hundredth of the cube
from the truth five control steps of a half-cheetah are off by five times the noise, at a tenth by twenty, with an
optimum behind every jump. A single control step from a known state is nearly smooth, costs little and tells most.

Where the noise of the known starts tells when a place fits, and single control steps tell every parameter, one
candidate is followed after the other, from single control steps to whole windows, each as long as it fits: no more than
that noise is left, and no more in some windows than in others. Searches from around its places leave its way where they
come to better ones; and where no candidate fits at all, searches go on from far around the best. Else the best of many
candidates go downhill on the first control step of all windows; the better half of the places where they come to rest
on longer beginnings, and so on.

Single control steps go downhill twice, first by Student's t (K. L. Lange, R. J. A. Little, J. M. G. Taylor 1989,
"Robust Statistical Modeling Using the t Distribution", JASA 84), which bears the few windows that are still beyond an
impact.

Where nothing touches, a whole log that begins at a known state is all the same hard to fit from afar: small errors of
theta grow with the time that is simulated, until a search stops in a side valley, or takes dozens of steps along the
bottom of one. There too the search goes downhill on beginnings of the log, from a sixteenth on, every other one twice
as long; the simulation is smooth, so that beginnings need neither wide differences nor single control steps.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch

from sipe_bayes.core.arrays import FloatArray, IntArray
from sipe_bayes.core.findings import Code, finding
from sipe_bayes.inference.laplace.options import ContactTuning
from sipe_bayes.inference.laplace.strategy import SearchProblem
from sipe_bayes.inference.laplace.windows.beginnings import Rest, beginning, misfit_of, rest_on
from sipe_bayes.inference.laplace.windows.energy import judging_channels
from sipe_bayes.inference.laplace.windows.growing_windows import told_starts
from sipe_bayes.inference.laplace.windows.state import WindowState
from sipe_bayes.likelihood.settings import BudgetExhausted
from sipe_bayes.likelihood.windows import Windows
from sipe_bayes.simulation.contacts import may_touch
from sipe_bayes.simulation.simulator import Simulator

_ANEW = 1_000_003  # of the seed, to other candidates


@dataclass(frozen=True)
class _Plan:
    """How beginnings grow.

    Args:
        horizons: their control steps.
        widest: differences at first, of the cube.
        robust: whether the first go downhill by Student's t before.
        judges: whether the noise of the known starts tells when a place fits.
    """

    horizons: tuple[int, ...]
    widest: float
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
            return cls(tuple(horizons), tuning.widest, robust=True, judges=judges)
        if windows.num_start or not isinstance(windows.simulator, Simulator) or longest < tuning.long:
            return None
        return cls(tuple(int(longest * 2.0 ** (k / 2)) for k in range(-8, 0)), 0.0, robust=False, judges=False)


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


def started_anew(problem: SearchProblem, windows: Windows, state: WindowState) -> FloatArray | None:
    """Starting points (R, N) from other candidates, where the best optimum leaves more than the known starts' noise.

    None where it does not, where starting points were given, or little of the budget is left.
    """
    best, tuning = max(state.optima, key=lambda optimum: optimum.evidence, default=None), problem.options.tuning
    left = (windows.budget - windows.rollouts) / windows.budget
    if best is None or not best.unexplained or problem.options.initial is not None or not problem.options.candidates:
        return None
    if left < tuning.contact.anew_share or len(state.points) >= tuning.windows.most_points:
        return None
    return grown_starts(replace(problem, seed=problem.seed + _ANEW * len(state.points)), windows)


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

    def in_turn(self) -> tuple[list[Rest], bool]:
        """One candidate after the other on ever longer beginnings, each as long as it fits.

        Returns:
            Where those that fit to the end do so, the best first, or else where the one ends that fits longest; and
            whether any fits at all.
        """
        first, chains, fitting = list[Rest](), list[list[Rest]](), list[Rest]()
        try:
            for rest in self._candidates(first):
                if rest is None or any(one.holds(rest) and one.misfit < rest.misfit + 1 for one in first):
                    continue
                first[:] = _with(first, rest)
                determined = rest.sd.max() < self.tuning.determined  # else what fits is no place
                chains.append(self._followed(rest) if rest.fits and determined else [rest])
                fitting = _with(fitting, chains[-1][-1] if self._whole(chains[-1]) else None)
                if fitting and self.used > self.tuning.fitting_share:
                    break
        except BudgetExhausted:
            pass
        longest = max(chains, key=_reach, default=[])
        return fitting or (longest[-1:] if len(longest) > 1 else first), len(longest) > 1

    def _candidates(self, first: list[Rest]) -> Iterator[Rest | None]:
        """Where searches from candidates end on the first beginnings; then those from far around the best of ``first``.

        Impacts part what fits from what nearly does: after few draws of the prior it is found beside the best of these
        (basin hopping, D. J. Wales, J. P. K. Doye 1997, J. Phys. Chem. A 101).

        Raises:
            BudgetExhausted: where the budget ends.
        """
        yield from (self._first(point) for point in self._screened())
        for _ in range(self.tuning.hops):
            if not first or first[0].fits or self.used > self.tuning.first_share:
                return
            begin = self._moved(first[0], self.tuning.far)
            yield self._rest(self.plan.horizons[0], begin, np.minimum(first[0].sd, self.plan.widest))

    def _moved(self, rest: Rest, sds: float) -> FloatArray:
        """A place (N,) around a rest."""
        normal = torch.randn(len(rest.theta), generator=self.generator, dtype=torch.float64).numpy()
        return np.asarray(np.clip(rest.theta + sds * np.linalg.cholesky(rest.covariance) @ normal, 0.0, 1.0))

    def first_rests(self) -> list[Rest]:
        """Where searches from candidates end on the first beginnings, the best first."""
        rests = list[Rest]()
        try:
            for point in self._screened():
                rests = _with(rests, self._first(point))
        except BudgetExhausted:
            pass
        return rests

    def together(self, rests: list[Rest]) -> list[Rest]:
        """Where the better half of the rests end on ever longer beginnings, until the budget ends."""
        try:
            for horizon in self.plan.horizons[1:]:
                before, after = rests[: max(self.problem.options.restarts, len(rests) // 2)], list[Rest]()
                for one in before:
                    after = _with(after, self._longer(one, horizon))
                rests = after
        except BudgetExhausted:
            pass
        return rests

    def _first(self, point: FloatArray) -> Rest | None:
        """Where a search from a candidate (N,) ends on the first beginning."""
        widest, horizon = np.full(len(point), self.plan.widest), self.plan.horizons[0]
        if not self.plan.robust:
            return self._rest(horizon, point, widest)
        robust = self._rest(horizon, point, widest, robust=True)
        return None if robust is None else self._rest(horizon, robust.theta, np.minimum(robust.sd, widest))

    def _longer(self, rest: Rest, horizon: int) -> Rest | None:
        """Where a search from a rest ends on longer beginnings."""
        return self._rest(horizon, rest.theta, np.minimum(rest.sd, self.plan.widest))

    def _followed(self, first: Rest) -> list[Rest]:
        """From a rest on the first beginnings to one on the longest, or to the first that does not fit.

        An impact that is missed may bring hardly any misfit, until beginnings are longer. So there are searches from
        around each rest as well; one that comes to a better place is followed instead.
        """
        chain = self._straight([first])
        try:
            for number in range(self.tuning.nearby):
                most = self.tuning.nearby_share if self._whole(chain) else self.tuning.first_share
                if self.used > most or (number and self._whole(chain)):
                    break
                chain = self._beside(chain)
        except BudgetExhausted:
            pass
        return chain

    def _beside(self, chain: list[Rest]) -> list[Rest]:
        """The chain, or one that leaves it for a better place.

        Raises:
            BudgetExhausted: where the budget ends.
        """
        for k in range(1, len(chain)):
            before = chain[k - 1]
            begin, widths = self._moved(before, self.tuning.away), np.minimum(before.sd, self.plan.widest)
            other = self._rest(self.plan.horizons[k], begin, widths)
            if other is None or other.misfit > chain[k].misfit - 1 or chain[k].holds(other):
                continue
            onward = self._straight([*chain[:k], other])
            if _reach(onward) > _reach(chain):
                return onward
        return chain

    def _straight(self, chain: list[Rest]) -> list[Rest]:
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

    def _whole(self, chain: list[Rest]) -> bool:
        """Whether it fits to the end."""
        return len(chain) == len(self.plan.horizons) and chain[-1].fits

    def _rest(self, horizon: int, theta: FloatArray, widths: FloatArray, robust: bool = False) -> Rest | None:
        limit = self.begun + self.tuning.budget_share * (self.windows.budget - self.begun)
        return rest_on(self.problem, self.windows, horizon, limit, theta, widths, robust)

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
        view, share = beginning(windows, self.plan.horizons[0], limit)
        residual, valid = view.residuals(points, np.tile(view.no_starts(), (len(points), 1, 1)))
        windows.rollouts += math.ceil(view.rollouts * share)
        misfits = [misfit_of(view, one) if good else np.inf for one, good in zip(residual, valid, strict=True)]
        return points[np.argsort(misfits, kind="stable")[: min(tuning.followed, int(valid.sum()))]]


def _reach(chain: list[Rest]) -> tuple[int, float]:
    """Of two chains the better one's is larger."""
    return len(chain), -chain[-1].misfit


def _with(rests: list[Rest], new: Rest | None) -> list[Rest]:
    """The rests with a new one, the best first, of those in one place the best alone."""
    every = sorted(rests if new is None else [*rests, new], key=lambda rest: rest.misfit)
    return [one for k, one in enumerate(every) if not any(better.holds(one) for better in every[:k])]


def screen(problem: SearchProblem, windows: Windows) -> FloatArray:
    """Starting points (R, N): the model as given and the best candidates, by their plain residuals.

    From many candidates on, only the first ones are drawn from the prior, the others in generations from a normal
    around the best ones so far: the cross-entropy method, which finds the narrow valleys that contact leaves.

    Raises:
        ValueError: when every one of the first diverges.
    """
    tuning, count = problem.options.tuning.screening, problem.options.candidates
    generator = torch.Generator().manual_seed(problem.seed)
    later: list[int] = []
    if count >= tuning.generations_from:
        ends = np.linspace(int(tuning.first_share * count), count, tuning.generations + 1)
        later = np.diff(ends.astype(int)).tolist()
    draws = problem.prior.sample((count - sum(later),), generator=generator).numpy()
    points = np.concatenate([problem.space.default_theta[None], draws])
    starts = told_starts(windows, problem.space.default_theta.clip(0, 1), problem.options.tuning.growing)
    loss = _plain_loss(windows, starts, points)
    if not np.isfinite(loss).any():
        raise ValueError(
            f"every one of {len(points)} starting points diverges in the simulation; narrow the bounds, "
            "shorten the model's timestep or the window"
        )
    rng = np.random.default_rng([problem.seed, 1])
    for size in later:
        best = points[_by_loss(loss)[: tuning.elite]]
        drawn = best.mean(0) + (best.std(0) + tuning.least_spread) * rng.standard_normal((size, points.shape[1]))
        points = np.concatenate([points, np.clip(drawn, 0.0, 1.0)])
        loss = np.concatenate([loss, _plain_loss(windows, starts, points[-size:])])
    chosen = _by_loss(loss)
    if np.isfinite(loss[0]):
        chosen = np.concatenate([[0], chosen[chosen != 0]])
    else:
        problem.find(finding(Code.DIVERGES_AS_GIVEN))
    return points[chosen[: problem.options.restarts]]


def _plain_loss(windows: Windows, starts: FloatArray, points: FloatArray) -> FloatArray:
    """Squared residuals (B,) of points (B, N) from starts (W, D), in units of each channel's spread.

    Infinite where one diverges.
    """
    residual, valid = windows.residuals(points, np.tile(starts, (len(points), 1, 1)))
    spread = np.maximum(windows.spread, 1e-12)
    return np.where(valid, ((residual / spread) ** 2).sum((1, 2, 3)), np.inf)


def _by_loss(loss: FloatArray) -> IntArray:
    """Places of the finite ones, the least first."""
    return np.argsort(loss, kind="stable")[: int(np.isfinite(loss).sum())]
