"""The estimator ``laplace``: a search for optima, their normals, and draws where the posterior is no normal.

What it computes, step by step, stands in the package's docstring.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.budget import BudgetExhausted, BudgetTooSmall, Deadline
from sipe_bayes.core.findings import Code
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.inference import importance
from sipe_bayes.inference.base import Estimator
from sipe_bayes.inference.importance import Draws, Judgement
from sipe_bayes.inference.laplace.draws import draw_more, draw_size, look_beyond, sharing
from sipe_bayes.inference.laplace.longer_windows import led_on
from sipe_bayes.inference.laplace.optimum import WindowOptimum, WindowState, not_followed
from sipe_bayes.inference.laplace.options import LaplaceOptions
from sipe_bayes.inference.laplace.solver import SegmentSolver, SolverState
from sipe_bayes.inference.laplace.state_space.chain_draws import blur, draws_size, looked_beyond
from sipe_bayes.inference.laplace.state_space.noise import excess
from sipe_bayes.inference.laplace.state_space.noise_average import averaged
from sipe_bayes.inference.laplace.state_space.search import StateSpaceSearch
from sipe_bayes.inference.laplace.state_space.several_linearisations import linearisations_cost, scattered
from sipe_bayes.inference.laplace.state_space.state import ChainOptimum, ChainState, contradiction
from sipe_bayes.inference.laplace.state_space.target import ChainFit, ChainTarget
from sipe_bayes.inference.laplace.strategy import Optimum, SearchProblem, Strategy, distinct, mixture
from sipe_bayes.inference.laplace.target import Target, WindowFit, WindowTarget
from sipe_bayes.likelihood import FitResult, Noise, StateSpace
from sipe_bayes.likelihood.quadratic_prior import FLAT_PRECISION, QuadraticPrior
from sipe_bayes.likelihood.starts.estimates import contacts_of
from sipe_bayes.likelihood.state_space.chain import Chain
from sipe_bayes.likelihood.windows import Windows
from sipe_bayes.posterior import GaussianMixture, Posterior
from sipe_bayes.simulation.simulator import Simulator


@dataclass(frozen=True)
class LaplaceState:
    """A fit of ``laplace``.

    Args:
        search: the state of its ``Strategy``.
        draws: those that take the normal's place; None before them, and where it stands.
        given: batches of them whose proposals the draws did not make.
        judgements: of the normals of a chain's optima, best first.
        looked: whether what lies beyond the normal of a chain's optimum has been looked at.
        unjudged: whether the budget left no room to see whether the posterior is a normal.
        done: whether all have ended.
    """

    search: SolverState | WindowState | ChainState
    draws: Draws | None = None
    given: int = 0
    judgements: tuple[Judgement, ...] = ()
    looked: bool = False
    unjudged: bool = False
    done: bool = False


class Laplace(Estimator[LaplaceState]):
    """Box-constrained least squares, noise by restricted likelihood; in seconds. A GaussianMixture of the optima.

    Args:
        restarts: starting points at most; more than one where the fit is poor. From known states through impacts the
            best of four are followed, and as many again, at most twice. With 1 there is one, and no second optimum is
            looked for.
        candidates: draws from the prior among which they are chosen.
        initial: (R, N), the starting points themselves instead.
        tuning: numbers of the search itself.
    """

    name: ClassVar[str] = "laplace"
    searches: ClassVar[bool] = True
    default_budget: ClassVar[int] = 5000
    goes_on: ClassVar[bool] = True
    options_type = LaplaceOptions
    state_type = LaplaceState
    options: LaplaceOptions
    initial_starts: FloatArray | None = None
    """(W, D) of segments, of the one starting point: the fit begins at both, with all segments."""

    def check_options(self) -> None:
        """Hold the starting points against the parameters, and into the cube."""
        initial = self.options.initial
        if initial is not None:
            inside = np.clip(np.atleast_2d(self.space.check_shape(initial)), 0, 1)
            self.options = replace(self.options, initial=inside)

    def budget_for(self, trajectories: Trajectories) -> int:
        """So many that each starting point may be followed to the end: it grows with logs and unknowns."""
        each = 200 * (len(self.space) + self.num_start + 12)  # two long searches, 12 trials a step
        if isinstance(self.likelihood, StateSpace):
            each += draws_size(len(self.space), self.problem) + linearisations_cost(self.problem, self._coordinates)
        return max(self.default_budget, each * len(trajectories))

    @property
    def num_start(self) -> int:
        """D, unknowns of a start."""
        known = self.likelihood.starts == "recorded" and not isinstance(self.likelihood, StateSpace)
        return 0 if known else self._coordinates

    @property
    def _coordinates(self) -> int:
        """D, of a state; of a callable's none."""
        if not isinstance(self.simulator, Simulator):
            return 0
        return len(self.simulator.environment.start_sd(self.simulator.model))

    @property
    def problem(self) -> SearchProblem:
        """What its search is given."""
        return SearchProblem(self.space, self.prior, self.seed, self.options, self.findings.add, self.tell)

    def start(self, trajectories: Trajectories) -> LaplaceState:
        """The first state of the search that fits the likelihood."""
        strategy = self._strategy(self.bound(trajectories))
        begun = LaplaceState(strategy.start())
        if self.initial_starts is None or self.options.initial is None:
            return begun
        assert isinstance(strategy, SegmentSolver)
        assert isinstance(begun.search, WindowState)
        onward = strategy.onward(begun.search, self.options.initial[0], self.initial_starts)
        return begun if onward is None else LaplaceState(onward)

    def describe(self, state: LaplaceState) -> str:
        """Starting point and step, or draws."""
        if state.draws is not None:
            return f"laplace: {len(state.draws.values)} importance draws"
        return f"laplace: {state.search.describe()}"

    def step(self, state: LaplaceState, trajectories: Trajectories) -> LaplaceState:
        """A step of the search, or, where it has ended, one more batch of draws."""
        windows = self.bound(trajectories)
        known = state.search.optima or self.initial_starts is not None  # else the first estimate has the time it needs
        windows.deadline = self._deadline if known else Deadline()
        if state.draws is not None and isinstance(windows, Windows):
            assert isinstance(state.search, WindowState)
            windows.mask(state.search.wild)
            return self._drawn(windows, state, state.draws)
        strategy = self._strategy(windows)
        windows.budget = self.budget - self._judges_share(windows, state)
        try:
            if state.search.done:
                assert isinstance(strategy, StateSpaceSearch)
                assert isinstance(state.search, ChainState)
                search = strategy.lead(state.search)
            else:
                search = strategy.step(state.search)
        except BudgetExhausted:
            windows.budget = self.budget
            if not isinstance(windows, Chain) or state.looked or not state.search.optima:
                raise
            kept = distinct(state.search.optima)
            judged, target = (state, None) if state.judgements else self._judged(windows, state, kept)
            if not judged.judgements:
                raise
            return replace(self._looked_beyond(windows, judged, target), done=False)  # the next step ends it
        windows.budget = self.budget
        before, after = (s.plain if isinstance(s, SolverState) else np.zeros(0) for s in (state.search, search))
        if len(after) > len(before):
            values = zip(self.space, self.space.values(after).tolist(), strict=True)
            named = ", ".join(f"{p.name} {value:.4g} {p.unit}".rstrip() for p, value in values)
            self.announce(f"First estimate (plain least squares, no intervals yet): {named}")
        if search.optima is not state.search.optima:
            state = replace(state, judgements=(), draws=None, looked=False, unjudged=False)
        state = replace(state, search=search)
        if not search.done:
            return state
        if len(state.judgements) == len(distinct(search.optima)):
            assert isinstance(windows, Chain)
            return state if self._may_lead(windows, search) else self._looked_beyond(windows, state, None)
        return self._probed(windows, state)

    def _judges_share(self, windows: Windows | Chain, state: LaplaceState) -> int:
        """Rollouts that the search of a chain leaves to judges of its optima and draws; none where they are dear."""
        if not isinstance(windows, Chain) or not state.search.optima:
            return 0
        linearised = 2 * (windows.num_theta + windows.num_start) + 1
        each = self.options.tuning.importance.judges + linearised
        judges, logs = each * len(distinct(state.search.optima)), len(windows.trajectories)
        later = linearisations_cost(self.problem, windows.num_start) + draws_size(len(self.space), self.problem)
        shares = [(judges + later) * logs, judges * logs]
        return next((one for one in shares if one < self.options.tuning.importance.most_share * self.budget), 0)

    def _strategy(self, windows: Windows | Chain) -> Strategy[Any]:
        """The search that fits the likelihood."""
        if not isinstance(windows, Chain):
            return SegmentSolver(self.problem, windows)
        return StateSpaceSearch(self.problem, windows)

    def _probed(self, windows: Windows | Chain, state: LaplaceState) -> LaplaceState:
        """The state of a finished search; not done where the posterior is no normal and draws are to take its place."""
        ended = replace(state, done=True)
        if isinstance(windows, Chain):
            optima, may_lead = distinct(state.search.optima), self._may_lead(windows, state.search)
            best, most = optima[0], self.options.tuning.state_space.absorbed * windows.observed.sum()
            assert isinstance(best, ChainOptimum)
            if may_lead and best.absorbed > most:  # process noise explains much: segments may need less
                return state
            state, target = self._judged(windows, state, optima)
            stands = not state.judgements or state.judgements[0].normal
            return self._looked_beyond(windows, state, target) if stands or not may_lead else state
        assert isinstance(state.search, WindowState)
        if not (search := led_on(self.problem, windows, state.search)).done:
            return replace(state, search=search)
        if isinstance(search, SolverState) and search.behind_noise:
            return replace(ended, search=search)  # its interval is no likelihood's
        kept = distinct(search.optima)
        exact = isinstance(search, SolverState) and search.here.exact and windows.has_parts  # a function costs little
        if exact and np.diag(kept[0].covariance).max() < 0.02**2:
            return replace(ended, search=search)  # narrow, and as the linearisation foretold at its own width
        look = look_beyond(self.problem, windows, kept)
        ended = replace(ended, search=search, draws=look.draws, given=look.given, unjudged=not look.judged)
        more = look.draws is not None and windows.has_room(draw_size(self.problem, windows, kept))
        return replace(ended, done=not more)

    def _may_lead(self, chain: Chain, search: WindowState | ChainState) -> bool:
        """Whether a finished search may go on from where segments lead: once, where not every state is measured.

        Not from known first states; nor where bodies strike, which segments do not follow.
        """
        known = chain.settings.starts == "recorded"
        if not isinstance(search, ChainState) or search.led or known or chain.determined.all():
            return False
        return not contacts_of(chain.simulator, [replace(log, states=None) for log in chain.trajectories]).change

    def _judged(
        self, chain: Chain, state: LaplaceState, kept: list[Optimum]
    ) -> tuple[LaplaceState, ChainTarget | None]:
        """With the normals of a chain's optima averaged over the noise and judged; fewer where the budget ends.

        And what the best one's were held against.
        """
        assert not isinstance(state.search, WindowState)
        judgements, search, targets = [], state.search, []
        tuning, steps = self.options.tuning.importance, len(chain.log)
        for optimum in kept:
            assert isinstance(optimum, ChainOptimum)
            try:
                fit = ChainFit.at(chain, optimum)
                whole = replace(optimum, averaged=averaged(self.problem, chain, fit))
                search = search.with_optimum(whole.beside_scatter(excess(chain, optimum.sd), chain.fitted))
                held = mixture([optimum.as_linearised], self.space)
                target = ChainTarget(self.prior, chain, fit)
                judgements.append(importance.judged(target, held, self.seed, tuning, steps))
                targets.append(target)
            except BudgetExhausted:
                chain.short = True  # a larger budget goes on from here
                break
        return replace(state, search=search, judgements=tuple(judgements)), targets[0] if targets else None

    def _looked_beyond(self, chain: Chain, state: LaplaceState, target: ChainTarget | None) -> LaplaceState:
        """The end of a fit of a chain: by several linearisations, and with draws where an only normal does not stand.

        target: the best optimum's, where it is at hand.
        """
        assert not isinstance(state.search, WindowState)
        search, kept, ended = state.search, distinct(state.search.optima), replace(state, done=True, looked=True)
        try:
            for one in kept[: len(state.judgements)]:
                assert isinstance(one, ChainOptimum)
                if target is None or one is not kept[0]:
                    target = ChainTarget(self.prior, chain, ChainFit.at(chain, one))
                search = search.with_optimum(scattered(self.problem, target, one))
        except BudgetExhausted:
            chain.short = True
            return replace(ended, search=search, unjudged=True)
        ended = replace(ended, search=search)
        if target is None or len(kept) > 1:
            return ended
        look = looked_beyond(self.problem, target, state.judgements[0].normal)
        return replace(ended, draws=look.draws, unjudged=not look.judged)

    def _drawn(self, windows: Windows, state: LaplaceState, draws: Draws) -> LaplaceState:
        """One more batch of draws, as long as they promise something and the budget lasts; or on from the best."""
        assert isinstance(state.search, WindowState)
        kept = distinct(state.search.optima)
        draws, elsewhere = draw_more(self.problem, windows, kept, draws)
        if elsewhere:
            search = SegmentSolver(self.problem, windows).onward(state.search, draws.points[draws.values.argmax()])
            if search is not None:
                return replace(state, search=search, draws=None)
        done = importance.ended(draws, self.prior, self.options.tuning.importance, state.given)
        return replace(state, draws=draws, done=done or not windows.has_room(draw_size(self.problem, windows, kept)))

    def posterior(self, state: LaplaceState, trajectories: Trajectories) -> GaussianMixture:
        """The optima's normals, or kernels on the draws that take their place.

        Raises:
            BudgetTooSmall: where there is no optimum yet.
        """
        kept = distinct(state.search.optima)
        if not kept:
            step, usual = self._strategy(self.bound(trajectories)).step_rollouts, self.budget_for(trajectories)
            raise BudgetTooSmall(
                f"budget: {self.budget} rollouts were not enough for one optimum; one step takes {step} rollouts, so "
                f"raise the budget (default for this log: {usual})"
            )
        draws, tuning = state.draws or Draws.none(len(self.space)), self.options.tuning.importance
        weight = importance.weights(draws, self.prior)
        effective = importance.effective(weight)
        self._report(kept, state, len(weight), effective)
        bound = self.bound(trajectories)
        if isinstance(bound, Windows):
            self._report_segments(bound, state, kept)
        if effective < tuning.least:
            return mixture(kept, self.space)
        wider = blur(kept[0].covariance, kept[0].spread) if isinstance(kept[0], ChainOptimum) else 0.0
        own = mixture(sharing(kept, self.problem), self.space)
        points = np.clip(draws.points + kept[0].centre - kept[0].mean, 0.0, 1.0)
        return importance.kernels(points, weight, own, self.seed, tuning, wider)

    def _report(self, kept: list[Optimum], state: LaplaceState, count: int, effective: float) -> None:
        """Diagnostics of the best optimum, and whether its normal, or ``count`` draws, are the posterior."""
        best, search = kept[0], state.search
        self.diagnostics = {"modes": len(kept), **noise_diagnostics(best)}
        if isinstance(best, ChainOptimum):
            self.diagnostics["pareto_k"] = [one.pareto_k for one in state.judgements]
            if not best.settled:
                self.find(Code.SEARCH_UNSETTLED, steps=search.here.iteration)
            if best.excess > THRESHOLDS.noise_excess:
                self.find(Code.NOISE_EXCEEDS_SCATTER, channel=best.noisiest, ratio=best.excess)
            distance = contradiction([one for one in search.optima if isinstance(one, ChainOptimum)])
            if distance is not None:
                self.find(Code.STARTS_CONTRADICT, distance=distance)
        failed = [(one.effective, one.draws) for one in state.judgements if not one.normal]
        if state.draws is not None:
            self.diagnostics["draws"] = {"draws": count, "effective": effective}
            failed = failed or [(effective, count)] * (state.done or state.looked)
        if effective < self.options.tuning.importance.least:
            for enough, draws in failed:
                self.find(Code.NOT_THE_NORMAL, effective=enough, draws=draws)
        chain = isinstance(best, ChainOptimum)
        if state.unjudged or (chain and state.done and len(state.judgements) < len(kept)):
            self.find(Code.NOT_JUDGED)
        if len(kept) > 1:
            self.find(Code.SEPARATE_OPTIMA, count=len(kept))

    def _report_segments(self, windows: Windows, state: LaplaceState, kept: list[Optimum]) -> None:
        """What is to be said of segments and against their optima."""
        search = state.search
        assert isinstance(search, WindowState)
        if isinstance(search, SolverState):
            if state.done:
                used = SegmentSolver(self.problem, windows).count_segments()
                self.diagnostics["segments"] = {"fitted": used, "of": windows.num_windows}
            if search.behind_noise:
                self.diagnostics["least_squares"] = True
                self.find(Code.LEAST_SQUARES)
        if len(search.wild):
            channels = ", ".join(self.simulator.environment.channels[c] for c in np.unique(search.wild[:, 2]))
            logs = len(np.unique(search.wild[:, 0]))
            self.find(Code.WILD_SAMPLES, count=len(search.wild), channels=channels, logs=logs)
        if isinstance(self.simulator, Simulator):
            # of fits from known states of 8 control steps through impacts four of four were right, of 120 two
            if windows.impacts and (windows.num_start or windows.steps.max() > 10):
                self.find(Code.IMPACTS)
            loose = not_followed(windows, kept[0].sd)
            if loose is not None:
                self.find(Code.NOISE_EXCEEDS_SCATTER, channel=loose[0], ratio=loose[1])
        for optimum in kept:
            assert isinstance(optimum, WindowOptimum)
            if optimum.finding is not None:
                self.findings.add(optimum.finding)

    def usual_rest(self) -> float | None:
        """Rollouts that the fit still takes as a rule; None where nothing is known of that."""
        state, bound = self.state, self._bound
        if state is None or bound is None:
            return None
        if not isinstance(state.search, SolverState):  # from each starting point some 60 linearisations by all columns
            usual = 60.0 * (state.search.point + 1) * (len(self.space) + self.num_start + 2) * len(bound[0])
            return max(usual - self.rollouts, usual / 4)
        return SegmentSolver(self.problem, self.windows(bound[0])).usual_rest(state.search)

    @property
    def best(self) -> Optimum | None:
        """The best optimum until now, None before one."""
        kept = [] if self.state is None else distinct(self.state.search.optima)
        return kept[0] if kept else None

    @property
    def result(self) -> FitResult | None:
        """The best optimum until now, None before one."""
        best, starts, slope, states, finding = self.best, None, None, None, None
        if best is None:
            return None
        assert self.state is not None
        search = self.state.search
        outliers = search.wild if isinstance(search, WindowState) else np.zeros((0, 3), np.int64)
        if isinstance(best, WindowOptimum):
            starts, slope, finding = best.starts, best.slope, best.finding
        elif isinstance(best, ChainOptimum) and self._bound is not None:
            length = self._bound[0].length
            sample = np.minimum(np.arange(int(length.max()) + 1), length[:, None])
            states = np.asarray(best.states[(np.cumsum(length + 1) - length - 1)[:, None] + sample])
        noise = Noise(best.sd, best.tau)
        return FitResult(
            best.theta, best.centre, best.spread, noise, best.evidence, starts, slope, states, outliers, finding
        )

    def information(self) -> tuple[FloatArray, FloatArray]:
        """Optimum (N,), perhaps outside the cube, and information (N, N) of the data alone, after ``fit``."""
        if self.best is None:
            raise ValueError("information: nothing has been fitted yet; call fit first")
        prior, mean, total = QuadraticPrior.of(self.prior), self.best.centre, np.linalg.inv(self.best.spread)
        flat = FLAT_PRECISION * np.eye(len(mean))
        eigenvalues, axes = np.linalg.eigh(total - prior.precision - flat)
        information = (axes * np.maximum(eigenvalues, 0.0)) @ axes.T
        right = total @ mean - prior.precision @ prior.mean - flat @ np.full(len(mean), 0.5)
        return np.linalg.pinv(information, rcond=1e-9, hermitian=True) @ right, information  # else a direction is open


TargetFit = WindowFit | ChainFit
"""What a target is made of, as plain data."""


def target_fit(bound: Windows | Chain, optimum: Optimum) -> TargetFit:
    """What the target at an optimum is made of; simulates."""
    if isinstance(bound, Chain):
        assert isinstance(optimum, ChainOptimum)
        return ChainFit.at(bound, optimum)
    assert isinstance(optimum, WindowOptimum)
    return WindowFit.at(bound, optimum)


def target_of(prior: Posterior, bound: Windows | Chain, fit: TargetFit) -> Target:
    """Log p(theta | y) as an optimum has it, initial states or states integrated out."""
    if isinstance(bound, Chain):
        assert isinstance(fit, ChainFit)
        return ChainTarget(prior, bound, fit)
    assert isinstance(fit, WindowFit)
    return WindowTarget(prior, bound, fit)


def noise_diagnostics(optimum: Optimum) -> dict[str, list[float] | list[int]]:
    """The noise at an optimum, as plain data."""
    noise: dict[str, list[float] | list[int]] = {"noise_sd": optimum.sd.tolist(), "noise_tau": optimum.tau.tolist()}
    return noise | optimum.diagnostics() if isinstance(optimum, ChainOptimum) else noise
