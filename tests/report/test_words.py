"""Numbers and names as words of a report."""

from __future__ import annotations

import pytest

from sipe_bayes.report.words import with_unit


@pytest.mark.parametrize(
    ("name", "unit", "text"),
    [
        ("pan_pos_deg", "rad", "pan_pos [rad]"),
        ("encoder_mm", "m", "encoder [m]"),
        ("q (deg)", "rad", "q [rad]"),
        ("wheel_rpm", "rad/s", "wheel [rad/s]"),
        ("reach_m", "m", "reach_m [m]"),
        ("joint_a", "rad", "joint_a [rad]"),
        ("deg", "rad", "deg [rad]"),
        ("obs/q[0]", "rad", "obs/q[0] [rad]"),
        ("pan_pos_deg", "", "pan_pos_deg"),
    ],
)
def test_one_unit_stands_beside_a_name(name: str, unit: str, text: str) -> None:
    assert with_unit(name, unit) == text
