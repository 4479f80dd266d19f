"""Clocks that jitter: whether the samples do, or only their stamps, is seen in the signals."""

from __future__ import annotations

import numpy as np
import pytest

from sipe_bayes.calibration.grid import control_grid

RATE = 190.0


def signals(time: np.ndarray) -> list[np.ndarray]:
    return [np.sin(2 * np.pi * 3 * time), np.cos(2 * np.pi * 2 * time)]


@pytest.mark.parametrize("of_stamps", [True, False])
def test_stamps_that_jitter_are_not_the_samples(of_stamps: bool) -> None:
    """Stamps rounded as a serial line's: their median period is off by a percent, and commands fall on wrong rows."""
    regular = np.arange(760) / RATE
    stamps = np.round(regular + np.clip(np.random.default_rng(0).normal(0, 3e-4, 760), -1e-3, 1e-3), 4)
    stamps -= stamps[0]
    grid = control_grid(stamps, None, signals(regular if of_stamps else stamps))
    assert grid.regular is of_stamps
    assert 1 / grid.dt == pytest.approx(RATE, rel=1e-4)
    if of_stamps:
        np.testing.assert_array_equal(grid.rows, np.arange(760))


def test_a_long_log_is_counted_through_a_bad_first_guess() -> None:
    """The median of rounded periods would lose count: 5.3 for 5.263 ms is a row in every 142."""
    stamps = np.round(np.arange(4000) / RATE, 3)
    grid = control_grid(stamps, None, signals(np.arange(4000) / RATE))
    assert grid.regular
    assert grid.samples == 4000
    assert 1 / grid.dt == pytest.approx(RATE, rel=1e-5)


def test_dropped_samples_stay_dropped_under_jitter() -> None:
    regular = np.delete(np.arange(760), [100, 101, 300]) / RATE
    stamps = regular + np.clip(np.random.default_rng(1).normal(0, 3e-4, len(regular)), -1e-3, 1e-3)
    grid = control_grid(stamps - stamps[0], None, signals(regular))
    np.testing.assert_array_equal(grid.rows, np.delete(np.arange(760), [100, 101, 300]))


def test_a_coarse_encoder_on_a_slow_ramp_says_nothing_of_jitter() -> None:
    """Regular samples to ticks of 1.5 mrad, of slow ramps: none of 40 logs is resampled."""
    regular = np.arange(760) / RATE
    for seed in range(40):
        rng = np.random.default_rng(seed)
        stamps = np.round(regular + np.clip(rng.normal(0, 3e-4, 760), -1e-3, 1e-3), 4)
        tick = 2 * np.pi / 4096
        ramp = rng.uniform(0.2, 1.2) * np.arcsin(np.sin(2 * np.pi * rng.uniform(0.2, 0.4) * regular))
        encoder = tick * np.round((ramp + rng.normal(0, 5e-4, 760)) / tick)
        assert control_grid(stamps - stamps[0], None, [encoder]).regular, seed
