"""How noisy recorded observations are, for methods that add noise to their simulations."""

from __future__ import annotations

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.likelihood.settings import Segments, StateSpace
from sipe_bayes.likelihood.starts import smoothed

NORMAL_MAD = 1.4826  # sd of a normal over the median of its absolute values


def noise_level(trajectories: Trajectories, likelihood: Segments | StateSpace) -> FloatArray:
    """Sd (O,) of each channel's noise in its unit.

    As ``likelihood.noise_sd`` states it; else zero for trajectories with recorded states; else the robust sd of what
    local quadratics over 60 ms leave of the recorded samples.

    Raises:
        ValueError: where the settings state another number of sds than there are channels.
    """
    count = trajectories.observations.shape[2]
    stated = likelihood.noise_sd or (None,) * count
    if len(stated) != count:
        raise ValueError(f"noise_sd: expected {count} values, one for each channel, got {len(stated)}")
    estimated = np.zeros(count) if trajectories.states is not None else _residual_sd(trajectories)
    return np.array([estimated[c] if sd is None else sd for c, sd in enumerate(stated)])


def _residual_sd(trajectories: Trajectories) -> FloatArray:
    """Robust sd (O,) of what smoothing leaves."""
    left = []
    for trajectory in trajectories:
        series = trajectory.observations
        finite, filled = np.isfinite(series), np.zeros(series.shape)
        for c, seen in enumerate(finite.T):
            if seen.any():
                filled[:, c] = np.interp(np.arange(len(series)), np.flatnonzero(seen), series[seen, c])
        left.append(np.where(finite, filled - smoothed(filled, trajectory.dt), np.nan))
    # five points of a local quadratic take away about half of white noise's variance
    return np.nan_to_num(NORMAL_MAD * np.nanmedian(np.abs(np.concatenate(left)), axis=0) * np.sqrt(2))
