"""A Gaussian mixture restricted to the unit cube. What BayesSim and Laplace approximations return.

The components are *not* renormalised one by one. The mixture density q(theta) = sum_k w_k N(theta; m_k, C_k)
is cut off outside the cube and divided by the mass that is left,

    p(theta) = q(theta) / Z,   Z = sum_k w_k Z_k,   Z_k = mass of N(m_k, C_k) in the cube,

so a draw comes from component k with probability w_k Z_k / Z: a component that lies mostly outside loses
weight. Z_k is exact for diagonal covariances and in one dimension, otherwise Botev's estimate (see
truncated_normal.py).

Mode: with responsibilities r_k(theta) the log density is bounded below, touching at theta, by
-1/2 sum_k r_k |W_k (theta' - m_k)|^2 + const, with W_k^T W_k = C_k^-1. Maximising the bound over the cube is
a bounded least-squares problem, solved by an active-set method; repeated, the density never falls. For K = 1
the first step is the answer.

Marginals: the marginal of a truncated normal is not a truncated normal. It is one if the dropped parameters
are uncorrelated with the kept ones (their mass goes into the weight), or if they are hardly truncated: when
the mass cut off along them is below 1e-9 of the component's own. Otherwise the marginal is Particles, of
8,000 exact draws.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import lsq_linear
from scipy.sparse.csgraph import connected_components
from scipy.special import ndtr
from torch import Generator, Tensor

from sipe_bayes.core.parameters import ParameterSpace
from sipe_bayes.posterior.base import Numbers, Posterior, as_float64
from sipe_bayes.posterior.truncated_normal import TruncatedNormal, interval_quantile, log_interval

_ABOVE_ONE = 0.1  # of the log of a mass: what draws may estimate it too high by
_MARGINAL_ERROR = 1e-9  # mass that a closed form may leave out


class GaussianMixture(Posterior):
    """sum_k w_k N(means_k, covariances_k), restricted to the cube and divided by its mass there.

    ``mean``, ``covariance`` and ``quantile`` are closed-form where every covariance is diagonal (or no component is
    truncated); otherwise the moments come from 32,768 fixed-seed quasi-random points per component and the
    quantiles from 20,000 fixed-seed draws.

    Args:
        log_weights: (K,), normalised or not; components of weight zero are dropped.
        means: (K, N), inside the cube or not.
        covariances: (K, N, N), positive definite.
        space: of the N parameters.
    """

    numbers_at_once: ClassVar[int] = 10_000_000  # in memory
    mode_starts: ClassVar[int] = 8  # components that are climbed from
    mode_steps: ClassVar[int] = 100  # of a climb, after which the density stands still

    def __init__(self, log_weights: Numbers, means: Numbers, covariances: Numbers, space: ParameterSpace) -> None:
        super().__init__(space)
        n = len(space)
        self.means = as_float64("means", means, (None, n))
        k = len(self.means)
        self.covariances = _symmetric(as_float64("covariances", covariances, (k, n, n)))
        self.log_weights = _log_weights(log_weights, k)
        used = self.log_weights > -torch.inf
        if not used.all():
            self.log_weights, self.means = self.log_weights[used], self.means[used]
            self.covariances = self.covariances[used]
        self._cholesky = _cholesky(self.covariances)
        self._known_masses: list[Any] = [None] * len(self.means)

    @cached_property
    def _components(self) -> list[TruncatedNormal]:
        rows = zip(self.means.numpy(), self.covariances.numpy(), self._known_masses, strict=True)
        return [TruncatedNormal(mean, covariance, mass) for mean, covariance, mass in rows]

    def of_masses(self) -> GaussianMixture:
        """The mixture whose draws come from each component as often as the weights say, whatever the cube cuts off."""
        mixture = GaussianMixture(self.log_weights - self.log_masses, self.means, self.covariances, self.space)
        mixture.__dict__["_components"] = self._components  # whose masses and moments are known
        return mixture

    @cached_property
    def log_masses(self) -> Tensor:
        """The log Z_k (K,): the log mass of each untruncated component in the cube."""
        return torch.tensor([c.log_mass for c in self._components], dtype=torch.float64)

    @cached_property
    def log_mass_errors(self) -> Tensor:
        """Relative standard error (K,) of each Z_k: 0 in closed form, aimed at 1e-4 otherwise."""
        return torch.tensor([c.log_mass_error for c in self._components], dtype=torch.float64)

    @cached_property
    def log_normaliser(self) -> Tensor:
        """The log Z, the log mass of the mixture in the cube."""
        log_z = torch.logsumexp(self.log_weights + self.log_masses, 0)
        if not torch.isfinite(log_z):
            raise ValueError("means: expected mass in the cube, but every component is out of reach of it; move them")
        return log_z

    @cached_property
    def probabilities(self) -> Tensor:
        """w_k Z_k / Z (K,): how often a draw comes from each component."""
        return torch.exp(self.log_weights + self.log_masses - self.log_normaliser)

    def _log_terms(self, theta: Tensor) -> Tensor:
        """The log of w_k N(theta; m_k, C_k), (K, n)."""
        deviation = theta.T - self.means[..., None]
        diagonal = self._cholesky.diagonal(dim1=1, dim2=2)
        if self._diagonal:
            white = deviation / diagonal[..., None]
        else:
            white = torch.linalg.solve_triangular(self._cholesky, deviation, upper=False)
        constant = self.log_weights - diagonal.log().sum(1) - len(self.space) / 2 * math.log(2 * math.pi)
        return constant[:, None] - (white**2).sum(1) / 2

    @cached_property
    def _diagonal(self) -> bool:
        return all(c.diagonal for c in self._components)

    def _log_prob(self, theta: Tensor) -> Tensor:
        rows = max(1, self.numbers_at_once // self.means.numel())
        chunks = [torch.logsumexp(self._log_terms(part), 0) for part in theta.split(rows)]
        return torch.cat(chunks) - self.log_normaliser

    def _sample(self, n: int, generator: Generator | None) -> Tensor:
        theta = torch.empty(n, len(self.space), dtype=torch.float64)
        if n == 0:
            return theta
        chosen = torch.multinomial(self.probabilities, n, replacement=True, generator=generator)
        for k in chosen.unique():
            rows = chosen == k
            theta[rows] = torch.from_numpy(self._components[int(k)].sample(int(rows.sum()), generator))
        return theta

    def _moments(self) -> tuple[Tensor, Tensor]:
        moments = [c.moments() for c in self._components]
        means = torch.from_numpy(np.stack([mean for mean, _ in moments]))
        covariances = torch.from_numpy(np.stack([covariance for _, covariance in moments]))
        p = self.probabilities
        mean = p @ means
        deviation = means - mean
        return mean, torch.einsum("k,kij->ij", p, covariances) + deviation.T @ (p[:, None] * deviation)

    def gaussian_moments(self) -> tuple[Tensor, Tensor]:
        """For K = 1 the untruncated Gaussian, exact once restricted to the cube; otherwise moment-matched."""
        return (self.means[0], self.covariances[0]) if len(self.means) == 1 else super().gaussian_moments()

    def _quantile(self, q: Tensor) -> Tensor:
        if not all(c.closed_form for c in self._components):
            return super()._quantile(q)
        if len(self._components) == 1:
            c = self._components[0]
            ends = -c.mean / c.sd, (1 - c.mean) / c.sd
            return torch.from_numpy(np.clip(c.mean + c.sd * interval_quantile(*ends, q.numpy()[:, None]), 0, 1))
        low, high = np.zeros((len(q), len(self.space))), np.ones((len(q), len(self.space)))
        for _ in range(60):
            middle = (low + high) / 2
            below = self._marginal_cdf(middle) < q.numpy()[:, None]
            low, high = np.where(below, middle, low), np.where(below, high, middle)
        return torch.from_numpy((low + high) / 2)

    def _marginal_cdf(self, theta: NDArray[Any]) -> NDArray[Any]:
        """CDF (Q, N) of each closed-form marginal at theta (Q, N)."""
        total = np.zeros_like(theta)
        for p, c in zip(self.probabilities.tolist(), self._components, strict=True):
            a = np.broadcast_to(-c.mean / c.sd, theta.shape)
            mass = log_interval(a, (1 - c.mean) / c.sd)
            total += p * np.exp(log_interval(a, (theta - c.mean) / c.sd) - mass)
        return total

    def _mode(self) -> Tensor:
        starts = self.means.clamp(0.0, 1.0)
        best = self._log_prob(starts).topk(min(self.mode_starts, len(starts))).indices
        candidates = torch.stack([self._climb(k) for k in best.tolist()])
        return candidates[self._log_prob(candidates).argmax()]

    def _climb(self, k: int) -> Tensor:
        share = torch.zeros(len(self.means), dtype=torch.float64)
        share[k] = 1.0
        theta, height = self._bound_maximum(share), -torch.inf
        for _ in range(self.mode_steps if len(self.means) > 1 else 0):
            terms = self._log_terms(theta[None])[:, 0]
            now = float(torch.logsumexp(terms, 0))
            if now <= height + 1e-12:
                break
            theta, height = self._bound_maximum(torch.softmax(terms, 0)), now
        return theta

    def _bound_maximum(self, share: Tensor) -> Tensor:
        """The theta (N,) in the cube that minimises sum_k share_k |W_k (theta - m_k)|^2."""
        used = torch.nonzero(share > 1e-12).flatten().tolist()
        roots = [float(share[k]) ** 0.5 * self._components[k].whitening for k in used]
        matrix = np.concatenate(roots)
        target = np.concatenate([root @ self._components[k].mean for root, k in zip(roots, used, strict=True)])
        if len(used) > 1:
            q, matrix = np.linalg.qr(matrix)
            target = q.T @ target
        solution = lsq_linear(matrix, target, bounds=(0.0, 1.0), method="bvls", tol=1e-14)
        return torch.from_numpy(np.clip(solution.x, 0.0, 1.0))

    def marginal(self, names: Iterable[str]) -> Posterior:
        """A GaussianMixture where that is exact (to 1e-9), otherwise Particles: see the module docstring."""
        columns, space = self._columns(names)
        corrections = [_marginal_correction(c, columns) for c in self._components]
        if any(correction is None for correction in corrections):
            return super().marginal(space.names)
        log_weights = self.log_weights + torch.tensor(corrections, dtype=torch.float64)
        covariances = self.covariances[:, columns][:, :, columns]
        return GaussianMixture(log_weights, self.means[:, columns], covariances, space)

    def _state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        tensors = {"log_weights": self.log_weights, "means": self.means, "covariances": self.covariances}
        return {**tensors, "log_masses": self.log_masses, "log_mass_errors": self.log_mass_errors}, {}

    @classmethod
    def _restore(cls, space: ParameterSpace, tensors: dict[str, Tensor], settings: dict[str, Any]) -> Self:
        new = cls(tensors["log_weights"], tensors["means"], tensors["covariances"], space)
        masses = [as_float64(key, tensors[key], (len(new.means),)) for key in ("log_masses", "log_mass_errors")]
        if not (masses[0] <= _ABOVE_ONE).all():
            raise ValueError(f"log_masses: expected shares of at most 1, got {masses[0].max().exp():.4g}")
        new._known_masses = list(zip(*(mass.tolist() for mass in masses), strict=True))
        return new


def _log_weights(log_weights: Numbers, k: int) -> Tensor:
    tensor = torch.as_tensor(log_weights, dtype=torch.float64).detach()
    if tensor.shape != (k,):
        raise ValueError(
            f"log_weights: expected shape ({k},), one for each mean, got {tuple(tensor.shape)}; reshape it"
        )
    total = torch.logsumexp(tensor, 0)
    if not torch.isfinite(total):
        raise ValueError(
            "log_weights: expected at least one finite and none NaN or +inf; pass logs of positive weights"
        )
    # weights read back from disk are normalised already and must stay the same to the last bit
    return tensor if total.abs() < 1e-12 else tensor - total


def _symmetric(covariances: Tensor) -> Tensor:
    transposed = covariances.transpose(1, 2)
    variances = covariances.diagonal(dim1=1, dim2=2)
    if (variances <= 0).any():
        raise ValueError(f"covariances: expected positive variances, got {variances.min():.3g}; add to the diagonal")
    sd = variances.sqrt()
    if ((covariances - transposed).abs() > 1e-8 * sd[:, :, None] * sd[:, None, :]).any():
        raise ValueError("covariances: expected symmetric matrices, got asymmetric ones; use (C + C.T) / 2")
    return (covariances + transposed) / 2


def _cholesky(covariances: Tensor) -> Tensor:
    factor, failed = torch.linalg.cholesky_ex(covariances)
    if (failed > 0).any():
        k = int(failed.nonzero()[0])
        least = float(torch.linalg.eigvalsh(covariances[k])[0])
        raise ValueError(
            f"covariances: expected positive definite matrices, got smallest eigenvalue {least:.3g} "
            f"in component {k}; add a small number to its diagonal"
        )
    return factor


def _marginal_correction(component: TruncatedNormal, columns: list[int]) -> float | None:
    """What dropping all but ``columns`` adds to a component's log weight; None when it has no closed form."""
    groups = connected_components(component.covariance != 0, directed=False)[1]
    coupled = np.isin(groups, groups[columns])
    dropped = coupled & ~np.isin(np.arange(len(groups)), columns)
    cut = ndtr(-component.mean / component.sd) + ndtr((component.mean - 1) / component.sd)
    if dropped.any() and not cut[dropped].sum() <= _MARGINAL_ERROR * np.exp(component.log_mass):
        return None
    free = ~coupled
    if not free.any():
        return 0.0
    return TruncatedNormal(component.mean[free], component.covariance[np.ix_(free, free)]).log_mass
