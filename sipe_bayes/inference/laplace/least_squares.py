"""Box-constrained Gauss-Newton over theta and the windows' starts, for given noise.

Levenberg-Marquardt on the arrow-shaped normal equations of ``sipe_bayes.likelihood.noise``: the starts are eliminated, what is
left is a small quadratic programme over theta in the unit cube, solved by MuJoCo's mju_boxQP. A step into a diverged
or unphysical simulation is refused and shortened, so one bad rollout costs one step, not the fit.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sipe_bayes.likelihood.minimise import damped_box_step
from sipe_bayes.likelihood.moments import Moments
from sipe_bayes.likelihood.noise import Noise
from sipe_bayes.likelihood.restricted import eliminate_starts
from sipe_bayes.likelihood.windows import Windows
from sipe_bayes.posterior import Posterior

FloatArray = NDArray[np.float64]

FLAT_PRECISION = 0.01  # sd 10 in units of the cube: closes the directions that the data leave open
_DAMPING_UP, _DAMPING_DOWN = 8.0, 0.2
_DAMPING_MIN, _DAMPING_MAX = 1e-9, 1e6


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
        """-log density at theta, up to a constant."""
        return 0.5 * float((theta - self.mean) @ self.precision @ (theta - self.mean))

    def pull(self, theta: FloatArray) -> FloatArray:
        """Negative gradient (N,) of the energy."""
        return self.precision @ (self.mean - theta)


@dataclass(frozen=True)
class Fit:
    """A point of the search: theta (N,), starts (W, D), energy = -log of likelihood x prior up to a constant.

    residual (W, L, C): that of the simulation there, if it was done. expected, gained: nats by which the step that led
    here was to lower the energy and did; both zero where no step was taken. refused: nats that a step was to gain when even
    the shortest gained nothing."""

    theta: FloatArray
    starts: FloatArray
    energy: float
    damping: float = 1e-4
    converged: bool = False
    residual: FloatArray | None = None
    expected: float = 0.0
    gained: float = 0.0
    refused: float = 0.0


def energy_of(
    windows: Windows,
    noise: Noise,
    prior: QuadraticPrior,
    theta: FloatArray,
    starts: FloatArray,
    residual: FloatArray,
) -> float:
    """Half the whitened sum of squares of a residual (W, L, C), plus the priors."""
    fit = 0.5 * float(windows.chi_square(residual[None], noise)[0])
    return fit + prior.energy(theta) + 0.5 * float((starts**2 @ windows.start_precision).sum())


def step(
    windows: Windows,
    noise: Noise,
    prior: QuadraticPrior,
    fit: Fit,
    moments: Moments,
    tolerance: float,
    stale: bool = False,
) -> Fit:
    """The first of ever shorter damped steps from ``fit`` that lowers the energy, for the linearisation behind
    ``moments``; converged where it would lower it by less than ``tolerance`` nats.

    stale: the linearisation is of an earlier point; a refused step is then left to a fresh one, with infinite
    ``expected``."""
    normal = moments.normal(noise)
    pull = -windows.start_precision * fit.starts
    damping, refused = fit.damping, 0.0
    while damping <= _DAMPING_MAX:
        solved = eliminate_starts(normal, moments.num_theta, windows.start_precision, pull, damping)
        hessian = solved.precision + prior.precision
        gradient = solved.gradient + prior.pull(fit.theta)
        move = damped_box_step(hessian, gradient, fit.theta, damping)
        expected = float(gradient @ move - 0.5 * move @ hessian @ move) + 0.5 * solved.explained
        if expected < tolerance:
            return replace(fit, converged=True)
        theta, starts = np.clip(fit.theta + move, 0.0, 1.0), fit.starts + solved.blocks(move)
        residual, valid = windows.residuals(theta[None], starts[None])
        value = energy_of(windows, noise, prior, theta, starts, residual[0]) if valid[0] else np.inf
        gained = fit.energy - value
        if gained > 0:
            damping = max(_DAMPING_MIN, damping * _DAMPING_DOWN)
            return Fit(theta, starts, value, damping, gained < tolerance, residual[0], expected, gained)
        if stale:
            return replace(fit, expected=np.inf)
        damping, refused = damping * _DAMPING_UP, max(refused, expected)
    return replace(fit, converged=True, refused=refused)
