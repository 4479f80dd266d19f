"""A look around an optimum, at points rather than by slopes.

V. Torczon 1997, "On the convergence of pattern search algorithms", SIAM J. Optim. 7. Contact bends a simulation at every scale, and a
linearisation sees neither a valley that is narrower than its step nor a plain that begins beside it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

SHORTEST = 1e-6  # of the cube
_LENGTHS = 10.0 ** np.arange(-6, 0)  # along the axes, of the cube
_SDS = np.array([1.0, 3.0, 10.0])  # along the principal directions
_OPEN = 0.5  # sd beyond which a direction is open
_BETTER, _BETWEEN = 0.5, 1.0  # nats: a difference that counts, and what may lie between two points of one optimum


@dataclass(frozen=True)
class Around:
    """better (N,): the best point, if better than the optimum. covariance (N, N): the optimum's, wide enough for every point that fits
    better, or as well with no worse ones in between; at least SHORTEST. other (N,): a point that fits as well, but apart."""

    better: FloatArray | None
    covariance: FloatArray
    other: FloatArray | None


def cost(size: int) -> int:
    """Points that ``poll`` may look at in ``size`` dimensions."""
    return 1 + 2 * size * (len(_LENGTHS) + len(_SDS)) + size


def poll(energies: Callable[[FloatArray], FloatArray], theta: FloatArray, covariance: FloatArray) -> Around:
    """Look around the optimum theta (N,) in the unit cube; energies: -log posterior (B,) of thetas (B, N), infinite where invalid."""
    size = len(theta)
    variance, principal = np.linalg.eigh(covariance)
    along = np.sqrt(np.clip(variance, 0, _OPEN**2))[:, None] * principal.T
    ways = np.concatenate([k * np.eye(size) for k in _LENGTHS] + [k * along for k in _SDS])
    trials = np.clip(theta + np.concatenate([np.zeros((1, size)), ways, -ways]), 0, 1)
    values = energies(trials)
    best, wide = int(values.argmin()), covariance + SHORTEST**2 * np.eye(size)
    if values[best] < values[0] - _BETTER:
        return Around(trials[best], _holding(wide, trials[best] - theta), None)
    good = trials[values < values[0] + _BETTER] - theta
    distance = np.einsum("bn,bn->b", good, np.linalg.solve(wide, good.T).T)
    good = good[np.argsort(-distance)][:size][: int((distance > 1).sum())]  # the farthest
    if not len(good):
        return Around(None, wide, None)
    one = energies(theta + 0.5 * good) < values[0] + _BETWEEN
    for way in good[one]:
        wide = _holding(wide, way)
    apart = good[~one]
    return Around(None, wide, theta + apart[0] if len(apart) else None)


def _holding(covariance: FloatArray, way: FloatArray) -> FloatArray:
    """The covariance with the way (N,) within one sd."""
    outside = way @ np.linalg.solve(covariance, way) > 1
    return covariance + np.outer(way, way) if outside else covariance
