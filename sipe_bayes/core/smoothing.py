"""Local quadratics over the samples of a log: what is smooth in them, and its slopes."""

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
    weights, columns, half = _weights(span, derivative), series.reshape(len(series), -1), span // 2
    inner = [np.convolve(column, weights[half, ::-1], "valid") for column in columns.T]
    ends = weights[:half] @ columns[:span], weights[half + 1 :] @ columns[-span:]
    smooth = np.concatenate([ends[0], np.stack(inner, axis=1), ends[1]])
    return np.asarray(smooth.reshape(series.shape) / dt**derivative)


def left_by_smoothing(count: int, dt: float) -> float:
    """Share of white noise's variance in samples less ``smoothed``, away from their ends; 0 of fewer than five."""
    span = _span(count, dt)
    return 0.0 if span < 5 else float(1 - _weights(span, 0)[span // 2, span // 2])


def _span(count: int, dt: float, wider: int = 1) -> int:
    """Samples of a local quadratic, an odd number."""
    half = wider * (max(5, 2 * round(0.06 / dt / 2) + 1) // 2)
    return min(2 * half + 1, count - (count + 1) % 2)


@functools.lru_cache(maxsize=64)
def _weights(span: int, derivative: int) -> FloatArray:
    """Weights (span, span) of a local quadratic's samples, for its value or slope per sample at each of them.

    A. Savitzky, M. Golay 1964, "Smoothing and differentiation of data by simplified least squares procedures",
    Anal. Chem. 36.
    """
    place = np.arange(span) - span // 2
    powers = np.stack([np.ones(span), place, place**2], axis=1)
    wanted = np.stack([np.zeros(span), np.ones(span), 2.0 * place], axis=1) if derivative else powers
    return np.asarray(wanted @ np.linalg.pinv(powers))


def smoothed_rotations(vectors: FloatArray, dt: float) -> tuple[FloatArray, FloatArray]:
    """Rotation vectors (T+1, 3) smoothed as ``smoothed`` does, and angular velocities (T+1, 3) about axes that stay.

    Around each sample a local quadratic is laid through the rotation vectors that lead from it to its neighbours.
    """
    count, span = len(vectors), _span(len(vectors), dt)
    if span < 3:
        turn = between(vectors[1:], vectors[:-1]) / dt if count > 1 else np.zeros((1, 3))
        return vectors, np.concatenate([turn, turn[-1:]])[:count]
    begin = np.clip(np.arange(count) - span // 2, 0, count - span)
    neighbours = begin[:, None] + np.arange(span)
    ways = between(vectors[neighbours], vectors[:, None])
    place = np.arange(count) - begin
    smooth, slope = ((_weights(span, derivative)[place][..., None] * ways).sum(1) for derivative in (0, 1))
    return added(vectors, smooth), slope / dt
