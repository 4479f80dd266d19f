"""Numbers and names as words of a report."""

from __future__ import annotations

import pytest

from sipe_bayes.report.words import unit_text, with_unit


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


@pytest.mark.parametrize(
    ("unit", "text"),
    [
        ("kg m^2", "kg m²"),
        ("1", ""),
        ("rad/s", "rad/s"),
        ("force", "N or N m"),
        ("force/command", "N or N m per unit of command"),
        ("N m/command", "N m per unit of command"),
        ("force/velocity", "N or N m per rad/s or m/s"),
        ("force/(position s)", "N or N m per (position s)"),
    ],
)
def test_a_unit_says_what_it_may_be(unit: str, text: str) -> None:
    assert unit_text(unit) == text
