"""Noise of the residuals of windows: white or coloured, and how residuals are whitened.

Residual model, per channel c and along each log: e_j = a_j e_{j-1} + sqrt(1 - a_j^2) sigma_c z_j, z_j ~ N(0, 1), with
a_j = exp(-gap_j / tau_c) for the time since the previous sample there is (first-order autoregression, which carries
on across windows and across missing samples); e_0 ~ N(0, sigma_c^2). White noise is tau = 0.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from sipe_bayes.core.arrays import FloatArray, IntArray
from sipe_bayes.likelihood.sequences import Sequence

NORMAL_MAD = 1.4826  # sd of a normal over the median of its absolute values


def coefficients(gaps: FloatArray, tau: float | FloatArray) -> FloatArray:
    """Autoregression coefficient of each gap in seconds; 0 for white noise (tau = 0) and infinite gaps."""
    return np.where(np.asarray(tau) > 0, np.exp(-gaps / np.maximum(tau, 1e-300)), 0.0)


@dataclass(frozen=True)
class Noise:
    """Stationary sd (C,) in the channels' units and correlation time tau (C,) in seconds, 0 for white."""

    sd: FloatArray
    tau: FloatArray


def chosen_sd(given: tuple[float | None, ...] | None, channels: list[int], names: tuple[str, ...]) -> FloatArray:
    """Noise sds (C,) of the given ``channels`` of all ``names``, NaN where none is given.

    Raises:
        ValueError: unless there is one, or None, for each of ``names``.
    """
    if given is None:
        return np.full(len(channels), np.nan)
    if len(given) != len(names):
        raise ValueError(
            f"noise_sd: expected one for each of the channels {list(names)}, got {len(given)}; None where unknown"
        )
    return np.array([np.nan if given[c] is None else given[c] for c in channels], float)


def noise_scales(count: int, rotations: Iterable[tuple[int, int, int]]) -> IntArray:
    """Which noise scale (G of them) each of C channels has: the three numbers of a rotation vector share one."""
    owner = np.arange(count)
    for triple in rotations:
        owner[list(triple)] = min(triple)
    return np.unique(owner, return_inverse=True)[1]


def pooled(sd: FloatArray, scales: IntArray) -> FloatArray:
    """Sds (C,), those of one scale at their root mean square."""
    if scales.max(initial=-1) + 1 == len(sd):
        return sd
    return np.asarray(np.sqrt(np.bincount(scales, sd**2) / np.bincount(scales))[scales])


def whiten(residual: FloatArray, sequence: Sequence, sd: float, tau: float) -> FloatArray:
    """Whitened residuals (..., n) of one channel's residual (..., W * L)."""
    a = coefficients(sequence.gaps, tau)[sequence.gap]
    before = np.where(sequence.previous >= 0, residual[..., sequence.previous], 0.0)
    return (residual[..., sequence.index] - a * before) / (sd * np.sqrt(1 - a**2))
