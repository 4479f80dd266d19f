"""Sides on which a density reaches further than its normal: found, drawn from, and a right normal left alone."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

import sipe_bayes as sipe
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.inference import importance
from sipe_bayes.inference.importance import Draws, ImportanceTuning
from sipe_bayes.inference.stretches import StretchTuning, look_size, proposals, stretches
from sipe_bayes.posterior import prior as default_prior

EDGE = 0.5
SD = np.array([1e-3, 5e-3, 0.02])
MIXING = np.array([[1.0, 0.6, 0.0], [0.0, 1.0, 0.5], [0.4, 0.0, 1.0]])
MEAN = np.array([0.3, EDGE, 0.6])
PRECISION = (MIXING / SD).T @ (MIXING / SD)


def normal(points: FloatArray) -> FloatArray:
    """Three correlated parameters."""
    gaps = points - MEAN
    return np.asarray(-0.5 * np.einsum("bi,ij,bj->b", gaps, PRECISION, gaps))


def floored(points: FloatArray) -> FloatArray:
    """The same where the second changes nothing below the edge."""
    return normal(np.stack([points[:, 0], np.maximum(points[:, 1], EDGE), points[:, 2]], axis=1))


def counted(target: Callable[[FloatArray], FloatArray]) -> tuple[Callable[[FloatArray], FloatArray], list[int]]:
    """The target, and how many points it was asked for."""
    asked: list[int] = []

    def values(points: FloatArray) -> FloatArray:
        asked.append(len(points))
        return target(points)

    return values, asked


def test_a_right_normal_is_left_alone() -> None:
    """No stretch, and no more points than are said; nor where a density falls faster, or as far as its bound only."""
    covariance = np.linalg.inv(PRECISION)
    for target in (normal, lambda x: 3 * normal(x), lambda x: normal(x) - 1e3 * np.maximum(x[:, 1] - EDGE, 0)):
        values, asked = counted(target)
        assert stretches(values, MEAN, MEAN, covariance, StretchTuning()) == []
        assert sum(asked) <= look_size(3)


def test_a_side_that_changes_nothing_is_seen_to_its_end() -> None:
    """To the bound, along the parameter alone, at the cost of some more points."""
    values, asked = counted(floored)
    found = stretches(values, MEAN, MEAN, np.linalg.inv(PRECISION), StretchTuning())
    (alone,) = (one for one in found if one.parameter == 1)
    np.testing.assert_allclose(alone.end, [0.3, 0.0, 0.6], atol=1e-9)
    assert alone.fall == pytest.approx(0.0, abs=1e-9)
    assert sum(asked) < 2 * look_size(3)


def test_a_stretch_behind_a_fall_counts_by_its_mass() -> None:
    """Three nats down and a hundred sds long it does; fifteen nats down it is nothing."""

    def step(fall: float) -> Callable[[FloatArray], FloatArray]:
        return lambda x: np.where(x[:, 0] < 0.5, np.maximum(-0.5 * ((x[:, 0] - 0.5) / 0.004) ** 2, -fall), normal1(x))

    def normal1(points: FloatArray) -> FloatArray:
        return np.asarray(-0.5 * ((points[:, 0] - 0.5) / 0.004) ** 2)

    middle, covariance = np.array([0.5]), np.array([[0.004**2]])
    for fall, wanted in ((3.0, True), (15.0, False)):
        found = stretches(step(fall), middle, middle, covariance, StretchTuning())
        assert bool(found) is wanted
        assert not wanted or found[0].end[0] == pytest.approx(0.0, abs=1e-12)


def test_draws_from_stretches_are_the_posterior() -> None:
    """Twelve seeds, against the posterior on a grid.

    Below the edge lies .98 of the mass, uniform, where the normal has half of it within .02; quantiles average to .04
    (an sd of .29 by the root of twelve times a hundred effective draws is .008), and every fit ends with draws enough.
    """
    covariance = np.linalg.inv(PRECISION)
    space = sipe.ParameterSpace([sipe.Parameter(f"p{k}", 0.0, 1.0) for k in range(3)])
    prior, tuning, levels, seen = default_prior(space), ImportanceTuning(), [0.05, 0.5, 0.95], []
    found = proposals(stretches(floored, MEAN, MEAN, covariance, StretchTuning()), covariance)
    for seed in range(12):
        draws = Draws.none(3)
        for mean, spread in [(MEAN, 1.5**2 * covariance), *found]:
            draws = importance.drawn_from(draws, floored, mean, spread, tuning.share, prior, seed, tuning)
        own = importance.GaussianMixture([0.0], MEAN[None], covariance[None], space)
        while not importance.ended(draws, prior, tuning, 1 + len(found)):
            draws = importance.draw(draws, floored, own, prior, seed, tuning)
        weight = importance.weights(draws, prior)
        assert importance.effective(weight) >= tuning.enough
        fitted = importance.kernels(draws.points, weight, own, seed, tuning)
        seen.append(fitted.quantile(levels)[:, 1].numpy())
    # below the edge the others' normal holds, above it that with the second integrated out
    grid = np.linspace(0, 1, 20001)
    marginal_sd, mass = np.sqrt(covariance[1, 1]), np.where(grid < EDGE, 1.0, 0.0)
    mass += (grid >= EDGE) * np.exp(-0.5 * ((grid - EDGE) / marginal_sd) ** 2)
    exact = np.interp(levels, np.cumsum(mass) / mass.sum(), grid)
    print(np.mean(seen, axis=0), exact, np.std(seen, axis=0))
    np.testing.assert_allclose(np.mean(seen, axis=0), exact, atol=0.04)


def test_two_sides_at_once() -> None:
    """Of two parameters that change nothing below an edge one more proposal covers both."""
    covariance = np.diag([1e-4, 1e-4, 1e-6])

    def target(points: FloatArray) -> FloatArray:
        gaps = np.maximum(points - 0.5, [0.0, 0.0, -1.0])
        return np.asarray(-0.5 * (gaps**2 / np.diag(covariance)).sum(1))

    found = stretches(target, np.full(3, 0.5), np.full(3, 0.5), covariance, StretchTuning())
    assert {one.parameter for one in found} >= {0, 1}
    mean, spread = proposals(found, covariance)[-1]
    np.testing.assert_allclose(mean, [0.25, 0.25, 0.5], atol=0.01)
    np.testing.assert_allclose(np.sqrt(np.diag(spread)), [0.204, 0.204, 1e-3], rtol=0.05)
