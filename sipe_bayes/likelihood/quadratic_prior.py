"""A prior as a quadratic energy: the normal before truncation to the cube."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sipe_bayes.core.arrays import BoolArray, FloatArray
from sipe_bayes.posterior import Posterior

FLAT_PRECISION = 0.01  # sd 10 in units of the cube: closes directions that data or prior leave open, flat within it
UNIFORM_PRECISION = 12.0  # of a uniform prior in units of the cube: its sd is 1 / sqrt(12)


@dataclass(frozen=True)
class QuadraticPrior:
    """Normal prior on theta: mean (N,), precision (N, N); zero precision is the uniform prior."""

    mean: FloatArray
    precision: FloatArray

    @classmethod
    def of(cls, prior: Posterior) -> QuadraticPrior:
        """The normal of a prior, before truncation."""
        mean, covariance = prior.gaussian_moments()
        return cls(mean.numpy(), np.linalg.inv(covariance.numpy()))

    def energy(self, theta: FloatArray) -> float:
        """-log density at theta (N,), up to a constant."""
        return 0.5 * float((theta - self.mean) @ self.precision @ (theta - self.mean))

    def pull(self, theta: FloatArray) -> FloatArray:
        """Negative gradient (N,) of the energy at theta (N,)."""
        return self.precision @ (self.mean - theta)


def free_to_move(theta: FloatArray, force: FloatArray) -> BoolArray:
    """Which parameters (N,) may move: all but those that a force (N,) presses against a bound of theta (N,)."""
    return ~(((theta <= 0) & (force < 0)) | ((theta >= 1) & (force > 0)))
