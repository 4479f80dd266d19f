"""A point estimate: all probability at one theta. What regression and meta-learning return.

Dirac(theta) has mean, mode and every quantile equal to theta and no spread; proper scores such as CRPS reduce
to its absolute error, so it stands on one axis with real posteriors.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, ClassVar, Self

import torch
from torch import Generator, Tensor

from sipe_bayes.core.parameters import ParameterSpace
from sipe_bayes.posterior.base import Numbers, Posterior, as_theta, check_bandwidth
from sipe_bayes.posterior.mixture import GaussianMixture


class Dirac(Posterior):
    """All probability at ``theta`` (N,). It has no density: ``log_prob`` raises NoDensityError."""

    has_density: ClassVar[bool] = False

    def __init__(self, theta: Numbers, space: ParameterSpace) -> None:
        super().__init__(space)
        self.theta = as_theta("theta", theta, (len(space),))

    def smoothed(self, bandwidth: float) -> GaussianMixture:
        """One Gaussian of sd ``bandwidth`` (theta units) around theta, truncated to the cube."""
        covariance = check_bandwidth(bandwidth) ** 2 * torch.eye(len(self.space), dtype=torch.float64)
        return GaussianMixture(torch.zeros(1), self.theta[None], covariance[None], self.space)

    def marginal(self, names: Iterable[str]) -> Dirac:
        """The same point in fewer parameters."""
        columns, space = self._columns(names)
        return Dirac(self.theta[columns], space)

    def _sample(self, n: int, generator: Generator | None) -> Tensor:
        return self.theta.repeat(n, 1)

    def _moments(self) -> tuple[Tensor, Tensor]:
        return self.theta, torch.zeros(len(self.space), len(self.space), dtype=torch.float64)

    def _quantile(self, q: Tensor) -> Tensor:
        return self.theta.repeat(len(q), 1)

    def _mode(self) -> Tensor:
        return self.theta

    def _state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        return {"theta": self.theta}, {}

    @classmethod
    def _restore(cls, space: ParameterSpace, tensors: dict[str, Tensor], settings: dict[str, Any]) -> Self:
        return cls(tensors["theta"], space)
