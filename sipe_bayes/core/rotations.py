"""Rotations in three dimensions: quaternions w-x-y-z of length one, and rotation vectors (axis times angle, rad).

A product ``a b`` turns by b first, then by a, about axes that stay. The vectors v and v + 2 pi k v / |v| are one
rotation; ``rotation_vectors`` gives the shortest.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from sipe_bayes.core.arrays import FloatArray


def product(a: FloatArray, b: FloatArray) -> FloatArray:
    """Quaternions (..., 4) of b, then a."""
    a, b = np.broadcast_arrays(a, b)
    scalar = a[..., :1] * b[..., :1] - (a[..., 1:] * b[..., 1:]).sum(-1, keepdims=True)
    vector = a[..., :1] * b[..., 1:] + b[..., :1] * a[..., 1:] + np.cross(a[..., 1:], b[..., 1:])
    return np.concatenate([scalar, vector], axis=-1)


def inverse(quaternion: FloatArray) -> FloatArray:
    """Quaternions (..., 4) that turn back."""
    return np.asarray(quaternion * np.array([1.0, -1.0, -1.0, -1.0]))


def turned(quaternion: FloatArray, vector: FloatArray) -> FloatArray:
    """Vectors (..., 3) turned by quaternions (..., 4)."""
    vector = np.broadcast_to(vector, (*np.broadcast_shapes(quaternion.shape[:-1], vector.shape[:-1]), 3))
    twice = 2 * np.cross(quaternion[..., 1:], vector)
    return np.asarray(vector + quaternion[..., :1] * twice + np.cross(quaternion[..., 1:], twice))


def quaternions(vector: FloatArray) -> FloatArray:
    """Quaternions (..., 4) of rotation vectors (..., 3)."""
    half = 0.5 * np.linalg.norm(vector, axis=-1, keepdims=True)
    return np.concatenate([np.cos(half), 0.5 * np.sinc(half / np.pi) * vector], axis=-1)


def rotation_vectors(quaternion: FloatArray) -> FloatArray:
    """Rotation vectors (..., 3) of quaternions (..., 4) of any length and sign; NaN of those that are NaN or zero."""
    quaternion = np.where(quaternion[..., :1] < 0, -quaternion, quaternion)
    size = np.linalg.norm(quaternion[..., 1:], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(size, quaternion[..., :1])
    with np.errstate(invalid="ignore", divide="ignore"):
        scale = np.where(size > 1e-12 * quaternion[..., :1], angle / size, 2 / quaternion[..., :1])
        return np.asarray(scale * quaternion[..., 1:])


def between(after: FloatArray, before: FloatArray) -> FloatArray:
    """Rotation vectors (..., 3) that lead from rotation vectors ``before`` to ``after``, about axes that stay."""
    return rotation_vectors(product(quaternions(after), inverse(quaternions(before))))


def added(vector: FloatArray, turn: FloatArray) -> FloatArray:
    """Rotation vectors (..., 3) turned on by ``turn`` (..., 3), about axes that stay."""
    return rotation_vectors(product(quaternions(turn), quaternions(vector)))


def nearest(vector: FloatArray, other: FloatArray) -> FloatArray:
    """The same rotations as ``vector`` (..., 3), written as near as may be to ``other`` (..., 3)."""
    size = np.linalg.norm(vector, axis=-1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        axis = np.where(size > 0, vector / size, 0.0)
    rounds = np.round(((other * axis).sum(-1, keepdims=True) - size) / (2 * np.pi))
    return np.asarray(vector + 2 * np.pi * np.nan_to_num(rounds) * axis)


def aligned(quaternion: FloatArray) -> FloatArray:
    """Quaternions (T, 4) along a log, each with the sign that is nearer to the one before; NaN rows are passed over."""
    out, finite = quaternion.copy(), np.flatnonzero(np.isfinite(quaternion).all(-1))
    flips = (out[finite[1:]] * out[finite[:-1]]).sum(-1) < 0
    out[finite[1:]] *= np.where(np.logical_xor.accumulate(flips), -1.0, 1.0)[:, None]
    return out


def continued(vector: FloatArray) -> FloatArray:
    """Rotation vectors (T, 3) along a log, each written as near as may be to the one before; NaN is passed over."""
    out = vector.copy()
    finite = np.flatnonzero(np.isfinite(vector).all(-1))
    for before, here in itertools.pairwise(finite):
        out[here] = nearest(out[here], out[before])
    return out


def bridged(vector: FloatArray) -> FloatArray:
    """Rotation vectors (T, 3) with those that are NaN between their neighbours; at least one must be finite."""
    finite = np.flatnonzero(np.isfinite(vector).all(-1))
    if len(finite) == len(vector):
        return vector
    sample = np.arange(len(vector))
    before = finite[np.clip(np.searchsorted(finite, sample, side="right") - 1, 0, None)]
    after = finite[np.clip(np.searchsorted(finite, sample), None, len(finite) - 1)]
    share = np.where(after > before, (sample - before) / np.maximum(after - before, 1), 0.0)
    return added(vector[before], share[:, None] * between(vector[after], vector[before]))


def with_noise(values: FloatArray, noise: FloatArray, triples: Sequence[tuple[int, int, int]]) -> FloatArray:
    """Channels (..., C) with noise (..., C) added; the rotation vectors at ``triples`` are turned by it."""
    out = np.asarray(values + noise)
    for triple in map(list, triples):
        out[..., triple] = added(values[..., triple], noise[..., triple])
    return out


def written_near(values: FloatArray, others: FloatArray, triples: Sequence[tuple[int, int, int]]) -> FloatArray:
    """Channels with their rotation vectors written so that ``others`` minus them is what turns them into ``others``.

    Args:
        values: (..., C).
        others: (..., C); where a vector of it has a NaN, values stay.
        triples: which channels are together a rotation vector.
    """
    if not triples:
        return values
    out = np.broadcast_to(values, np.broadcast_shapes(values.shape, others.shape)).copy()
    for triple in map(list, triples):
        other = others[..., triple]
        near = other - between(other, values[..., triple])
        out[..., triple] = np.where(np.isfinite(other).all(-1, keepdims=True), near, values[..., triple])
    return out
