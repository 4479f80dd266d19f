"""Box-constrained Gauss-Newton over theta and the windows' starts, for given noise.

Levenberg-Marquardt on the arrow-shaped normal equations of ``sipe_bayes.noise``: the starts are eliminated, what is
left is a small quadratic programme over theta in the unit cube, solved by MuJoCo's mju_boxQP. A step into a diverged
or unphysical simulation is refused and shortened, so one bad rollout costs one step, not the fit.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import mujoco
import numpy as np
from numpy.typing import NDArray

from sipe_bayes.likelihood import Linearisation, Windows
from sipe_bayes.noise import Moments, Noise, eliminate

FloatArray = NDArray[np.float64]

_DAMPING_UP, _DAMPING_DOWN = 8.0, 0.2
_DAMPING_MIN, _DAMPING_MAX = 1e-9, 1e6


@dataclass(frozen=True)
class QuadraticPrior:
    """Normal prior on theta: mean (N,), precision (N, N); zero precision is the uniform prior."""

    mean: FloatArray
    precision: FloatArray

    def energy(self, theta: FloatArray) -> float:
        return 0.5 * float((theta - self.mean) @ self.precision @ (theta - self.mean))

    def pull(self, theta: FloatArray) -> FloatArray:
        """Negative gradient (N,) of the energy."""
        return self.precision @ (self.mean - theta)


@dataclass(frozen=True)
class Fit:
    """A point of the search: theta (N,), starts (W, D), energy = -log of likelihood x prior up to a constant."""

    theta: FloatArray
    starts: FloatArray
    energy: float
    damping: float = 1e-4
    converged: bool = False


def energy(windows: Windows, noise: Noise, prior: QuadraticPrior, theta: FloatArray, starts: FloatArray) -> float:
    """Half the whitened sum of squares plus the priors; infinite where the simulation is not valid."""
    residual, valid = windows.residuals(theta[None], starts[None])
    if not valid[0]:
        return np.inf
    fit = 0.5 * float(windows.chi_square(residual, noise)[0])
    return fit + prior.energy(theta) + 0.5 * float((starts**2 @ windows.start_precision).sum())


def iterate(
    windows: Windows, noise: Noise, prior: QuadraticPrior, fit: Fit, tolerance: float = 1e-3
) -> tuple[Fit, Linearisation, Moments]:
    """One accepted step (or convergence) from ``fit``; also the linearisation at the point it started from.

    Converged when a full step would lower the energy by less than ``tolerance`` nats."""
    linearisation = windows.linearise(fit.theta, fit.starts)
    moments = windows.moments(linearisation)
    return step(windows, noise, prior, fit, moments, tolerance), linearisation, moments


def step(
    windows: Windows, noise: Noise, prior: QuadraticPrior, fit: Fit, moments: Moments, tolerance: float
) -> Fit:
    """The best of ever shorter damped steps from ``fit``, for the linearisation behind ``moments``."""
    normal = moments.normal(noise)
    pull = -windows.start_precision * fit.starts
    damping = fit.damping
    while damping <= _DAMPING_MAX:
        arrow = eliminate(normal, moments.num_theta, windows.start_precision, pull, damping)
        hessian = arrow.precision + prior.precision
        gradient = arrow.gradient + prior.pull(fit.theta)
        move = box_step(hessian, gradient, fit.theta, damping)
        starts = fit.starts + arrow.starts(move)
        expected = float(gradient @ move - 0.5 * move @ hessian @ move) + 0.5 * arrow.explained
        if expected < tolerance:
            return replace(fit, converged=True)
        theta = np.clip(fit.theta + move, 0.0, 1.0)
        value = energy(windows, noise, prior, theta, starts)
        if value < fit.energy:
            damping = max(_DAMPING_MIN, damping * _DAMPING_DOWN)
            return Fit(theta, starts, value, damping, fit.energy - value < tolerance)
        damping *= _DAMPING_UP
    return replace(fit, converged=True)


def box_step(hessian: FloatArray, gradient: FloatArray, theta: FloatArray, damping: float) -> FloatArray:
    """Minimiser of the damped quadratic model within the unit cube."""
    n = len(theta)
    damped = hessian + damping * (np.diag(np.diag(hessian)) + 1e-12 * np.trace(hessian) / n * np.eye(n))
    result, factor = np.zeros(n), np.zeros((n, n + 7))
    index = np.zeros(n, np.int32)
    ok = mujoco.mju_boxQP(result, factor, index, damped, -gradient, -theta, 1 - theta)
    return result if ok >= 0 else np.zeros(n)
