"""The multivariate normal N(m, C) restricted to the unit cube: its mass there, exact samples, moments.

**One dimension.** With a = (0 - m) / s and b = (1 - m) / s the mass is Phi(b) - Phi(a). By symmetry let a + b
<= 0. If b > 0 it is [erf(b / sqrt2) - erf(a / sqrt2)] / 2, without cancellation; else, in the tail, with
Phi(x) = exp(-x^2 / 2) erfcx(-x / sqrt2) / 2, its logarithm is log Phi(b) + log(1 - Phi(a) / Phi(b)), where
the ratio needs only (b - a)(b + a). Inverse-CDF samples are drawn on the same logarithmic scale. A diagonal C
factorises.

**Full covariance.** Z. I. Botev, "The normal law under linear restrictions: simulation and estimation via
minimax tilting", Journal of the Royal Statistical Society B 79 (2017), 125-148,
https://arxiv.org/abs/1603.04166. Let C = L L^T (variables ordered so that the least probable given the
earlier ones comes first), D = diag(L) and A = D^-1 L - I, strictly lower triangular. The cube is l <= z + A z
<= u, with l, u the bounds minus m over D, and z standard normal. Draw z_k one after another from N(mu_k, 1)
truncated to [l_k - (Az)_k, u_k - (Az)_k]; the likelihood ratio of the normal law to this proposal is exp
psi(z; mu), with

    psi(z; mu) = sum_k  mu_k^2 / 2 - mu_k z_k + log[ Phi(u_k - (Az)_k - mu_k) - Phi(l_k - (Az)_k - mu_k) ].

So E exp psi is the mass for any mu. psi is concave in z and convex in mu; the tilting mu* is its saddle
point, where the worst ratio is least. With t_k and V_k the mean and variance of the truncated N(mu_k, 1), and
w = t - mu, the saddle solves t - z = 0 and A^T w - mu = 0; its Hessian blocks are diag(V), diag(V - 1) A - I
and A^T diag(V - 1) A, and SciPy's least squares find it from the mode z of the truncated law, to which the first
equations assign mu = (I + A^T)^-1 A^T z. As psi(z; mu*) <= psi* = psi(z*; mu*) for all z,
accepting a draw with probability exp(psi - psi*) is exact, and the acceptance rate is mass / exp(psi*). The
mass is estimated by averaging exp psi over eight scrambled Sobol sequences of fixed seed; their spread gives
the standard error. The moments are weighted averages over the same points.

**Approximation.** Where fewer than one draw in a thousand would be accepted (tens of dimensions whose variances
span many decades), draws are states of up to 500 Markov chains that begin at the mode, after 100 sweeps: Gibbs
sampling along the eigenvectors of C and the axes, where the conditionals are truncated normals of one dimension.
Moments are those of such draws, and the standard error of the mass may be large. Elliptical slice sampling
(``botorch.utils.probability.lin_ess``) needs far more steps: each is as short as the narrowest cut.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from functools import cached_property
from typing import ClassVar, NamedTuple

import numpy as np
import torch
from scipy.linalg import solve_triangular
from scipy.optimize import least_squares, lsq_linear
from scipy.special import erf, erfcx, log_ndtr, logsumexp, ndtr, ndtri_exp
from scipy.stats import qmc
from torch import Generator

from sipe_bayes.core.arrays import FloatArray, IntArray

Bounds = FloatArray | float
Draw = Callable[[int, Generator | None], FloatArray]
"""Tries (n,), some of which are accepted (m, N)."""
_UNTRUNCATED = 1e-12  # mass outside the cube below which nothing is cut off
_NODES, _NODE_WEIGHTS = np.polynomial.legendre.leggauss(64)


def log_interval(a: Bounds, b: Bounds) -> FloatArray:
    """log(Phi(b) - Phi(a)) for a <= b, elementwise, to nearly full precision in both tails."""
    flip = a + b > 0
    a, b = np.where(flip, -b, a), np.where(flip, -a, b)
    root2 = math.sqrt(2)
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        centre = np.log((erf(b / root2) - erf(a / root2)) / 2)
        ratio = np.exp((b - a) * (b + a) / 2) * erfcx(-a / root2) / erfcx(-np.minimum(b, 0) / root2)
        tail = -b * b / 2 + np.log(erfcx(-np.minimum(b, 0) / root2) / 2) + np.log1p(-np.minimum(ratio, 1))
    return np.where(b > 0, centre, tail)


def interval_quantile(a: Bounds, b: Bounds, u: Bounds) -> FloatArray:
    """The u-quantile of the standard normal truncated to [a, b], elementwise."""
    flip = a + b > 0
    a, b, u = np.where(flip, -b, a), np.where(flip, -a, b), np.where(flip, 1 - u, u)
    top = log_ndtr(b)
    ratio = np.exp(log_ndtr(a) - top)
    with np.errstate(divide="ignore"):
        x = np.clip(ndtri_exp(top + np.log(ratio + u * (1 - ratio))), a, b)
    return np.where(flip, -x, x)


def interval_moments(low: Bounds, high: Bounds, location: Bounds, scale: Bounds) -> tuple[FloatArray, FloatArray]:
    """Mean and variance of a truncated normal, elementwise.

    64-point Gauss-Legendre quadrature from the density's maximum to where it has fallen by exp(-40): the
    textbook formulas subtract nearly equal numbers in the tails and in narrow intervals, this does not.

    Args:
        low: bound.
        high: bound.
        location: mean before truncation.
        scale: sd before truncation, which may be infinite.
    """
    low, high, location, scale = (np.asarray(x, dtype=np.float64) for x in (low, high, location, scale))
    start = np.asarray(np.clip(location, low, high))
    slope = start - location
    reach = np.sqrt(slope**2 + 80 * np.square(scale))
    left, right = np.maximum(low, location - reach), np.minimum(high, location + reach)
    step = (left - start)[..., None] + (right - left)[..., None] * (_NODES + 1) / 2
    exponent = step * (step + 2 * slope[..., None]) / (2 * np.square(scale)[..., None])
    weight = np.exp(-exponent) * _NODE_WEIGHTS
    weight /= weight.sum(-1, keepdims=True)
    mean = (weight * step).sum(-1)
    variance = (weight * (step - mean[..., None]) ** 2).sum(-1)
    return start + mean, variance


class Tilting(NamedTuple):
    """The proposal of the full-covariance case: the ordered, scaled problem and its saddle point."""

    order: IntArray
    diagonal: FloatArray
    lower: FloatArray  # A, strictly lower triangular
    low: FloatArray
    high: FloatArray
    mu: FloatArray
    log_bound: float


class Estimate(NamedTuple):
    """What the quasi-random points say: log mass, its standard error, and the truncated moments."""

    log_mass: float
    error: float
    mean: FloatArray
    covariance: FloatArray


def ordered_cholesky(mean: FloatArray, covariance: FloatArray) -> tuple[IntArray, FloatArray]:
    """An order of the variables, least probable interval first, and the Cholesky factor in that order.

    The greedy order of G. J. Gibson, C. A. Glasbey, D. A. Elston, "Monte Carlo evaluation of multivariate
    normal integrals and sensitivity to variate ordering" (1994); each chosen variable stands at its truncated
    mean.
    """
    size = len(mean)
    order, factor = np.arange(size), np.zeros((size, size))
    covariance, low, high = covariance.copy(), -mean, 1 - mean
    z = np.zeros(size)
    for k in range(size):
        rest = slice(k, size)
        left = np.diag(covariance)[rest] - (factor[rest, :k] ** 2).sum(1)
        spread = np.sqrt(np.maximum(left, 1e-14 * np.diag(covariance)[rest]))
        shift = factor[rest, :k] @ z[:k]
        best = k + int(np.argmin(log_interval((low[rest] - shift) / spread, (high[rest] - shift) / spread)))
        swap, back = [k, best], [best, k]
        for array in (order, low, high, factor, covariance):
            array[swap] = array[back]
        covariance[:, swap] = covariance[:, back]
        factor[k, k] = spread[best - k]
        factor[k + 1 :, k] = (covariance[k + 1 :, k] - factor[k + 1 :, :k] @ factor[k, :k]) / factor[k, k]
        offset = factor[k, :k] @ z[:k]
        bounds = (low[k] - offset) / factor[k, k], (high[k] - offset) / factor[k, k]
        z[k] = interval_moments(*bounds, 0.0, 1.0)[0]
    return order, factor


def _saddle_equations(
    point: FloatArray, lower: FloatArray, low: FloatArray, high: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Gradient of psi in (z, mu), the last of each left out (they are zero), and its Jacobian."""
    n = len(low) - 1
    z, mu = np.append(point[:n], 0.0), np.append(point[n:], 0.0)
    shift = lower @ z
    mean, variance = interval_moments(low - shift, high - shift, mu, np.ones_like(mu))
    gradient = np.concatenate([(lower.T @ (mean - mu) - mu)[:n], (mean - z)[:n]])
    curved = (variance - 1)[:, None] * lower
    cross = curved[:n, :n] - np.eye(n)
    jacobian = np.block([[lower[:, :n].T @ curved[:, :n], cross.T], [cross, np.diag(variance[:n])]])
    return gradient, jacobian


def saddle_point(mode: FloatArray, lower: FloatArray, low: FloatArray, high: FloatArray) -> tuple[FloatArray, float]:
    """The tilting mu (N,) and the bound psi*; (0, 0), always valid, where the ``mode`` z (N,) does not lead there."""
    mu, bound = np.zeros_like(mode), 0.0
    start = np.concatenate([mode[:-1], np.linalg.solve(np.eye(len(mode)) + lower.T, lower.T @ mode)[:-1]])
    with suppress(ValueError, np.linalg.LinAlgError):  # numbers that overflow
        found = least_squares(
            lambda point: _saddle_equations(point, lower, low, high)[0],
            start,
            jac=lambda point: _saddle_equations(point, lower, low, high)[1],
            **{"method": "dogbox", "x_scale": "jac", "max_nfev": 200, "ftol": 1e-15, "xtol": 1e-15, "gtol": 1e-15},
        )
        if np.linalg.norm(found.fun) < 1e-9 * (1 + np.linalg.norm(found.x)):
            z, mu = (np.append(half, 0.0) for half in np.split(found.x, 2))
            shift = lower @ z + mu
            bound = float((mu**2 / 2 - mu * z + log_interval(low - shift, high - shift)).sum())
    return mu, bound


class TruncatedNormal:
    """N(mean, covariance) restricted to [0, 1]^N and renormalised.

    Args:
        mean: (N,).
        covariance: (N, N), positive definite.
        log_mass: with its standard error, when it is known already, so that it is not estimated again.
    """

    scrambles: ClassVar[int] = 8  # Sobol sequences, whose spread is the error
    points: int = 2**12  # of each sequence
    rejection_mass: ClassVar[float] = 0.05  # above it plain draws are thrown away until enough are inside
    least_acceptance: ClassVar[float] = 1e-3  # of tilted draws, below which Markov chains take their place
    chains: ClassVar[int] = 500
    sweeps: ClassVar[int] = 100  # of a chain over all directions before its first draw
    most_tries: ClassVar[float] = 1e3  # times what a draw should take, before its mass is called wrong

    def __init__(self, mean: FloatArray, covariance: FloatArray, log_mass: tuple[float, float] | None = None) -> None:
        self.mean, self.covariance = mean, covariance
        self.sd = np.sqrt(np.diag(covariance))
        self.diagonal = not np.any(covariance - np.diag(np.diag(covariance)))
        outside = float((ndtr(-mean / self.sd) + ndtr((mean - 1) / self.sd)).sum())
        self.untruncated = outside < _UNTRUNCATED
        if log_mass is not None:
            self.__dict__["_mass"] = log_mass

    @property
    def closed_form(self) -> bool:
        """Whether the marginals are truncated normals, so that moments and quantiles are exact."""
        return self.diagonal or self.untruncated

    @property
    def log_mass(self) -> float:
        """Log of the probability that the untruncated normal lies in the cube."""
        return self._mass[0]

    @property
    def log_mass_error(self) -> float:
        """Standard error of ``log_mass``, which is the relative error of the mass; 0 in closed form."""
        return self._mass[1]

    @cached_property
    def _mass(self) -> tuple[float, float]:
        if self.untruncated:
            return 0.0, 0.0
        if self.diagonal:
            return float(log_interval(-self.mean / self.sd, (1 - self.mean) / self.sd).sum()), 0.0
        return self._estimate.log_mass, self._estimate.error

    @cached_property
    def _estimate(self) -> Estimate:
        theta, psi = self._points()
        per_scramble = logsumexp(psi, axis=1) - math.log(psi.shape[1])
        log_mass = float(logsumexp(per_scramble) - math.log(self.scrambles))
        error = float(np.exp(per_scramble - log_mass).std(ddof=1)) / math.sqrt(self.scrambles)
        theta, psi = theta.reshape(-1, len(self.mean)), psi.reshape(-1)
        weight = np.exp(psi - logsumexp(psi))
        mean = weight @ theta
        return Estimate(log_mass, error, mean, (theta - mean).T @ (weight[:, None] * (theta - mean)))

    @cached_property
    def _tilting(self) -> Tilting:
        order, factor = ordered_cholesky(self.mean, self.covariance)
        diagonal = np.diag(factor).copy()
        lower = factor / diagonal[:, None] - np.eye(len(diagonal))
        low, high = -self.mean[order] / diagonal, (1 - self.mean[order]) / diagonal
        mode = solve_triangular(factor, (self._mode - self.mean)[order], lower=True)
        return Tilting(order, diagonal, lower, low, high, *saddle_point(mode, lower, low, high))

    @cached_property
    def _mode(self) -> FloatArray:
        found = lsq_linear(self.whitening, self.whitening @ self.mean, (0.0, 1.0), method="bvls", tol=1e-14)
        return np.asarray(np.clip(found.x, 0.0, 1.0), dtype=np.float64)

    @cached_property
    def _rate(self) -> float:
        """The share of tilted draws that are accepted."""
        return math.exp(min(self.log_mass - self._tilting.log_bound, 0.0))

    def _propose(self, uniforms: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Draws theta (n, N) and log likelihood ratios psi (n,) of uniform numbers (n, N)."""
        tilting = self._tilting
        z, psi = np.zeros_like(uniforms), np.zeros(len(uniforms))
        for k, mu in enumerate(tilting.mu):
            shift = z[:, :k] @ tilting.lower[k, :k] + mu
            a, b = tilting.low[k] - shift, tilting.high[k] - shift
            z[:, k] = mu + interval_quantile(a, b, uniforms[:, k])
            psi += log_interval(a, b) + mu**2 / 2 - mu * z[:, k]
        theta = np.empty_like(z)
        theta[:, tilting.order] = tilting.diagonal * (z + z @ tilting.lower.T)
        return np.clip(theta + self.mean, 0.0, 1.0), psi

    def _points(self) -> tuple[FloatArray, FloatArray]:
        """Draws theta (8, n, N) and psi (8, n) at eight scrambled Sobol sequences."""
        engines = [qmc.Sobol(len(self.mean), scramble=True, seed=seed) for seed in range(self.scrambles)]
        theta, psi = self._propose(np.concatenate([engine.random(self.points) for engine in engines]))
        return theta.reshape(self.scrambles, -1, len(self.mean)), psi.reshape(self.scrambles, -1)

    def moments(self) -> tuple[FloatArray, FloatArray]:
        """Mean (N,) and covariance (N, N) of the truncated distribution."""
        if self.untruncated:
            return self.mean, self.covariance
        if self.diagonal:
            mean, variance = interval_moments(np.zeros_like(self.mean), np.ones_like(self.mean), self.mean, self.sd)
            return mean, np.diag(variance)
        if self._rate < self.least_acceptance:
            theta = self._chain_draws(20 * self.chains, torch.Generator().manual_seed(0))
            return theta.mean(0), np.cov(theta.T)
        return self._estimate.mean, self._estimate.covariance

    def sample(self, n: int, generator: Generator | None) -> FloatArray:
        """Draws (n, N): exact, or of Markov chains where too few would be accepted."""
        if self.diagonal:
            uniforms = torch.rand(n, len(self.mean), dtype=torch.float64, generator=generator).numpy()
            a, b = -self.mean / self.sd, (1 - self.mean) / self.sd
            return np.clip(self.mean + self.sd * interval_quantile(a, b, uniforms), 0.0, 1.0)
        if self.log_mass > math.log(self.rejection_mass):
            return self._accepted(n, math.exp(self.log_mass), self._plain_draws, generator)
        if self._rate < self.least_acceptance:
            return self._chain_draws(n, generator)
        return self._accepted(n, self._rate, self._tilted_draws, generator)

    def _chain_draws(self, n: int, generator: Generator | None) -> FloatArray:
        """States (n, N) of Markov chains from the mode, by Gibbs sampling along eigenvectors and axes."""
        directions = np.concatenate([np.linalg.eigh(self.covariance)[1].T, np.eye(len(self.mean))])
        slopes = directions @ self.whitening.T @ self.whitening
        chains = max(1, min(n, self.chains))
        theta, draws = np.tile(self._mode, (chains, 1)), []
        for _ in range(self.sweeps + math.ceil(max(n, 1) / chains)):
            for k in torch.randperm(len(directions), generator=generator).tolist():
                direction, sd = directions[k], (slopes[k] @ directions[k]) ** -0.5
                used, centre = direction != 0, (self.mean - theta) @ slopes[k] * sd**2
                ends = np.sort(np.stack([-theta[:, used], 1 - theta[:, used]]) / direction[used], axis=0)
                low, high = (ends[0].max(1) - centre) / sd, (ends[1].min(1) - centre) / sd
                uniforms = torch.rand(chains, dtype=torch.float64, generator=generator).numpy()
                length = centre + sd * interval_quantile(low, high, uniforms)
                theta = np.clip(theta + length[:, None] * direction, 0.0, 1.0)
            draws.append(theta)
        return np.concatenate(draws[self.sweeps :])[:n]

    def _accepted(self, n: int, rate: float, draw: Draw, generator: Generator | None) -> FloatArray:
        accepted: list[FloatArray] = [np.empty((0, len(self.mean)))]
        missing, left = n, self.most_tries * (n / rate + self.most_tries)
        while missing > 0:
            batch = min(int(1.1 * missing / rate) + 16, 2**16)
            if left < 0:
                raise ValueError("posterior: far fewer draws lie in the cube than the stored mass says; save it again")
            accepted.append(draw(batch, generator)[:missing])
            missing, left = missing - len(accepted[-1]), left - batch
        return np.concatenate(accepted)

    def _plain_draws(self, n: int, generator: Generator | None) -> FloatArray:
        normals = torch.randn(n, len(self.mean), dtype=torch.float64, generator=generator).numpy()
        theta = self.mean + normals @ self._factor.T
        return theta[((theta >= 0) & (theta <= 1)).all(1)]

    def _tilted_draws(self, n: int, generator: Generator | None) -> FloatArray:
        uniforms = torch.rand(n, len(self.mean) + 1, dtype=torch.float64, generator=generator).numpy()
        theta, psi = self._propose(uniforms[:, :-1])
        return theta[np.log1p(-uniforms[:, -1]) <= psi - self._tilting.log_bound]

    @cached_property
    def _factor(self) -> FloatArray:
        return np.asarray(np.linalg.cholesky(self.covariance), dtype=np.float64)

    @cached_property
    def whitening(self) -> FloatArray:
        """W (N, N) with W C W^T = I."""
        inverse: FloatArray = solve_triangular(self._factor, np.eye(len(self.mean)), lower=True)
        return inverse
