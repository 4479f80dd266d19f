"""Is a log like the simulations that a method learned from? A test before any answer, in the space of summaries.

With x a log's samples and statistics, standardised over n simulations (``models.regressed.Columns``), K the matrix of
their products 1 + <x_i, x_j>, and k those of the log with them, the simulations leave

    v = 1 + <x, x> - k^T (K + lambda I)^-1 k

of it. Where there are more numbers than simulations this is its squared distance from their span: motions that no
theta within the bounds gives, as of physics that the model lacks (process monitoring's Q statistic: J. Jackson, G.
Mudholkar 1979, "Control procedures for residuals associated with principal component analysis",
https://doi.org/10.1080/00401706.1979.10489779). Where there are fewer, v / lambda goes as its leverage, Hotelling's T
squared: motions larger than any that was simulated. Both are looked at, v / <x, x> for the first and v for the second,
and compared with what the others leave of each simulation, so that p is uniform for logs of the prior, whatever the
distribution (V. Vovk, A. Gammerman, G. Shafer 2005, "Algorithmic learning in a random world").

A log whose start had to be estimated begins a little off all simulations, which their span does not hold: it is looked
at along their ``_LEADING`` principal directions alone, where only what is grossly different shows.

Deviations:

- Twice the smaller p of the two (Bonferroni).
- The others are one fewer than the log's simulations, and were standardised together with the one that is left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from sipe_bayes.core.arrays import Float32Array, FloatArray
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.models.regressed import Columns

_RIDGE = 1e-6  # of K's largest eigenvalue: rounding of float32
_LEADING = 3  # principal directions in which an error of the start is small beside what theta does


@dataclass(frozen=True)
class Outside:
    """What tells a log from n simulations.

    Attributes:
        samples, statistics: columns that vary.
        directions: (F, P), leading ones, of logs whose start is an estimate; else None.
        points: (n, F or P), standardised.
        inverse: (n, n) of K + lambda I.
        left: (n, 2), what the others leave of each, of its own size and as it is.
    """

    samples: Columns
    statistics: Columns
    directions: Float32Array | None
    points: Float32Array
    inverse: FloatArray
    left: FloatArray

    @classmethod
    def of(cls, samples: FloatArray, statistics: FloatArray, noise: FloatArray, known_start: bool) -> Self:
        """Of simulations' samples (n, D), with noise of sd ``noise`` (D,), and statistics (n, E)."""
        columns = Columns.of(samples, noise), Columns.of(statistics, np.zeros(statistics.shape[1]))
        points = np.concatenate([columns[0](samples), columns[1](statistics)], axis=1)
        directions = None if known_start else np.linalg.svd(points, full_matrices=False)[2][:_LEADING].T.copy()
        points = points if directions is None else points @ directions
        products = 1 + (points @ points.T).astype(float)
        ridge = _RIDGE * float(np.linalg.eigvalsh(products)[-1])
        inverse = np.linalg.inv(products + ridge * np.eye(len(points)))
        left = 1 / np.diag(inverse) - ridge
        return cls(*columns, directions, points, inverse, np.stack([left / np.diag(products), left], axis=1))

    def p_value(self, samples: FloatArray, statistics: FloatArray) -> float:
        """Of a log (1, D) with statistics (1, E) as unlike the simulations as this one."""
        point = np.concatenate([self.samples(samples), self.statistics(statistics)], axis=1)[0]
        point = point if self.directions is None else point @ self.directions
        row, own = 1 + (self.points @ point).astype(float), 1 + float(point @ point)
        left = own - row @ self.inverse @ row
        larger = (self.left >= [left / own, left]).sum(0)
        return min(1.0, 2 * (1 + int(larger.min())) / (1 + len(self.left)))

    def alarm(self, p: float) -> bool:
        """Whether p is too small for a log of the prior, or as small as so few simulations let it be."""
        return p <= max(THRESHOLDS.misfit, 2 / (1 + len(self.left)))
