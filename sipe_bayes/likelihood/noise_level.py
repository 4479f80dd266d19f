"""How noisy recorded observations are, for methods that add noise to their simulations."""

from __future__ import annotations

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.likelihood.settings import Segments, StateSpace
from sipe_bayes.likelihood.windows import smoothed


def noise_level(trajectories: Trajectories, likelihood: Segments | StateSpace) -> FloatArray:
    """Noise of each channel as it is stated, or as it shows.

    As ``likelihood.noise_sd`` states it; else zero for trajectories with recorded states; else the robust sd of what
    local quadratics over 60 ms leave of the recorded samples.

    Args:
        trajectories: the logs.
        likelihood: with stated sds.

    Returns:
        (O,), sds.

    Raises:
        ValueError: unless one is stated for each channel, or none.
    """
    count = trajectories.observations.shape[2]
    stated = likelihood.noise_sd or (None,) * count
    if len(stated) != count:
        raise ValueError(f"noise_sd: expected {count} values, one for each channel, got {len(stated)}")
    shown = np.zeros(count) if trajectories.states is not None else _residual_sd(trajectories)
    return np.array([shown[c] if sd is None else sd for c, sd in enumerate(stated)])


def _residual_sd(trajectories: Trajectories) -> FloatArray:
    left = []
    for trajectory in trajectories:
        series = trajectory.observations
        observed = np.isfinite(series)
        filled = np.stack(
            [
                np.interp(np.arange(len(series)), np.flatnonzero(g), column[g]) if g.any() else np.zeros(len(series))
                for column, g in zip(series.T, observed.T, strict=True)
            ],
            axis=1,
        )
        left.append(np.where(observed, filled - smoothed(filled, trajectory.dt), np.nan))
    # five points of a local quadratic take away about half of white noise's variance
    return np.nan_to_num(1.4826 * np.nanmedian(np.abs(np.concatenate(left)), axis=0) * np.sqrt(2))
