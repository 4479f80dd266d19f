"""What ``laplace`` asks of a search for optima, and what it gives it.

A ``Strategy`` is a class for one kind of likelihood: ``SegmentSolver`` and ``StateSpaceSearch``.
It is made of a ``SearchProblem`` and the bound logs, writes ``start`` and ``step`` over its own frozen state, and hands
over ``Optimum``s.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Generic, Protocol, Self, TypeVar

import numpy as np
import torch

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.findings import Finding
from sipe_bayes.core.parameters import ParameterSpace
from sipe_bayes.inference.laplace.options import LaplaceOptions
from sipe_bayes.likelihood import FLAT_PRECISION, QuadraticPrior
from sipe_bayes.likelihood.block_tridiagonal import inverse
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

    @property
    def centre(self) -> FloatArray:
        """Mean (N,) of the posterior, before truncation."""
        return self.mean

    @property
    def spread(self) -> FloatArray:
        """Covariance (N, N) of the posterior, before truncation."""
        return self.covariance

    def holds(self, other: Optimum) -> bool:
        """Whether this optimum's normal holds another one well inside it."""
        return self.distance(other) ** 2 < len(self.mean)

    def distance(self, other: Optimum) -> float:
        """How far off another one's mean is, in sds of this one's normal."""
        gap = other.mean - self.mean
        return float(np.sqrt(gap @ np.linalg.solve(self.covariance, gap)))

    def resembles(self, mean: FloatArray, covariance: FloatArray, tolerance: float) -> bool:
        """Whether a normal's mean (N,) is as near, in sds, and its sds in any direction, as logarithms."""
        root = np.linalg.cholesky(self.covariance)
        gap = np.linalg.solve(root, mean - self.mean)
        ratios = np.linalg.eigvalsh(np.linalg.solve(root, np.linalg.solve(root, covariance).T))
        widths = 0.5 * np.log(np.maximum(ratios, 1e-12))
        return bool(np.linalg.norm(gap) < tolerance and np.abs(widths).max() < tolerance)


@dataclass(frozen=True)
class SearchProblem:
    """What every search is given.

    Args:
        space: the parameters.
        prior: over theta.
        seed: of whatever is drawn.
        options: of ``laplace``.
        find: notes a finding.
        tell: called within a long step with what is being done, and the rollouts so far.
    """

    space: ParameterSpace
    prior: Posterior
    seed: int
    options: LaplaceOptions
    find: Callable[[Finding], None]
    tell: Callable[[str, int], None] = lambda what, rollouts: None

    @cached_property
    def quadratic_prior(self) -> QuadraticPrior:
        """The prior's normal, before truncation."""
        return QuadraticPrior.of(self.prior)

    def normal(self, theta: FloatArray, precision: FloatArray, gradient: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean (N,) and covariance (N, N) of the posterior's normal, before truncation.

        At theta (N,), of precision (N, N) and downhill gradient (N,) of the data alone.
        """
        prior = self.quadratic_prior
        covariance = inverse(precision + prior.precision + FLAT_PRECISION * np.eye(len(theta)))[0]
        pull = gradient + prior.pull(theta) + FLAT_PRECISION * (0.5 - theta)
        return theta + covariance @ pull, 0.5 * (covariance + covariance.T)


class Stepping(Protocol):
    """Where the search from one starting point stands."""

    @property
    def iteration(self) -> int:
        """Steps until now."""


P = TypeVar("P", bound=Stepping)


@dataclass(frozen=True)
class StrategyState(Generic[P]):
    """The state of a strategy, which follows one starting point after the other.

    Args:
        points: (R, N), starting points.
        point: which of them is followed.
        here: where that stands.
        optima: those recorded.
        done: whether the last point has been followed to its end.
    """

    points: FloatArray
    point: int
    here: P
    optima: tuple[Optimum, ...] = ()
    done: bool = False

    def describe(self) -> str:
        """Starting point and step, for the progress bar."""
        of = f" of at least {len(self.points)}" * (len(self.points) > 1)  # the search may come upon more
        return f"start {self.point + 1}{of}, step {self.here.iteration}"

    def at(self, here: P) -> Self:
        """The search at another position."""
        return replace(self, here=here)

    def next_point(self, begin: Callable[[FloatArray], P]) -> Self:
        """At the next starting point (N,), from which the search begins as ``begin`` says; or done."""
        point = self.point + 1
        if point >= len(self.points):
            return replace(self, done=True)
        return replace(self, point=point, here=begin(self.points[point]))


S = TypeVar("S", bound=StrategyState[Any])


class Strategy(Protocol[S]):
    """A search for the optima of one kind of likelihood, step by step over a frozen state S."""

    @property
    def step_rollouts(self) -> int:
        """Rollouts that a step takes, for the message where the budget allows none."""

    def start(self) -> S:
        """The first state; may simulate."""

    def step(self, state: S) -> S:
        """One affordable piece of work further; ``done`` ends the search, BudgetExhausted keeps the state."""


def distinct(optima: Sequence[Optimum]) -> list[Optimum]:
    """The optima worth keeping, best first, not the same twice; ten nats below the best their weight is nothing."""
    kept: list[Optimum] = []
    for one in sorted(optima, key=lambda optimum: -optimum.evidence):
        if not kept or (one.evidence >= kept[0].evidence - 10 and not any(best.holds(one) for best in kept)):
            kept.append(one)
    return kept


def mixture(optima: Sequence[Optimum], space: ParameterSpace) -> GaussianMixture:
    """The optima's normals truncated to the cube, weighted by their evidence."""
    evidence = np.array([one.evidence for one in optima])
    weights = torch.from_numpy(evidence - evidence.max())
    means, covariances = np.stack([o.centre for o in optima]), np.stack([o.spread for o in optima])
    return GaussianMixture(weights, means, covariances, space)
