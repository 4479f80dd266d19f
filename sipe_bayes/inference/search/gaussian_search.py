"""What the search methods (simopt, adr, cem) share: a pool of simulated thetas with rewards, and Gaussians on the cube.

Draws come from generators made of (seed, number of the draw), so that a state needs none and a run that resumes goes on
as if it had not stopped. A pool belongs to one set of trajectories: given others, a method keeps its Gaussian or
particles and starts a new pool.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from sipe_bayes.core.checkpoint import State
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.core.validation import one_of, positive, whole
from sipe_bayes.inference.base import Estimator, Recorded, digest
from sipe_bayes.inference.search.learned_reward import LearnedReward
from sipe_bayes.likelihood.discrepancy import StateDifference, channel_scale, simulate
from sipe_bayes.likelihood.settings import BudgetExhausted, BudgetTooSmall
from sipe_bayes.models.discriminator import HIDDEN
from sipe_bayes.posterior import Posterior
from sipe_bayes.posterior.truncated_normal import interval_quantile

FloatArray = NDArray[np.float64]

_WIDE_SD = 0.15
_SWEEPS = 10  # of Gibbs sampling for draws that fell outside the cube
REWARDS = ("state_difference", "learned")


class Search(Estimator):
    """Base of the methods that simulate where they expect good rewards: minus the cost of ``discrepancy.StateDifference``.

    The State holds pool_theta (P, N), pool_reward (P,), -inf where the simulation diverged, pool_draw (P,), the number of the draw
    that each came from, and units (C,), NaN before the first valid simulation: what the pool's differences are divided by.
    """

    uses_prior: ClassVar[bool] = False
    uncertain: ClassVar[bool] = False
    begins_with_prior: ClassVar[bool] = True

    def fit(self, trajectories: Recorded) -> Posterior:
        """As ``Estimator.fit``; a warning if a prior was given, of which a search makes little use."""
        found = super().fit(trajectories)
        if (self.prior.gaussian_moments()[1].diagonal() < 1).any():  # a uniform prior counts as enormously wide
            use = "uses the prior only to begin" if self.begins_with_prior else "does not use the prior"
            self.warn(f"{self.name} searches within the bounds and {use}; bayesopt and npe count it")
        return found

    def empty_pool(self, trajectories: Trajectories) -> State:
        """The pool's entries before the first simulation."""
        return {
            "pool_theta": np.empty((0, len(self.space))),
            "pool_reward": np.empty(0),
            "pool_draw": np.empty(0, np.int64),
            "pool_of": digest(trajectories),
            "units": np.full(len(self.windows(trajectories).channels), np.nan),
            "draws": 0,
            "simulated": 0,
            "diverged": 0,
        }

    def renewed(self, state: State, trajectories: Trajectories) -> State:
        """The state, without its pool where that belongs to other trajectories."""
        if state["pool_of"] == digest(trajectories):
            return state
        keep = {k: state[k] for k in state if k in ("draws", "simulated", "diverged") or k.startswith("reward_")}
        return {**state, **self.empty_pool(trajectories), **keep}

    def affordable(self, wanted: int, trajectories: Trajectories) -> int:
        """How many of ``wanted`` simulations fit into what is left of the budget."""
        return max(0, min(wanted, (self.budget - self.windows(trajectories).rollouts) // len(trajectories)))

    def check_budget(self, state: State, trajectories: Trajectories) -> None:
        """Raise BudgetExhausted where not one simulation was or can be made."""
        if not state["simulated"] and not self.affordable(1, trajectories):
            raise BudgetExhausted(f"one simulation takes {len(trajectories)} rollouts, the budget is {self.budget}")

    def random(self, state: State) -> np.random.Generator:
        """The generator of the state's next draw."""
        return np.random.default_rng([self.seed, state["draws"]])

    def evaluated(self, state: State, theta: FloatArray, trajectories: Trajectories, most: int) -> State:
        """The state with theta (B, N) simulated and added to the pool of at most the ``most`` latest, rewards up to date."""
        predicted = simulate(self.windows(trajectories), theta)
        pool = {
            "pool_theta": np.concatenate([state["pool_theta"], theta])[-most:],
            "pool_draw": np.concatenate([state["pool_draw"], np.full(len(theta), state["draws"])])[-most:],
            **self.rewarded(state, predicted, trajectories, most),
        }
        lost = int((~np.isfinite(pool["pool_reward"][-len(theta) :])).sum())
        counts = {"simulated": state["simulated"] + len(theta), "diverged": state["diverged"] + lost}
        return {**state, **pool, **counts, "draws": state["draws"] + 1}

    def rewarded(self, state: State, predicted: FloatArray, trajectories: Trajectories, most: int) -> State:
        """pool_reward of the ``most`` latest, predictions (B, W, L, C) the newest of them, and what else rewards change."""
        windows, units = self.windows(trajectories), state["units"]
        if not np.isfinite(units).all():
            units = channel_scale(windows, predicted)
        reward = -StateDifference(windows, units)(predicted)
        return {"units": units, "pool_reward": np.concatenate([state["pool_reward"], reward])[-most:]}

    def report(self, state: State) -> None:
        """Diagnostics and warnings of the simulations; raises BudgetTooSmall without any, and ValueError where none was valid."""
        if not state["simulated"]:
            raise BudgetTooSmall(f"budget: {self.budget} rollouts were not enough for one simulation; raise it")
        if state["diverged"] == state["simulated"]:
            raise ValueError(
                f"budget: {state['simulated']} simulations of {self.budget} rollouts, none of them valid; raise the budget, "
                "or narrow the bounds"
            )
        self.diagnostics["simulated"] = state["simulated"]
        self.diagnostics["diverged"] = state["diverged"]
        if state["diverged"]:
            self.warn(
                f"{state['diverged']} of {state['simulated']} simulations {self.simulator.failure} and counted as worst; "
                "narrow the bounds if they are many"
            )

    def warn_if_wide(self, sd: float) -> None:
        """A warning where the search distribution's largest sd says that the search was cut short."""
        if sd > _WIDE_SD:
            self.warn(
                f"the search is still wide (sd {sd:.2f} of the bounds' range): raise the budget, or expect nothing of it"
            )


class RewardSearch(Search):
    """Base of the searches that can learn their reward.

    reward: "state_difference", as ``Search``, or "learned", a discriminator's (see ``learned_reward``), with two layers of
    ``discriminator_hidden`` units, which takes ``discriminator_updates`` steps of Adam, of ``learning_rate`` and on batches of
    ``discriminator_batch``, after each draw. With learned rewards the State also holds pool_features (P, M, F) and the discriminator.
    """

    def __init__(
        self,
        simulator: Any,
        *,
        reward: str = "state_difference",
        learning_rate: float = 0.001,
        discriminator_batch: int = 320,
        discriminator_updates: int = 30,
        discriminator_hidden: int = HIDDEN,
        **settings: Any,
    ) -> None:
        super().__init__(simulator, **settings)
        self.reward, self.learning_rate = one_of("reward", reward, REWARDS), positive("learning_rate", learning_rate)
        self.discriminator_batch = whole("discriminator_batch", discriminator_batch, 2)
        self.discriminator_updates = whole("discriminator_updates", discriminator_updates)
        self.discriminator_hidden = whole("discriminator_hidden", discriminator_hidden)
        self._learned: tuple[Trajectories, LearnedReward] | None = None

    def settings(self) -> dict[str, Any]:
        own = ("reward", "learning_rate", "discriminator_batch", "discriminator_updates", "discriminator_hidden")
        return {**super().settings(), **{name: getattr(self, name) for name in own}}

    def empty_pool(self, trajectories: Trajectories) -> State:
        state = super().empty_pool(trajectories)
        if self.reward == "learned":
            learned = self.learned(trajectories)
            state.update(learned.start(), pool_features=learned.features(None))
        return state

    def learned(self, trajectories: Trajectories) -> LearnedReward:
        """The discriminator's reward on the trajectories."""
        if self._learned is None or self._learned[0] is not trajectories:
            made = LearnedReward(
                self.windows(trajectories),
                seed=self.seed,
                learning_rate=self.learning_rate,
                batch=self.discriminator_batch,
                updates=self.discriminator_updates,
                hidden=self.discriminator_hidden,
            )
            self._learned = (trajectories, made)
        return self._learned[1]

    def rewarded(self, state: State, predicted: FloatArray, trajectories: Trajectories, most: int) -> State:
        if self.reward != "learned":
            return super().rewarded(state, predicted, trajectories, most)
        learned = self.learned(trajectories)
        features = np.concatenate([state["pool_features"], learned.features(predicted)])[-most:]
        trained = learned.train(state, features)
        return {**trained, "pool_features": features, "pool_reward": learned(trained, features)}


def draw_in_cube(mean: FloatArray, covariance: FloatArray, count: int, random: np.random.Generator) -> FloatArray:
    """Draws (count, N) of the Gaussian restricted to the unit cube.

    Draws inside stay; the others walk into it by Gibbs sweeps, one coordinate after another from its truncated conditional.
    """
    factor = np.linalg.cholesky(covariance)
    theta = mean + random.standard_normal((count, len(mean))) @ factor.T
    out = ((theta < 0) | (theta > 1)).any(1)
    inside = np.clip(theta[out], 0.0, 1.0)
    precision = np.linalg.inv(covariance)
    sd = np.diag(precision) ** -0.5
    for u in random.uniform(size=(_SWEEPS, len(mean), len(inside))) if len(inside) else ():
        for j in range(len(mean)):
            centre = inside[:, j] - (inside - mean) @ precision[j] * sd[j] ** 2
            inside[:, j] = np.clip(
                centre + sd[j] * interval_quantile(-centre / sd[j], (1 - centre) / sd[j], u[j]), 0.0, 1.0
            )
    theta[out] = inside
    return theta


def log_normal(theta: FloatArray, mean: FloatArray, covariance: FloatArray) -> FloatArray:
    """Log density (n,) of the untruncated Gaussian at theta (n, N)."""
    factor = np.linalg.cholesky(covariance)
    white = solve_triangular(factor, (theta - mean).T, lower=True)
    return -0.5 * (white**2).sum(0) - np.log(np.diag(factor)).sum() - 0.5 * len(mean) * np.log(2 * np.pi)


def gaussian_kl(mean: FloatArray, covariance: FloatArray, old_mean: FloatArray, old_covariance: FloatArray) -> float:
    """KL(new || old) of two untruncated Gaussians, in nats."""
    factor = np.linalg.cholesky(old_covariance)
    white = solve_triangular(factor, np.linalg.cholesky(covariance), lower=True)
    shift = solve_triangular(factor, mean - old_mean, lower=True)
    log_ratio = np.log(np.abs(np.diag(white))).sum()
    return float(0.5 * ((white**2).sum() + shift @ shift - len(mean)) - log_ratio)
