"""What numbers say by themselves."""

import numpy as np
import pytest
import scipy.signal

from sipe_bayes.calibration.signals import likeness, slope_of, turn_of, white_share

TIME = np.arange(2000) * 0.004
ANGLE = np.sin(3 * TIME) + 0.3 * np.sin(11 * TIME)
SPEED = 3 * np.cos(3 * TIME) + 3.3 * np.cos(11 * TIME)


@pytest.mark.parametrize("factor", [1.0, -1.0, 180 / np.pi, -0.1])
def test_the_slope_of_a_rounded_position(factor: float) -> None:
    rounded = np.round(factor * ANGLE / 2e-3) * 2e-3
    slope = slope_of(rounded, SPEED + 0.05 * np.random.default_rng(0).standard_normal(len(SPEED)), 0.004)
    assert slope.factor == pytest.approx(factor, rel=0.02)
    assert slope.share > 0.97
    assert abs(slope.lag) < 0.6


def test_a_filter_s_lag_shows_and_another_signal_is_no_slope() -> None:
    late = scipy.signal.lfilter([0.2], [1, -0.8], SPEED)  # four samples at low frequencies
    assert slope_of(ANGLE, late).lag == pytest.approx(4, abs=1)
    assert slope_of(ANGLE, np.sin(7 * TIME)).share < 0.2
    assert likeness(2 * ANGLE, np.roll(ANGLE, 5)) == pytest.approx((2, 1), rel=0.01)  # a set-point and what follows it
    assert likeness(np.cos(23 * TIME), ANGLE).share < 0.2


@pytest.mark.parametrize("turn", [360.0, 2 * np.pi, 1.0])
def test_turns_are_seen_and_nothing_else(turn: float) -> None:
    angle = turn * 1.7 * ANGLE
    assert turn_of((angle + turn / 2) % turn - turn / 2) == pytest.approx(turn)
    assert turn_of(angle) == 0.0
    assert turn_of(0.4 * turn * np.sign(ANGLE)) == 0.0  # switched, not turned


def test_filtered_columns_lack_noise_above() -> None:
    noise = 1e-3 * np.random.default_rng(0).standard_normal(len(TIME))
    assert 0.5 < white_share(ANGLE + noise) < 2
    assert white_share(ANGLE + scipy.signal.lfilter(*scipy.signal.butter(2, 0.1), noise)) < 0.05
