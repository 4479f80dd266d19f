"""Where a posterior reaches further than its normal: sides on which a parameter changes little or nothing.

A friction below that of the floor does nothing, since MuJoCo takes the larger of the two; a stop that is not reached
may lie anywhere beyond. An optimum at such an edge has a normal whose width is that of the steep side, and draws from
it never come to where the posterior goes on. So points further off are looked at, along each parameter alone and along
its direction with the others following: where the log posterior has fallen by less than it should, and what lies there
would count, twice as far again, up to the bound.

Each stretch that is found is the middle of a normal to draw from: as long as it, and across it as wide as the first
normal is for a given place along it. Where several parameters alone have one, one more has them all.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.inference.importance import ImportanceTuning, Target


class StretchTuning:
    """How far a posterior is looked at beyond its normal, and what counts."""

    far: ClassVar[float] = 8.0  # sds, the first points; where the density holds on, twice as far again
    unseen: ClassVar[float] = 0.01  # of the normal's mass, which a stretch has to have to count
    most: ClassVar[int] = 6  # stretches drawn from

    def least_worth(self, length: FloatArray) -> FloatArray:
        """Falls (...), in nats, below which what lies along lengths (...), in sds, counts."""
        return np.asarray(np.log(np.maximum(length, 1.0) / (np.sqrt(2 * np.pi) * self.unseen)))


@dataclass(frozen=True)
class Stretch:
    """One of them.

    Args:
        start: (N,), the middle of the normal, or the optimum where that lies outside the cube.
        end: (N,), the furthest point along it at which the density was too large.
        fall: nats by which the log density is lower there than at the start.
        distance: sds of the normal from start to end.
        parameter: which parameter alone changes along it; None where several do.
    """

    start: FloatArray
    end: FloatArray
    fall: float
    distance: float
    parameter: int | None


def look_size(size: int) -> int:
    """Points that ``stretches`` looks at in ``size`` dimensions where there is none."""
    return 1 + 4 * size


def stretches(
    target: Target,
    theta: FloatArray,
    mean: FloatArray,
    covariance: FloatArray,
    tuning: StretchTuning,
) -> list[Stretch]:
    """Those beyond N(mean, covariance) of a log density with its optimum in the cube at theta (N,); most mass first."""
    start = mean if ((mean >= 0) & (mean <= 1)).all() else theta
    level = float(target(start[None])[0])
    if not np.isfinite(level):
        start, level = theta, float(target(theta[None])[0])
    precision, n = np.linalg.inv(covariance), len(theta)
    ways = np.diag(np.diag(precision) ** -0.5)
    if n > 1:  # else both are one
        ways = np.concatenate([ways, (covariance / np.sqrt(np.diag(covariance))).T])
    ways = np.concatenate([ways, -ways])  # one sd each
    room = np.where(ways > 0, 1 - start, start) / np.maximum(np.abs(ways), 1e-300)
    most = room.min(1)
    by_way: dict[int, Stretch] = {}
    centre = start - mean
    open_ways, length = np.flatnonzero(most > 1.0), tuning.far  # nearer bounds leave no room for a stretch
    while len(open_ways):
        reached = np.minimum(length, most[open_ways])
        points = np.clip(start + reached[:, None] * ways[open_ways], 0.0, 1.0)
        falls, gaps = level - target(points), points - mean
        foretold = 0.5 * (np.einsum("bi,ij,bj->b", gaps, precision, gaps) - centre @ precision @ centre)
        small = falls + ImportanceTuning.slack < ImportanceTuning.least_fall * (foretold + ImportanceTuning.slack)
        small &= falls < tuning.least_worth(most[open_ways])
        for k in np.flatnonzero(small & (falls < tuning.least_worth(reached))):
            way = int(open_ways[k])
            parameter = way % (len(ways) // 2) if way % (len(ways) // 2) < n else None
            by_way[way] = Stretch(start, points[k], float(falls[k]), float(reached[k]), parameter)
        open_ways = open_ways[small & (most[open_ways] > length)]
        length = 2 * length
    ordered = sorted(by_way.values(), key=lambda one: one.fall - np.log(one.distance))
    return ordered[: tuning.most]


def proposals(beyond: list[Stretch], covariance: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
    """Means (N,) and covariances (N, N) of normals to draw from: one for each stretch, and one for all."""
    alone = [one for one in beyond if one.parameter is not None]
    groups = [[one] for one in beyond] + ([alone] if len({one.parameter for one in alone}) > 1 else [])
    return [_proposal(group, covariance) for group in groups]


def _proposal(group: list[Stretch], covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Over the stretches at once: their middle, and the normal's width in what is left of the directions."""
    sd, start = np.sqrt(np.diag(covariance)), group[0].start
    along = np.array([one.end - one.start for one in group]) / sd
    inner = np.linalg.inv(covariance / np.outer(sd, sd))
    # the directions across, in the parameters' sds
    across = np.linalg.svd(along)[2][np.linalg.matrix_rank(along) :].T
    spread = across @ np.linalg.inv(across.T @ inner @ across) @ across.T if across.size else 0.0 * inner
    spread = spread + along.T @ along / 6
    spread = spread + 1e-9 * np.diag(np.diag(spread))
    return start + 0.5 * along.sum(0) * sd, spread * np.outer(sd, sd)
