"""Independent parameters, each uniform or normal, restricted to [0, 1]: what is believed before any log is seen.

p(theta) = prod_j N(theta_j; m_j, s_j^2) / [Phi((1 - m_j) / s_j) - Phi(-m_j / s_j)]; s_j = inf is the uniform
density 1.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import cached_property
from typing import Any, Self

import numpy as np
import torch
from torch import Generator, Tensor

from sipe_bayes.core.parameters import ParameterSpace
from sipe_bayes.posterior.base import Numbers, Posterior, as_float64
from sipe_bayes.posterior.truncated_normal import interval_moments, interval_quantile, log_interval

_FLAT_SD = 1e3  # of the normal that stands for a uniform density: flat within the cube to 1e-7


class IndependentPrior(Posterior):
    """A product of truncated normals; ``mean`` (N,) and ``sd`` (N,) before truncation, sd = inf uniform."""

    def __init__(self, mean: Numbers, sd: Numbers, space: ParameterSpace) -> None:
        super().__init__(space)
        self.normal_mean = as_float64("mean", mean, (len(space),))
        sd = torch.as_tensor(sd, dtype=torch.float64)
        if sd.shape != (len(space),) or not (sd > 0).all():
            raise ValueError(f"sd: expected {len(space)} positive numbers, got {sd.tolist()}; inf means uniform")
        self.normal_sd = sd

    @cached_property
    def _flat(self) -> Tensor:
        return torch.isinf(self.normal_sd)

    @cached_property
    def _limits(self) -> tuple[np.ndarray, np.ndarray]:
        mean, sd = self.normal_mean, torch.where(self._flat, 1.0, self.normal_sd)
        return (-mean / sd).numpy(), ((1 - mean) / sd).numpy()

    @cached_property
    def _log_normaliser(self) -> Tensor:
        log_mass = torch.from_numpy(log_interval(*self._limits))
        normal = log_mass + self.normal_sd.log() + math.log(2 * math.pi) / 2
        return torch.where(self._flat, 0.0, normal).sum()

    def _log_prob(self, theta: Tensor) -> Tensor:
        return -(((theta - self.normal_mean) / self.normal_sd) ** 2).sum(-1) / 2 - self._log_normaliser

    def _quantile(self, q: Tensor) -> Tensor:
        return self.inverse(q[:, None].expand(-1, len(self.space)))

    def inverse(self, q: Tensor) -> Tensor:
        """Quantiles theta (n, N) at levels q (n, N), one level for each parameter."""
        normal = self.normal_mean + self.normal_sd * torch.from_numpy(interval_quantile(*self._limits, q.numpy()))
        return torch.where(self._flat, q, normal).clamp(0.0, 1.0)

    def _sample(self, n: int, generator: Generator | None) -> Tensor:
        return self.inverse(torch.rand(n, len(self.space), dtype=torch.float64, generator=generator))

    def _moments(self) -> tuple[Tensor, Tensor]:
        zero = np.zeros(len(self.space))
        mean, variance = interval_moments(zero, zero + 1, self.normal_mean.numpy(), self.normal_sd.numpy())
        return torch.from_numpy(mean), torch.diag(torch.from_numpy(variance))

    def gaussian_moments(self) -> tuple[Tensor, Tensor]:
        """The normals before truncation, exact once restricted to the cube; uniform as sd 1000 (1e-7)."""
        return self.normal_mean, torch.diag(self.normal_sd.clamp_max(_FLAT_SD) ** 2)

    def _mode(self) -> Tensor:
        """Clipped mean; the centre where every value is equally probable."""
        return torch.where(self._flat, 0.5, self.normal_mean.clamp(0.0, 1.0))

    def marginal(self, names: Iterable[str]) -> IndependentPrior:
        """The same normals for fewer parameters; exact."""
        columns, space = self._columns(names)
        return IndependentPrior(self.normal_mean[columns], self.normal_sd[columns], space)

    def _state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        return {"mean": self.normal_mean, "sd": self.normal_sd}, {}

    @classmethod
    def _restore(cls, space: ParameterSpace, tensors: dict[str, Tensor], settings: dict[str, Any]) -> Self:
        return cls(tensors["mean"], tensors["sd"], space)


def prior(space: ParameterSpace) -> IndependentPrior:
    """What the parameters' ``prior_mean`` and ``prior_sd`` say; uniform in theta where they say nothing."""
    pairs = [parameter.theta_prior for parameter in space]
    return IndependentPrior([mean for mean, _ in pairs], [sd for _, sd in pairs], space)


def uniform(space: ParameterSpace) -> IndependentPrior:
    """The uniform distribution over the cube, whatever the parameters' own priors."""
    return IndependentPrior([0.5] * len(space), [math.inf] * len(space), space)
