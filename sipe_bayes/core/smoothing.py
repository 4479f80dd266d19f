"""Local quadratics over the samples of a log: what is smooth in them, and its slopes.

A. Savitzky, M. Golay 1964, "Smoothing and differentiation of data by simplified least squares procedures", Anal. Chem.
36.
"""

from __future__ import annotations

import functools

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.rotations import added, between


def smoothed(series: FloatArray, dt: float, derivative: int = 0, wider: int = 1) -> FloatArray:
    """Local quadratics over 60 ms, at least 5 samples, of a series (T+1, ...).

    Args:
        series: the samples.
        dt: seconds between them.
        derivative: 1 for their slopes in time.
        wider: how many times as many samples.
    """
    span = _span(len(series), dt, wider)
    if span < 3:
        return np.gradient(series, dt, axis=0) if derivative else series
    weights, half, inner = _weights(span, derivative), span // 2, len(series) - span + 1
    middle = sum(weight * series[k : k + inner] for k, weight in enumerate(weights[half]))
    begin, end = np.tensordot(weights[:half], series[:span], 1), np.tensordot(weights[-half:], series[-span:], 1)
    return np.concatenate([begin, middle, end]) / dt**derivative


def filled(series: FloatArray) -> FloatArray:
    """Series (T+1,) or (T+1, C) whose missing samples lie on lines; zeros where there is no sample at all."""
    out, place = np.zeros(series.shape), np.arange(len(series))
    for column, values in zip(out.reshape(len(out), -1).T, series.reshape(len(out), -1).T, strict=True):
        seen = np.flatnonzero(np.isfinite(values))
        if len(seen):
            column[:] = np.interp(place, seen, values[seen])
    return out


def left_by_smoothing(count: int, dt: float) -> float:
    """Share of white noise's variance in samples less ``smoothed``, away from their ends; 0 of fewer than five."""
    span = _span(count, dt)
    return 0.0 if span < 5 else float(1 - _weights(span, 0)[span // 2, span // 2])


def smoothed_rotations(vectors: FloatArray, dt: float) -> tuple[FloatArray, FloatArray]:
    """Rotation vectors (T+1, 3) smoothed as ``smoothed`` does, and angular velocities (T+1, 3) about axes that stay.

    Around each sample a local quadratic is laid through the rotation vectors that lead from it to its neighbours.
    """
    count, span = len(vectors), _span(len(vectors), dt)
    if span < 3:
        turn = between(vectors[1:], vectors[:-1]) / dt if count > 1 else np.zeros((1, 3))
        return vectors, np.concatenate([turn, turn[-1:]])[:count]
    begin = np.clip(np.arange(count) - span // 2, 0, count - span)
    ways, place = between(vectors[begin[:, None] + np.arange(span)], vectors[:, None]), np.arange(count) - begin
    smooth, slope = (np.einsum("ks,ksi->ki", _weights(span, derivative)[place], ways) for derivative in (0, 1))
    return added(vectors, smooth), slope / dt


def _span(count: int, dt: float, wider: int = 1) -> int:
    """Samples of a local quadratic, an odd number."""
    half = wider * (max(5, 2 * round(0.06 / dt / 2) + 1) // 2)
    return min(2 * half + 1, count - (count + 1) % 2)


@functools.lru_cache(maxsize=256)
def _weights(span: int, derivative: int) -> FloatArray:
    """Weights (span, span) of samples in the value, or the slope by sample, of their quadratic at each of them."""
    powers = np.vander(np.arange(span) - (span - 1) / 2, 3, increasing=True)
    seen = np.stack([0 * powers[:, 0], powers[:, 0], 2 * powers[:, 1]], axis=1) if derivative else powers
    return np.asarray(seen @ np.linalg.pinv(powers))
