"""SimOpt: a Gaussian over theta that episodic relative entropy policy search (REPS) moves towards good simulations.

Y. Chebotar et al. 2019, "Closing the Sim-to-Real Loop: Adapting Simulation Randomization with Real World Experience",
https://arxiv.org/abs/1810.05687; J. Peters, K. Mülling, Y. Altün 2010, "Relative Entropy Policy Search", AAAI.
Hyper-parameters in bold in B. Mehta et al. 2020, "A User's Guide to Calibrating Robotics Simulators",
https://arxiv.org/abs/2011.08985, are the defaults.

With rewards R_i of draws theta_i ~ q, the distribution p of the best expected reward within KL(p || q) <= epsilon is
p_i proportional to q_i exp(R_i / eta), where the temperature eta minimises the convex dual

    g(eta) = eta epsilon + eta log sum_i q_i exp(R_i / eta),    dg/d eta = epsilon - KL(p || q),

found as the root of its slope. A Gaussian is fitted to the weighted draws and goes on as the next q.

An iteration is 12 updates of 6 particles: 72 rollouts for each recorded trajectory. Iterations go on until the budget
is spent, or until the Gaussian is narrower than 1e-4 in every parameter.

Deviations:

- Draws of the last iteration's updates (72) take part in each update, q_i being the present Gaussian against the
  mixture of those that they came from: six draws alone say little in more than two dimensions.
- The new Gaussian takes what the weights p change in the mean and covariance of the draws against the weights q,
  instead of their plain moments under p: those also hold the noise of q's own weights and what the cube cuts off, and
  collapse far from the optimum.
- The covariance is damped: with n_eff effective draws its change counts by n_eff / (n_eff + damping (N + 1)),
  ``damping`` = 1 being the weight of as many draws as a Gaussian's scatter takes. No variance shrinks by more than
  ``least_factor``, a quarter, in an update or below 1e-10 at all (neither paper gives a rule or a number).
- The mean stays in the cube, to which draws are restricted.
- The step is cut back until the Gaussians' own KL is within epsilon.
- The earlier Gaussians' densities are those before the cube cuts them: their masses within it, which differ, are
  taken as equal.
- Diverged simulations have weight zero.
- "Covariance initialisation 0.2" is read as a variance, and epsilon is chosen here.
- Policy training is not part of it: other trajectories may be given at each step.

The result is a search distribution that narrows as long as it is fed: it finds, and does not say how sure one may be.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import brentq
from scipy.special import logsumexp

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.options import option
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.inference.search.base import PoolState, RewardSearch
from sipe_bayes.inference.search.gaussians import LEAST_VARIANCE, draw_in_cube, gaussian_kl, log_normal
from sipe_bayes.inference.search.learned_reward import RewardOptions
from sipe_bayes.posterior import GaussianMixture, Particles


@dataclass(frozen=True)
class SimOptOptions(RewardOptions):
    """How REPS moves the Gaussian, and what it is rewarded for."""

    updates: int = option(12, "REPS updates in an iteration", least=1)
    particles: int = option(6, "simulated in each update", least=2)
    initial_mean: float = option(0.5, "the first mean is drawn uniformly from [0, this]^N", "theta", above=0, most=1)
    initial_variance: float = option(0.2, "of the first Gaussian", "theta squared", above=0)
    epsilon: float = option(0.5, "bound on the KL of an update", "nats", above=0)
    damping: float = option(1.0, "of the covariance: the more, the slower it follows few draws", least=0)
    least_factor: float = option(
        0.25, "an update narrows a variance by this at most, or widens it by its inverse", above=0, below=1
    )
    converged_sd: float = option(1e-4, "sd of every parameter where the search ends", "theta", above=0)


@dataclass(frozen=True, kw_only=True)
class SimOptState(PoolState):
    """The pool and the Gaussians of all updates.

    Args:
        means: (U + 1, N), the first and one after each of U updates.
        covariances: (U + 1, N, N).
    """

    means: FloatArray
    covariances: FloatArray

    @property
    def updates(self) -> int:
        """Updates so far, U."""
        return len(self.means) - 1

    @property
    def variances(self) -> FloatArray:
        """Of the present Gaussian, (N,)."""
        return np.diag(self.covariances[-1])


class SimOpt(RewardSearch[SimOptState]):
    """Relative entropy policy search. Its last draws, weighted, as Particles; `proposal` is their Gaussian."""

    name: ClassVar[str] = "simopt"
    begins_with_prior: ClassVar[bool] = False
    options_type = SimOptOptions
    state_type = SimOptState
    options: SimOptOptions

    def start(self, trajectories: Trajectories) -> SimOptState:
        """The first Gaussian."""
        n = len(self.space)
        return SimOptState(
            pool=self.empty_pool(trajectories),
            training=self.untrained(trajectories),
            draws=1,
            means=self.random(0).uniform(0.0, self.options.initial_mean, n)[None],
            covariances=(self.options.initial_variance * np.eye(n))[None],
        )

    def describe(self, state: SimOptState) -> str:
        """For the progress bar."""
        return f"simopt: update {state.updates}"

    def step(self, state: SimOptState, trajectories: Trajectories) -> SimOptState:
        """An iteration: ``updates`` REPS updates, as far as the budget goes."""
        self.check_budget(state, trajectories)
        state = self.renewed(state, trajectories)
        for _ in range(self.options.updates):
            count = self.affordable(self.options.particles, trajectories)
            if not count or (state.variances < self.options.converged_sd**2).all():
                return replace(state, done=True)
            state = self._update(state, trajectories, count)
        return replace(state, done=not self.affordable(1, trajectories))

    def _update(self, state: SimOptState, trajectories: Trajectories, count: int) -> SimOptState:
        """The state after ``count`` simulations and a new Gaussian."""
        mean, covariance, options = state.means[-1], state.covariances[-1], self.options
        theta = draw_in_cube(mean, covariance, count, self.random(state.draws))
        state = self.evaluated(state, theta, trajectories, options.updates * options.particles)
        if state.pool.valid.sum() > 1:
            log_base = _log_base(state)
            temperature = reps_temperature(state.pool.reward, log_base, options.epsilon)
            weights = reps_weights(state.pool.reward, log_base, temperature)
            base = np.where(state.pool.valid, np.exp(log_base), 0.0)
            mean, covariance = updated_gaussian(
                state.pool.theta, weights, base / base.sum(), mean, covariance, self.options
            )
        return replace(
            state,
            means=np.concatenate([state.means, mean[None]]),
            covariances=np.concatenate([state.covariances, covariance[None]]),
        )

    def posterior(self, state: SimOptState, trajectories: Trajectories) -> Particles:
        """The pool, weighted as the next update would."""
        self.report(state)
        mean, pool = state.means[-1], state.pool
        self.proposal = GaussianMixture([0.0], mean[None], state.covariances[-1][None], self.space)
        if not pool.valid.any():
            return Particles(np.clip(mean, 0, 1)[None], self.space)
        log_base = _log_base(state)
        weights = reps_weights(pool.reward, log_base, reps_temperature(pool.reward, log_base, self.options.epsilon))
        posterior = Particles(pool.theta, self.space, weights, best=pool.best)
        largest_sd = float(np.sqrt(state.variances.max()))
        self.diagnostics["search"] = {
            "updates": state.updates,
            "largest_sd": largest_sd,
            "effective_particles": posterior.effective_size,
            "best_reward": float(pool.reward.max()),
        }
        self.check_width(largest_sd)
        return posterior


def reps_weights(reward: FloatArray, log_base: FloatArray, temperature: float) -> FloatArray:
    """Weights (n,) proportional to the base's times exp(reward / temperature), summing to one."""
    score = log_base + (reward - reward.max()) / temperature
    weights: FloatArray = np.exp(score - logsumexp(score))
    return weights / weights.sum()


def reps_temperature(reward: FloatArray, log_base: FloatArray, epsilon: float) -> float:
    """The eta that minimises the dual.

    Args:
        reward: (n,); draws of -inf are left out of the base, since they can have no weight at any temperature.
        log_base: log weights (n,) of the draws under the last Gaussian, normalised.
        epsilon: bound on the KL, in nats.

    Returns:
        eta > 0; where none reaches a KL of epsilon, as small a one as tells the draws apart.
    """
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


def updated_gaussian(
    theta: FloatArray,
    weights: FloatArray,
    base: FloatArray,
    mean: FloatArray,
    covariance: FloatArray,
    options: SimOptOptions,
) -> tuple[FloatArray, FloatArray]:
    """The Gaussian moved by what the weights change against the base.

    Args:
        theta: draws (n, N).
        weights: (n,), wanted, summing to one.
        base: weights (n,) that make the draws those of the last Gaussian.
        mean: of the last Gaussian (N,).
        covariance: of the last Gaussian (N, N).
        options: ``epsilon``, ``damping`` and ``least_factor`` of them.

    Returns:
        Mean (N,), in the cube, and covariance (N, N), within a KL of epsilon from the last ones.
    """
    n = len(mean)
    factor = np.linalg.cholesky(covariance)
    white = solve_triangular(factor, (theta - mean).T, lower=True).T
    shift = (weights - base) @ white
    change = white.T @ ((weights - base)[:, None] * white)
    effective = 1 / (weights**2).sum()
    values, vectors = np.linalg.eigh(effective / (options.damping * (n + 1) + effective) * change)
    scaled = (vectors * np.clip(1 + values, options.least_factor, 1 / options.least_factor)) @ vectors.T
    new_mean = np.clip(mean + factor @ shift, 0.0, 1.0)
    new = factor @ scaled @ factor.T
    new = (new + new.T) / 2 + LEAST_VARIANCE * np.eye(n)

    def between(t: float) -> tuple[FloatArray, FloatArray]:
        return mean + t * (new_mean - mean), covariance + t * (new - covariance)

    def excess(t: float) -> float:
        return gaussian_kl(*between(t), mean, covariance) - options.epsilon

    if excess(1.0) <= 0:
        return between(1.0)
    return between(0.999 * brentq(excess, 0.0, 1.0, xtol=1e-6))


def _log_base(state: SimOptState) -> FloatArray:
    """Normalised log weights (n,) of the pool under the present Gaussian against the mixture that it was drawn from."""
    theta, draw = state.pool.theta, state.pool.draw
    # draw number d came from the Gaussian after d - 1 updates
    each = [
        log_normal(theta, state.means[d - 1], state.covariances[d - 1]) + np.log((draw == d).sum())
        for d in np.unique(draw)
    ]
    score = log_normal(theta, state.means[-1], state.covariances[-1]) - logsumexp(each, axis=0)
    log_base: FloatArray = score - logsumexp(score)
    return log_base


def _relative_entropy(weights: FloatArray, log_base: FloatArray) -> float:
    used = weights > 0
    return float((weights[used] * (np.log(weights[used]) - log_base[used])).sum())
