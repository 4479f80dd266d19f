"""How noisy recorded observations are, for methods that add noise to their simulations."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.likelihood.settings import Segments, StateSpace
from sipe_bayes.likelihood.windows import smoothed

FloatArray = NDArray[np.float64]


def noise_level(trajectories: Trajectories, likelihood: Segments | StateSpace) -> FloatArray:
    """Sd (O,) of each channel's noise: as ``likelihood.noise_sd`` states it; else zero for trajectories with recorded
    states; else the robust sd of what local quadratics over 60 ms leave of the recorded samples."""
    count = trajectories.observations.shape[2]
    stated = likelihood.noise_sd or (None,) * count
    if len(stated) != count:
        raise ValueError(f"noise_sd: expected {count} values, one for each channel, got {len(stated)}")
    found = np.zeros(count) if trajectories.states is not None else _residual_sd(trajectories)
    return np.array([found[c] if sd is None else sd for c, sd in enumerate(stated)])


def _residual_sd(trajectories: Trajectories) -> FloatArray:
    left = []
    for trajectory in trajectories:
        series = trajectory.observations
        there = np.isfinite(series)
        filled = np.stack(
            [
                np.interp(np.arange(len(series)), np.flatnonzero(g), column[g]) if g.any() else np.zeros(len(series))
                for column, g in zip(series.T, there.T, strict=True)
            ],
            axis=1,
        )
        left.append(np.where(there, filled - smoothed(filled, trajectory.dt), np.nan))
    # five points of a local quadratic take away about half of white noise's variance
    return np.nan_to_num(1.4826 * np.nanmedian(np.abs(np.concatenate(left)), axis=0) * np.sqrt(2))
