"""A Gaussian process over theta with a Matern-5/2 kernel: fitted by BoTorch, predicted by a plain Cholesky factor.

With data X (n, N), standardised values z = (y - location) / scale (n,), constant mean m, unit signal variance and noise
variance v, K = k(X, X) + v I = L L' and at theta

    mu = location + scale [m + k' K^-1 (z - m)],   s^2 = scale^2 [1 - |L^-1 k|^2],
    k(r) = (1 + sqrt(5) r + 5 r^2 / 3) exp(-sqrt(5) r),   r^2 = sum_j ((theta_j - X_j) / lengthscale_j)^2

(C. E. Rasmussen, C. K. I. Williams 2006, "Gaussian Processes for Machine Learning", https://gaussianprocess.org/gpml,
equations 2.25, 2.26, 4.17). s is the sd of the smooth function, without the noise.

Hyper-parameters maximise the marginal likelihood times their priors. Lengthscales have the prior that grows with the
dimension, log-normal(sqrt(2) + log(N) / 2, sqrt(3)), which makes high dimensions work (C. Hvarfner, E. O. Hellsten,
L. Nardi 2024, "Vanilla Bayesian Optimization Performs Great in High Dimensions", https://arxiv.org/abs/2402.02229).

Deviations:

- The noise's prior is log-normal(-7, 2), for simulators that are deterministic but rough.
- Beyond ``most`` points the hyper-parameters are fitted to a subset: the best half of it by value, the rest at random.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

_CHUNK = 20_000_000  # numbers in memory while predicting
_LEAST_NOISE = 1e-6  # variance, of standardised values: what keeps the Cholesky factor well conditioned


@dataclass(frozen=True)
class GaussianProcess:
    """Data and hyper-parameters, all float64.

    Args:
        x: points (n, N).
        y: values (n,).
        lengthscale: (N,).
        noise: variance, of the standardised values.
        level: mean, of the standardised values.
        location, scale: of the values, standardising them.
    """

    x: Tensor
    y: Tensor
    lengthscale: Tensor
    noise: float
    level: float
    location: float
    scale: float

    @property
    def noise_sd(self) -> float:
        """Sd of the noise in units of y."""
        return math.sqrt(self.noise) * self.scale

    @cached_property
    def _z(self) -> Tensor:
        return (self.y - self.location) / self.scale - self.level

    @cached_property
    def _factor(self) -> Tensor:
        covariance = self.kernel(self.x, self.x)
        return torch.linalg.cholesky(covariance + self.noise * torch.eye(len(covariance), dtype=torch.float64))

    @cached_property
    def _weights(self) -> Tensor:
        return torch.cholesky_solve(self._z[:, None], self._factor)

    def kernel(self, a: Tensor, b: Tensor) -> Tensor:
        """Correlations (A, B) between points a (A, N) and b (B, N)."""
        r = self._distance(a, b)
        return (1 + r + r**2 / 3) * torch.exp(-r)

    def _distance(self, a: Tensor, b: Tensor) -> Tensor:
        """sqrt(5) r (A, B)."""
        a, b = a / self.lengthscale, b / self.lengthscale
        square = (a**2).sum(1)[:, None] + (b**2).sum(1) - 2 * a @ b.T
        return math.sqrt(5.0) * square.clamp_min(1e-20).sqrt()

    def predict(self, theta: Tensor) -> tuple[Tensor, Tensor]:
        """Mean (B,) and sd (B,) of the smooth function at theta (B, N), in units of y; differentiable."""
        parts = [self._predict(part) for part in theta.split(max(1, _CHUNK // len(self.x)))]
        return torch.cat([mean for mean, _ in parts]), torch.cat([sd for _, sd in parts])

    def _predict(self, theta: Tensor) -> tuple[Tensor, Tensor]:
        correlation = self.kernel(self.x, theta)
        mean = self.location + self.scale * (self.level + (correlation * self._weights).sum(0))
        white = torch.linalg.solve_triangular(self._factor, correlation, upper=False)
        return mean, self.scale * (1 - (white**2).sum(0)).clamp_min(1e-12).sqrt()

    def slopes(self, theta: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Mean and sd as of ``predict``, and their gradients, written out at a fraction of autograd's time.

        Args:
            theta: (B, N).

        Returns:
            Mean (B,), sd (B,), and the gradients (B, N) of both.
        """
        r = self._distance(self.x, theta)
        decay = torch.exp(-r)
        correlation, along = (1 + r + r**2 / 3) * decay, (1 + r) * decay * (-5 / 3)
        white = torch.linalg.solve_triangular(self._factor, correlation, upper=False)
        solved = torch.linalg.solve_triangular(self._factor.T, white, upper=True)
        mean = self.location + self.scale * (self.level + (correlation * self._weights).sum(0))
        share = (1 - (white**2).sum(0)).clamp_min(1e-12).sqrt()
        by_mean = self._pulled(theta, along * self._weights)
        by_sd = self._pulled(theta, along * solved) / -share[:, None]
        return mean, self.scale * share, self.scale * by_mean, self.scale * by_sd

    def _pulled(self, theta: Tensor, weight: Tensor) -> Tensor:
        """sum_i weight_ib (theta_b - x_i) / lengthscale^2 (B, N)."""
        return (weight.sum(0)[:, None] * theta - weight.T @ self.x) / self.lengthscale**2

    def with_data(self, x: Tensor, y: Tensor) -> GaussianProcess:
        """The same hyper-parameters with other data."""
        return replace(self, x=x, y=y)

    def imagined(self, theta: Tensor) -> GaussianProcess:
        """With one more point theta (N,) whose value is the mean predicted there: mean unchanged, sd smaller."""
        with torch.no_grad():
            mean, _ = self.predict(theta[None])
            new = self.with_data(torch.cat([self.x, theta[None]]), torch.cat([self.y, mean]))
            row = torch.linalg.solve_triangular(self._factor, self.kernel(self.x, theta[None]), upper=False)[:, 0]
            corner = (1 + self.noise - (row**2).sum()).clamp_min(self.noise / 2).sqrt()
            size = len(self.x)
            factor = torch.zeros(size + 1, size + 1, dtype=torch.float64)
            factor[:size, :size], factor[size, :size], factor[size, size] = self._factor, row, corner
        new.__dict__["_factor"] = factor
        return new


def fit_gaussian_process(
    x: Tensor, y: Tensor, seed: int = 0, previous: GaussianProcess | None = None, iterations: int = 60, most: int = 300
) -> GaussianProcess:
    """The Gaussian process of some points, its hyper-parameters fitted.

    Args:
        x: (n, N), in the unit cube.
        y: (n,), finite.
        seed: of the subset that is fitted to.
        previous: whose hyper-parameters the fit begins with.
        iterations: of L-BFGS at most.
        most: points that hyper-parameters are fitted to: the time of each iteration goes as their third power.
    """
    scale = float(y.std(correction=0))
    location, scale = float(y.mean()), scale if scale > 0 else 1.0
    rows = _subset(y, seed, most)
    lengthscale, noise, level = _hyper_parameters(x[rows], (y[rows] - location) / scale, previous, iterations)
    return GaussianProcess(x, y, lengthscale, noise, level, location, scale)


def _subset(y: Tensor, seed: int, most: int) -> Tensor:
    if len(y) <= most:
        return torch.arange(len(y))
    order = np.argsort(y.numpy(), kind="stable")
    half = most // 2
    others = np.random.default_rng([seed, len(y)]).choice(order[half:], most - half, replace=False)
    return torch.from_numpy(np.sort(np.concatenate([order[:half], others])))


def _hyper_parameters(
    x: Tensor, z: Tensor, previous: GaussianProcess | None, iterations: int
) -> tuple[Tensor, float, float]:
    import gpytorch  # type: ignore[import-untyped]
    from botorch.models import SingleTaskGP
    from botorch.models.utils.gpytorch_modules import get_covar_module_with_dim_scaled_prior
    from botorch.optim.fit import fit_gpytorch_mll_scipy

    kernel = get_covar_module_with_dim_scaled_prior(ard_num_dims=x.shape[1], use_rbf_kernel=False)
    likelihood = gpytorch.likelihoods.GaussianLikelihood(
        noise_prior=gpytorch.priors.LogNormalPrior(-7.0, 2.0),
        noise_constraint=gpytorch.constraints.GreaterThan(_LEAST_NOISE, transform=None, initial_value=1e-3),
    )
    with warnings.catch_warnings():
        # values are standardised over all points, not over the subset; iterations are few
        warnings.simplefilter("ignore")
        model = SingleTaskGP(x, z[:, None], likelihood=likelihood, covar_module=kernel, outcome_transform=None)
        if previous is not None:
            kernel.lengthscale, likelihood.noise = previous.lengthscale, max(previous.noise, 2 * _LEAST_NOISE)
            model.mean_module.constant = previous.level
        mll = gpytorch.mlls.ExactMarginalLogLikelihood(likelihood, model).double()
        fit_gpytorch_mll_scipy(mll, options={"maxiter": iterations})
    with torch.no_grad():
        lengthscale = kernel.lengthscale.reshape(-1).clone()
        return lengthscale, float(likelihood.noise), float(model.mean_module.constant)
