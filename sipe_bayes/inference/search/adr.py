"""Active domain randomisation turned to calibration: particles that seek simulations like the log, and keep apart.

B. Mehta, M. Diaz, F. Golemo, C. Pal, L. Paull 2019, "Active Domain Randomization", https://arxiv.org/abs/1904.04762;
with the sign of the reward turned as in B. Mehta et al. 2020, "A User's Guide to Calibrating Robotics Simulators",
https://arxiv.org/abs/2011.08985, whose 10 particles are the default. The particles move by Y. Liu, P. Ramachandran,
Q. Liu, J. Peng 2017, "Stein Variational Policy Gradient", https://arxiv.org/abs/1704.02399: policies phi_1..M with
expected rewards J approach q(phi) proportional to exp(J(phi) / alpha), by

    phi_i += step / M sum_j [ k(phi_j, phi_i) grad J(phi_j) / alpha + grad_phi_j k(phi_j, phi_i) ],

the first part towards reward, the second away from each other, with k(a, b) = exp(-|a - b|^2 / h) and
h = median^2 / log(M + 1).

Deviations:

- A policy is a Gaussian over theta, its mean phi the particle: an episode of one step, where ADR trains a recurrent
  actor-critic that walks through theta; a few hundred rollouts train no such networks.
- grad J is the score-function gradient with all recent draws of all particles taking part: draws weighted by a Gaussian
  around phi, wide enough for 2 (N + 1) effective ones, and the best baseline and scale found by (ridge) regression, as
  in compatible function approximation (J. Peters, S. Schaal 2008, "Natural Actor-Critic").
- Rewards enter as centred ranks, as in evolution strategies (D. Wierstra et al. 2014, "Natural Evolution Strategies"),
  so that alpha means the same whatever the reward's unit; diverged simulations rank last.
- All is done in units of the particles' spread in each parameter, which shrinks as ranks among ever better draws keep
  pulling: alpha sets how fast, and a floor where that ends. ADR's temperature, 10 for summed log-probabilities, does
  not carry over.

Equal particles that are still spread tell where the reward is flat; their spread is the repulsion's as much as the
log's and is no posterior's.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from scipy.optimize import brentq
from scipy.stats import rankdata

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.options import option
from sipe_bayes.core.seeding import torch_generator_from
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.inference.search.base import PoolState, RewardSearch
from sipe_bayes.inference.search.learned_reward import RewardOptions
from sipe_bayes.posterior import Particles


@dataclass(frozen=True)
class ADROptions(RewardOptions):
    """How the particles move, and what they are rewarded for."""

    particles: int = option(10, "how many", least=2)
    temperature: float = option(0.03, "alpha, for rewards as centred ranks", above=0)
    step_size: float = option(0.5, "of the particles", above=0)
    exploration: float = option(0.5, "sd of the policies", "particles' spread", above=0)
    pool_steps: int = option(10, "the latest steps whose draws take part", least=1)
    least_spread: float = option(0.005, "floor of the particles' spread", "theta", above=0)
    longest_move: float = option(1.0, "of a particle in a step", "particles' spread", above=0)
    ridge: float = option(0.1, "of the gradients' regression", "draws' mean variance", above=0)


@dataclass(frozen=True, kw_only=True)
class ADRState(PoolState):
    """The pool and the particles' paths.

    Args:
        paths: (steps + 1, M, N), where the particles went.
    """

    paths: FloatArray

    @property
    def steps(self) -> int:
        """Steps so far."""
        return len(self.paths) - 1


class ADR(RewardSearch[ADRState]):
    """Stein variational policy gradient of a few particles. Particles of equal weight; `state.paths`: their way."""

    name: ClassVar[str] = "adr"
    options_type = ADROptions
    state_type = ADRState
    options: ADROptions

    def start(self, trajectories: Trajectories) -> ADRState:
        """Particles drawn from the prior."""
        pool, training = self.empty_pool(trajectories), self.untrained(trajectories)
        first = self.prior.sample((self.options.particles,), torch_generator_from(self.random(0))).numpy()
        return ADRState(pool=pool, training=training, draws=1, paths=first[None])

    def describe(self, state: ADRState) -> str:
        """For the progress bar."""
        return f"adr: step {state.steps}"

    def step(self, state: ADRState, trajectories: Trajectories) -> ADRState:
        """A draw from the policy of each particle, or of as many as the budget wants, and a move of all."""
        self.check_budget(state, trajectories)
        state, options = self.renewed(state, trajectories), self.options
        count = self.affordable(options.particles, trajectories)
        if not count:
            return replace(state, done=True)
        # draw and simulate
        particles = state.paths[-1]
        spread = np.maximum(particles.std(0), options.least_spread)
        random = self.random(state.draws)
        noise = options.exploration * spread * random.standard_normal(particles.shape)
        chosen = random.permutation(options.particles)[:count]
        theta = _folded(particles + noise)[chosen]
        state = self.evaluated(state, theta, trajectories, options.pool_steps * options.particles)
        # move
        moved = particles
        if state.pool.valid.sum() > 1:
            z = particles / spread
            gradients = policy_gradients(z, state.pool.theta / spread, centred_ranks(state.pool.reward), options.ridge)
            move = options.step_size * stein_direction(z, gradients / options.temperature)
            length = np.linalg.norm(move, axis=1, keepdims=True)
            move *= np.minimum(1.0, options.longest_move / np.maximum(length, 1e-300))
            moved = np.clip(particles + spread * move, 0.0, 1.0)
        paths = np.concatenate([state.paths, moved[None]])
        return replace(state, paths=paths, done=not self.affordable(1, trajectories))

    def posterior(self, state: ADRState, trajectories: Trajectories) -> Particles:
        """The particles, with the best simulation of the pool as mode."""
        self.report(state)
        pool, particles = state.pool, state.paths[-1]
        self.diagnostics["search"] = {
            "steps": state.steps,
            "largest_sd": float(particles.std(0).max()),
            "best_reward": float(pool.reward.max()) if len(pool.reward) else float("-inf"),
        }
        return Particles(particles, self.space, best=pool.best if pool.valid.any() else None)


def centred_ranks(reward: FloatArray) -> FloatArray:
    """Ranks of rewards (n,) scaled to [-1/2, 1/2]; equal rewards have equal ones."""
    ranks: FloatArray = rankdata(reward) - 1
    return ranks / max(len(reward) - 1, 1) - 0.5


def policy_gradients(particles: FloatArray, theta: FloatArray, utility: FloatArray, ridge: float) -> FloatArray:
    """Gradients of the expected reward, by local weighted ridge regression.

    Args:
        particles: (M, N).
        theta: draws (n, N), in the same units.
        utility: of the draws (n,).
        ridge: in units of the draws' mean variance.

    Returns:
        grad J (M, N) at the particles.
    """
    wanted = min(2.0 * (theta.shape[1] + 1), 0.9 * len(theta))
    return np.stack([_slope(theta - particle, utility, wanted, ridge) for particle in particles])


def stein_direction(particles: FloatArray, scores: FloatArray) -> FloatArray:
    """Stein variational direction (M, N) of particles (M, N) whose target has these scores (M, N)."""
    difference = particles[:, None] - particles  # (j, i, N)
    square = (difference**2).sum(-1)
    count = len(particles)
    apart = square[np.triu_indices(count, 1)]
    h = max(float(np.median(apart)), 1e-12) / np.log(count + 1)
    kernel = np.exp(-square / h)
    repulsion = -2 / h * (kernel[..., None] * difference).sum(0)
    out: FloatArray = (kernel.T @ scores + repulsion) / count
    return out


def _slope(offset: FloatArray, utility: FloatArray, wanted: float, ridge: float) -> FloatArray:
    """Slope (N,) of utility (n,) at offset (n, N) zero, from ``wanted`` effective draws around it."""
    square = (offset**2).sum(1)
    square = square - square.min()

    def excess(log_width: float) -> float:
        weights = np.exp(-0.5 * square / np.exp(2 * log_width))
        return float(weights.sum() ** 2 / (weights**2).sum() - wanted)

    low, high = np.log(1e-6), np.log(1e6)
    width = np.exp(brentq(excess, low, high, xtol=1e-4)) if excess(low) < 0 < excess(high) else 1.0
    weights = np.exp(-0.5 * square / width**2)
    weights /= weights.sum()
    centre = weights @ offset
    centred = offset - centre
    moment = centred.T @ (weights[:, None] * centred)
    ridge *= max(float(np.trace(moment)) / len(centre), 1e-12)
    slope: FloatArray = np.linalg.solve(
        moment + ridge * np.eye(len(centre)), centred.T @ (weights * (utility - weights @ utility))
    )
    return slope


def _folded(theta: FloatArray) -> FloatArray:
    """Theta reflected at the bounds into the cube."""
    theta = np.abs(theta) % 2.0
    return np.where(theta > 1, 2.0 - theta, theta)
