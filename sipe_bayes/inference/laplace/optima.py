"""What a search for optima needs of ``laplace``, and the optima in its state: which are the same, and which are worth keeping."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sipe_bayes.core.checkpoint import State
from sipe_bayes.core.parameters import ParameterSpace
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.inference.laplace.least_squares import QuadraticPrior
from sipe_bayes.posterior import Posterior

FloatArray = NDArray[np.float64]

_DROP = 10.0  # nats below the best optimum
_NEAR = 0.1  # of the way to a known optimum


class Search(Protocol):
    """What is needed of ``Laplace``."""

    space: ParameterSpace
    prior: Posterior
    seed: int
    restarts: int
    candidates: int
    initial: FloatArray | None

    @property
    def quadratic_prior(self) -> QuadraticPrior: ...

    def posterior(self, state: State, trajectories: Trajectories) -> Posterior:
        """Of the optima in a state."""

    def warn(self, sentence: str | None) -> None: ...

    def normal(self, theta: FloatArray, precision: FloatArray, gradient: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean and covariance of the quadratic model of data and prior at theta."""


def distinct_modes(state: State) -> list[int]:
    """Optima worth keeping, best first: within ``_DROP`` nats of the best, and not the same point twice."""
    order = np.argsort(-state["mode_evidence"], kind="stable")
    kept: list[int] = []
    for m in order:
        if state["mode_evidence"][m] < state["mode_evidence"][order[0]] - _DROP:
            continue
        if not any(_close(state, int(m), k) for k in kept):
            kept.append(int(m))
    return kept


def known(state: State) -> bool:
    """Whether the search has come to one of the optima found earlier: in each principal direction of its normal within
    one sd, or within a tenth of the way that it had to come."""
    begin = state["points"][state["point"]]
    for mean, covariance in zip(state["mode_mean"], state["mode_covariance"], strict=True):
        eigenvalues, axes = np.linalg.eigh(covariance)
        sd = np.sqrt(eigenvalues)
        left, whole = np.abs((state["theta"] - mean) @ axes) / sd, np.abs((begin - mean) @ axes) / sd
        if (left < np.maximum(1.0, _NEAR * whole)).all():
            return True
    return False


def _close(state: State, a: int, b: int) -> bool:
    """Whether optimum b's normal holds optimum a well inside it."""
    gap = state["mode_mean"][a] - state["mode_mean"][b]
    return bool(gap @ np.linalg.solve(state["mode_covariance"][b], gap) < len(gap))
