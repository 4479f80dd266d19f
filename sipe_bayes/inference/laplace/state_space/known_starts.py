"""The ``Strategy`` for a ``StateSpace`` whose logs' first states are known.

The commands lead from there to states near the true ones once theta is roughly right, which ever longer beginnings of
the logs make it (``growing_horizon``). So no state has to be found from its measurement; what matters is to stay honest
through contacts, and the smoother's transitions are linearised as widely as states and theta are still open
(``likelihood.state_space.differences``).

1. FOLLOW: the states that the commands lead to, and a first guess of the noise about them. What a budget that ends
   before any step leaves is as wide as the first step is long.
2. SMOOTH: three Gauss-Newton steps of theta and all states.
3. NOISE: an estimate of the noise, and a step. The estimate credits a step not yet taken only where next to nothing is
   left to gain: through contact a linearisation promises what the simulation does not keep. It has settled where theta
   has hardly moved since the last one, and a new noise gains next to nothing.

Of each starting point the estimate that has settled is kept, or the likeliest one if none has, or if it is far
likelier. Its normal lies about the best step from there, which the slopes foretell better than the simulation grants.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.inference.laplace.state_space.growing_horizon import grown
from sipe_bayes.inference.laplace.state_space.noise import first_noise, infer_noise, likeliest_share
from sipe_bayes.inference.laplace.state_space.smoother import border, smooth, solvable
from sipe_bayes.inference.laplace.state_space.state import (
    ChainSearch,
    ChainState,
    Phase,
    Position,
    evidence,
    optimum_at,
    screened,
    unknown_noise,
)
from sipe_bayes.likelihood.settings import BudgetExhausted
from sipe_bayes.likelihood.state_space.differences import linearise_by
from sipe_bayes.likelihood.state_space.linearisation import ChainLinearisation, ChainNoise, eliminate_states, restricted


@dataclass(frozen=True)
class KnownStartPosition(Position):
    """Where the search from one starting point stands.

    Args:
        theta_step: (N,), of the next differences.
        state_step: (K, D).
        estimate_theta: (N,), where the noise was estimated last.
    """

    theta_step: FloatArray = field(default_factory=lambda: np.zeros(0))
    state_step: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    estimate_theta: FloatArray = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True)
class KnownStartState(ChainState[KnownStartPosition]):
    """A search from known first states."""

    here: KnownStartPosition


class KnownStartSearch(ChainSearch[KnownStartState]):
    """The ``Strategy`` for a ``StateSpace`` whose first states are known."""

    @property
    def step_rollouts(self) -> int:
        """Rollouts that a step takes."""
        return (2 * (self.chain.num_theta + self.chain.num_start) + 2) * len(self.chain.trajectories)

    def start(self) -> KnownStartState:
        """The first state: at the first starting point."""
        chain, points = self.chain, self.problem.options.initial
        chain.rollouts += chain.setup_rollouts
        if points is None:
            points = grown(self.problem, chain)
        if points is None:
            points = screened(self.problem, chain)
        return KnownStartState(points, 0, self._begin(points[0]), uncounted=chain.uncounted)

    def phases(self) -> dict[Phase, Callable[[KnownStartState, ChainLinearisation], KnownStartState]]:
        """A function for each phase."""
        return {Phase.FOLLOW: self._follow, Phase.SMOOTH: self._smooth, Phase.NOISE: self._noise}

    def _linearised(self, here: KnownStartPosition) -> ChainLinearisation | None:
        """Over the surroundings that are open, after short differences first."""
        return linearise_by(self.chain, here.theta, here.states, here.theta_step, here.state_step)

    def _begin(self, theta: FloatArray) -> KnownStartPosition:
        """At a starting point (N,)."""
        chain, ones = self.chain, np.ones(self.chain.num_start)
        return KnownStartPosition(
            phase=Phase.FOLLOW,
            theta=theta,
            states=chain.reference,
            noise=unknown_noise(chain),
            movement=ones,
            damping=self.tuning.damping.first,
            theta_step=np.zeros(chain.num_theta),
            state_step=np.zeros(chain.prior_precision.shape),
            estimate_theta=theta,
        )

    # ------------------------------------------------------------------ phases

    def _follow(self, state: KnownStartState, linear: ChainLinearisation) -> KnownStartState:
        """A first guess of the noise about the states that the commands lead to."""
        chain, theta, prior, tuning = self.chain, state.here.theta, self.problem.quadratic_prior, self.tuning.noise
        movement, fixed = chain.movement(state.here.states), chain.fixed_sd
        noise = first_noise(chain, linear, movement, tuning)
        residual = np.sqrt((linear.residual**2).sum(0) / linear.observed.sum(0))
        smaller = np.maximum(np.minimum(noise.sd, residual), chain.least[0])
        noise = replace(noise, sd=np.where(np.isnan(fixed), smaller, fixed))
        noise = solvable(linear, likeliest_share(chain, linear, noise, prior, theta, tuning))
        state = state.at(replace(state.here, phase=Phase.SMOOTH, noise=noise, movement=movement))
        # an optimum in case the budget ends before any step, as wide as that step is long
        value = evidence(self.problem, state.here, linear, noise, settled=False)
        optimum = optimum_at(self.problem, state, linear, noise, value, settled=False)
        away = optimum.mean - theta
        optimum = replace(optimum, covariance=optimum.covariance + np.outer(away, away))
        return self._with_differences(state.with_optimum(optimum), linear, noise)

    def _smooth(self, state: KnownStartState, linear: ChainLinearisation) -> KnownStartState:
        """A step of theta and all states."""
        return self._stepped(state, linear, solvable(linear, state.here.noise))

    def _noise(self, state: KnownStartState, linear: ChainLinearisation) -> KnownStartState:
        """An estimate of the noise, which may be worth recording, and a step."""
        state, noise, ends = self.estimated(state, linear)
        if ends:
            return state.next_point(self._begin)
        try:
            return self._stepped(state, linear, noise)
        except BudgetExhausted:
            return state  # what was recorded is kept, and the next step ends the search

    # ------------------------------------------------------------------ what they are made of

    def _stepped(self, state: KnownStartState, linear: ChainLinearisation, noise: ChainNoise) -> KnownStartState:
        """Where a step leads, and how long the differences are there."""
        here, tuning = state.here, self.tuning.known_starts
        prior = self.problem.quadratic_prior
        point, fit = smooth(self.chain, linear, noise, prior, here.point, here.damping, tuning.tolerance, self.tuning)
        steps = tuning.steps if fit.point is None else here.steps + 1
        phase = Phase.NOISE if steps >= tuning.steps else Phase.SMOOTH
        here = replace(here, phase=phase, theta=point.theta, states=point.states, damping=fit.damping)
        state = state.at(replace(here, steps=steps, iteration=here.iteration + 1))
        return self._with_differences(state, linear, noise)

    def estimated(self, state: KnownStartState, linear: ChainLinearisation) -> tuple[KnownStartState, ChainNoise, bool]:
        """Estimate the noise anew.

        Returns:
            The state with the noise, and with the optimum if it is worth recording; the noise that a step is made for;
            and whether the search from this starting point ends.
        """
        here, prior, tuning = state.here, self.problem.quadratic_prior, self.tuning.known_starts
        theta, noise = here.theta, solvable(linear, here.noise)
        # whether a step not yet taken is to be credited
        hold = border(prior, theta, eliminate_states(linear, noise).gradient)
        promised = restricted(linear, noise, hold)[0] - restricted(linear, noise, hold, held=True)[0]
        held = promised > tuning.tolerance
        estimate, gain = infer_noise(self.chain, linear, noise, prior, theta, here.movement, self.tuning.noise, held)
        estimate = solvable(linear, estimate)
        # whether it has settled
        away = theta - here.estimate_theta
        moved = float(away @ eliminate_states(linear, estimate).precision @ away) / len(theta)
        enough = max(tuning.settled, tuning.settled_each * float(linear.observed.sum()))
        settled = here.estimates > 0 and gain < enough and moved < tuning.still
        value = evidence(self.problem, here, linear, estimate, settled=False)
        if value > state.best_evidence - settled * tuning.as_good or here.estimates == 0:
            optimum = optimum_at(self.problem, state, linear, estimate, value, settled)
            optimum = replace(optimum, theta_step=here.theta_step, state_step=here.state_step)
            state = state.with_optimum(optimum)
        noise = replace(here.noise, sd=estimate.sd, process=estimate.process)
        estimates, ends = here.estimates + 1, settled or here.estimates + 1 >= tuning.most_estimates
        here = replace(here, phase=Phase.SMOOTH, noise=noise, estimates=estimates, steps=0, estimate_theta=theta)
        return state.at(here), estimate, ends

    def _with_differences(
        self, state: KnownStartState, linear: ChainLinearisation, noise: ChainNoise
    ) -> KnownStartState:
        """With the lengths of the next differences: the sds of theta and of the states, within limits."""
        here, tuning = state.here, self.tuning.known_starts
        solved = eliminate_states(linear, noise)
        variance = np.einsum("kdd->kd", solved.covariances()[0])
        _, covariance = self.problem.normal(here.theta, solved.precision, solved.gradient)
        longest = np.maximum(tuning.most_state_step * here.movement, tuning.least_state_step)
        theta_step = np.clip(np.sqrt(np.diag(covariance)), tuning.least_theta_step, tuning.most_theta_step)
        state_step = np.clip(np.sqrt(variance), tuning.least_state_step, longest)
        return state.at(replace(here, theta_step=theta_step, state_step=state_step))
