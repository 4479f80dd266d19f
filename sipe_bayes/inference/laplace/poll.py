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
_BETWEEN_LENGTHS = 3 * _LENGTHS[2:]  # as well, where the simulation is rough
_SDS = np.array([1.0, 3.0, 10.0])  # along the principal directions
_OPEN = 0.5  # sd beyond which a direction is open
_BETTER, _BETWEEN = 0.5, 1.0  # nats: a difference that counts, and what may lie between two points of one optimum
_LUCK = 3.0  # nats by which an optimum may be better than its nearest neighbours before the simulation may be rough
_SMOOTH = 10.0  # times as much worse, at least, are points ten times farther away in a smooth one (a hundred)


@dataclass(frozen=True)
class Around:
    """better (N,): the best point, if better than the optimum. covariance (N, N): the optimum's, wide enough for every point that fits
    better, or as well with no worse ones in between, or in a simulation that is rough at every scale as well; at least SHORTEST. other (N,): a point that fits as well, but apart."""

    better: FloatArray | None
    covariance: FloatArray
    other: FloatArray | None
    rough: bool = False


def cost(size: int) -> int:
    """Points that ``poll`` may look at in ``size`` dimensions."""
    return 1 + 2 * size * (1 + len(_LENGTHS) + len(_SDS) + len(_BETWEEN_LENGTHS))


def nearest(theta: FloatArray) -> FloatArray:
    """Points (2N, N) of the cube that are as good as theta (N,) itself, unless the simulation is rough."""
    step = SHORTEST * np.eye(len(theta))
    return np.clip(theta + np.concatenate([step, -step]), 0, 1)


def poll(
    energies: Callable[[FloatArray], FloatArray], theta: FloatArray, covariance: FloatArray, level: float = -np.inf
) -> Around:
    """Look around the optimum theta (N,) in the unit cube; energies: -log posterior (B,) of thetas (B, N), infinite where invalid.
    level: the highest of ``nearest``: far above the optimum's, and hardly lower than ten times farther away, it says that the optimum is a stroke of luck
    in a simulation that is rough at every scale; then whatever is no worse than its neighbours counts as fitting as well."""
    size = len(theta)
    variance, principal = np.linalg.eigh(covariance)
    along = np.sqrt(np.clip(variance, 0, _OPEN**2))[:, None] * principal.T
    ways = np.concatenate([k * np.eye(size) for k in _LENGTHS] + [k * along for k in _SDS])
    trials = np.clip(theta + np.concatenate([np.zeros((1, size)), ways, -ways]), 0, 1)
    values = energies(trials)
    best, wide = int(values.argmin()), covariance + SHORTEST**2 * np.eye(size)
    luck, apart = level - values[0], values[_second(size)].max() - values[0]
    rough = luck > max(_LUCK, apart / _SMOOTH)
    luck = luck if rough else 0.0
    if values[best] < values[0] - _BETTER - luck:
        return Around(trials[best], _holding(wide, trials[best] - theta), None)
    level = values[0] + luck
    if rough:
        ways = np.concatenate([k * np.eye(size) for k in _BETWEEN_LENGTHS])
        more = np.clip(theta + np.concatenate([ways, -ways]), 0, 1)
        trials, values = np.concatenate([trials, more]), np.concatenate([values, energies(more)])
    good = trials[values < level + _BETTER] - theta
    distance = np.einsum("bn,bn->b", good, np.linalg.solve(wide, good.T).T)
    good = good[np.argsort(-distance)][: int((distance > 1).sum())]  # the farthest first
    if rough:
        for way in good:
            wide = _holding(wide, way)
        return Around(None, wide, None, rough)
    good = good[:size]
    if not len(good):
        return Around(None, wide, None)
    one = energies(theta + 0.5 * good) < level + _BETWEEN
    for way in good[one]:
        wide = _holding(wide, way)
    apart = good[~one]
    return Around(None, wide, theta + apart[0] if len(apart) else None)


def _second(size: int) -> list[int]:
    """Where in a poll the points are that lie ten times SHORTEST away."""
    half = (len(_LENGTHS) + len(_SDS)) * size
    return [1 + size + k + side for side in (0, half) for k in range(size)]


def _holding(covariance: FloatArray, way: FloatArray) -> FloatArray:
    """The covariance with the way (N,) within one sd."""
    outside = way @ np.linalg.solve(covariance, way) > 1
    return covariance + np.outer(way, way) if outside else covariance
