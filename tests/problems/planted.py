"""Estimators that are wrong on purpose."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.inference.laplace import Laplace
from sipe_bayes.inference.laplace.estimator import LaplaceState
from sipe_bayes.posterior import GaussianMixture, Posterior


@dataclass(frozen=True)
class Ended:
    """A state of a method that has nothing to remember."""

    done: bool


class Planted(Laplace):
    """Laplace's normals, ``width`` times as wide."""

    width: ClassVar[float]

    def posterior(self, state: LaplaceState, trajectories: Trajectories) -> Posterior:
        found = super().posterior(state, trajectories)
        assert isinstance(found, GaussianMixture)
        return GaussianMixture(found.log_weights, found.means, self.width**2 * found.covariances, found.space)


class Half(Planted):
    width = 0.5


class Twice(Planted):
    width = 2.0
