"""Active domain randomisation turned to calibration: particles that seek simulations like the recording, and keep apart.

B. Mehta, M. Diaz, F. Golemo, C. Pal, L. Paull 2019, "Active Domain Randomization", https://arxiv.org/abs/1904.04762; with the
sign of the reward turned as in B. Mehta et al. 2020, "A User's Guide to Calibrating Robotics Simulators",
https://arxiv.org/abs/2011.08985, whose 10 particles are the default. The particles move by Y. Liu, P. Ramachandran, Q. Liu,
J. Peng 2017, "Stein Variational Policy Gradient", https://arxiv.org/abs/1704.02399: policies phi_1..M with expected rewards J
approach q(phi) proportional to exp(J(phi) / alpha), by

    phi_i += step / M sum_j [ k(phi_j, phi_i) grad J(phi_j) / alpha + grad_phi_j k(phi_j, phi_i) ],

the first part towards reward, the second away from each other; k(a, b) = exp(-|a - b|^2 / h), h = median^2 / log(M + 1).

Deviations. A policy is a Gaussian over theta, its mean phi the particle: an episode of one step, where ADR trains a recurrent
actor-critic that walks through theta; a few hundred rollouts train no such networks. grad J is the score-function
gradient with all recent draws of all particles taking part: draws weighted by a Gaussian around phi, wide enough for 2 (N + 1)
effective ones, and the best baseline and scale found by (ridge) regression, as in compatible function approximation
(J. Peters, S. Schaal 2008, "Natural Actor-Critic"). Rewards enter as centred ranks, as in evolution strategies
(D. Wierstra et al. 2014, "Natural Evolution Strategies"), so that alpha means the same whatever the reward's unit;
diverged simulations rank last. All is done in units of the particles' spread in each parameter, which shrinks as ranks among
ever better draws keep pulling: alpha sets how fast, and a floor where that ends. ADR's temperature, 10 for summed
log-probabilities, does not carry over.

Equal particles that are still spread tell where the reward is flat; their spread is the repulsion's as much as the log's and is
no posterior's.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.stats import rankdata

from sipe_bayes.core.checkpoint import State
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.core.validation import positive, whole
from sipe_bayes.inference.search.gaussian_search import RewardSearch
from sipe_bayes.posterior import Particles

FloatArray = NDArray[np.float64]


class ADR(RewardSearch):
    """Particles of equal weights where they stand; ``state["paths"]`` (steps + 1, M, N) is where they went.

    particles: how many. temperature: alpha, for rewards as centred ranks. step_size: of the particles. exploration: sd of their
    policies in units of the particles' spread. pool_steps: the latest steps whose draws take part. least_spread: floor of the
    spread, in theta. longest_move: of a particle in a step, in units of the spread. ridge: of the gradients' regression, in
    units of the draws' mean variance. reward: see ``RewardSearch``.
    """

    name: ClassVar[str] = "adr"

    def __init__(
        self,
        simulator: Any,
        *,
        particles: int = 10,
        temperature: float = 0.03,
        step_size: float = 0.5,
        exploration: float = 0.5,
        pool_steps: int = 10,
        least_spread: float = 0.005,
        longest_move: float = 1.0,
        ridge: float = 0.1,
        **settings: Any,
    ) -> None:
        super().__init__(simulator, **settings)
        self.particles, self.temperature = whole("particles", particles, 2), positive("temperature", temperature)
        self.step_size, self.exploration = positive("step_size", step_size), positive("exploration", exploration)
        self.pool_steps, self.least_spread = whole("pool_steps", pool_steps), positive("least_spread", least_spread)
        self.longest_move, self.ridge = positive("longest_move", longest_move), positive("ridge", ridge)

    def settings(self) -> dict[str, Any]:
        own = ("particles", "temperature", "step_size", "exploration")
        limits = ("pool_steps", "least_spread", "longest_move", "ridge")
        return {**super().settings(), **{name: getattr(self, name) for name in own + limits}}

    def start(self, trajectories: Trajectories) -> State:
        state = self.empty_pool(trajectories)
        generator = torch.Generator().manual_seed(int(self.random(state).integers(2**62)))
        first = self.prior.sample((self.particles,), generator=generator).numpy()
        return {**state, "draws": 1, "paths": first[None], "done": False}

    def describe(self, state: State) -> str:
        return f"adr: step {len(state['paths']) - 1}"

    def step(self, state: State, trajectories: Trajectories) -> State:
        """A draw from the policy of each particle, or of as many as the budget wants, and a move of all."""
        self.check_budget(state, trajectories)
        state = self.renewed(state, trajectories)
        if not self.affordable(1, trajectories):
            return {**state, "done": True}
        particles = state["paths"][-1]
        spread = np.maximum(particles.std(0), self.least_spread)
        random = self.random(state)
        noise = self.exploration * spread * random.standard_normal(particles.shape)
        count = self.affordable(self.particles, trajectories)
        chosen = random.permutation(self.particles)[:count]
        theta = _folded(particles + noise)[chosen]
        state = self.evaluated(state, theta, trajectories, self.pool_steps * self.particles)
        moved = particles
        if np.isfinite(state["pool_reward"]).sum() > 1:
            utility = centred_ranks(state["pool_reward"])
            z = particles / spread
            gradients = policy_gradients(z, state["pool_theta"] / spread, utility, self.ridge)
            move = self.step_size * stein_direction(z, gradients / self.temperature)
            length = np.linalg.norm(move, axis=1, keepdims=True)
            move *= np.minimum(1.0, self.longest_move / np.maximum(length, 1e-300))
            moved = np.clip(particles + spread * move, 0.0, 1.0)
        paths = np.concatenate([state["paths"], moved[None]])
        return {**state, "paths": paths, "done": not self.affordable(1, trajectories)}

    def posterior(self, state: State, trajectories: Trajectories) -> Particles:
        self.report(state)
        reward, particles = state["pool_reward"], state["paths"][-1]
        best = state["pool_theta"][reward.argmax()] if np.isfinite(reward).any() else None
        self.diagnostics["search"] = {
            "steps": len(state["paths"]) - 1,
            "largest_sd": float(particles.std(0).max()),
            "best_reward": float(reward.max()) if len(reward) else float("-inf"),
        }
        return Particles(particles, self.space, best=best)


def centred_ranks(reward: FloatArray) -> FloatArray:
    """Ranks of rewards (n,) scaled to [-1/2, 1/2]; equal rewards have equal ones."""
    ranks: FloatArray = rankdata(reward) - 1
    return ranks / max(len(reward) - 1, 1) - 0.5


def policy_gradients(particles: FloatArray, theta: FloatArray, utility: FloatArray, ridge: float = 0.1) -> FloatArray:
    """grad J (M, N) at particles (M, N) from draws theta (n, N) with utility (n,): local weighted ridge regression."""
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

    def lacking(log_width: float) -> float:
        weights = np.exp(-0.5 * square / np.exp(2 * log_width))
        return float(weights.sum() ** 2 / (weights**2).sum() - wanted)

    low, high = np.log(1e-6), np.log(1e6)
    width = np.exp(brentq(lacking, low, high, xtol=1e-4)) if lacking(low) < 0 < lacking(high) else 1.0
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
    """theta reflected at the bounds into the cube."""
    theta = np.abs(theta) % 2.0
    return np.where(theta > 1, 2.0 - theta, theta)
