"""The cost of a theta: how far what it simulates is from what was recorded.

Recorded trajectories are cut into windows (``sipe_bayes.likelihood.Segments``), each replayed from its own recorded or
estimated starting state with the recorded actions. ``Segments(window=None)`` replays whole trajectories, as the SiPE
paper does (Mehta, Handa, Fox, Ramos 2020, section 2.3). The default, half a second, is a deviation from it: over a
whole trajectory contact and chaos hide the parameters (half-cheetah, 200 steps: least squares is no better than the
prior mean).
"""

from __future__ import annotations

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.likelihood import BoundLikelihood
from sipe_bayes.simulation.callable_simulator import CallableSimulator


class StateDifference:
    """Mean squared difference between simulated and recorded channels.

    Args:
        windows: the recorded logs.
        scale: (C,), the channels' units, of ``channel_scale``.

    Deviation from the SiPE paper: it sums plain squares, so that its metres and radians per second weigh alike.
    """

    def __init__(self, windows: BoundLikelihood, scale: FloatArray) -> None:
        self.windows, self.scale = windows, scale

    def __call__(self, predicted: FloatArray) -> FloatArray:
        """Cost (B,) of predictions (B, W, L, C), infinite where the simulation diverged."""
        windows = self.windows
        with np.errstate(invalid="ignore"):
            square = ((predicted - windows.measured) / self.scale) ** 2
        cost = np.where(windows.observed, square, 0.0).sum(axis=(1, 2, 3)) / windows.observed.sum()
        return np.where(np.isfinite(cost), cost, np.inf)


def channel_scale(windows: BoundLikelihood, first: FloatArray) -> FloatArray:
    """What a channel's differences are divided by (C,), so that nothing depends on the channels' units.

    Its recorded spread, of channels that hardly move a thousandth of the median channel's. One observed x of a function
    has no spread: there it is that of the ``first`` simulations (B, W, L, C), and the channel's magnitude where they do
    not differ; NaN where none was valid.
    """
    if isinstance(windows.simulator, CallableSimulator):
        return _simulated_scale(windows, first)
    seen = [windows.measured[..., c][windows.observed[..., c]] for c in range(len(windows.channels))]
    spread = np.array([values.std() if len(values) else 0.0 for values in seen])
    moving = spread[spread > 0]
    return np.maximum(spread, 1e-3 * float(np.median(moving)) if len(moving) else 1.0)


def _simulated_scale(windows: BoundLikelihood, first: FloatArray) -> FloatArray:
    samples = first[:, :, 1].reshape(-1, first.shape[-1])
    samples = samples[np.isfinite(samples).all(1)]
    if not len(samples):
        return np.full(first.shape[-1], np.nan)
    size = np.maximum(np.abs(samples).max(0), np.nanmax(np.abs(windows.measured[:, 1]), axis=0))
    spread = samples.std(0)
    return np.where(spread > 1e-7 * size, spread, np.where(size > 0, size, 1.0))  # less is rounding
