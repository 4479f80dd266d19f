"""The look around an optimum: cheap where all is smooth, and what it says of places beside a narrow valley."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.inference.laplace.windows.pattern_search import (
    PatternTuning,
    Surroundings,
    pattern_search,
    pattern_size,
)

SD, THETA = 0.02, np.array([0.4, 0.6])
COVARIANCE = SD**2 * np.eye(2)


def looked(valley: Callable[[FloatArray], FloatArray]) -> tuple[Surroundings, int]:
    """What is seen of an energy by the distances from THETA (B, N) in sds, and at how many points it was asked."""
    points = []

    def energies(thetas: FloatArray) -> FloatArray:
        points.extend(thetas)
        return valley((thetas - THETA) / SD)

    seen = pattern_search(energies, THETA, COVARIANCE, PatternTuning(), level=0.0)
    return seen, len(points)


def test_a_smooth_optimum_is_looked_at_in_a_third_of_the_points() -> None:
    seen, points = looked(lambda z: 0.5 * (z**2).sum(1))
    assert (seen.better, seen.other, seen.rough, seen.heavier) == (None, None, False, False)
    np.testing.assert_allclose(seen.covariance, COVARIANCE, rtol=1e-6)
    full = pattern_size(2, PatternTuning())
    assert points < 0.4 * full


def test_a_trough_around_a_narrow_valley_widens_the_normal() -> None:
    """A valley of the normal's width in a trough ten times as wide: half of its width, at the least."""
    seen, points = looked(lambda z: np.minimum(0.5 * (z**2).sum(1), 1.5 + 0.005 * (z**2).sum(1)))
    assert (np.sqrt(np.diag(seen.covariance)) > 5 * SD).all()
    assert (seen.better, seen.other, seen.rough, seen.heavier) == (None, None, False, False)
    assert points > 0.4 * pattern_size(2, PatternTuning())


def test_a_place_apart_that_the_normal_excludes_and_that_fits_is_seen() -> None:
    """A second valley, two nats worse: no wider normal holds both."""
    apart = np.array([10.0, 0.0])
    seen, _ = looked(lambda z: np.minimum(0.5 * (z**2).sum(1), 2 + 0.5 * ((z - apart) ** 2).sum(1)))
    assert seen.heavier
    assert seen.better is None
    np.testing.assert_allclose(seen.covariance, COVARIANCE, rtol=1e-6)


def test_a_better_place_ends_the_look() -> None:
    seen, points = looked(lambda z: 0.5 * (z**2).sum(1) - 8 * np.exp(-((z - np.array([3.0, 0.0])) ** 2).sum(1)))
    assert seen.better is not None
    np.testing.assert_allclose((seen.better - THETA) / SD, [3, 0], atol=1e-9)
    assert points < 0.4 * pattern_size(2, PatternTuning())
