"""Who frees a gain and all that it drives is asked for one of them before the fit; who knows a mass is not."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

import sipe_bayes as sipe
from sipe_bayes.calibration.force_scale import find_open_scale
from sipe_bayes.cli.app import main
from tests.problems.lacking import write_lacking

GAIN = '[[parameters]]\nname = "gain"\ntarget = "actuator:motor.gain"\nbounds = [{}, {}]\n'
DAMPING = '\n[[parameters]]\nname = "damping"\ntarget = "joint:hinge.damping"\nbounds = [0.0, 0.2]\n'


def configuration(folder: Path, gain: str, prior: str = "", damped: bool = True) -> Path:
    config = write_lacking(folder)
    text = config.read_text().replace("bounds = [0.3, 1.0]\n", "bounds = [0.3, 1.0]\n" + prior)
    text = text if damped else text.replace(DAMPING, "")
    config.write_text(text.replace("[structure]", gain + "[structure]"))
    return config


@pytest.mark.parametrize(
    ("gain", "prior", "damped", "asked"),
    [
        (GAIN.format(0.5, 2.0), "", True, True),
        ("", "", True, False),  # the force is known
        (GAIN.format(0.5, 2.0), "", False, False),  # the damping is
        (GAIN.format(0.5, 2.0), "prior = { mean = 0.6, sd = 0.01 }\n", True, False),  # the mass was weighed
        (GAIN.format(0.95, 1.05), "", True, False),  # the bounds say about as much
    ],
)
def test_a_scale_is_open_where_all_forces_and_masses_are_free(
    gain: str, prior: str, damped: bool, asked: bool, tmp_path: Path
) -> None:
    problem = sipe.prepare(configuration(tmp_path, gain, prior, damped), 1)
    assert find_open_scale(problem) == (("rod_mass", "damping", "gain") if asked else ())


def test_the_question_stands_before_the_first_estimate(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    config = configuration(tmp_path, GAIN.format(0.5, 2.0))
    words = ["sipe", "calibrate", str(config), "--threads", "1", "--out", str(tmp_path / "o"), "--time-limit", "1"]
    monkeypatch.setattr(sys, "argv", words)
    with pytest.raises(SystemExit):
        main()
    errors = capsys.readouterr().err
    assert "rod_mass, damping, gain are not identifiable together" in errors
    assert "Fix one of them at a measured value" in errors
