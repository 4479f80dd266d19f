"""Numbers and names as words of a report."""

from __future__ import annotations

import math

import pytest

from sipe_bayes.core.findings import Code, finding, singular
from sipe_bayes.diagnostics.records import ChannelNoise, ChannelScore, improvement
from sipe_bayes.report.templates import breakable
from sipe_bayes.report.words import correlation_time, times, unit_text, with_unit


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
    ("rmse_default", "rmse", "text"),
    [
        (0.3, 0.1, "3.0 times smaller"),
        (0.1, 0.3, "3.0 times larger"),
        (0.1, 0.1, "about the same"),
        (0.1, math.inf, "it diverges"),
        (math.inf, 0.1, "–"),
        (math.inf, math.inf, "–"),
    ],
)
def test_what_became_of_an_error(rmse_default: float, rmse: float, text: str) -> None:
    assert times(improvement([ChannelScore("log", "angle", "rad", rmse, rmse_default)])) == text


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


@pytest.mark.parametrize(
    ("noise", "text"),
    [
        (ChannelNoise(0.1, 0.0), "white"),
        (ChannelNoise(0.1, 0.25), "0.25 s"),
        (ChannelNoise(0.1, 12.0, tau_at_limit=True), "12 s or more (as long as the logs)"),
    ],
)
def test_a_correlation_time_at_its_limit_is_not_told_as_if_it_were_measured(noise: ChannelNoise, text: str) -> None:
    assert correlation_time(noise) == text


def test_names_break_at_underscores_and_are_escaped() -> None:
    assert breakable("pan_drive_kv") == "pan_<wbr>drive_<wbr>kv"
    assert breakable("a<b_c") == "a&lt;b_<wbr>c"


@pytest.mark.parametrize(
    ("text", "one"),
    [
        ("1 samples in 1 logs", "1 sample in 1 log"),
        ("1 of 21 samples, 0.1 samples, 11 logs", "1 of 21 samples, 0.1 samples, 11 logs"),
    ],
)
def test_one_is_one(text: str, one: str) -> None:
    assert singular(text) == one
    assert "q: 1 sample masked" in finding(Code.LOG_WILD, channel="q", count=1).text
