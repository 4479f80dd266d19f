"""Rotations against MuJoCo's own, and the ways in which one rotation can be written."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from sipe_bayes.core import rotations

RNG = np.random.default_rng(0)
VECTORS = RNG.normal(size=(50, 3)) * RNG.uniform(0, 3, (50, 1))


@pytest.mark.parametrize("size", [1e-9, 1e-3, 1.0, 3.1])
def test_vectors_and_quaternions_are_mujocos(size: float) -> None:
    """Both ways, at angles from nothing to nearly half a turn."""
    for axis in RNG.normal(size=(20, 3)):
        vector = size * axis / np.linalg.norm(axis)
        expected = np.zeros(4)
        mujoco.mju_axisAngle2Quat(expected, axis / np.linalg.norm(axis), size)
        np.testing.assert_allclose(rotations.quaternions(vector), expected, atol=1e-15)
        np.testing.assert_allclose(rotations.rotation_vectors(expected), vector, atol=1e-12)
        np.testing.assert_allclose(rotations.rotation_vectors(-3 * expected), vector, atol=1e-12)


def test_products_turn_as_mujoco_turns() -> None:
    a, b = rotations.quaternions(VECTORS), rotations.quaternions(VECTORS[::-1])
    for one, two, three, vector in zip(a, b, rotations.product(a, b), VECTORS, strict=True):
        expected, moved = np.zeros(4), np.zeros(3)
        mujoco.mju_mulQuat(expected, one, two)
        np.testing.assert_allclose(three, expected, atol=1e-14)
        mujoco.mju_rotVecQuat(moved, vector, one)
        np.testing.assert_allclose(rotations.turned(one, vector), moved, atol=1e-14)


def test_what_lies_between_leads_there() -> None:
    there = rotations.added(VECTORS, rotations.between(VECTORS[::-1], VECTORS))
    np.testing.assert_allclose(rotations.between(there, VECTORS[::-1]), 0, atol=1e-12)


def test_nearest_is_the_same_rotation_and_nearer() -> None:
    """Of ten rounds about each axis, no other way of writing lies nearer."""
    other = 5 * RNG.normal(size=VECTORS.shape)
    found = rotations.nearest(VECTORS, other)
    np.testing.assert_allclose(rotations.between(found, VECTORS), 0, atol=1e-7)
    axis = VECTORS / np.linalg.norm(VECTORS, axis=1, keepdims=True)
    ways = VECTORS + 2 * np.pi * np.arange(-5, 6)[:, None, None] * axis
    best = np.linalg.norm(ways - other, axis=-1).min(0)
    np.testing.assert_allclose(np.linalg.norm(found - other, axis=-1), best, atol=1e-12)


def test_signs_of_quaternions_are_aligned() -> None:
    """However the signs of a smooth motion are flipped, and where samples are missing, one smooth motion is left."""
    time = np.linspace(0, 3, 400)
    smooth = rotations.quaternions(np.stack([4 * time, np.sin(time), 0 * time], axis=1))
    flipped = smooth * RNG.choice([-1.0, 1.0], (400, 1))
    flipped[100:103] = np.nan
    found = rotations.aligned(flipped)
    kept = np.isfinite(found).all(1)
    assert np.abs(np.diff(found[kept], axis=0)).max() < 0.1
    np.testing.assert_allclose(np.abs((found[kept] * smooth[kept]).sum(1)), 1, atol=1e-12)


def test_a_turning_body_is_written_without_jumps() -> None:
    """Three rounds about one axis: vectors grow to 6 pi, and missing samples lie on the way."""
    angle = np.linspace(0, 6 * np.pi, 200)
    true = angle[:, None] * np.array([0.6, 0.0, 0.8])
    seen = rotations.rotation_vectors(rotations.quaternions(true))
    assert np.abs(np.diff(seen, axis=0)).max() > 3
    np.testing.assert_allclose(rotations.continued(seen), true, atol=1e-9)
    seen[[0, 50, 51, 199]] = np.nan
    filled = rotations.bridged(seen)
    np.testing.assert_allclose(rotations.between(filled[[50, 51]], true[[50, 51]]), 0, atol=1e-9)
    np.testing.assert_allclose(filled[[0, 199]], filled[[1, 198]])


def test_a_vector_of_which_a_number_is_missing_stays() -> None:
    """Near a whole turn, where another way of writing would be nearer."""
    values, others = np.array([[3.3, 0.0, 0.1], [0.1, 0.0, 0.2]]), np.array([[-2.9, 0.0, -0.1], [0.1, np.nan, 0.2]])
    near = rotations.written_near(values, others, [(0, 1, 2)])
    assert np.isfinite(near).all()
    assert near[0] == pytest.approx(others[0] - rotations.between(others[0], values[0]))
    assert near[1] == pytest.approx(values[1])
