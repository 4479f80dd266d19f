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
from dataclasses import dataclass, replace

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.inference.laplace.state_space.growing_horizon import grown
from sipe_bayes.inference.laplace.state_space.noise import first_noise, likeliest_share
from sipe_bayes.inference.laplace.state_space.posterior_linearisation import WidePosition, WideSearch
from sipe_bayes.inference.laplace.state_space.smoother import solvable
from sipe_bayes.inference.laplace.state_space.state import (
    ChainState,
    Phase,
    evidence,
    optimum_at,
    screened,
    unknown_noise,
)
from sipe_bayes.likelihood.state_space.linearisation import ChainLinearisation


@dataclass(frozen=True)
class KnownStartState(ChainState[WidePosition]):
    """A search from known first states."""

    here: WidePosition


class KnownStartSearch(WideSearch[KnownStartState]):
    """The ``Strategy`` for a ``StateSpace`` whose first states are known."""

    @property
    def step_rollouts(self) -> int:
        """Rollouts that a step takes."""
        return self.wide_step_rollouts

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
        return {Phase.FOLLOW: self._follow, Phase.SMOOTH: self.wide_smooth, Phase.NOISE: self.wide_noise}

    def _begin(self, theta: FloatArray) -> WidePosition:
        """At a starting point (N,)."""
        chain, ones = self.chain, np.ones(self.chain.num_start)
        return WidePosition(
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
        return self.with_differences(state.with_optimum(optimum), linear, noise)
