"""Steps of a smoother whose differences are as long as the posterior is wide.

A control step jumps where a contact opens or closes. A short difference across such a jump is a slope of jump by
length: one of them in a log outweighs all that the other steps say of a parameter, and its interval is a hundredth of
what it should be. Differences as long as what is still open, with a variance for what no line can follow
(``likelihood.state_space.differences``), do not see it. A search over a chain of states ends with them where they say
something else than short ones.

They may lead from a likelier place to a less likely one: what lines across a contact promise, a simulation of the
states that they lead to need not keep, and the process noise grows to explain that. Some ways back down lead to a
likelier place yet; where the search ends below the likeliest one, it ends there instead, once its noise has settled, if
a step promises no more than fitting the log's noise would.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sipe_bayes.core.budget import BudgetExhausted
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.inference.laplace.state_space.noise import NoisePosterior, excess, infer_noise
from sipe_bayes.inference.laplace.state_space.smoother import smooth, solvable
from sipe_bayes.inference.laplace.state_space.state import (
    ChainSearch,
    ChainState,
    Phase,
    Position,
    evidence,
    optimum_at,
)
from sipe_bayes.likelihood.state_space.differences import linearise_by
from sipe_bayes.likelihood.state_space.linearisation import ChainLinearisation, ChainNoise, eliminate_states


class WideSearch(ChainSearch):
    """A search with steps by such differences."""

    @property
    def wide_step_rollouts(self) -> int:
        """Rollouts that a step takes."""
        return (2 * (self.chain.num_theta + self.chain.num_start) + 2) * len(self.chain.trajectories)

    def _linearised(self, here: Position) -> ChainLinearisation | None:
        """Over the surroundings that are open, after short differences first."""
        return linearise_by(self.chain, here.theta, here.states, here.theta_step, here.state_step)

    def onward(self, state: ChainState) -> ChainState:
        """At the next starting point where the fit is poor: unsettled, or with noise far above the samples' scatter."""
        best = state.recorded
        poor = best is None or not best.settled or excess(self.chain, best.sd).max() > THRESHOLDS.noise_excess
        return state.next_point(self._begin) if poor else replace(state, done=True)

    def wide_smooth(self, state: ChainState, linear: ChainLinearisation) -> ChainState:
        """A step of theta and all states."""
        return self._stepped(state, linear, solvable(linear, state.here.noise))

    def wide_noise(self, state: ChainState, linear: ChainLinearisation) -> ChainState:
        """An estimate of the noise, which may be worth recording, and a step unless the noise gains more."""
        state, noise, ends = self.estimated(state, linear)
        if ends:
            return self.onward(state)
        if state.here.phase is Phase.NOISE:
            return self.with_differences(state, linear, noise)
        try:
            return self._stepped(state, linear, noise)
        except BudgetExhausted:
            return state  # what was recorded is kept, and the next step ends the search

    def _stepped(self, state: ChainState, linear: ChainLinearisation, noise: ChainNoise) -> ChainState:
        """Where a step leads, and how long the differences are there."""
        here, tuning = state.here, self.tuning.wide
        prior = self.problem.quadratic_prior
        point, fit = smooth(self.chain, linear, noise, prior, here.point, here.damping, tuning.tolerance, self.tuning)
        steps = tuning.steps if fit.point is None else here.steps + 1
        phase = Phase.NOISE if steps >= tuning.steps else Phase.SMOOTH
        here = replace(here, phase=phase, theta=point.theta, states=point.states, damping=fit.damping)
        state = state.at(replace(here, steps=steps, iteration=here.iteration + 1))
        return self.with_differences(state, linear, noise)

    def estimated(self, state: ChainState, linear: ChainLinearisation) -> tuple[ChainState, ChainNoise, bool]:
        """Estimate the noise anew.

        Returns:
            The state with the noise, and with the optimum if it is worth recording; the noise that a step is made for;
            and whether the search from this starting point ends.
        """
        here, prior, tuning = state.here, self.problem.quadratic_prior, self.tuning.wide
        theta, noise, recorded = here.theta, solvable(linear, here.noise), state.recorded
        # whether a step not yet taken is to be credited
        given = NoisePosterior(self.chain, linear, noise, prior, theta, here.movement, self.tuning.noise)
        estimate, gain = infer_noise(replace(given, held=given.promised > tuning.tolerance))
        estimate = solvable(linear, estimate)
        # whether it has settled
        away = theta - here.estimate_theta
        moved = float(away @ eliminate_states(linear, estimate).precision @ away) / len(theta)
        enough = max(tuning.settled, tuning.settled_each * float(linear.observed.sum()))
        value, best = evidence(self.problem, here, linear, estimate, settled=False), state.best_evidence
        still = here.steps > 0 and moved < tuning.still and value < best + enough
        settled = gain < enough and (given.promised < given.freedom if here.back else still)
        estimates = here.estimates + 1
        ends = settled or estimates >= tuning.most_estimates + here.back * tuning.last_estimates
        if ends and not here.back and recorded is not None and value < best - tuning.as_good:
            # steps have led on to where it is less likely: the noise is yet to settle where it was likeliest
            here = replace(here, theta=recorded.theta, states=recorded.states, noise=recorded.noise, back=True)
            here = replace(here, phase=Phase.NOISE, estimates=tuning.most_estimates, steps=0)
            return state.at(here), solvable(linear, recorded.noise), False
        same = recorded is not None and np.array_equal(recorded.states, here.states)
        if value > best - settled * tuning.as_good or same or here.estimates == 0:
            optimum = optimum_at(self.problem, state, linear, estimate, value, settled)
            optimum = replace(optimum, theta_step=here.theta_step, state_step=here.state_step)
            state = state.with_optimum(optimum)
        noise = replace(here.noise, sd=estimate.sd, process=estimate.process)
        phase = Phase.NOISE if here.back or gain > max(given.promised, enough) else Phase.SMOOTH
        here = replace(here, phase=phase, noise=noise, estimates=estimates, steps=0, estimate_theta=theta)
        return state.at(here), estimate, ends

    def with_differences(self, state: ChainState, linear: ChainLinearisation, noise: ChainNoise) -> ChainState:
        """With the lengths of the next differences: the sds of theta and of the states, within limits."""
        here, tuning = state.here, self.tuning.wide
        solved = eliminate_states(linear, noise)
        variance = np.einsum("kdd->kd", solved.covariances()[0])
        _, covariance = self.problem.normal(here.theta, solved.precision, solved.gradient)
        longest = np.maximum(tuning.most_state_step * here.movement, tuning.least_state_step)
        theta_step = np.clip(np.sqrt(np.diag(covariance)), tuning.least_theta_step, tuning.most_theta_step)
        state_step = np.clip(np.sqrt(variance), tuning.least_state_step, longest)
        return state.at(replace(here, theta_step=theta_step, state_step=state_step))
