"""Is a log like the simulations that a method learned from? A test before any answer, in the space of summaries.

A log's samples and statistics, standardised over the simulations (``models.regressed.Columns``), are a point among
theirs. Its distance to the ``_NEAREST``th nearest of them, as a multiple of these neighbours' own (a local outlier
factor: M. Breunig, H. Kriegel, R. Ng, J. Sander 2000, "LOF: identifying density-based local outliers",
https://doi.org/10.1145/335191.335388), is compared with the factors of the simulations among the others, so that p is
uniform for logs of the prior, whatever the distribution (V. Vovk, A. Gammerman, G. Shafer 2005, "Algorithmic learning
in a random world").

A log whose start had to be estimated begins a little off all simulations: only a factor beyond every simulation's
raises an alarm then.

Deviations:

- Neighbours' mean distance stands for the mean of their densities, without reachability.
- The simulations' others are one fewer than the log's, and were standardised together with the one that is left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
import scipy.spatial.distance

from sipe_bayes.core.arrays import Float32Array, FloatArray, IntArray
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.models.regressed import Columns

_NEAREST = 20  # neighbours: fewer are near by chance, more reach beyond what is local


@dataclass(frozen=True)
class Outside:
    """What tells a log from n simulations.

    Attributes:
        samples, statistics: columns that vary.
        points: (n, F), standardised.
        spacing: (n,), distance of each from its nearest others.
        factors: (n,), outlier factor of each among the others.
        known_start: whether logs start where the simulations did.
    """

    samples: Columns
    statistics: Columns
    points: Float32Array
    spacing: FloatArray
    factors: FloatArray
    known_start: bool

    @classmethod
    def of(cls, samples: FloatArray, statistics: FloatArray, noise: FloatArray, known_start: bool) -> Self:
        """Of simulations' samples (n, D), with noise of sd ``noise`` (D,), and statistics (n, E)."""
        columns = Columns.of(samples, noise), Columns.of(statistics, np.zeros(statistics.shape[1]))
        points = np.concatenate([columns[0](samples), columns[1](statistics)], axis=1)
        distances = scipy.spatial.distance.cdist(points, points)
        np.fill_diagonal(distances, np.inf)
        spacing = _furthest(distances, _nearest(distances))
        return cls(*columns, points, spacing, _factors(distances, spacing), known_start)

    def p_value(self, samples: FloatArray, statistics: FloatArray) -> float:
        """Of a log (1, D) with statistics (1, E) as unlike the simulations as this one."""
        point = np.concatenate([self.samples(samples), self.statistics(statistics)], axis=1)
        (factor,) = _factors(scipy.spatial.distance.cdist(point, self.points), self.spacing)
        return float((1 + (self.factors >= factor).sum()) / (1 + len(self.factors)))

    @property
    def floor(self) -> float:
        """The least p that the simulations can give."""
        return 1 / (1 + len(self.factors))

    def alarm(self, p: float) -> bool:
        """Whether p is too small for a log of the prior, or as small as so few simulations let it be."""
        return p <= (max(THRESHOLDS.unlike, self.floor) if self.known_start else self.floor)


def _nearest(distances: FloatArray) -> IntArray:
    """Numbers (m, K) of the nearest of n others at these distances (m, n), nearest first."""
    return np.argsort(distances, axis=1)[:, : max(1, min(_NEAREST, distances.shape[1] // 5))]


def _furthest(distances: FloatArray, nearest: IntArray) -> FloatArray:
    return np.asarray(np.take_along_axis(distances, nearest[:, -1:], axis=1)[:, 0])


def _factors(distances: FloatArray, spacing: FloatArray) -> FloatArray:
    """How far m points are from their nearest of n others (m, n), by these neighbours' own spacing (n,): (m,)."""
    nearest = _nearest(distances)
    return _furthest(distances, nearest) / np.maximum(spacing[nearest].mean(1), np.finfo(float).tiny)
