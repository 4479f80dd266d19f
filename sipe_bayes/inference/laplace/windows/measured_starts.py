"""Where windows start by what was measured there, and, of bodies that tumble, by their first moments."""

from __future__ import annotations

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.inference.laplace.options import GrowingTuning
from sipe_bayes.inference.laplace.windows.growing_windows import tells_starts, told_starts
from sipe_bayes.likelihood.windows import Windows


def measured_starts(windows: Windows, theta: FloatArray, near: FloatArray | None = None) -> FloatArray:
    """Starts (B, W, D) of theta (B, N): zero is what was measured; of bodies that tumble their first moments tell more.

    Of these the starts of ``near`` (N,) serve all, default each theta its own.
    """
    if tells_starts(windows) and windows.trajectories.states is None:
        own = [told_starts(windows, at, GrowingTuning()) for at in (theta if near is None else near[None])]
        return np.broadcast_to(np.stack(own), (len(theta), *own[0].shape))
    return np.tile(windows.no_starts(), (len(theta), 1, 1))
