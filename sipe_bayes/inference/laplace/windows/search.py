"""The search over windows, from starting point to recorded optimum, in phases.

The Jacobian of the starts is kept as long as
it foretells the gain of a step to a fifth; an optimum is only accepted where what was foretold since it was taken is
wrong by less than half a nat. A later starting point is dropped once the search has all but come to an optimum that is
already known. Where the best one leaves more than the noise of known starts, the search begins anew while it may.

Where a direction is open (a ridge), the search goes on once from its middle, since the width across a ridge may differ
from place to place, and the place would otherwise be an accident of the start.

Of bodies that tumble and land, theta and the starts descend together on beginnings of the windows that grow
(``growing_windows``).

Where the starts are recorded and theta alone is searched, points around each optimum are tried as well
(``pattern_search``), and the search goes on from a better one, with finite differences no longer than the way there.
The normal that is left is no narrower than the shortest of these ways, and holds the points that fit as well as the
optimum, whatever the curvature says; one that fits as well but lies beyond worse ones becomes a further starting point.
Where already the shortest way leads to a far worse fit, the optimum is a stroke of luck: then its neighbours say how
large the noise is and what fits as well, and a finding says so.

Where the budget ends before the first optimum, the best point so far is recorded in its place; where theta alone is
searched, what is kept of the budget is spent on such a look around it. Of that point, and, where theta alone is
searched, of an optimum where no step found the gain that its linearisation foretold, of a stroke of luck and of one
that leaves more than the noise of known starts, the normal says nothing; its sd is guessed: the way from the starting
point (root mean square over theta), times the share of the first misfit that is left, as one that is theta's shrinks.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.findings import Code, finding
from sipe_bayes.inference.laplace.levenberg_marquardt import Descent, descend
from sipe_bayes.inference.laplace.options import LaplaceTuning
from sipe_bayes.inference.laplace.strategy import SearchProblem
from sipe_bayes.inference.laplace.windows.contact_starts import started_anew, starting_points
from sipe_bayes.inference.laplace.windows.energy import (
    LinearisedWindows,
    WindowEnergy,
    WindowPoint,
    foretold,
    misfit,
    present_noise,
    same_noise,
    updated_noise,
)
from sipe_bayes.inference.laplace.windows.followed_posterior import followed_step
from sipe_bayes.inference.laplace.windows.growing_windows import (
    ManyStarts,
    counted,
    first_beginnings,
    group,
    grown,
    grows,
    num_groups,
    scattered,
)
from sipe_bayes.inference.laplace.windows.optimum import (
    Ending,
    is_broken,
    judged,
    middle_of_ridge,
    sandwiches,
    summarised,
    surroundings,
)
from sipe_bayes.inference.laplace.windows.pattern_search import SHORTEST, pattern_size
from sipe_bayes.inference.laplace.windows.state import Kept, Phase, Position, WindowState
from sipe_bayes.likelihood.moments import Moments
from sipe_bayes.likelihood.noise import Noise
from sipe_bayes.likelihood.settings import BudgetExhausted
from sipe_bayes.likelihood.wild_samples import wild_residuals
from sipe_bayes.likelihood.windows import Linearisation, Windows
from sipe_bayes.simulation.contacts import may_touch

_ROUGH = (Phase.ROUGH,)


@dataclass(frozen=True)
class Step:
    """A step of a phase, before the phase that follows is known.

    Args:
        lin: the linearisation behind it.
        moments: of that.
        noise: that it was made for.
        fit: how it went.
        after: where the search stands then.
        cut_short: whether the budget allowed none.
    """

    lin: Linearisation
    moments: Moments
    noise: Noise
    fit: Descent[WindowPoint]
    after: Position
    cut_short: bool


@dataclass(frozen=True)
class WindowSearch:
    """The ``Strategy`` for windows of the logs."""

    problem: SearchProblem
    windows: Windows

    @property
    def step_rollouts(self) -> int:
        """Rollouts that a step takes."""
        windows = self.windows
        return (windows.num_theta + windows.num_start + 2) * len(windows.trajectories)

    def start(self) -> WindowState:
        """The first state: at the first starting point."""
        points = starting_points(self.problem, self.windows)
        return WindowState(points, 0, self._begin(points[0]))

    def step(self, state: WindowState) -> WindowState:
        """One linearisation and one accepted step; what it does is the phase's."""
        self.windows.mask(state.wild)
        phases: dict[Phase, Callable[[WindowState], WindowState]] = {
            Phase.GROW: self._grow,
            Phase.ROUGH: self._rough,
            Phase.DESCEND: self._descend,
            Phase.NOISE: self._noise,
            Phase.FOLLOW: partial(followed_step, self.problem, self.windows),
        }
        return phases[state.here.phase](state)

    def _grow(self, state: WindowState) -> WindowState:
        """A step on beginnings of the windows, or of a group of them; see ``growing_windows``."""
        tuning, prior, before = self._tuning, self.problem.quadratic_prior, state.here
        if before.group is None:
            here = grown(self.windows, self.windows, prior, before, tuning.growing, tuning.damping)
            state = replace(state, here=here)
            return self._next(state) if state.here.phase is not Phase.GROW and state.known else state
        part = group(self.windows, before.group, count := num_groups(self.windows, tuning.growing))
        here = grown(self.windows, part, prior, before, tuning.growing, tuning.damping)
        if here.phase is Phase.GROW:
            return replace(state, here=here)
        state = replace(state, estimates=(*state.estimates, here.theta))
        if before.group + 1 < count:
            return replace(state, here=self._apart(before.group + 1, state))
        best, slips = max(state.aside, key=lambda one: one.evidence), self.windows.contacts.slips
        optimum = scattered(best, np.stack(state.estimates), tuning.growing, slips)
        return replace(state, optima=(optimum,), here=here.following(best), done=slips)

    def _next(self, state: WindowState) -> WindowState:
        """At the next starting point; after the last, groups of windows that tumble are fitted apart."""
        onward = state.next_point(self._begin)
        if onward.done and (anew := started_anew(self.problem, self.windows, state)) is not None:
            return replace(state, points=np.concatenate([state.points, anew])).next_point(self._begin)
        if not (onward.done and grows(self.windows)) or not state.optima:
            return onward
        if num_groups(self.windows, self._tuning.growing):
            cut_short = tuple(replace(o, finding=finding(Code.SEARCH_CUT_SHORT)) for o in state.optima)  # until then
            return replace(state, here=self._apart(0, state), optima=cut_short, aside=state.optima, estimates=())
        if not may_touch(self.windows.simulator.model):
            return onward
        unknown = finding(Code.SCATTER_UNKNOWN, windows=self.windows.num_windows)
        return replace(onward, optima=tuple(replace(optimum, finding=unknown) for optimum in state.optima))

    def onward(self, state: WindowState, theta: FloatArray, starts: FloatArray | None = None) -> WindowState | None:
        """A search that had ended, from a better place (N,), and starts (W, D); None where it has had enough."""
        if len(state.points) >= self._tuning.windows.most_points or self._leaves_no_room():
            return None
        points, here = np.concatenate([state.points, theta[None]]), self._begin(theta)
        here = here if starts is None else replace(here, starts=starts)
        return replace(state, points=points, point=len(state.points), here=here, done=False)

    def _apart(self, number: int, state: WindowState) -> Position:
        """Where a group of windows is fitted from: the best optimum's theta, and starts of its own."""
        best = max(state.optima, key=lambda optimum: optimum.evidence)
        part = group(self.windows, number, num_groups(self.windows, self._tuning.growing))
        at = Position.at(part, best.theta, self._tuning.damping)
        here = first_beginnings(part, at, self._tuning.growing, state.here)
        counted(self.windows, part, self.windows.rollouts)
        return replace(here, group=number)

    def _rough(self, state: WindowState) -> WindowState:
        """A step with white noise of the size of the present residuals, to a relative tolerance."""
        return self._with_present_noise(state, *self._linearise(state.here))

    def _with_present_noise(self, state: WindowState, lin: Linearisation, stale: bool, drift: float) -> WindowState:
        if not state.optima and len(wild := wild_residuals(self.windows, lin.residual)):
            state = replace(state, wild=np.concatenate([state.wild, wild]))
            self.windows.mask(state.wild)
            seen = self.windows.observed
            lin = replace(lin, residual=lin.residual * seen, jacobian=lin.jacobian * seen[..., None])
        noise, moments = present_noise(self.windows, lin.residual), self.windows.moments(lin, white=True)
        step, converged = self._stepped(state, lin, moments, noise, stale, drift)
        last = step.after.iteration >= self._tuning.windows.most_steps // 2
        phase = Phase.NOISE if converged else Phase.DESCEND if last else Phase.ROUGH
        return self._continued(state, step, phase, settled=False)

    def _descend(self, state: WindowState) -> WindowState:
        """A step with the noise as it was estimated last."""
        lin, stale, drift = self._linearise(state.here)
        moments = self.windows.moments(lin, white=self._white)
        step, converged = self._stepped(state, lin, moments, state.here.noise, stale, drift)
        return self._continued(state, step, Phase.NOISE if converged else Phase.DESCEND, settled=False)

    def _noise(self, state: WindowState) -> WindowState:
        """The noise estimated anew, then a step; where neither moves, an optimum."""
        windows, here = self.windows, state.here
        lin, stale, drift = self._linearise(here)
        moments, coloured = windows.moments(lin, white=self._white), windows.settings.noise == "ar1"
        at, prior = (here.theta, here.starts), self.problem.quadratic_prior
        held = is_broken(self.problem, windows, here.theta, here.refused)
        noise = updated_noise(windows, moments, here.noise, *at, prior, coloured, held)
        step, converged = self._stepped(state, lin, moments, noise, stale, drift)
        # where theta does not move for the noise that is best there, both are; not for one that a broken promise made
        settled = converged and (not step.fit.gained or same_noise(noise, here.noise))
        settled &= held or not is_broken(self.problem, windows, here.theta, step.fit.refused)
        return self._continued(state, step, Phase.NOISE if converged else Phase.DESCEND, settled)

    def _linearise(self, here: Position) -> tuple[Linearisation, bool, float]:
        """Linearisation at the point, whether part of it is of an earlier one, and the drift of that part."""
        windows, kept, n = self.windows, here.kept, self.windows.num_theta
        if kept.jacobian is None or not np.isfinite(kept.drift) or not kept.keep_starts:
            lin = windows.linearise(here.theta, here.starts, residual=kept.residual, theta_step=here.theta_step)
            return lin, False, 0.0
        if not kept.moved and kept.residual is not None:
            return Linearisation(kept.residual, kept.jacobian, True), kept.drift > 0, kept.drift
        size, residual = here.theta_step, kept.residual
        lin = windows.linearise(here.theta, here.starts, with_starts=False, residual=residual, theta_step=size)
        both = np.concatenate([lin.jacobian, kept.jacobian[..., n:]], axis=-1)
        return replace(lin, jacobian=both), True, kept.drift

    def _stepped(
        self, state: WindowState, lin: Linearisation, moments: Moments, noise: Noise, stale: bool, drift: float
    ) -> tuple[Step, bool]:
        """A step downhill, and whether there is nothing left to gain for this noise."""
        windows, here, tuning = self.windows, state.here, self._tuning.windows
        point = WindowPoint(here.theta, here.starts, lin.residual)
        energy = WindowEnergy(windows, noise, self.problem.quadratic_prior)
        linearised = LinearisedWindows(energy, point, moments)
        if grows(windows):
            linearised = ManyStarts(energy, point, moments, self._tuning.growing.shares)
        tolerance = tuning.tolerance
        if here.phase in _ROUGH:
            tolerance = max(tuning.rough_tolerance * linearised.energy, tolerance)
        try:
            fit, cut_short = descend(linearised, here.damping, tolerance, self._tuning.damping, stale), False
        except BudgetExhausted:
            if state.optima:  # else the budget leaves room for one
                raise
            windows.short = True
            fit, cut_short = Descent(None, linearised.energy, here.damping), True
        point, drift = fit.point or point, drift + abs(fit.gained - fit.expected)
        converged = fit.converged and drift < tuning.most_drift
        kept = Kept(
            point.residual,
            lin.jacobian,
            drift=np.inf if fit.converged and not converged else drift,
            keep_starts=foretold(fit, tuning),
            moved=fit.gained > 0,
        )
        after = replace(
            here,
            theta=point.theta,
            starts=point.starts,
            noise=noise,
            damping=fit.damping,
            iteration=here.iteration + 1,
            misfit=here.misfit or misfit(windows, lin.residual),
            refused=fit.refused,
            kept=kept,
        )
        return Step(lin, moments, noise, fit, after, cut_short), converged

    def _continued(self, state: WindowState, step: Step, phase: Phase, settled: bool) -> WindowState:
        """On to the next step; or, where the search stands still or has to end, an optimum."""
        after = replace(step.after, phase=phase)
        onward = replace(state, here=after)
        ends = not state.optima and (step.cut_short or self._leaves_no_room())
        if settled or ends or after.iteration >= self._tuning.windows.most_steps:
            return self._recorded(onward, state.here, step, settled, ends)
        return self._next(onward) if not after.revisits and onward.known else onward

    def _recorded(
        self, state: WindowState, before: Position, step: Step, settled: bool, cut_short: bool
    ) -> WindowState:
        """Record an optimum, and go on from a better or a more central one or from the next starting point.

        ``state`` is that after the last step, ``before`` where this was linearised, which is the optimum.
        """
        windows, tuning, here, theta, noise = self.windows, self._tuning, state.here, before.theta, step.noise
        moments = windows.moments(step.lin) if before.phase in _ROUGH and not self._white else step.moments
        ending = Ending(
            theta,
            before.starts,
            noise,
            moments,
            step.lin.residual,
            step.lin.jacobian,
            begin=state.points[state.point],
            steps=here.iteration,
            first_misfit=here.misfit,
            refused=step.fit.refused,
            tells=step.fit.exhausted or windows.num_start > 0,
            settled=settled,
            cut_short=cut_short,
            bettered=state.optima[-1] if here.patterns else None,
        )
        optimum = summarised(self.problem, windows, ending)
        afresh, stays = here.afresh(tuning.damping), here.centred or cut_short
        if (further := None if stays else middle_of_ridge(self.problem, windows, optimum)) is not None:
            return replace(state, here=replace(afresh, theta=further, centred=True))
        searched = Noise(noise.sd, np.zeros(len(noise.sd))) if sandwiches(windows) else noise
        around = surroundings(self.problem, windows, theta, searched, optimum.covariance)
        optimum = judged(self.problem, windows, optimum, around, ending)
        # one that is searched on from is none
        optima = (*state.optima[: len(state.optima) - here.revisits], optimum)
        state = replace(state, optima=optima)
        if around is not None and around.other is not None and len(state.points) < tuning.windows.most_points:
            state = replace(state, points=np.concatenate([state.points, around.other[None]]))
        if around is None or around.better is None or here.patterns >= tuning.windows.most_patterns:
            return self._next(state)
        size = min(here.theta_step, max(float(np.abs(around.better - theta).max()), SHORTEST))
        better = replace(afresh, theta=around.better, theta_step=size, iteration=0, patterns=here.patterns + 1)
        return replace(state, here=better)

    def _begin(self, theta: FloatArray) -> Position:
        """At a starting point theta (N,)."""
        here = Position.at(self.windows, theta, self._tuning.damping)
        return first_beginnings(self.windows, here, self._tuning.growing) if grows(self.windows) else here

    def _leaves_no_room(self) -> bool:
        """Whether the budget has no room for another step, and where there is still some, for a look around."""
        windows, tuning = self.windows, self._tuning
        step = windows.num_theta + windows.num_start + tuning.windows.trials
        look = 0 if windows.num_start else pattern_size(windows.num_theta, tuning.pattern)
        cost = look * len(windows.trajectories)
        looks = 2 * cost < windows.budget and windows.rollouts + cost <= windows.budget
        return not windows.has_room(step + looks * look)

    @property
    def _tuning(self) -> LaplaceTuning:
        return self.problem.options.tuning

    @property
    def _white(self) -> bool:
        return self.windows.settings.noise == "white"
