"""log p(theta | y) of windows with their starts and the noise integrated out: a simulation of the logs a value, or two.

For ``mcmc`` and ``importance``. With r the residual at the predicted starts x(theta), V(noise) its covariance and J_x
the starts' Jacobian,

    log p(theta | y) = log prior + max over noise of -1/2 [log|V| + log|A| + r' V^-1 r - b' A^-1 b + x' P_x x] + const,
    A = J_x' V^-1 J_x + P_x,   b = J_x' V^-1 r - P_x x.

The starts are integrated out exactly where the prediction is linear in them over their narrow conditional posterior:
x(theta) = x_hat - S (theta - theta_hat) and J_x are those of the ``laplace`` optimum. Far off, or beyond an edge where
theta stops to matter, no starts lie along that slope. Where the step that remains promises a nat, they are also
simulated as they are at the optimum; the value is theirs unless following promises less by ten. The noise is integrated
out by Laplace's method (L. Tierney, J. Kadane 1986, "Accurate Approximations for Posterior Moments and Marginal
Densities", J. Am. Stat. Assoc. 81) under a flat prior on log sd and log tau; exact for white noise of one channel whose
starts are known.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
import torch

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.inference.laplace.optimum import WindowOptimum, beyond_rounding, free_noise
from sipe_bayes.likelihood import Linearisation, Noise
from sipe_bayes.likelihood.windows import Windows
from sipe_bayes.posterior import Posterior

FORETOLD, FOLLOWED = 1.0, 10.0  # nats: that a step of starts that follow theta promises; by which less than those held


@dataclass(frozen=True)
class WindowFit:
    """An optimum and the starts' Jacobian (W, L, C, D) there: what ``WindowTarget`` is made of."""

    optimum: WindowOptimum
    jacobian: FloatArray

    @classmethod
    def at(cls, windows: Windows, optimum: WindowOptimum) -> WindowFit:
        """Take the Jacobian at an optimum; simulates where there are starts."""
        jacobian = np.zeros((*windows.observed.shape, windows.num_start))
        if windows.num_start:
            lin = windows.linearise(optimum.theta, optimum.starts, with_theta=False)
            jacobian = np.ascontiguousarray(lin.jacobian)
        return cls(optimum, jacobian)


class Target(ABC):
    """log p(theta | y), starts or states marginalised; a subclass writes the likelihood of one kind of logs."""

    prior: Posterior
    value_cost = 2
    """Simulations of the logs that a value takes, at most."""

    def __call__(self, points: FloatArray) -> FloatArray:
        """Values (B,) of points (B, N), up to a constant; minus infinity outside the cube and where one diverges."""
        out = np.full(len(points), -np.inf)
        inside = np.flatnonzero(((points >= 0) & (points <= 1)).all(1))
        if len(inside):
            theta = points[inside]
            out[inside] = self.log_likelihood(theta) + self.prior.log_prob(torch.from_numpy(theta)).numpy()
        return np.where(np.isnan(out), -np.inf, out)

    @abstractmethod
    def log_likelihood(self, theta: FloatArray) -> FloatArray:
        """Of points (B, N) in the cube (B,), minus infinity where one diverges."""

    @property
    @abstractmethod
    def check_cost(self) -> int:
        """Rollouts of a log to hold ``refreshed`` against the target."""

    @abstractmethod
    def refreshed(self, point: FloatArray) -> float:
        """The target at one point (N,) with the Jacobians taken there, after steps of starts or states."""


class WindowTarget(Target):
    """Of windows: one simulation of the logs a value, or two."""

    def __init__(self, prior: Posterior, windows: Windows, fit: WindowFit) -> None:
        self.prior, self.windows, self.fit = prior, windows, fit
        self.value_cost = 2 if windows.num_start else 1
        self.noise = Noise(fit.optimum.sd, fit.optimum.tau)
        silent = beyond_rounding(windows, self.noise).sd
        self.silent = bool((silent > self.noise.sd).all())  # residuals of rounding are no evidence
        least = np.where(silent > self.noise.sd, silent, windows.rounding)
        self.least_sd = np.where(np.isnan(windows.fixed_sd), least, 0.0)

    def starts(self, theta: FloatArray) -> FloatArray:
        """Starts (B, W, D) that follow theta (B, N)."""
        optimum = self.fit.optimum
        moved = np.einsum("wdn,bn->bwd", optimum.slope, theta - optimum.theta)
        return np.asarray(optimum.starts - moved)

    def log_likelihood(self, theta: FloatArray) -> FloatArray:
        """See ``Target``."""
        out, promised = self._values(theta, self.starts(theta))
        far = np.flatnonzero(promised > FORETOLD)
        if len(far) and self.windows.num_start:
            held, left = self._values(theta[far], np.tile(self.fit.optimum.starts, (len(far), 1, 1)))
            out[far] = np.where(left < promised[far] + FOLLOWED, held, out[far])
        return out

    def _values(self, theta: FloatArray, starts: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Log-likelihoods (B,) of theta (B, N) at starts (B, W, D), and nats that a step of these promises."""
        out, promised = np.full(len(theta), -np.inf), np.full(len(theta), np.inf)
        residuals, valid = self.windows.residuals(theta, starts)
        for k in np.flatnonzero(valid):
            out[k], _, promised[k] = self._integrated(residuals[k], self.fit.jacobian, starts[k])
        return out, promised

    def _integrated(
        self, residual: FloatArray, jacobian: FloatArray, starts: FloatArray
    ) -> tuple[float, FloatArray, float]:
        """``marginal`` of a residual (W, L, C) at ``starts`` (W, D), with the noise that fits best.

        jacobian: (W, L, C, D), by the starts.
        """
        windows, noise = self.windows, self.noise
        moments = windows.moments(Linearisation(residual, jacobian, True), windows.settings.noise == "white")
        if len(free_noise(windows)):
            context = windows.pulls(np.zeros((0, 0)), np.zeros(0), starts)
            noise = windows.estimate_noise(moments, noise, context, windows.settings.noise == "ar1")
        noise = Noise(np.maximum(noise.sd, self.least_sd), noise.tau)
        return windows.log_density(moments, noise, starts)

    @property
    def check_cost(self) -> int:
        """See ``Target``."""
        return 2 * self.windows.num_start + 3

    def refreshed(self, point: FloatArray) -> float:
        """See ``Target``; after one step of the starts."""
        starts, value = self.starts(point[None])[0], -np.inf
        for _ in range(2):  # a step, then the value
            lin = self.windows.linearise(point, starts, with_theta=False)
            value, move, _ = self._integrated(lin.residual, lin.jacobian, starts)
            starts = starts + move
        return value + float(self.prior.log_prob(torch.from_numpy(point)))
