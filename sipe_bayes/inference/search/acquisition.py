"""What Bayesian optimisation evaluates next: acquisition functions, and the theta that maximises one.

A candidate starts as the best of random points of the box and of the best evaluated points changed in a few
coordinates, and climbs by L-BFGS.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.options import Options, option
from sipe_bayes.models.gaussian_process import GaussianProcess


class Acquisition(Protocol):
    """What a candidate maximises."""

    def __call__(self, lowest: Tensor, mean: Tensor, sd: Tensor) -> Tensor:
        """How much (B,) evaluations promise, differentiable.

        Args:
            lowest: the lowest value so far, a number.
            mean: predicted there (B,).
            sd: of the prediction (B,).
        """
        ...


@dataclass(frozen=True)
class ConfidenceBound:
    """kappa s - mu: minus the lower confidence bound."""

    kappa: float

    def __call__(self, lowest: Tensor, mean: Tensor, sd: Tensor) -> Tensor:
        """As ``Acquisition`` says."""
        return self.kappa * sd - mean


@dataclass(frozen=True)
class ExpectedImprovement:
    """log E[max(lowest - xi - y, 0)]."""

    xi: float

    def __call__(self, lowest: Tensor, mean: Tensor, sd: Tensor) -> Tensor:
        """As ``Acquisition`` says."""
        return log_improvement((lowest - self.xi - mean) / sd) + sd.log()


@dataclass(frozen=True)
class CandidateOptions(Options):
    """How hard a candidate is looked for."""

    pool: int = option(256, "random points, and as many changed ones, that a candidate starts from", least=3)
    parents: int = option(5, "best evaluated points that are changed", least=1)
    changed: int = option(10, "coordinates that change on average, so that little is lost in many dimensions", least=1)
    climbs: int = option(3, "candidates that climb together", least=1)
    climb_steps: int = option(20, "iterations of L-BFGS; the surface changes with the next evaluation", least=1)


@dataclass(frozen=True)
class CandidateSearch:
    """The theta of a box that maximises an acquisition.

    Args:
        acquisition: what is maximised.
        low: of the box (N,).
        high: of the box (N,).
        options: how hard it looks.
    """

    acquisition: Acquisition
    low: FloatArray
    high: FloatArray
    options: CandidateOptions

    def best(self, process: GaussianProcess, rng: np.random.Generator) -> Tensor:
        """The candidate (N,) found."""
        pool = torch.from_numpy(np.clip(self._pool(process, rng), self.low, self.high))
        with torch.no_grad():
            top = pool[self.merit(process, pool).topk(self.options.climbs).indices]
        return self._climbed(process, top)

    def merit(self, process: GaussianProcess, theta: Tensor) -> Tensor:
        """The acquisition (B,) at theta (B, N)."""
        return self.acquisition(process.y.min(), *process.predict(theta))

    def _pool(self, process: GaussianProcess, rng: np.random.Generator) -> FloatArray:
        """Random points of the box, and the best evaluated points changed in a few coordinates (2 ``pool``, N)."""
        n, size, width = len(self.low), self.options.pool, self.high - self.low
        everywhere = rng.uniform(self.low, self.high, (size, n))
        best = process.x[process.y.argsort(stable=True)[: self.options.parents]].numpy()
        parents = best[rng.integers(len(best), size=size)]
        changed = rng.random((size, n)) < min(1.0, self.options.changed / n)
        reach = width * 10 ** rng.uniform(-3, -0.5, (size, 1))
        return np.concatenate([everywhere, parents + changed * reach * rng.standard_normal((size, n))])

    def _climbed(self, process: GaussianProcess, starts: Tensor) -> Tensor:
        """The best theta (N,) reached from starts (B, N) within the box."""
        from scipy.optimize import minimize

        lowest = process.y.min()

        def negative(flat: FloatArray) -> tuple[float, FloatArray]:
            with torch.no_grad():
                mean, sd, by_mean, by_sd = process.slopes(torch.from_numpy(flat.reshape(starts.shape)))
            mean, sd = mean.requires_grad_(True), sd.requires_grad_(True)
            total = -self.acquisition(lowest, mean, sd).sum()
            along_mean, along_sd = torch.autograd.grad(total, (mean, sd))
            gradient = along_mean[:, None] * by_mean + along_sd[:, None] * by_sd
            return float(total.detach()), gradient.numpy().ravel()

        bounds = list(zip(np.tile(self.low, len(starts)), np.tile(self.high, len(starts)), strict=True))
        limit = {"maxiter": self.options.climb_steps}
        end = minimize(negative, starts.numpy().ravel(), jac=True, method="L-BFGS-B", bounds=bounds, options=limit)
        ends = torch.cat([starts, torch.from_numpy(np.clip(end.x.reshape(starts.shape), self.low, self.high))])
        with torch.no_grad():
            return ends[self.merit(process, ends).argmax()]


def log_improvement(z: Tensor) -> Tensor:
    """log(phi(z) + z Phi(z)) without cancellation, differentiable.

    S. Ament et al. 2023, "Unexpected Improvements to Expected Improvement for Bayesian Optimization",
    https://arxiv.org/abs/2310.20708, equation 9.
    """
    high = z.clamp_min(-1.0)
    density = torch.exp(-(high**2) / 2) / math.sqrt(2 * math.pi)
    above = torch.log(density + high * torch.special.ndtr(high))
    low = z.clamp(-1e3, -1.0)
    mills = math.sqrt(math.pi / 2) * torch.special.erfcx(-low / math.sqrt(2))
    below = -(low**2) / 2 - math.log(2 * math.pi) / 2 + torch.log1p(low * mills)
    # beyond: phi(z) / z^2 is what is left
    beyond = z.clamp_max(-1e3)
    far = -(beyond**2) / 2 - math.log(2 * math.pi) / 2 - 2 * torch.log(-beyond)
    return torch.where(z > -1.0, above, torch.where(z > -1e3, below, far))
