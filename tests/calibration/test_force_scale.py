"""Who frees a gain and all that it drives is asked for one of them before the fit; who knows a mass is not."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

import sipe_bayes as sipe
from sipe_bayes.calibration.force_scale import find_open_scale
from sipe_bayes.cli.app import main
from tests.problems.pendulums import log, pendulum

MODEL = """<mujoco><option timestep="0.01"/>
<worldbody><body name="rod"><joint name="hinge" axis="0 1 0" damping="0.05"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.01" mass="0.6" contype="0" conaffinity="0"/></body></worldbody>
<actuator><motor name="motor" joint="hinge"/></actuator></mujoco>"""
PARAMETER = '[[parameters]]\nname = "{}"\ntargets = ["{}"]\nbounds = [{}, {}]\n'
ROWS = {
    "gain": ("actuator:motor.gain", 0.5, 2.0),
    "mass": ("body:rod.mass", 0.3, 1.2),
    "damping": ("joint:hinge.damping", 0.0, 0.2),
}


def configuration(folder: Path, free: list[str], prior: str = "") -> Path:
    recorded = log(pendulum(), [0.6, 0.08], 2)
    rows = ["t,angle,torque"]
    for k, angle in enumerate(recorded.observations[:, 0].tolist()):
        rows.append(f"{k * recorded.dt:.3f},{angle:.6f},{recorded.actions[min(k, len(recorded) - 1), 0]:.6f}")
    (folder / "log.csv").write_text("\n".join(rows))
    (folder / "rod.xml").write_text(MODEL)
    head = 'model = "rod.xml"\nwindow = 0.5\n[columns]\ntime = { column = "t", unit = "s" }\n'
    head += '[[measurements]]\ntarget = "joint:hinge.position"\ncolumn = "angle"\nunit = "rad"\n'
    head += '[[commands]]\nactuator = "motor"\ncolumn = "torque"\nunit = "N m"\n[[logs]]\nfile = "log.csv"\n'
    config = folder / "calibrate.toml"
    config.write_text(head + "".join(PARAMETER.format(name, *ROWS[name]) for name in free) + prior)
    return config


@pytest.mark.parametrize(
    ("free", "prior", "asked"),
    [
        (["gain", "mass", "damping"], "", True),
        (["gain", "damping"], "", False),  # the mass is known
        (["mass", "damping"], "", False),  # the force is
        (["gain", "mass"], "", False),  # the damping is
        (["gain", "damping", "mass"], "prior = { mean = 0.6, sd = 0.01 }\n", False),  # the mass was weighed
    ],
)
def test_a_scale_is_open_where_all_forces_and_masses_are_free(
    free: list[str], prior: str, asked: bool, tmp_path: Path
) -> None:
    problem = sipe.prepare(configuration(tmp_path, free, prior), 1)
    assert find_open_scale(problem) == (tuple(free) if asked else ())


def test_the_question_stands_before_the_first_estimate(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    config = configuration(tmp_path, ["gain", "mass", "damping"])
    words = ["sipe", "calibrate", str(config), "--threads", "1", "--out", str(tmp_path / "o"), "--time-limit", "1"]
    monkeypatch.setattr(sys, "argv", words)
    with pytest.raises(SystemExit):
        main()
    errors = capsys.readouterr().err
    assert "no motion tells how large gain, mass, damping are together" in errors
    assert "fix one of them at a measured value" in errors
