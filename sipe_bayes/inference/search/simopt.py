"""SimOpt: a Gaussian over theta that episodic relative entropy policy search (REPS) moves towards good simulations.

Y. Chebotar et al. 2019, "Closing the Sim-to-Real Loop: Adapting Simulation Randomization with Real World Experience",
https://arxiv.org/abs/1810.05687; J. Peters, K. Mülling, Y. Altün 2010, "Relative Entropy Policy Search", AAAI.
Hyper-parameters in bold in B. Mehta et al. 2020, "A User's Guide to Calibrating Robotics Simulators",
https://arxiv.org/abs/2011.08985, are the defaults.

With rewards R_i of draws theta_i ~ q, the distribution p of the best expected reward within KL(p || q) <= epsilon is
p_i proportional to q_i exp(R_i / eta), where the temperature eta minimises the convex dual

    g(eta) = eta epsilon + eta log sum_i q_i exp(R_i / eta),    dg/d eta = epsilon - KL(p || q),

found as the root of its slope. A Gaussian is fitted to the weighted draws and goes on as the next q.

An iteration is 12 updates of 6 particles: 72 rollouts for each recorded trajectory. Iterations go on until the budget is spent,
or until the Gaussian is narrower than 1e-4 in every parameter.

Deviations. Draws of the last iteration's updates (72) take part in each update, q_i being the present Gaussian against the
mixture of those that they came from: six draws alone say little in more than two dimensions. The new Gaussian takes what
the weights p change in the mean and covariance of the draws against the weights q, instead of their plain moments under
p: those also hold the noise of q's own weights and what the cube cuts off, and collapse far from the optimum. The covariance
is damped: with n_eff effective draws its change counts by n_eff / (n_eff + damping (N + 1)), ``damping`` = 1 being the weight
of as many draws as a Gaussian's scatter takes, and no variance shrinks by more than ``least_factor``, a quarter, in an update or
below 1e-10 at all (neither paper gives a rule or a number); the mean stays in the cube, to which draws are restricted; and the step is cut back until the
Gaussians' own KL is within epsilon. The earlier Gaussians' densities are those before the cube cuts them: their
masses within it, which differ, are taken as equal. Diverged simulations have weight zero. "Covariance initialisation 0.2" is read as a
variance, and epsilon is chosen here. Policy training is not part of it: other trajectories may be given at each step.

The result is a search distribution that narrows as long as it is fed: it finds, and does not say how sure one may be.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.optimize import brentq
from scipy.special import logsumexp

from sipe_bayes.core.checkpoint import State
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.core.validation import at_least, positive, share, whole
from sipe_bayes.inference.search.gaussian_search import RewardSearch, draw_in_cube, gaussian_kl, log_normal
from sipe_bayes.posterior import GaussianMixture, Particles

FloatArray = NDArray[np.float64]

_LEAST_VARIANCE = 1e-10


class SimOpt(RewardSearch):
    """The last iteration's weighted draws as Particles; ``proposal`` is the Gaussian that they fit.

    updates: REPS updates in an iteration. particles: simulated in each. initial_variance: of the first Gaussian, whose mean
    is drawn uniformly from [0, initial_mean]^N. epsilon: bound on the KL of an update, in nats. damping: of the covariance, 0 or
    more; the more, the slower it follows few draws. least_factor: by which an update narrows, or its inverse widens, a
    variance at most. converged_sd: of every parameter, in theta, where the search ends. reward: see ``RewardSearch``.
    """

    name: ClassVar[str] = "simopt"
    begins_with_prior: ClassVar[bool] = False

    def __init__(
        self,
        simulator: Any,
        *,
        updates: int = 12,
        particles: int = 6,
        initial_mean: float = 0.5,
        initial_variance: float = 0.2,
        epsilon: float = 0.5,
        damping: float = 1.0,
        least_factor: float = 0.25,
        converged_sd: float = 1e-4,
        **settings: Any,
    ) -> None:
        super().__init__(simulator, **settings)
        self.updates, self.particles = whole("updates", updates), whole("particles", particles, 2)
        if positive("initial_mean", initial_mean) > 1:
            raise ValueError(f"initial_mean: expected a number in (0, 1], got {initial_mean}")
        self.initial_mean, self.initial_variance = initial_mean, positive("initial_variance", initial_variance)
        self.epsilon, self.damping = positive("epsilon", epsilon), at_least("damping", damping, 0)
        self.least_factor, self.converged_sd = (
            share("least_factor", least_factor),
            positive("converged_sd", converged_sd),
        )
        self.proposal: GaussianMixture | None = None

    def settings(self) -> dict[str, Any]:
        own = ("updates", "particles", "initial_mean", "initial_variance", "epsilon")
        ends = ("damping", "least_factor", "converged_sd")
        return {**super().settings(), **{name: getattr(self, name) for name in own + ends}}

    def start(self, trajectories: Trajectories) -> State:
        n = len(self.space)
        state = self.empty_pool(trajectories)
        mean = self.random(state).uniform(0.0, self.initial_mean, n)
        return {
            **state,
            "draws": 1,
            "means": mean[None],
            "covariances": (self.initial_variance * np.eye(n))[None],
            "temperature": np.inf,
            "done": False,
        }

    def describe(self, state: State) -> str:
        return f"simopt: update {len(state['means']) - 1}"

    def step(self, state: State, trajectories: Trajectories) -> State:
        """An iteration: ``updates`` REPS updates, as far as the budget goes."""
        self.check_budget(state, trajectories)
        state = self.renewed(state, trajectories)
        for _ in range(self.updates):
            count = self.affordable(self.particles, trajectories)
            converged = bool((np.diag(state["covariances"][-1]) < self.converged_sd**2).all())
            if not count or converged:
                return {**state, "done": True}
            state = self._update(state, trajectories, count)
        return {**state, "done": not self.affordable(1, trajectories)}

    def _update(self, state: State, trajectories: Trajectories, count: int) -> State:
        """The state after ``count`` simulations and a new Gaussian."""
        mean, covariance = state["means"][-1], state["covariances"][-1]
        theta = draw_in_cube(mean, covariance, count, self.random(state))
        state = self.evaluated(state, theta, trajectories, self.updates * self.particles)
        temperature = state["temperature"]
        if np.isfinite(state["pool_reward"]).sum() > 1:
            log_base = _log_base(state)
            temperature = reps_temperature(state["pool_reward"], log_base, self.epsilon)
            weights = reps_weights(state["pool_reward"], log_base, temperature)
            base = np.where(np.isfinite(state["pool_reward"]), np.exp(log_base), 0.0)
            old = (mean, covariance, self.epsilon, self.damping, self.least_factor)
            mean, covariance = fitted(state["pool_theta"], weights, base / base.sum(), *old)
        return {
            **state,
            "means": np.concatenate([state["means"], mean[None]]),
            "covariances": np.concatenate([state["covariances"], covariance[None]]),
            "temperature": float(temperature),
        }

    def posterior(self, state: State, trajectories: Trajectories) -> Particles:
        self.report(state)
        mean, covariance = state["means"][-1], state["covariances"][-1]
        self.proposal = GaussianMixture([0.0], mean[None], covariance[None], self.space)
        reward = state["pool_reward"]
        if not np.isfinite(reward).any():
            return Particles(np.clip(mean, 0, 1)[None], self.space)
        log_base = _log_base(state)
        weights = reps_weights(reward, log_base, reps_temperature(reward, log_base, self.epsilon))
        result = Particles(state["pool_theta"], self.space, weights, best=state["pool_theta"][reward.argmax()])
        self.diagnostics["search"] = {
            "updates": len(state["means"]) - 1,
            "largest_sd": float(np.sqrt(np.diag(covariance).max())),
            "effective_particles": result.effective_size,
            "best_reward": float(reward.max()),
        }
        self.warn_if_wide(self.diagnostics["search"]["largest_sd"])
        return result


def reps_weights(reward: FloatArray, log_base: FloatArray, temperature: float) -> FloatArray:
    """Weights (n,) proportional to the base's times exp(reward / temperature), summing to one."""
    score = log_base + (reward - reward.max()) / temperature
    weights: FloatArray = np.exp(score - logsumexp(score))
    return weights / weights.sum()


def reps_temperature(reward: FloatArray, log_base: FloatArray, epsilon: float) -> float:
    """The eta > 0 that minimises the dual; where no eta reaches a KL of epsilon, as small a one as tells the draws apart.

    Draws of reward -inf are left out of the base: they can have no weight at any temperature."""
    good = np.isfinite(reward)
    reward, log_base = reward[good], log_base[good] - logsumexp(log_base[good])
    spread = reward.max() - reward.min()
    if not spread > 0:
        return 1.0

    def slope(log_eta: float) -> float:
        weights = reps_weights(reward, log_base, spread * np.exp(log_eta))
        return epsilon - _relative_entropy(weights, log_base)

    low, high = np.log(1e-6), np.log(1e6)
    if slope(low) >= 0 or slope(high) <= 0:
        return float(spread * np.exp(low if slope(low) >= 0 else high))
    return float(spread * np.exp(brentq(slope, low, high, xtol=1e-10)))


def fitted(
    theta: FloatArray,
    weights: FloatArray,
    base: FloatArray,
    mean: FloatArray,
    covariance: FloatArray,
    epsilon: float,
    damping: float = 1.0,
    least_factor: float = 0.25,
) -> tuple[FloatArray, FloatArray]:
    """Mean (N,) and covariance (N, N) after what ``weights`` (n,) of theta (n, N) change against the ``base`` weights (n,),
    which are the last Gaussian's; within a KL of epsilon from it."""
    n = len(mean)
    factor = np.linalg.cholesky(covariance)
    white = solve_triangular(factor, (theta - mean).T, lower=True).T
    shift = (weights - base) @ white
    change = white.T @ ((weights - base)[:, None] * white)
    effective = 1 / (weights**2).sum()
    values, vectors = np.linalg.eigh(effective / (damping * (n + 1) + effective) * change)
    scaled = (vectors * np.clip(1 + values, least_factor, 1 / least_factor)) @ vectors.T
    new_mean = np.clip(mean + factor @ shift, 0.0, 1.0)
    new = factor @ scaled @ factor.T
    new = (new + new.T) / 2 + _LEAST_VARIANCE * np.eye(n)

    def between(t: float) -> tuple[FloatArray, FloatArray]:
        return mean + t * (new_mean - mean), covariance + t * (new - covariance)

    def excess(t: float) -> float:
        return gaussian_kl(*between(t), mean, covariance) - epsilon

    if excess(1.0) <= 0:
        return between(1.0)
    return between(0.999 * brentq(excess, 0.0, 1.0, xtol=1e-6))


def _log_base(state: State) -> FloatArray:
    """Normalised log weights (n,) of the pool under the present Gaussian against the mixture that it was drawn from."""
    theta, draw = state["pool_theta"], state["pool_draw"]
    sources = np.unique(draw)
    # draw number d came from the Gaussian after d - 1 updates
    each = [
        log_normal(theta, state["means"][d - 1], state["covariances"][d - 1]) + np.log((draw == d).sum())
        for d in sources
    ]
    last = len(state["means"]) - 1
    score = log_normal(theta, state["means"][last], state["covariances"][last]) - logsumexp(each, axis=0)
    out: FloatArray = score - logsumexp(score)
    return out


def _relative_entropy(weights: FloatArray, log_base: FloatArray) -> float:
    used = weights > 0
    return float((weights[used] * (np.log(weights[used]) - log_base[used])).sum())
