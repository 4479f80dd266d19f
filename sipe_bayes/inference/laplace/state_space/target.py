"""log p(theta | y) with all states of a ``StateSpace`` marginalised: one simulation of the logs a value, or two.

The states follow theta as the smoother found, x(theta) = x_hat - slope (theta - theta_hat), and are simulated there;
what remains of the likelihood is quadratic in them with the Jacobians of the ``laplace`` optimum, so its
block-tridiagonal matrix is factorised once. Exact where measurement and transition are linear in the states. The noise
is that of the optimum.

Far off, or beyond an edge where theta stops to matter, no states lie along that slope. Where the step that remains
promises more than at the optimum, the states are also simulated where they are there, and the value is theirs unless
following promises less by ten nats.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.inference.laplace.state_space.state import ChainOptimum
from sipe_bayes.inference.laplace.target import FOLLOWED, FORETOLD, Target
from sipe_bayes.likelihood.state_space.chain import Chain
from sipe_bayes.likelihood.state_space.differences import compare, linearise_by
from sipe_bayes.likelihood.state_space.linearisation import ChainLinearisation, eliminate_states, log_likelihood, pull
from sipe_bayes.posterior import Posterior

_STEPS = 2  # of the states, before a fresh linearisation is compared: Gauss-Newton's second is below rounding


@dataclass(frozen=True)
class ChainFit:
    """An optimum and the linearisation there: what ``ChainTarget`` is made of."""

    optimum: ChainOptimum
    linearisation: ChainLinearisation

    @classmethod
    def at(cls, chain: Chain, optimum: ChainOptimum) -> ChainFit:
        """Linearise at an optimum, by differences as long as the fit took them.

        Raises:
            ValueError: where the simulation diverges there.
        """
        linear = linearise_by(chain, optimum.theta, optimum.states, optimum.theta_step, optimum.state_step)
        if linear is None:
            raise ValueError("mcmc: the simulation diverges at the laplace fit; narrow the bounds")
        return cls(optimum, linear)


class ChainTarget(Target):
    """Of a chain of states.

    Args:
        prior: on theta.
        chain: the logs.
        fit: the optimum.
    """

    def __init__(self, prior: Posterior, chain: Chain, fit: ChainFit) -> None:
        self.prior, self.chain, self.optimum, self.fit = prior, chain, fit.optimum, fit.linearisation
        self.noise = fit.optimum.noise
        self.solved = eliminate_states(self.fit, self.noise)

    def states(self, theta: FloatArray) -> FloatArray:
        """States (B, K, S) that follow theta (B, N)."""
        away = np.einsum("kdn,bn->bkd", self.optimum.slope, theta - self.optimum.theta)
        return self.chain.moved(self.optimum.states, -away)

    def log_likelihood(self, theta: FloatArray) -> FloatArray:
        """See ``Target``; by comparisons that share the optimum's Jacobians."""
        out, promised = self._compared(theta, self.states(theta))
        far = np.flatnonzero(promised > self.promised + FORETOLD)
        if len(far):
            held, left = self._compared(theta[far], np.tile(self.optimum.states, (len(far), 1, 1)))
            out[far] = np.where(left < promised[far] + FOLLOWED, held, out[far])
        return out

    @cached_property
    def promised(self) -> float:
        """Nats that a step of the states promises at the optimum; takes no simulation."""
        return 0.5 * self.solved.explained

    def _compared(self, theta: FloatArray, states: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Log-likelihoods (B,) of theta (B, N) from states (B, K, S), and nats that a step of these promises.

        Minus infinity, and infinity, where it diverges.
        """
        every = compare(self.chain, theta, states, self.fit)
        out, promised = np.full(len(theta), -np.inf), np.full(len(theta), np.inf)
        valid = {k: one for k, one in enumerate(every) if one is not None}
        if valid:
            forces = np.stack([pull(one, self.noise).ravel() for one in valid.values()], axis=1)
            gains = (forces * self.solved.solve(forces)).sum(0)
            solved = [replace(self.solved, explained=float(g)) for g in gains]
            pairs = zip(valid.values(), solved, strict=True)
            out[list(valid)] = [log_likelihood(one, self.noise, s) for one, s in pairs]
            promised[list(valid)] = 0.5 * gains
        return out, promised

    @property
    def check_cost(self) -> int:
        """See ``Target``."""
        sides = 2 if self.optimum.state_step.any() else 1
        return 1 + _STEPS * (1 + sides * (self.chain.num_theta + self.chain.num_start))

    def refreshed(self, point: FloatArray) -> float:
        """See ``Target``; after steps of the states alone."""
        states = self.states(point[None])[0]
        value = -np.inf
        for _ in range(_STEPS):
            linear = linearise_by(self.chain, point, states, self.optimum.theta_step, self.optimum.state_step)
            if linear is None:
                return -np.inf
            solved = eliminate_states(linear, self.noise)
            value = log_likelihood(linear, self.noise, solved)
            states = self.chain.moved(states, solved.shift)
        return value + float(self.prior.log_prob(torch.from_numpy(point)))
