"""Logs as what a regression on the training's simulations makes of them (``models.regressed``)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from sipe_bayes.core.arrays import Float32Array, FloatArray
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.models.regressed import Regressed


@dataclass(frozen=True)
class Summaries:
    """How logs of an experiment are summarised.

    Attributes:
        regressed: the regression.
        shape: (R, T+1, O) of the logs that it was made for.
    """

    regressed: Regressed
    shape: tuple[int, int, int]

    @classmethod
    def of(
        cls,
        theta: FloatArray,
        observations: NDArray[np.floating],
        statistics: FloatArray,
        trajectories: Trajectories,
        noise: FloatArray,
    ) -> tuple[Self, FloatArray]:
        """Of simulations, with their summaries (n, N).

        Args:
            theta: (n, N).
            observations: (n, R, T+1, O) with noise.
            statistics: (n, E) of them.
            trajectories: R, the log; what it lacks does not count.
            noise: (O,), sd.
        """
        seen = np.where(np.isfinite(trajectories.observations), observations, np.nan).astype(float)
        count, traces, samples, channels = seen.shape
        every = np.tile(noise, traces * samples)
        regressed, summaries = Regressed.of(theta, seen.reshape(count, -1), statistics, every)
        return cls(regressed, (traces, samples, channels)), summaries

    def __call__(self, observations: FloatArray, statistics: FloatArray) -> FloatArray:
        """Of a log (R, T+1, O) with statistics (1, E): (1, N).

        Of one of another size what both have counts; what this one lacks is taken for the simulations' mean.
        """
        return self.regressed.summaries(self._point(observations, statistics))

    def _point(self, observations: FloatArray, statistics: FloatArray) -> Float32Array:
        whole = np.full(self.shape, np.nan)
        both = tuple(slice(0, min(a, b)) for a, b in zip(self.shape, observations.shape, strict=True))
        whole[both] = observations[both]
        return self.regressed.points_of(whole.reshape(1, -1), statistics)
