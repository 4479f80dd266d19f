"""Where a fit ended, for all who look at it: diagnostics, structure, calibration and report."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sipe_bayes.core.arrays import FloatArray, IntArray
from sipe_bayes.core.findings import Finding
from sipe_bayes.likelihood.noise import Noise


@dataclass(frozen=True)
class FitResult:
    """The best optimum of a search.

    Args:
        theta: (N,), within the cube.
        mean: (N,), of the posterior's normal there before truncation.
        covariance: (N, N), likewise.
        noise: (C,), of the measurements.
        evidence: log of what the posterior's mass there is, up to a constant.
        starts: (W, D), initial states of segments; None with a ``StateSpace``.
        slope: (W, D, N): initial states follow theta by minus this.
        states: (R, T+1, S) of the logs with a ``StateSpace``, else None; beyond a shorter log's end they stay.
        outliers: (k, 3), samples that the fit left out, by log, number in it and channel.
        finding: why its intervals are not to be trusted; None where they may be.
    """

    theta: FloatArray
    mean: FloatArray
    covariance: FloatArray
    noise: Noise
    evidence: float
    starts: FloatArray | None
    slope: FloatArray | None
    states: FloatArray | None
    outliers: IntArray
    finding: Finding | None

    def starts_at(self, theta: FloatArray) -> FloatArray | None:
        """Initial states (W, D) of the segments at theta (N,); None with a ``StateSpace``."""
        if self.starts is None or self.slope is None:
            return None
        return np.asarray(self.starts - self.slope @ (theta - self.theta))
