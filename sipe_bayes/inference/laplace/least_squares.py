"""The energy of theta and the windows' starts for given noise, linearised for ``levenberg_marquardt``.

The normal equations are the arrow of ``sipe_bayes.likelihood.noise``: the starts are eliminated.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.inference.laplace.levenberg_marquardt import QuadraticModel
from sipe_bayes.likelihood.moments import Moments
from sipe_bayes.likelihood.noise import Noise
from sipe_bayes.likelihood.restricted import eliminate_starts
from sipe_bayes.likelihood.windows import Windows
from sipe_bayes.posterior import Posterior

FLAT_PRECISION = 0.01  # sd 10 in units of the cube: closes the directions that the data leave open


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


@dataclass(frozen=True)
class WindowPoint:
    """theta (N,), starts (W, D), and the residual (W, L, C) of the simulation there."""

    theta: FloatArray
    starts: FloatArray
    residual: FloatArray


def energy_of(
    windows: Windows,
    noise: Noise,
    prior: QuadraticPrior,
    theta: FloatArray,
    starts: FloatArray,
    residual: FloatArray,
) -> float:
    """Half the whitened sum of squares of a residual (W, L, C), plus the priors of theta (N,) and starts (W, D)."""
    fit = 0.5 * float(windows.chi_square(residual[None], noise)[0])
    return fit + prior.energy(theta) + 0.5 * float((starts**2 @ windows.start_precision).sum())


class LinearisedWindows:
    """A ``levenberg_marquardt.LinearisedEnergy`` of windows.

    Args:
        windows: the logs.
        noise: of the residuals.
        prior: on theta.
        point: where the energy is known.
        moments: of the linearisation there, or at an earlier point.
    """

    def __init__(
        self, windows: Windows, noise: Noise, prior: QuadraticPrior, point: WindowPoint, moments: Moments
    ) -> None:
        self.windows, self.noise, self.prior, self.point = windows, noise, prior, point
        self.theta, self.num_theta = point.theta, moments.num_theta
        self.energy = self._energy(point)
        self._normal_of = moments

    @cached_property
    def _normal(self) -> FloatArray:
        return self._normal_of.normal(self.noise)

    def _energy(self, point: WindowPoint) -> float:
        return energy_of(self.windows, self.noise, self.prior, point.theta, point.starts, point.residual)

    def model(self, damping: float) -> QuadraticModel:
        """The quadratic model in theta, the starts eliminated."""
        pull = -self.windows.start_precision * self.point.starts
        solved = eliminate_starts(self._normal, self.num_theta, self.windows.start_precision, pull, damping)
        hessian, gradient = solved.precision + self.prior.precision, solved.gradient + self.prior.pull(self.theta)
        return QuadraticModel(hessian, gradient, solved.explained, solved.blocks)

    def simulated(self, theta: FloatArray, change: FloatArray) -> tuple[WindowPoint, float]:
        """The point at theta (N,) with the starts changed by (W, D), and its energy."""
        starts = self.point.starts + change
        residual, valid = self.windows.residuals(theta[None], starts[None])
        point = WindowPoint(theta, starts, residual[0])
        return point, self._energy(point) if valid[0] else np.inf
