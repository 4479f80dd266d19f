"""How noisy recorded observations are, for methods that add noise to their simulations."""

from __future__ import annotations

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.likelihood.settings import Segments, StateSpace
from sipe_bayes.likelihood.starts import smoothed

_ROBUST = 1.4826  # sd of a normal over the median of its absolute values
_SMOOTHED = np.sqrt(2)  # five points of a local quadratic take away about half of white noise's variance


def noise_level(trajectories: Trajectories, likelihood: Segments | StateSpace) -> FloatArray:
    """Sd of each channel's noise.

    As ``likelihood.noise_sd`` states it; else zero for trajectories with recorded states; else the robust sd of what
    local quadratics over 60 ms leave of the recorded samples.

    Args:
        trajectories: the logs.
        likelihood: its settings.

    Returns:
        (O,), in the channels' units.

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
        finite = np.isfinite(series)
        filled = np.stack(
            [
                np.interp(np.arange(len(series)), np.flatnonzero(g), column[g]) if g.any() else np.zeros(len(series))
                for column, g in zip(series.T, finite.T, strict=True)
            ],
            axis=1,
        )
        left.append(np.where(finite, filled - smoothed(filled, trajectory.dt), np.nan))
    return np.nan_to_num(_ROBUST * np.nanmedian(np.abs(np.concatenate(left)), axis=0) * _SMOOTHED)
