"""Logs as what a regression on the training's simulations makes of them (``models.regressed``).

``"regressed"`` is that summary of the log, ``"robust"`` the one whose simulations are nearest to the log
(``models.minimum_distance``), of a method that learned from the same summaries of its simulations.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.models.minimum_distance import MinimumDistance
from sipe_bayes.models.regressed import Regressed

REGRESSED = ("regressed", "robust")
"""Summaries that a regression makes."""


@dataclass(frozen=True)
class Summaries:
    """How logs of an experiment are summarised.

    Attributes:
        regressed: the regression.
        shape: (R, T+1, O) of the logs that it was made for.
        nearest: finds the summary of a log whose simulations are nearest to it; None where it is the log's own.
    """

    regressed: Regressed
    shape: tuple[int, int, int]
    nearest: MinimumDistance | None = None

    @classmethod
    def of(
        cls,
        theta: FloatArray,
        observations: NDArray[np.floating],
        statistics: FloatArray,
        trajectories: Trajectories,
        noise: FloatArray,
        kind: str,
    ) -> tuple[Self, FloatArray]:
        """Of simulations, with their summaries (n, N).

        Args:
            theta: (n, N).
            observations: (n, R, T+1, O) with noise.
            statistics: (n, E) of them.
            trajectories: R, the log; what it lacks does not count.
            noise: (O,), sd.
            kind: one of ``REGRESSED``.
        """
        seen = np.where(np.isfinite(trajectories.observations), observations, np.nan).astype(float)
        count, *shape = seen.shape
        every = np.tile(noise, shape[0] * shape[1])
        samples = seen.reshape(count, -1)
        regressed, summaries = Regressed.of(theta, samples, statistics, every)
        nearest = MinimumDistance.of(summaries, regressed.samples(samples)) if kind == "robust" else None
        return cls(regressed, (shape[0], shape[1], shape[2]), nearest), summaries

    def __call__(self, observations: FloatArray, statistics: FloatArray) -> FloatArray:
        """Of a log (R, T+1, O) with statistics (1, E): (1, N).

        Of one of another size what both have counts; what this one lacks is taken for the simulations' mean.
        """
        whole = np.full(self.shape, np.nan)
        both = tuple(slice(0, min(a, b)) for a, b in zip(self.shape, observations.shape, strict=True))
        whole[both] = observations[both]
        samples = whole.reshape(1, -1)
        if self.nearest is None:
            return self.regressed.summaries(self.regressed.points_of(samples, statistics))
        columns = self.regressed.samples
        return self.nearest(columns(samples)[0].astype(float), np.isfinite(samples[0, columns.kept]))[None]
