"""What `sipe calibrate` prints of errors: a line for a channel, one for a vector, and how many more there are."""

from __future__ import annotations

from dataclasses import replace

import pytest

from sipe_bayes.cli.app import print_calibration
from sipe_bayes.core.findings import Code, Severity
from sipe_bayes.diagnostics.records import ChannelScore
from tests.problems.calibrations import make_calibration, noticed


def printed(capsys: pytest.CaptureFixture[str], channels: dict[str, str]) -> list[str]:
    """The lines about held-out errors of two logs, .03 in each channel and .06 with the model as given."""
    rows = [ChannelScore(log, name, unit, 0.03, 0.06) for log in "ab" for name, unit in channels.items()]
    print_calibration(replace(make_calibration(), holdout=rows))
    return [line for line in capsys.readouterr().out.splitlines() if line.startswith("held out")]


def test_a_vector_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    """Of the lengths of its errors: .03 times the root of three."""
    pose = {f"cube.{name}_{axis}": unit for name, unit in (("place", "m"), ("turn", "rad")) for axis in "xyz"}
    first, second = printed(capsys, {**pose, "lid_x": "rad"})[:2]
    assert first.startswith("held out, 2 logs, cube.place: RMSE 0.052 m; model as given 0.104")
    assert second.startswith("held out, 2 logs, cube.turn: RMSE 0.052 rad")
    assert printed(capsys, {"lid_x": "rad"})[0].startswith("held out, 2 logs, lid_x: RMSE 0.03 rad")


def test_channels_beyond_three_are_counted(capsys: pytest.CaptureFixture[str]) -> None:
    lines = printed(capsys, {f"q{k}": "rad" for k in range(5)})
    assert len(lines) == 3
    assert lines[-1].endswith("[2 more in the report]")
    assert "more" not in "".join(printed(capsys, {f"q{k}": "rad" for k in range(3)}))


def test_parameters_without_a_row_are_named(capsys: pytest.CaptureFixture[str]) -> None:
    """Twenty lines hold a few rows; what became of the others is no riddle."""
    print_calibration(make_calibration(size=24))
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= 20
    (line,) = [line for line in lines if line.startswith("values and intervals of")]
    rows = [line.split()[0] for line in lines if line.split()[0].startswith("p")]
    first = int(rows[-1][1:]) + 1
    named = ", ".join(f"p{k}" for k in range(first, first + 4))
    assert line == f"values and intervals of {named} and {20 - first} more: in the report"


def test_what_no_log_tells_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    """Of notes it alone says that values may be off by more than their intervals."""
    notes = [
        noticed(code, severity=Severity.NOTE, text=f"about {code.name}") for code in (Code.UNTOLD, Code.LEAST_SQUARES)
    ]
    print_calibration(replace(make_calibration(), findings=tuple(notes)))
    lines = capsys.readouterr().out.splitlines()
    assert "note: about UNTOLD" in lines
    assert "what these mean and what to do: sipe explain untold" in lines
    assert "LEAST_SQUARES" not in "".join(lines)
