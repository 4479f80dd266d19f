"""The cost of a theta: how far what it simulates is from what was recorded.

Recorded trajectories are cut into windows (``likelihood.Segments``), each replayed from its own recorded or estimated
starting state with the recorded actions. ``Segments(window=None)`` replays whole trajectories, as the SiPE paper does
(Mehta, Handa, Fox, Ramos 2020, section 2.3). The default, half a second, is a deviation from it: over a whole trajectory
contact and chaos hide the parameters (half-cheetah, 200 steps: least squares is no better than the prior mean).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sipe_bayes.likelihood import Windows

FloatArray = NDArray[np.float64]

_BATCH = 32  # thetas simulated at once
_STILL = 1e-3  # of the median channel's spread: less motion than that is scaled as if it were that much


@dataclass(frozen=True)
class Transitions:
    """Control steps (s, a, s'): features (n, 2 C + A) float64, finite, and theta's row (n,) that each belongs to."""

    features: FloatArray
    row: NDArray[np.int64]


class StateDifference:
    """Mean squared difference between simulated and recorded channels, each in units of its own recorded spread.

    Deviation from the SiPE paper: it sums plain squares, so that its metres and radians per second weigh alike.
    """

    def __init__(self, windows: Windows) -> None:
        self.windows = windows
        spread = np.array(
            [_spread(windows.measured[..., c][windows.observed[..., c]]) for c in range(len(windows.channels))]
        )
        moving = spread[spread > 0]
        floor = _STILL * float(np.median(moving)) if len(moving) else 1.0
        self.scale = np.maximum(spread, floor)

    def __call__(self, theta: FloatArray) -> FloatArray:
        """Cost (B,) of theta (B, N), infinite where the simulation diverged; raises BudgetExhausted."""
        return self.of(simulate(self.windows, theta))

    def of(self, predicted: FloatArray) -> FloatArray:
        """Cost (B,) of predictions (B, W, L, C), NaN where they diverged."""
        windows = self.windows
        with np.errstate(invalid="ignore"):
            square = ((predicted - windows.measured) / self.scale) ** 2
        cost = np.where(windows.observed, square, 0.0).sum(axis=(1, 2, 3)) / windows.observed.sum()
        return np.where(np.isfinite(cost), cost, np.inf)


def simulate(windows: Windows, theta: FloatArray) -> FloatArray:
    """Predictions (B, W, L, C) from the windows' own starts; raises BudgetExhausted."""
    starts = windows.no_starts()
    parts = [
        windows.predict(rows, np.broadcast_to(starts, (len(rows), *starts.shape)))[0]
        for rows in np.split(theta, range(_BATCH, len(theta), _BATCH))
    ]
    return np.concatenate(parts)


def transitions(windows: Windows, samples: FloatArray) -> Transitions:
    """The control steps of samples (B, W, L, C), predicted or measured (B = 1), where all channels are finite."""
    batch = len(samples)
    actions = np.broadcast_to(windows.actions, (batch, *windows.actions.shape))
    features = np.concatenate([samples[:, :, :-1], actions, samples[:, :, 1:]], axis=-1)
    inside = np.arange(windows.actions.shape[1]) < windows.steps[:, None]
    good = np.isfinite(features).all(-1) & inside
    row = np.broadcast_to(np.arange(batch)[:, None, None], good.shape)
    return Transitions(features[good], row[good])


def _spread(values: FloatArray) -> float:
    return float(values.std()) if len(values) else 0.0
