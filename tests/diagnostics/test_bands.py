"""Bands hold what they say where logs are alike, and say so where they are not."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.diagnostics.bands import band_coverage, predictive_bands, widen, widening
from sipe_bayes.likelihood import Segments, bind
from sipe_bayes.posterior import GaussianMixture
from tests.problems.pendulums import log, pendulum


def windows(measured: FloatArray, logs: int) -> Any:
    """Of measurements (W, L, C), equally many windows of each log."""
    count, length, channels = measured.shape
    return SimpleNamespace(
        measured=measured,
        observed=np.isfinite(measured),
        owned=np.ones((count, length), bool),
        log=np.repeat(np.arange(logs), count // logs),
        trajectories=range(logs),
        rounding=np.zeros(channels),
        fitted=[f"c{k}" for k in range(channels)],
        simulator=SimpleNamespace(environment=None),
        channels=range(channels),
    )


def walks(seed: int, logs: int = 4) -> FloatArray:
    """Errors (40, 30, 2) that grow with the time since a window began, those of the second channel a hundred times."""
    steps = np.random.default_rng(seed).standard_normal((10 * logs, 30, 2)).cumsum(1)
    return steps * np.array([0.01, 1.0])


def test_bands_of_errors_that_grow_hold_nine_tenths_of_other_logs() -> None:
    """Over 20 pairs of sets the mean is within 2.5 % of 90 %: its standard error is below .6 %."""
    shares = []
    for seed in range(20):
        train, other = walks(2 * seed), walks(2 * seed + 1)
        nothing = np.zeros_like(train)
        margin = widening(windows(train, 4), nothing, nothing, nothing)
        assert (np.diff(margin, axis=0) >= 0).all()
        assert 50 < margin[-1, 1] / margin[-1, 0] < 200
        held = band_coverage(windows(other, 4), *widen(margin, nothing, nothing))
        assert held is not None
        shares.append(held.share)
    print(np.mean(shares))
    assert 0.9 <= np.mean(shares) <= 0.95  # the level of 40 pieces is .9225


def test_errors_twice_as_large_elsewhere_are_seen() -> None:
    train, nothing = walks(1), np.zeros((40, 30, 2))
    margin = widening(windows(train, 4), nothing, nothing, nothing)
    held = band_coverage(windows(2 * walks(2), 4), *widen(margin, nothing, nothing))
    assert held is not None
    assert held.share + 2 * held.error < 0.85
    assert held.pieces == 80


def test_a_wide_band_of_the_posterior_is_not_narrowed_and_gaps_do_no_harm() -> None:
    train = walks(1)
    train[3, 5:9, 0], train[:, :, 1] = np.nan, np.nan
    margin = widening(windows(train, 4), np.zeros_like(train), np.full_like(train, -9.0), np.full_like(train, 9.0))
    assert not margin[:, 0].any()
    held = band_coverage(windows(train, 4), np.full_like(train, -9.0), np.full_like(train, 9.0))
    assert held is not None
    assert (held.share, list(held.half)) == (1.0, ["c0"])
    train[:, :, 0] = np.nan
    assert band_coverage(windows(train, 4), train, train) is None


@pytest.mark.parametrize("lacking", [False, True])
def test_bands_of_a_calibrated_pendulum(lacking: bool) -> None:
    """A right model's hold about nine tenths of another log; of one that lacks something both sides are as wide."""
    simulator = pendulum()
    theta = simulator.space.normalise(np.array([0.6, 0.08]))
    posterior = GaussianMixture([0.0], [theta + np.array([0.02, 0.0])], [1e-4 * np.eye(2)], simulator.space)
    logs = {
        use: bind(Segments(0.5), simulator, Trajectories.stack([log(simulator, [0.6, 0.08], seed)]))
        for use, seed in (("train", 1), ("holdout", 2))
    }
    predicted = {use: own.predict(theta[None], own.no_starts()[None])[0] for use, own in logs.items()}
    bands = predictive_bands(logs, predicted, theta, posterior, 0, lacking)
    held = band_coverage(logs["holdout"], *bands["holdout"])
    assert held is not None
    assert 0.8 < held.share <= 1
    low, high = bands["holdout"]
    own = logs["holdout"].owned
    even = np.abs(low + high - 2 * predicted["holdout"][0])[own].max()
    assert (even < 1e-9) == lacking
