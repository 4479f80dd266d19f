"""A pendulum's log, its configuration, and the command `sipe calibrate` on it, in this process or in one of its own."""

from __future__ import annotations

import functools
import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pandas as pd
from typer.testing import CliRunner

import sipe_bayes as sipe
from sipe_bayes.cli.app import app

MODEL = """\
<mujoco model="pendulum">
  <option timestep="0.005" integrator="implicitfast"/>
  <worldbody>
    <body name="rod">
      <joint name="hinge" type="hinge" axis="0 1 0" damping="0.02"/>
      <geom name="rod" type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="0.5"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge"/></actuator>
</mujoco>
"""

CONFIG = """\
model = "pendulum.xml"
window = 0.5

[[commands]]
actuator = "motor"
column = "torque"
unit = "N m"

[[measurements]]
name = "angle"
column = "position"
target = "joint:hinge.position"
unit = "rad"

[[logs]]
file = "log.csv"
span = [0.0, 2.0]

[[logs]]
file = "log.csv"
name = "rest"
use = "holdout"
span = [2.01, 3.0]

[[parameters]]
name = "mass"
target = "body:rod.mass"
bounds = [0.3, 0.8]

[[parameters]]
name = "damping"
target = "joint:hinge.damping"
bounds = [0.01, 0.2]
scale = "log"

[noise]
model = "white"
"""

TRUTH = {"mass": 0.6, "damping": 0.05}
SAMPLES, DT, NOISE = 301, 0.01, 0.002


@functools.cache
def swing() -> pd.DataFrame:
    """A recorded log of the pendulum with the true parameters."""
    model = mujoco.MjModel.from_xml_string(MODEL)
    scale = TRUTH["mass"] / model.body_mass[1]
    model.body_mass[1] *= scale
    model.body_inertia[1] *= scale
    model.dof_damping[0] = TRUTH["damping"]
    data = mujoco.MjData(model)
    mujoco.mj_setConst(model, data)
    time_s = np.arange(SAMPLES) * DT
    torque = 1.5 * np.sin(2 * np.pi * time_s) + 0.7 * np.sin(2 * np.pi * 2.3 * time_s)
    angle = np.empty(SAMPLES)
    for k in range(SAMPLES):
        angle[k] = data.qpos[0]
        data.ctrl[0] = torque[k]
        mujoco.mj_step(model, data, 2)
    angle += np.random.default_rng(0).normal(0, NOISE, SAMPLES)
    return pd.DataFrame({"time": time_s, "torque": torque, "position": angle})


def write_case(folder: Path, log: pd.DataFrame | None = None) -> Path:
    """The model, the configuration and the log in a folder; returns the configuration."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "pendulum.xml").write_text(MODEL)
    (folder / "config.toml").write_text(CONFIG)
    (swing() if log is None else log).to_csv(folder / "log.csv", index=False)
    return folder / "config.toml"


def call(*arguments: object) -> Any:
    return CliRunner().invoke(app, ["calibrate", *map(str, arguments), "--threads", "2"])


def text(old: str, new: str, file: str = "config.toml") -> Callable[[Path], None]:
    """Replace ``old`` in a file of the case."""

    def change(folder: Path) -> None:
        content = (folder / file).read_text()
        assert content.count(old) >= 1
        (folder / file).write_text(content.replace(old, new, 1))

    return change


def table(edit: Callable[[pd.DataFrame], pd.DataFrame]) -> Callable[[Path], None]:
    """Change the log."""
    return lambda folder: edit(pd.read_csv(folder / "log.csv")).to_csv(folder / "log.csv", index=False)


def gone(file: str) -> Callable[[Path], None]:
    return lambda folder: (folder / file).unlink()


def contents(folder: Path) -> dict[str, str]:
    return {
        str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() if p.is_file() else ""
        for p in sorted(folder.rglob("*"))
    }


def command(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "sipe_bayes.cli.app", "calibrate", *map(str, arguments)]


def environment() -> dict[str, str]:
    here = str(Path(sipe.__file__).parents[1])
    return {**os.environ, "PYTHONPATH": here, "OMP_NUM_THREADS": "1"}


def sipe_command(folder: Path, *arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command(*arguments), cwd=folder, env=environment(), capture_output=True, text=True, check=False
    )


def strict_json(words: str) -> Any:
    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is not JSON")

    return json.loads(words, parse_constant=refuse)
