"""A cart on a rail: with gear and mass, which only together show; and with the files of a whole calibration."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.simulation.simulator import Simulator

GEARED = """
<mujoco><option timestep="0.01" gravity="0 0 0"/>
  <worldbody><body name="cart"><joint name="slide" type="slide" axis="1 0 0"/>
    <geom size="0.1" mass="2" contype="0" conaffinity="0"/></body></worldbody>
  <actuator><motor name="motor" joint="slide" gear="3"/></actuator></mujoco>"""
DAMPED = """
<mujoco><option timestep="0.02" gravity="0 0 0" integrator="Euler"/>
  <worldbody><body name="cart"><joint name="slide" type="slide" axis="1 0 0" damping="0.5"/>
    <geom size="0.1" mass="1" contype="0" conaffinity="0"/></body></worldbody>
  <actuator><motor name="motor" joint="slide"/></actuator></mujoco>"""
CONFIG = """
model = "cart.xml"
window = 0.6
search = {restarts = 1, candidates = 0}
noise = {model = "white"}
commands = [{actuator = "motor", column = "force", unit = "N"}]
measurements = [{column = "place", target = "joint:slide.position", unit = "m"}]
logs = [{file = "log.csv"}]
[[parameters]]
name = "mass"
target = "body:cart.mass"
bounds = [0.5, 1.5]
[[parameters]]
name = "damping"
target = "joint:slide.damping"
bounds = [0.0, 2.0]
"""


def cart(scale: str = "linear") -> Simulator:
    """Unknown gear, mass and wind, which nothing feels."""
    parameters = [
        Parameter("gear", 1.0, 6.0, scale=scale, targets=("actuator:motor.gear",)),  # type: ignore[arg-type]
        Parameter("mass", 1.0, 4.0, scale=scale, targets=("body:cart.mass",)),  # type: ignore[arg-type]
        Parameter("wind", 0.0, 5.0, targets=("option.wind_x",)),
    ]
    return Simulator(MjcfEnvironment.build(GEARED, parameters, ["motor"], ["joint:slide.position"]), num_threads=1)


def write_configuration(folder: Path) -> Path:
    """A cart's model, its log and the TOML file of its calibration, whose path is returned."""
    model = mujoco.MjModel.from_xml_string(DAMPED)
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    rows = ["time,force,place"]
    for k in range(91):
        force = 2.0 * np.sin(1.3 * 0.02 * k * 2 * np.pi) + np.sin(0.6 * 0.02 * k * 2 * np.pi)
        rows.append(f"{0.02 * k:.3f},{force:.6f},{data.qpos[0] + 0.005 * rng.standard_normal():.6f}")
        data.ctrl[0] = force
        mujoco.mj_step(model, data)
    (folder / "log.csv").write_text("\n".join(rows) + "\n")
    (folder / "cart.xml").write_text(DAMPED)
    (folder / "config.toml").write_text(CONFIG)
    return folder / "config.toml"
