"""Trajectories as sets of control steps (s, a, s' - s), for networks that take trajectories of any length.

Control steps are what the dynamics are written in: a set of them tells the parameters even where the open loop is
chaotic.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from sipe_bayes.core.arrays import Float32Array, FloatArray, IntArray

SMALLEST = 1e-12  # sd: what the rounding of numbers of order one leaves of channels that do not move
_ROUNDING = 1e-7  # of a column's largest number
MOST_STEPS = 200  # of a simulation that are looked at, spread evenly


def control_steps(
    observations: NDArray[np.floating], actions: FloatArray, length: IntArray, most: int | None = MOST_STEPS
) -> Float32Array:
    """Control steps of n simulations, or of a log.

    Args:
        observations: (n, R, T+1, O).
        actions: (R, T, A).
        length: (R,), control steps of each trajectory.
        most: of all R trajectories together, spread evenly; None for all.

    Returns:
        (n, M, 2 O + A); a step with a missing sample is NaN throughout.
    """
    trajectory, step = np.nonzero(np.arange(actions.shape[1]) < length[:, None])
    if most is not None and len(step) > most:
        kept = np.linspace(0, len(step) - 1, most).round().astype(int)
        trajectory, step = trajectory[kept], step[kept]
    here = np.asarray(observations[:, trajectory, step], np.float32)
    change = np.asarray(observations[:, trajectory, step + 1], np.float32) - here
    taken = np.broadcast_to(actions[trajectory, step].astype(np.float32), (len(here), len(step), actions.shape[2]))
    out = np.concatenate([here, taken, change], axis=-1)
    out[~np.isfinite(out).all(-1)] = np.nan
    return out


class Standardise(nn.Module):
    """(x - mean) / sd of the last axis, with the finite rows' mean and sd, in whatever unit.

    Columns that change by no more than rounding, ``_ROUNDING`` of their size or ``SMALLEST``, become zero.

    Args:
        features: F, the size of that axis.
    """

    mean: Tensor
    sd: Tensor

    def __init__(self, features: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(features))
        self.register_buffer("sd", torch.ones(features))

    def fit(self, x: Tensor) -> None:
        """Take mean and sd from x (..., F); stays as it is where no row is finite."""
        rows = x.reshape(-1, x.shape[-1])
        rows = rows[rows.isfinite().all(-1)]
        if not len(rows):
            return
        size = rows.abs().amax(0)
        # a power of two, exact: squares neither vanish nor overflow
        unit = torch.ldexp(torch.ones_like(size), torch.frexp(size).exponent)
        rows = rows / unit
        sd = rows.std(0)
        still = (sd <= _ROUNDING * (size / unit)) | (sd * unit <= SMALLEST)
        self.mean.copy_(rows.mean(0) * unit)
        self.sd.copy_(torch.where(still, torch.full_like(sd, torch.inf), sd * unit))

    def forward(self, x: Tensor) -> Tensor:
        """Standardised x (..., F)."""
        return (x - self.mean) / self.sd


class StepEmbedding(nn.Module):
    """A set of control steps to features: a network on each step, averaged over the finite ones.

    M. Zaheer et al. 2017, "Deep Sets" (https://arxiv.org/abs/1703.06114).

    Args:
        step_features: F, numbers of a step.
        features: D, numbers that come out.
        hidden: units of each layer.
    """

    def __init__(self, step_features: int, features: int, hidden: int = 64) -> None:
        super().__init__()
        self.standardise = Standardise(step_features)
        self.each = nn.Sequential(nn.Linear(step_features, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU())
        self.all = nn.Sequential(nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, features))

    def forward(self, steps: Tensor) -> Tensor:
        """Features (n, D) of sets of control steps (n, M, F)."""
        good = steps.isfinite().all(-1, keepdim=True)
        each = self.each(torch.where(good, self.standardise(steps), steps.new_zeros(())))
        return self.all((each * good).sum(-2) / good.sum(-2).clamp_min(1))
