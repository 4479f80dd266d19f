"""An earlier run's posterior as the prior, and a log recorded under position control, from the configuration on."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import mujoco
import numpy as np
import pandas as pd
import pytest

import sipe_bayes as sipe
from sipe_bayes.calibration.config_fields import ConfigError
from sipe_bayes.calibration.run import run

MODEL = """
<mujoco>
  <option timestep="0.005" integrator="implicitfast"/>
  <worldbody>
    <body name="rod">
      <joint name="hinge" axis="0 1 0" damping="0.05"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.01" mass="0.6" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <actuator>{actuator}</actuator>
</mujoco>
"""
SERVO = '<position name="servo" joint="hinge" kp="8" kv="0.4"/>'
MOTOR = '<motor name="servo" joint="hinge"/>'
CONFIG = """
model = "model.xml"
window = 1.0
commands = [{{actuator = "servo", column = "command", unit = "{unit}"}}]
measurements = [{{name = "angle", column = "angle", target = "joint:hinge.position", unit = "rad"}}]
logs = [{logs}]
{prior}
[noise]
model = "white"
{parameters}
"""
MASS = """
[[parameters]]
name = "mass"
target = "body:rod.mass"
bounds = [0.3, 1.0]
[[parameters]]
name = "damping"
target = "joint:hinge.damping"
bounds = [0.0, 0.3]
"""
GAINS = """
[[parameters]]
name = "kp"
target = "actuator:servo.kp"
bounds = [2.0, 20.0]
[[parameters]]
name = "kv"
target = "actuator:servo.kv"
bounds = [0.0, 2.0]
"""


def write(folder: Path, actuator: str, scale: float, seeds: list[int]) -> None:
    """Logs log0.csv, ... of the model as written, each with its own command and 2 mrad of noise."""
    xml = MODEL.format(actuator=actuator)
    (folder / "model.xml").write_text(xml)
    model = mujoco.MjModel.from_xml_string(xml)
    for k, seed in enumerate(seeds):
        rng, data = np.random.default_rng(seed), mujoco.MjData(model)
        time = np.arange(401) * 0.01
        command = scale * np.sin(2 * np.pi * rng.uniform(0.4, 1.5, 3) * time[:, None] + rng.uniform(0, 6, 3)).sum(1)
        angle = np.empty(len(time))
        for t in range(len(time)):
            angle[t], data.ctrl[0] = data.qpos[0], command[t]
            mujoco.mj_step(model, data, 2)
        angle += rng.normal(0, 0.002, len(time))
        pd.DataFrame({"time": time, "command": command, "angle": angle}).to_csv(folder / f"log{k}.csv", index=False)


def config(folder: Path, name: str, logs: list[int], parameters: str, unit: str = "N m", prior: str = "") -> Path:
    entries = ", ".join(f'{{file = "log{k}.csv"}}' for k in logs)
    source = f'prior = {{from = "{prior}"}}' if prior else ""
    path = folder / f"{name}.toml"
    path.write_text(CONFIG.format(unit=unit, logs=entries, prior=source, parameters=parameters))
    return path


@pytest.fixture(autouse=True, scope="module")
def unreported() -> Iterator[None]:
    """Reports, which take longer than these fits, have tests of their own."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("sipe_bayes.calibration.output.write_report", lambda *_: None)
        yield


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory, unreported: None) -> Path:
    """A folder with logs 0 and 1, and the run of log 0 in ``first``."""
    folder = tmp_path_factory.mktemp("logs")
    write(folder, MOTOR, 0.4, [0, 1])
    run(config(folder, "first", [0], MASS), out=folder / "first")
    return folder


def test_one_log_after_the_other_is_both_together(logs: Path) -> None:
    """Bayes' rule: the posterior of log 0 as the prior for log 1 against a fit of both.

    The noise is estimated in each fit for itself, from 400 samples, which alone may move a width by a tenth.
    """
    both = run(config(logs, "both", [0, 1], MASS), out=logs / "both")
    earlier = str(logs / "first" / "posterior")
    then = run(config(logs, "then", [1], MASS, prior=earlier), out=logs / "then")
    for a, b in zip(then.parameters, both.parameters, strict=True):
        print(a.name, (a.mean - b.mean) / b.sd, a.sd / b.sd)
        assert abs(a.mean - b.mean) < 0.3 * b.sd
        assert a.sd == pytest.approx(b.sd, rel=0.15)
    assert not any("counted twice" in w for w in then.warnings)
    again = run(config(logs, "again", [0], MASS, prior=earlier), out=logs / "again")
    assert any("counted twice" in w and "log0" in w for w in again.warnings)


def test_an_earlier_posterior_of_another_unit_is_refused(logs: Path, tmp_path: Path) -> None:
    shutil.copytree(logs, tmp_path, dirs_exist_ok=True)
    side = tmp_path / "first" / "posterior.json"
    text = json.loads(side.read_text())
    text["space"][0]["unit"] = "g"
    side.write_text(json.dumps(text))
    with pytest.raises(ConfigError, match="'g' there and has 'kg' here"):
        sipe.prepare(config(tmp_path, "then", [0], MASS, prior=str(tmp_path / "first" / "posterior")))


def test_a_position_controlled_log_gives_its_gains(tmp_path: Path) -> None:
    """The command is the set-point in rad.

    Both gains within 4 posterior sds of the truth (false alarm 0.01 %) and sharp.
    """
    write(tmp_path, SERVO, 0.5, [0])
    found = run(config(tmp_path, "servo", [0], GAINS, unit="rad"), out=tmp_path / "out")
    for p, truth in zip(found.parameters, (8.0, 0.4), strict=True):
        assert abs(p.mean - truth) < 4 * p.sd, (p.name, p.mean, p.sd)
        assert p.contraction > 0.9
