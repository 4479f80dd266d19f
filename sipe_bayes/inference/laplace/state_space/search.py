"""The ``Strategy`` for a ``StateSpace``: from starting point to recorded optimum, in phases.

1. REGRESS: theta by reweighted least squares of the jumps between states as measured. A later starting point is dropped
   once its regression ends where an earlier one did. Or FOLLOW, where some coordinate is not measured: the filter's
   states about those that the commands lead to.
2. SMOOTH: steps of theta and all states (``smoother``).
3. NOISE: an estimate of the noise, and a step. After each of the first few an extended Kalman filter runs through the
   logs (``kalman_filter``), and the search goes on from its states where that ends lower.
4. At an optimum, or where the noise does not settle, jumps that stand out become outliers (``outlying_jumps``) and the
   search goes on; from the optimum without them the filter tries to make do without outliers, and where that is
   likelier the search goes on from there, until it comes to nothing likelier.
5. WIDEN: as soon as steps by short differences have to be damped to less than half (``SmoothingTuning.blind``), as
   where contacts open and close, the search goes on with differences as long as the posterior is wide
   (``posterior_linearisation``); from an optimum where they say something else of it than short ones did, or its noise
   did not settle. What that ends in takes the optimum's place. Then the next starting point, where the fit is poor.
6. Where not every state is measured, and process noise explains much of the logs, or draws find that the best optimum
   is not the posterior's (``inference.importance.judged``), segments of the logs lead to a further starting point.

Of each starting point the likeliest optimum is kept: its normal in theta, with the states integrated out, is what
``laplace`` makes its truncated normal of.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sipe_bayes.core.arrays import BoolArray, FloatArray
from sipe_bayes.core.budget import BudgetExhausted
from sipe_bayes.inference.laplace.longer_windows import trailed
from sipe_bayes.inference.laplace.state_space.kalman_filter import filtered
from sipe_bayes.inference.laplace.state_space.noise import (
    NoisePosterior,
    first_noise,
    infer_noise,
    likeliest_share,
    regress,
    roughness,
)
from sipe_bayes.inference.laplace.state_space.outlying_jumps import needed, outstanding
from sipe_bayes.inference.laplace.state_space.posterior_linearisation import WideSearch
from sipe_bayes.inference.laplace.state_space.smoother import ChainPoint, smooth, solvable
from sipe_bayes.inference.laplace.state_space.state import (
    ChainState,
    Phase,
    Position,
    evidence,
    optimum_at,
    screened,
    unknown_noise,
)
from sipe_bayes.likelihood.settings import Segments
from sipe_bayes.likelihood.state_space.differences import linearise
from sipe_bayes.likelihood.state_space.linearisation import ChainLinearisation, ChainNoise, eliminate_states


@dataclass(frozen=True)
class _Filtered:
    """Where Gauss-Newton comes from the filter's states."""

    point: ChainPoint
    damping: float
    energy: float


class StateSpaceSearch(WideSearch):
    """The ``Strategy`` for a ``StateSpace``."""

    @property
    def step_rollouts(self) -> int:
        """Rollouts that a step takes."""
        return ((self.chain.num_theta + self.chain.num_start) + 2) * len(self.chain.trajectories)

    def start(self) -> ChainState:
        """The first state: at the first starting point."""
        chain, initial = self.chain, self.problem.options.initial
        chain.rollouts += chain.setup_rollouts
        points = screened(self.problem, chain) if initial is None else initial
        none = np.empty((0, chain.num_theta))
        return ChainState(points, 0, self._begin(points[0]), uncounted=chain.uncounted, regressed=none)

    def phases(self) -> dict[Phase, Callable[[ChainState, ChainLinearisation], ChainState]]:
        """A function for each phase."""
        return {
            Phase.REGRESS: self._regress,
            Phase.FOLLOW: self._follow,
            Phase.SMOOTH: self._smooth,
            Phase.NOISE: self._noise,
            Phase.WIDEN: self._widen,
        }

    def _linearised(self, here: Position) -> ChainLinearisation | None:
        """By short differences at first, by theta alone for the regression."""
        if here.phase is Phase.REGRESS:
            return linearise(self.chain, here.theta, here.states, with_states=False)
        return super()._linearised(here)

    def _begin(self, theta: FloatArray) -> Position:
        """At a starting point (N,)."""
        chain = self.chain
        phase, ones = Phase.REGRESS if chain.determined.all() else Phase.FOLLOW, np.ones(chain.num_start)
        none, damping = np.zeros(len(chain.linked), bool), self.tuning.damping.first
        here = Position(phase, theta, chain.reference, unknown_noise(chain), ones, damping, refused=none)
        return replace(here, theta_step=np.zeros(chain.num_theta), state_step=np.zeros(chain.prior_precision.shape))

    def lead(self, state: ChainState) -> ChainState:
        """A finished search, once more from where segments of the logs end; as it was where they lead nowhere."""
        chain, state = self.chain, replace(state, led=True)
        judges = 2 * self.problem.options.tuning.importance.judges  # of two optima
        room = 20 * self.wide_step_rollouts + judges * len(chain.trajectories)  # few searches take more steps
        end = self._by_windows(chain.budget - chain.rollouts - room)
        if end is None:
            return replace(state, uncounted=chain.uncounted)
        movement, fixed = chain.movement(end.states), chain.fixed_sd
        sd = np.where(np.isnan(fixed), np.maximum(roughness(chain), chain.least[0]), fixed)
        noise = ChainNoise(sd, np.maximum(0.01 * movement, chain.least[1]))
        here = replace(self._begin(end.theta), states=end.states, movement=movement, phase=Phase.WIDEN)
        here = replace(here, noise=self._guessed(noise, movement), estimate_theta=end.theta)
        points = np.concatenate([state.points, end.theta[None]])
        return replace(state, points=points, point=len(points) - 1, here=here, done=False, uncounted=chain.uncounted)

    def _by_windows(self, budget: float) -> ChainPoint | None:
        """Theta and states where long windows without process noise end; None where ``budget`` is too small."""
        chain = self.chain
        settings = Segments(noise="white", fit=chain.settings.fit, noise_sd=chain.settings.noise_sd)
        before = math.ceil(chain.rollouts)
        counted = replace(self.problem, tell=lambda what, more: self.problem.tell(what, before + more))
        trail, rollouts = trailed(counted, chain.simulator, chain.trajectories, settings, budget)
        chain.rollouts += rollouts
        if trail is None:
            return None
        away = chain.difference(np.concatenate(trail.states), chain.reference)
        return ChainPoint(trail.theta, chain.moved(chain.reference, away))

    # ------------------------------------------------------------------ phases

    def _regress(self, state: ChainState, linear: ChainLinearisation) -> ChainState:
        """A step of the regression; at its end a first guess of the noise."""
        chain, here, tuning = self.chain, state.here, self.tuning.smoothing
        theta = regress(linear, self.problem.quadratic_prior, here.theta, self.tuning.noise)
        still = np.abs(theta - here.theta).max() < tuning.still or here.iteration + 1 >= tuning.most_regressions
        here = replace(here, theta=theta, iteration=here.iteration + 1)
        if not still:
            return state.at(here)
        if any(np.abs(theta - earlier).max() < tuning.same for earlier in state.regressed):
            return state.next_point(self._begin)
        movement = chain.movement(here.states)
        noise = self._guessed(first_noise(chain, linear, movement, self.tuning.noise), movement)
        here = replace(here, phase=Phase.SMOOTH, noise=noise, movement=movement)
        return replace(state, here=here, regressed=np.concatenate([state.regressed, theta[None]]))

    def _follow(self, state: ChainState, linear: ChainLinearisation) -> ChainState:
        """The filter's states, about those that the commands lead to."""
        chain, theta, prior = self.chain, state.here.theta, self.problem.quadratic_prior
        states, tuning = state.here.states, self.tuning.noise
        movement = chain.movement(states)
        noise = first_noise(chain, linear, movement, tuning)
        noise = solvable(linear, likeliest_share(chain, linear, noise, prior, theta, tuning))
        better = filtered(chain, linear, noise, theta, states, self.tuning.smoothing)
        states, noise = states if better is None else better, self._guessed(noise, movement)
        return state.at(replace(state.here, phase=Phase.SMOOTH, states=states, noise=noise, movement=movement))

    def _smooth(self, state: ChainState, linear: ChainLinearisation) -> ChainState:
        """A step of theta and all states; where none gains anything, an estimate of the noise at once."""
        if state.here.is_wide:
            return self.wide_smooth(state, linear)
        if state.here.damping > self.tuning.smoothing.blind:
            ahead = self._widened(state, blind=True)
            return ahead if state.recorded is not None else self._widen(ahead, linear)
        tuning, here = self.tuning.smoothing, replace(state.here, iteration=state.here.iteration + 1)
        here = replace(here, steps=here.steps + 1)
        prior, tolerance = self.problem.quadratic_prior, tuning.tolerance
        point, fit = smooth(self.chain, linear, here.noise, prior, here.point, here.damping, tolerance, self.tuning)
        if fit.point is None:
            return self._estimated(state.at(here), linear, still=True)
        most = tuning.steps if here.estimates else tuning.first_steps
        phase = Phase.NOISE if here.steps >= most else Phase.SMOOTH
        return state.at(replace(here, phase=phase, theta=point.theta, states=point.states, damping=fit.damping))

    def _noise(self, state: ChainState, linear: ChainLinearisation) -> ChainState:
        """An estimate of the noise, and a step."""
        if state.here.is_wide:
            return self.wide_noise(state, linear)
        here = replace(state.here, iteration=state.here.iteration + 1, steps=state.here.steps + 1)
        return self._estimated(state.at(here), linear, still=False)

    # ------------------------------------------------------------------ the noise, and what follows from it

    def _guessed(self, noise: ChainNoise, movement: FloatArray) -> ChainNoise:
        """A first guess, outliers as wide as a movement (D,), and none yet."""
        return replace(noise, wide=movement, outliers=np.zeros(len(self.chain.linked), bool))

    def _estimated(self, state: ChainState, linear: ChainLinearisation, still: bool) -> ChainState:
        """Estimate the noise, and take a step, or end; still: whether no step gains anything for the old noise."""
        chain, here, tuning = self.chain, state.here, self.tuning.smoothing
        prior, noise = self.problem.quadratic_prior, solvable(linear, here.noise)
        given = NoisePosterior(chain, linear, noise, prior, here.theta, here.movement, self.tuning.noise)
        estimate, gain = infer_noise(given)
        settled, last = gain < tuning.settled and still, here.estimates >= tuning.most_estimates
        if here.estimates and (settled or last):
            return self._ended(state, linear, noise, settled)
        point, fit = smooth(chain, linear, estimate, prior, here.point, here.damping, tuning.tolerance, self.tuning)
        damping, energy = fit.damping, fit.energy
        # the filter, where the noise was only guessed, or much too large until now
        dropped = np.log(noise.process / estimate.process).mean() > tuning.dropped
        if here.estimates == 0 or (here.estimates < tuning.most_filters and dropped):
            other = self._refiltered(linear, estimate, point.theta, here.states)
            if other is not None and other.energy < energy:
                point, damping = other.point, other.damping
        here = replace(here, phase=Phase.SMOOTH, theta=point.theta, states=point.states, damping=damping)
        noise = replace(here.noise, sd=estimate.sd, process=estimate.process)
        return state.at(replace(here, noise=noise, estimates=here.estimates + 1, steps=0))

    def _refiltered(
        self, linear: ChainLinearisation, noise: ChainNoise, theta: FloatArray, states: FloatArray
    ) -> _Filtered | None:
        """Where Gauss-Newton comes from the filter's states.

        The linearisation is that at ``states``; None where the simulation diverges.
        """
        chain, tuning, noise = self.chain, self.tuning.smoothing, solvable(linear, noise)
        begin = filtered(chain, linear, noise, theta, states, tuning)
        if begin is None:
            return None
        prior = self.problem.quadratic_prior
        end = _Filtered(ChainPoint(theta, begin), self.tuning.damping.first, np.inf)
        for _ in range(tuning.filter_steps):
            fresh = linearise(chain, end.point.theta, end.point.states)
            if fresh is None:
                return None
            point, fit = smooth(chain, fresh, noise, prior, end.point, end.damping, tuning.tolerance, self.tuning)
            end = _Filtered(point, fit.damping, fit.energy)
            if fit.point is None:
                break
        return end

    def _ended(self, state: ChainState, linear: ChainLinearisation, noise: ChainNoise, settled: bool) -> ChainState:
        """After an optimum: keep it if it is likelier than those before, and go on from it."""
        here, tuning, before = state.here, self.tuning, state.best_evidence
        assert here.noise.outliers is not None
        worthwhile, more = before + tuning.smoothing.settled, here.estimates < tuning.smoothing.most_estimates
        # first without the outliers that need not be
        outliers = needed(linear, noise, self.problem.quadratic_prior, here.theta, tuning.outliers)
        if not np.array_equal(outliers, here.noise.outliers):
            refused = here.refused | (here.noise.outliers & ~outliers)
            here = replace(here, noise=replace(here.noise, outliers=outliers), refused=refused)
            noise = replace(noise, outliers=outliers)
            likelier = outliers.any() or evidence(self.problem, here, linear, noise, True) > worthwhile
            if likelier and more:
                return state.at(replace(here, phase=Phase.SMOOTH, steps=0))
        value = evidence(self.problem, here, linear, noise, settled)
        if value <= worthwhile:
            return self._widened(state)
        state = state.at(here)
        state = state.with_optimum(optimum_at(self.problem, state, linear, noise, value, settled))
        # then from the optimum: without any outlier, or with those that stand out now
        again = replace(here, phase=Phase.SMOOTH, estimates=1, steps=0)
        if outliers.any():
            other = self._without_outliers(here, linear, noise)
            if other is None or other[1] <= value + tuning.smoothing.settled:
                return self._widened(state)
            end, _ = other
            again = replace(again, theta=end.point.theta, states=end.point.states, damping=end.damping)
            return state.at(replace(again, noise=replace(here.noise, outliers=np.zeros_like(outliers))))
        proposed = self._candidates(here, linear, noise)
        if not proposed.any():
            return self._widened(state)
        noise = replace(here.noise, outliers=proposed)
        return state.at(replace(again, noise=noise, proposals=here.proposals + 1))

    def _widened(self, state: ChainState, blind: bool = False) -> ChainState:
        """On with wide differences from this starting point's optimum, or from where short ones are ``blind``."""
        here, optimum = state.here, state.recorded
        if optimum is not None:
            here = replace(here, theta=optimum.theta, states=optimum.states, noise=optimum.noise)
        elif not blind:
            return state.next_point(self._begin)
        here = replace(here, phase=Phase.WIDEN, damping=self.tuning.damping.first, estimate_theta=here.theta)
        return state.at(replace(here, estimates=0, steps=0))

    def _widen(self, state: ChainState, linear: ChainLinearisation) -> ChainState:
        """The lengths of wide differences; then whether these say anything else than short ones did."""
        noise = solvable(linear, state.here.noise)
        if not state.here.is_wide:
            return self.with_differences(state, linear, noise)
        solved = eliminate_states(linear, noise)
        mean, covariance = self.problem.normal(state.here.theta, solved.precision, solved.gradient)
        short = state.recorded
        if short is not None and short.settled and short.resembles(mean, covariance, self.tuning.wide.alike):
            return self.onward(state)
        return self.wide_noise(state, linear)

    def _candidates(self, here: Position, linear: ChainLinearisation, noise: ChainNoise) -> BoolArray:
        """Jumps (K-1,) to propose: none that turned out to be no outlier, and none after a few times."""
        tuning = self.tuning.outliers
        return outstanding(linear, noise, tuning) & ~here.refused & (here.proposals < tuning.proposals)

    def _without_outliers(
        self, here: Position, linear: ChainLinearisation, noise: ChainNoise
    ) -> tuple[_Filtered, float] | None:
        """Where the filter leads with no outlier, and the evidence there; None if the budget ends or it diverges."""
        regular = solvable(linear, replace(noise, outliers=np.zeros_like(here.refused)))
        try:
            end = self._refiltered(linear, regular, here.theta, here.states)
            fresh = None if end is None else linearise(self.chain, end.point.theta, end.point.states)
        except BudgetExhausted:
            return None
        if end is None or fresh is None:
            return None
        position = replace(here, theta=end.point.theta, states=end.point.states)
        return end, evidence(self.problem, position, fresh, solvable(fresh, regular), False)
