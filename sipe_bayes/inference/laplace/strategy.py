"""What ``laplace`` asks of a search for optima, and what it gives it.

A ``Strategy`` is a class for one kind of likelihood: ``WindowSearch`` (windows of the logs), ``StateSpaceSearch``
(every sample's state is unknown) and ``KnownStartSearch`` (the first states are known). It is made of a
``SearchProblem`` and of the logs bound to their likelihood, writes ``start`` and ``step`` over its own frozen state,
and hands over ``Optimum``s.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol, Self, TypeVar

import numpy as np
import torch

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.checkpoint import SearchState
from sipe_bayes.core.findings import Finding
from sipe_bayes.core.parameters import ParameterSpace
from sipe_bayes.inference.laplace.options import LaplaceOptions
from sipe_bayes.likelihood.block_tridiagonal import inverse
from sipe_bayes.likelihood.quadratic_prior import FLAT_PRECISION, QuadraticPrior
from sipe_bayes.posterior import GaussianMixture, Posterior


@dataclass(frozen=True)
class Optimum:
    """Where a search ended: the quadratic model of the posterior there, and the noise.

    Args:
        theta: (N,), within the cube.
        mean: (N,), of the normal before truncation; beyond the bound at which theta sits.
        covariance: (N, N), before truncation.
        evidence: log of what the posterior's mass there is, up to a constant.
        sd: (C,), of the measurement noise in the channels' units.
        tau: (C,), its correlation time in seconds; zero where white.
    """

    theta: FloatArray
    mean: FloatArray
    covariance: FloatArray
    evidence: float
    sd: FloatArray
    tau: FloatArray

    def holds(self, other: Optimum) -> bool:
        """Whether this optimum's normal holds another one well inside it."""
        gap = other.mean - self.mean
        return bool(gap @ np.linalg.solve(self.covariance, gap) < len(gap))


@dataclass(frozen=True)
class SearchProblem:
    """What every search is given.

    Args:
        space: the parameters.
        prior: over theta.
        seed: of whatever is drawn.
        options: of ``laplace``.
        initial: (R, N), starting points; None where the search looks for them.
        find: notes a finding.
    """

    space: ParameterSpace
    prior: Posterior
    seed: int
    options: LaplaceOptions
    initial: FloatArray | None
    find: Callable[[Finding], None]

    def within(self, initial: FloatArray) -> Self:
        """The same problem from other starting points (R, N), a part of a search that notes no findings."""
        return replace(self, initial=initial, find=lambda _: None)

    @cached_property
    def quadratic_prior(self) -> QuadraticPrior:
        """The prior's normal, before truncation."""
        return QuadraticPrior.of(self.prior)

    def normal(self, theta: FloatArray, precision: FloatArray, gradient: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The quadratic model of data and prior.

        Args:
            theta: (N,), where it is taken.
            precision: (N, N), of the data alone.
            gradient: (N,), downhill, of the data alone.

        Returns:
            Mean (N,) and covariance (N, N) of the normal, before truncation.
        """
        prior = self.quadratic_prior
        covariance = inverse(precision + prior.precision + FLAT_PRECISION * np.eye(len(theta)))[0]
        pull = gradient + prior.pull(theta) + FLAT_PRECISION * (0.5 - theta)
        return theta + covariance @ pull, 0.5 * (covariance + covariance.T)


class StrategyState(SearchState, Protocol):
    """The state of a strategy: a frozen dataclass that ``core.checkpoint`` takes."""

    @property
    def optima(self) -> Sequence[Optimum]:
        """Those recorded until now."""

    def describe(self) -> str:
        """What is being done, for the progress bar."""


S = TypeVar("S", bound=StrategyState)


class Strategy(Protocol[S]):
    """A search for the optima of one kind of likelihood, step by step over a frozen state S."""

    @property
    def step_rollouts(self) -> int:
        """Rollouts that a step takes, for the message where the budget allows none."""

    def start(self) -> S:
        """The first state; may simulate."""

    def step(self, state: S) -> S:
        """One affordable piece of work further; a state that is ``done`` ends the search.

        Raises:
            BudgetExhausted: the state that went in is kept.
        """


def distinct(optima: Sequence[Optimum], drop: float = 10.0) -> list[int]:
    """Places of the optima worth keeping, best first, and not the same twice.

    Args:
        optima: of a search.
        drop: nats below the best one at most; below it an optimum's weight is nothing.
    """
    if not optima:
        return []
    evidence = np.array([one.evidence for one in optima])
    order = np.argsort(-evidence, kind="stable")
    kept: list[int] = []
    for m in map(int, order):
        if evidence[m] < evidence[order[0]] - drop:
            continue
        if not any(optima[k].holds(optima[m]) for k in kept):
            kept.append(m)
    return kept


def mixture(optima: Sequence[Optimum], space: ParameterSpace) -> GaussianMixture:
    """The optima's normals truncated to the cube, weighted by their evidence."""
    evidence = np.array([one.evidence for one in optima])
    weights = torch.from_numpy(evidence - evidence.max())
    means, covariances = np.stack([o.mean for o in optima]), np.stack([o.covariance for o in optima])
    return GaussianMixture(weights, means, covariances, space)
