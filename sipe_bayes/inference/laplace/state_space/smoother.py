"""Steps of theta and all states for a given noise: an iterated Kalman smoother with theta on its border.

Given the noise, theta and all states minimise half the whitened squares of residuals and jumps plus the priors, by
damped Gauss-Newton steps on the block-tridiagonal normal equations (``likelihood.block_tridiagonal``), theta within the
unit cube.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.inference.laplace.levenberg_marquardt import Descent, QuadraticModel, descend
from sipe_bayes.inference.laplace.state_space.options import ChainTuning
from sipe_bayes.likelihood.block_tridiagonal import Border
from sipe_bayes.likelihood.quadratic_prior import FLAT_PRECISION, QuadraticPrior, free_to_move
from sipe_bayes.likelihood.state_space.chain import Chain
from sipe_bayes.likelihood.state_space.differences import compare
from sipe_bayes.likelihood.state_space.linearisation import ChainLinearisation, ChainNoise, eliminate_states, energy

_RAISES = 40  # of the process noise by three: from rounding's size far beyond any motion


@dataclass(frozen=True)
class ChainPoint:
    """theta (N,) and states (K, S)."""

    theta: FloatArray
    states: FloatArray


def penalty(prior: QuadraticPrior, theta: FloatArray) -> float:
    """-log prior of theta (N,), with the flat normal that closes open directions."""
    return prior.energy(theta) + 0.5 * FLAT_PRECISION * float(((theta - 0.5) ** 2).sum())


def border(prior: QuadraticPrior, theta: FloatArray, gradient: FloatArray) -> Border:
    """The prior at theta (N,); a parameter that ``gradient`` (N,) presses against a bound may not move."""
    flat = FLAT_PRECISION * np.eye(len(theta))
    pull = prior.pull(theta) + FLAT_PRECISION * (0.5 - theta)
    return Border(prior.precision + flat, pull, free_to_move(theta, gradient + pull))


class LinearisedChain:
    """A ``levenberg_marquardt.LinearisedEnergy`` of a chain of states, with its linearisation ``linear`` at a point."""

    def __init__(
        self, chain: Chain, linear: ChainLinearisation, noise: ChainNoise, prior: QuadraticPrior, point: ChainPoint
    ) -> None:
        self.chain, self.linear, self.noise, self.prior, self.point = chain, linear, noise, prior, point
        self.theta = point.theta
        self.energy = energy(linear, noise) + penalty(prior, point.theta)
        self._border = border(prior, point.theta, np.zeros_like(point.theta))

    def model(self, damping: float) -> QuadraticModel:
        """The quadratic model in theta, the states eliminated."""
        solved = eliminate_states(self.linear, self.noise, damping)
        hessian, gradient = solved.precision + self._border.precision, solved.gradient + self._border.pull
        return QuadraticModel(hessian, gradient, solved.explained, solved.blocks)

    def simulated(self, theta: FloatArray, change: FloatArray) -> tuple[ChainPoint, float]:
        """The point at theta (N,) with the states moved by tangents (K, D), and its energy."""
        point = ChainPoint(theta, self.chain.moved(self.point.states, change))
        (linear,) = compare(self.chain, theta[None], point.states[None], self.linear)
        return point, np.inf if linear is None else energy(linear, self.noise) + penalty(self.prior, theta)


def smooth(
    chain: Chain,
    linear: ChainLinearisation,
    noise: ChainNoise,
    prior: QuadraticPrior,
    point: ChainPoint,
    damping: float,
    tolerance: float,
    tuning: ChainTuning,
) -> tuple[ChainPoint, Descent[ChainPoint]]:
    """The first of ever shorter damped steps from a point, at which ``linear`` was taken, that lowers the energy.

    damping: of the first step tried; tolerance: nats that a step must promise. Returns where it led, or the point
    itself; and how it went: ``point`` is None there where no step was taken.
    """
    step = descend(LinearisedChain(chain, linear, noise, prior, point), damping, tolerance, tuning.damping)
    return point if step.point is None else step.point, step


def solvable(linear: ChainLinearisation, noise: ChainNoise) -> ChainNoise:
    """The noise, its process noise raised as far as the equations need it to be solved in spite of rounding.

    Raises:
        numpy.linalg.LinAlgError: where no process noise is enough, as where slopes are beyond numbers.
    """
    for _ in range(_RAISES):
        try:
            eliminate_states(linear, noise)
        except np.linalg.LinAlgError:
            noise = replace(noise, process=3.0 * noise.process)
        else:
            return noise
    eliminate_states(linear, noise)
    return noise
