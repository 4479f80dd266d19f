"""What the search methods (simopt, adr, cem) share: a pool of simulated thetas with rewards.

Draws come from generators made of (seed, number of the draw), so that a state needs none and a run that resumes goes on
as if it had not stopped. A pool belongs to one set of trajectories: given others, a method keeps its Gaussian or
particles and starts a new pool.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, TypeVar

import numpy as np

from sipe_bayes.core.arrays import BoolArray, Float32Array, FloatArray, IntArray
from sipe_bayes.core.budget import BudgetExhausted, BudgetTooSmall
from sipe_bayes.core.findings import Code
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.inference.base import Estimator
from sipe_bayes.inference.recorded import Recorded, digest
from sipe_bayes.inference.search.discrepancy import StateDifference, channel_scale
from sipe_bayes.inference.search.learned_reward import LearnedReward, RewardOptions
from sipe_bayes.models.discriminator import TrainingState
from sipe_bayes.posterior import Posterior


@dataclass(frozen=True)
class Pool:
    """The latest simulated thetas, all of one set of trajectories.

    Args:
        theta: (P, N).
        reward: (P,), -inf where the simulation diverged.
        draw: (P,), the number of the draw that each came from.
        units: (C,), what differences of states are divided by; NaN before the first valid simulation.
        trajectories: digest of those that were simulated.
        features: (P, M, F), control steps, where rewards are learned.
    """

    theta: FloatArray
    reward: FloatArray
    draw: IntArray
    units: FloatArray
    trajectories: str
    features: Float32Array | None = None

    @property
    def valid(self) -> BoolArray:
        """Which simulations (P,) did not diverge."""
        return np.isfinite(self.reward)

    @property
    def best(self) -> FloatArray:
        """The theta (N,) of the highest reward."""
        return self.theta[self.reward.argmax()]


@dataclass(frozen=True, kw_only=True)
class PoolState:
    """State of a search.

    Args:
        pool: the simulations that rewards are known of.
        training: the discriminator, where rewards are learned.
        draws: generators used so far.
        simulated: simulations so far, of all pools.
        diverged: how many of them diverged.
        done: whether the search has ended.
    """

    pool: Pool
    training: TrainingState | None = None
    draws: int = 0
    simulated: int = 0
    diverged: int = 0
    done: bool = False


P = TypeVar("P", bound=PoolState)


class Search(Estimator[P]):
    """Base of the methods that simulate where they expect good rewards.

    A reward is minus the cost of ``discrepancy.StateDifference``. ``proposal`` is what new theta are drawn from, where
    that is not the posterior.
    """

    uses_prior: ClassVar[bool] = False
    uncertain: ClassVar[bool] = False
    begins_with_prior: ClassVar[bool] = True
    proposal: Posterior | None = None

    def fit(self, trajectories: Recorded, *, retrain: bool = False) -> Posterior:
        """As ``Estimator.fit``; a finding if a prior was given, of which a search makes little use."""
        posterior = super().fit(trajectories, retrain=retrain)
        if (self.prior.gaussian_moments()[1].diagonal() < 1).any():  # a uniform prior counts as enormously wide
            use = "uses the prior only to begin" if self.begins_with_prior else "does not use the prior"
            self.find(Code.PRIOR_HARDLY_USED, method=self.name, use=use)
        return posterior

    def empty_pool(self, trajectories: Trajectories) -> Pool:
        """The pool before the first simulation."""
        units = np.full(len(self.windows(trajectories).channels), np.nan)
        none = np.empty((0, len(self.space)))
        return Pool(none, np.empty(0), np.empty(0, np.int64), units, digest(trajectories))

    def renewed(self, state: P, trajectories: Trajectories) -> P:
        """The state, without its pool where that belongs to other trajectories."""
        if state.pool.trajectories == digest(trajectories):
            return state
        return replace(state, pool=self.empty_pool(trajectories))

    def affordable(self, wanted: int, trajectories: Trajectories) -> int:
        """How many of ``wanted`` simulations fit into what is left of the budget."""
        return max(0, min(wanted, (self.budget - self.windows(trajectories).rollouts) // len(trajectories)))

    def check_budget(self, state: P, trajectories: Trajectories) -> None:
        """Raise BudgetExhausted where not one simulation was or can be made."""
        if not state.simulated and not self.affordable(1, trajectories):
            raise BudgetExhausted(f"one simulation takes {len(trajectories)} rollouts, the budget is {self.budget}")

    def random(self, draw: int) -> np.random.Generator:
        """The generator of a draw of this number."""
        return np.random.default_rng([self.seed, draw])

    def evaluated(self, state: P, theta: FloatArray, trajectories: Trajectories, most: int) -> P:
        """Simulate, and bring the rewards up to date.

        Args:
            state: before it.
            theta: (B, N).
            trajectories: the logs.
            most: simulations that the pool keeps, the latest.

        Returns:
            The state with theta in its pool.
        """
        predicted = self.windows(trajectories).simulate(theta)
        pool, training = self.rewarded(state, predicted, trajectories, most)
        pool = replace(
            pool,
            theta=np.concatenate([pool.theta, theta])[-most:],
            draw=np.concatenate([pool.draw, np.full(len(theta), state.draws)])[-most:],
        )
        return replace(
            state,
            pool=pool,
            training=training,
            draws=state.draws + 1,
            simulated=state.simulated + len(theta),
            diverged=state.diverged + int((~pool.valid[-len(theta) :]).sum()),
        )

    def rewarded(
        self, state: P, predicted: FloatArray, trajectories: Trajectories, most: int
    ) -> tuple[Pool, TrainingState | None]:
        """Rewards after new predictions.

        Args:
            state: before them.
            predicted: (B, W, L, C).
            trajectories: the logs.
            most: simulations that the pool keeps, the latest.

        Returns:
            The pool with its rewards and what else they change, but the old thetas; and the discriminator.
        """
        windows, pool = self.windows(trajectories), state.pool
        units = pool.units if np.isfinite(pool.units).all() else channel_scale(windows, predicted)
        reward = -StateDifference(windows, units)(predicted)
        return replace(pool, units=units, reward=np.concatenate([pool.reward, reward])[-most:]), state.training

    def report(self, state: P) -> None:
        """Diagnostics and findings of the simulations.

        Raises:
            BudgetTooSmall: without any.
            ValueError: where none was valid.
        """
        if not state.simulated:
            raise BudgetTooSmall(f"budget: {self.budget} rollouts were not enough for one simulation; raise it")
        if state.diverged == state.simulated:
            raise ValueError(
                f"budget: {state.simulated} simulations of {self.budget} rollouts, none of them valid; raise the "
                "budget, or narrow the bounds"
            )
        self.diagnostics.update(simulated=state.simulated, diverged=state.diverged)
        if state.diverged:
            count, total, failure = state.diverged, state.simulated, self.simulator.failure
            self.find(Code.DIVERGED_COUNT_AS_WORST, count=count, total=total, failure=failure)

    def check_width(self, sd: float) -> None:
        """A finding where the search distribution's largest sd says that the search was cut short."""
        if sd > THRESHOLDS.search_wide:
            self.find(Code.SEARCH_STILL_WIDE, sd=sd)


class RewardSearch(Search[P]):
    """Base of the searches that can learn their reward; see ``RewardOptions`` and ``learned_reward``."""

    options_type = RewardOptions
    options: RewardOptions
    _learned: tuple[Trajectories, LearnedReward] | None = None

    def empty_pool(self, trajectories: Trajectories) -> Pool:
        """The pool before the first simulation."""
        pool = super().empty_pool(trajectories)
        if self.options.reward != "learned":
            return pool
        return replace(pool, features=self.learned(trajectories).features(None))

    def untrained(self, trajectories: Trajectories) -> TrainingState | None:
        """The discriminator before the first simulation, where rewards are learned."""
        return self.learned(trajectories).start() if self.options.reward == "learned" else None

    def learned(self, trajectories: Trajectories) -> LearnedReward:
        """The discriminator's reward on the trajectories."""
        if self._learned is None or self._learned[0] is not trajectories:
            self._learned = (trajectories, LearnedReward(self.windows(trajectories), self.options, self.seed))
        return self._learned[1]

    def rewarded(
        self, state: P, predicted: FloatArray, trajectories: Trajectories, most: int
    ) -> tuple[Pool, TrainingState | None]:
        """As ``Search.rewarded``; a learned reward is another one for the whole pool."""
        if state.training is None or state.pool.features is None:
            return super().rewarded(state, predicted, trajectories, most)
        learned = self.learned(trajectories)
        features = np.concatenate([state.pool.features, learned.features(predicted)])[-most:]
        training = learned.train(state.training, features)
        return replace(state.pool, features=features, reward=learned(training, features)), training
