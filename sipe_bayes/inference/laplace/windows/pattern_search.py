"""A look around an optimum, at points rather than by slopes.

V. Torczon 1997, "On the convergence of pattern search algorithms", SIAM J. Optim. 7. Contact bends a simulation at
every scale, and a linearisation sees neither a valley that is narrower than its step nor a plain that begins beside it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.options import Options, option

SHORTEST = 1e-6  # of the cube: the way over which an optimum's neighbours are as good in a smooth simulation
_LENGTHS = 10.0 ** np.arange(-5, 0)  # of the cube, along the axes: powers of ten beyond SHORTEST


@dataclass(frozen=True)
class PatternTuning(Options):
    """What a pattern search looks at, and what it makes of it."""

    sds: tuple[float, ...] = option((1.0, 3.0, 10.0), "distances along the principal directions", "sd")
    between: float = option(
        3.0, "further points where the simulation is rough, between powers of ten", above=1, below=10
    )
    open_sd: float = option(0.5, "sd from which a direction counts as open, and is cut", "of the cube", above=0)
    better: float = option(0.5, "a difference that counts", "nats", above=0)
    deepest: float = option(4.5, "fall of points that the normal is held against: three of its sds", "nats", above=0.5)
    believed: float = option(2.0, "fall that the normal foretells, over theirs, with which it stands", above=1)
    saddle: float = option(1.0, "how much worse points between two of one optimum may be", "nats", above=0)
    smooth: float = option(3.0, "distance up to which a simulation is looked at for being smooth", "sd", above=0)
    least_rise: float = option(0.6, "a rise, over that of the normal, with which it is", above=0, below=1)
    most_rise: float = option(2.0, "the same above", above=1)
    excluded: float = option(6.0, "rise with which a place hardly counts, however far it is", "nats", above=0)
    luck: float = option(3.0, "how much worse the nearest neighbours may be in a smooth simulation", "nats", above=0)
    growth: float = option(10.0, "how much worse still, at least, points ten times farther are there", above=1)


@dataclass(frozen=True)
class Surroundings:
    """What is around an optimum.

    Args:
        better: (N,), the best point, if better than the optimum.
        covariance: (N, N), the optimum's, at least ``SHORTEST`` and wide enough for every point that fits better, or as
            well with no worse ones in between, or as well in a simulation that is rough at every scale; and for points
            that fall by far less than the normal foretells, as a difference across a jump is no slope.
        other: (N,), a point that fits as well, but apart.
        rough: whether the simulation is rough at every scale.
        heavier: whether places that the normal all but excludes fit nearly as well.
    """

    better: FloatArray | None
    covariance: FloatArray
    other: FloatArray | None
    rough: bool = False
    heavier: bool = False


def pattern_size(size: int, tuning: PatternTuning) -> int:
    """Points that ``pattern_search`` looks at in ``size`` dimensions, at most."""
    return 1 + 2 * size * (1 + len(_LENGTHS) + len(tuning.sds) + len(_LENGTHS) - 1)


def nearest_points(theta: FloatArray) -> FloatArray:
    """Points (2N, N) of the cube that are as good as theta (N,) itself, unless the simulation is rough."""
    step = SHORTEST * np.eye(len(theta))
    return np.clip(theta + np.concatenate([step, -step]), 0, 1)


def pattern_search(
    energies: Callable[[FloatArray], FloatArray],
    theta: FloatArray,
    covariance: FloatArray,
    tuning: PatternTuning,
    level: float = -np.inf,
) -> Surroundings:
    """Look around an optimum in the unit cube.

    Args:
        energies: -log posterior (B,) of thetas (B, N), infinite where invalid.
        theta: (N,), the optimum.
        covariance: (N, N), of its normal.
        tuning: distances and what differences mean.
        level: the highest energy of ``nearest_points``. Far above the optimum's, and hardly lower than ten times
            farther away, it says that the optimum is a stroke of luck in a simulation that is rough at every scale;
            then whatever is no worse than its neighbours counts as fitting as well.
    """
    size = len(theta)
    variance, principal = np.linalg.eigh(covariance)
    along = np.sqrt(np.clip(variance, 0, tuning.open_sd**2))[:, None] * principal.T
    ways = np.concatenate([k * along for k in tuning.sds])
    trials = np.clip(theta + np.concatenate([np.zeros((1, size)), ways, -ways]), 0, 1)
    values = energies(trials)
    lengths, wide = _LENGTHS, covariance + SHORTEST**2 * np.eye(size)
    luck = level - values[0]
    if luck <= tuning.luck and values.min() < values[0] - tuning.better:
        lengths = _LENGTHS[:0]  # the search goes on from a better one
    elif luck <= tuning.luck and _smooth(trials - theta, values, wide, tuning):
        lengths = _LENGTHS[tuning.smooth * np.sqrt(variance[-1]) < _LENGTHS]
    ways = np.kron(lengths[:, None], np.eye(size))
    further = np.clip(theta + np.concatenate([ways, -ways]), 0, 1)
    rough = False
    if len(further):
        apart = energies(further)
        # is the optimum better than its neighbours by more than a smooth simulation allows?
        tenfold = np.abs(further - theta).sum(1) < 1.5 * _LENGTHS[0]
        rough = luck > max(tuning.luck, (apart[tenfold].max(initial=-np.inf) - values[0]) / tuning.growth)
        trials, values = np.concatenate([trials, further]), np.concatenate([values, apart])
    best = int(values.argmin())
    luck = luck if rough else 0.0
    if values[best] < values[0] - tuning.better - luck:
        return Surroundings(trials[best], _holding(wide, trials[best] - theta), None)
    level = values[0] + luck
    if rough:
        ways = np.concatenate([k * np.eye(size) for k in tuning.between * _LENGTHS[1:]])
        more = np.clip(theta + np.concatenate([ways, -ways]), 0, 1)
        trials, values = np.concatenate([trials, more]), np.concatenate([values, energies(more)])
    # where along each way one sd would be, if its end falls as a normal does; those farthest outside first
    fall = np.maximum(values - level, tuning.better)
    ways = (trials - theta) / np.sqrt(fall / tuning.better)[:, None]
    distance = np.einsum("bn,bn->b", ways, np.linalg.solve(wide, ways.T).T)
    as_good = fall <= tuning.better
    outside = np.where(as_good, distance > 1, (distance > tuning.believed) & (fall <= tuning.deepest) & (not rough))
    chosen = np.flatnonzero(outside)[np.argsort(-distance[outside])]
    if rough:
        for way in ways[chosen]:
            wide = _holding(wide, way)
        return Surroundings(None, wide, None, rough)
    chosen = chosen[:size]
    # half-way points say whether it is one optimum
    half_way = energies(theta + 0.5 * (trials[chosen] - theta)) if len(chosen) else np.zeros(0)
    one = half_way < level + np.maximum(tuning.saddle, fall[chosen])
    for way in ways[chosen[one]]:
        wide = _holding(wide, way)
    others = trials[chosen[~one & as_good[chosen]]]
    due = np.minimum(_foretold(trials - theta, wide), tuning.excluded)
    heavier = bool((values - values[0] + tuning.better < tuning.least_rise * (due + tuning.better)).any())
    return Surroundings(None, wide, others[0] if len(others) else None, heavier=heavier)


def _smooth(ways: FloatArray, values: FloatArray, covariance: FloatArray, tuning: PatternTuning) -> bool:
    """Whether energies (B,) rise as the normal says along ways (B, N) within a few sds, the first of them nothing."""
    foretold = _foretold(ways, covariance)
    near = foretold <= 0.5 * (1.01 * tuning.smooth) ** 2
    ratio = (values[near] - values[0] + tuning.better) / (foretold[near] + tuning.better)
    return bool((ratio > tuning.least_rise).all() and (ratio < tuning.most_rise).all())


def _foretold(ways: FloatArray, covariance: FloatArray) -> FloatArray:
    """How far the normal says that energies (B,) rise along ways (B, N)."""
    return np.asarray(0.5 * np.einsum("bn,bn->b", ways, np.linalg.solve(covariance, ways.T).T))


def _holding(covariance: FloatArray, way: FloatArray) -> FloatArray:
    """The covariance (N, N) with the way (N,) within one sd."""
    outside = way @ np.linalg.solve(covariance, way) > 1
    return covariance + np.outer(way, way) if outside else covariance
