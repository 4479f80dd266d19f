"""Several posteriors in equal parts: what an ensemble of trained networks answers.

    p(theta) = (1 / K) sum_k p_k(theta).

B. Lakshminarayanan, A. Pritzel, C. Blundell 2017, "Simple and Scalable Predictive Uncertainty Estimation using Deep
Ensembles" (https://arxiv.org/abs/1612.01474); J. Hermans et al. 2022, "A Trust Crisis In Simulation-Based Inference?
Your Posterior Approximations Can Be Unfaithful" (https://arxiv.org/abs/2110.06581), for posteriors: where the networks
disagree, their mixture is wider than any of them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Self

import torch
from torch import Generator, Tensor

from sipe_bayes.core.parameters import ParameterSpace
from sipe_bayes.posterior.base import Posterior


class Averaged(Posterior):
    """A mixture of K posteriors of one space in equal parts; each of them has a density.

    Args:
        members: K of them.
    """

    def __init__(self, members: Sequence[Posterior]) -> None:
        if not members:
            raise ValueError("members: expected at least one posterior, got none")
        bare = [type(member).__name__ for member in members if not member.has_density]
        if bare:
            raise ValueError(f"members: expected posteriors with a density, got {bare[0]}; use .smoothed(...)")
        names = [member.space.names for member in members]
        if len(set(names)) > 1:
            raise ValueError(f"members: expected the same parameters, got {list(names[0])} and {list(names[-1])}")
        super().__init__(members[0].space)
        self.members = tuple(members)

    def _sample(self, n: int, generator: Generator | None) -> Tensor:
        chosen = torch.randint(len(self.members), (n,), generator=generator)
        theta = torch.empty(n, len(self.space), dtype=torch.float64)
        for k, member in enumerate(self.members):
            mine = chosen == k
            theta[mine] = member._sample(int(mine.sum()), generator)
        return theta

    def _log_prob(self, theta: Tensor) -> Tensor:
        each = torch.stack([member._log_prob(theta) for member in self.members])
        return each.logsumexp(0) - math.log(len(self.members))

    def _moments(self) -> tuple[Tensor, Tensor]:
        means = torch.stack([member.mean for member in self.members])
        within = torch.stack([member.covariance for member in self.members]).mean(0)
        apart = means - means.mean(0)
        return means.mean(0), within + apart.T @ apart / len(means)

    def _mode(self) -> Tensor:
        """The best of the members' modes and of the reference draws: modes that overlap have their best in between."""
        candidates = torch.cat([torch.stack([member.mode for member in self.members]), self._reference])
        return candidates[self._log_prob(candidates).argmax()]

    def _state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        tensors: dict[str, Tensor] = {}
        settings: dict[str, Any] = {}
        for k, member in enumerate(self.members):
            own, plain = member._state()
            tensors |= {f"member{k}.{name}": tensor for name, tensor in own.items()}
            settings[f"member{k}"] = {"family": type(member).__name__, "settings": plain}
        return tensors, settings

    @classmethod
    def _restore(cls, space: ParameterSpace, tensors: dict[str, Tensor], settings: dict[str, Any]) -> Self:
        return cls([settings[f"member{k}"] for k in range(len(settings))])
