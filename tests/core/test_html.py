"""What a notebook shows: every name and number, hostile ones escaped, long tables cut."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sipe_bayes.core.html import html_table
from sipe_bayes.core.parameters import Parameter, ParameterSpace
from sipe_bayes.core.trajectory import Trajectory
from sipe_bayes.envs.registry import make_task
from sipe_bayes.simulation.simulator import Simulator
from tests.problems.calibrations import make_calibration
from tests.problems.html import cells

HOSTILE = "<script>alert('x')</script>&"


def test_texts_are_escaped() -> None:
    html = html_table(HOSTILE, (HOSTILE,), [(HOSTILE,)], [HOSTILE])
    assert "<script" not in html
    assert html.count("&lt;script&gt;") == 4
    assert cells(html) == [[HOSTILE]]


def test_long_tables_are_cut_and_say_so() -> None:
    html = html_table("", ("k",), ((k,) for k in range(60)))
    assert len(cells(html)) == 50
    assert "and 10 more" in html


def test_space() -> None:
    space = ParameterSpace([Parameter("mass", 0.5, 2.0, unit="kg"), Parameter(HOSTILE, 1e-3, 1.0, scale="log")])
    assert [row[:4] for row in cells(space._repr_html_())] == [
        ["mass", "0.5 to 2", "kg", "linear"],
        [HOSTILE, "0.001 to 1", "", "log"],
    ]


def test_trajectory() -> None:
    observations = np.array([[0.0, np.nan], [2.0, np.nan], [-1.0, np.nan]])
    html = Trajectory(observations, np.zeros((2, 1)), 0.1, name="one", channels=("angle", "rate"))._repr_html_()
    assert cells(html) == [["angle", "-1 to 2", "0"], ["rate", "nothing measured", "3"]]
    assert "2 control steps of 0.1 s" in html


def test_simulator() -> None:
    simulator = Simulator(make_task("Pendulum"))
    html = simulator._repr_html_()
    assert [row[0] for row in cells(html)] == list(simulator.space.names)
    assert f"control step {simulator.dt:g} s" in html


def test_calibration() -> None:
    calibration = make_calibration(names=("mass", HOSTILE, "drag"))
    html = calibration._repr_html_()
    assert [row[0] for row in cells(html)] == ["mass", HOSTILE, "drag"]
    assert "<script" not in html
    np.testing.assert_allclose([float(row[1]) for row in cells(html)], [p.mode for p in calibration.parameters], 1e-3)


def test_a_calibration_gives_its_report(tmp_path: Path) -> None:
    calibration = make_calibration(names=(HOSTILE, "drag"))
    page = calibration.report()
    page.save(tmp_path / "report.html")
    assert (tmp_path / "report.html").read_text(encoding="utf-8") == page.html
    frame = page._repr_html_()
    assert frame.startswith('<iframe srcdoc="&lt;!DOCTYPE html&gt;')
    assert frame.count("<") == 2
    assert "drag" in frame
