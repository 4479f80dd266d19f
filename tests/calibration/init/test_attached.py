"""Masses of what is attached to a link, and machines that nothing but an inertial unit measures."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pandas as pd
import pytest

from sipe_bayes.calibration.init.propose import propose

ARM = """<mujoco><option timestep="0.005" integrator="implicitfast"><flag contact="disable"/></option><worldbody>
  <body name="upper"><joint name="shoulder" axis="0 1 0" damping=".3"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.4" size=".02" mass="1"/>
  <body name="lower" pos="0 0 -.4"><joint name="elbow" axis="0 1 0" damping=".2"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass=".6"/>
  <body name="tool" pos=".1 0 -.3"><geom type="sphere" size=".03" mass=".3"/></body></body></body></worldbody>
  <actuator><motor name="shoulder" joint="shoulder" gear="8"/>
  <motor name="elbow" joint="elbow" gear="4"/></actuator></mujoco>"""
ROLLER = """<mujoco><option timestep="0.005" integrator="implicitfast"/><worldbody>
  <geom name="floor" type="plane" size="9 9 .1"/><body name="hull" pos="0 0 .1"><freejoint/>
  <geom name="hull" type="sphere" size=".1" mass="1"/><site name="imu"/></body></worldbody>
  <sensor><gyro name="gyro" site="imu"/><accelerometer name="accelerometer" site="imu"/></sensor></mujoco>"""


def _arm_log(folder: Path, unit: str) -> None:
    """Commands as shares of the largest, or in N m."""
    (folder / "arm.xml").write_text(ARM)
    model = mujoco.MjModel.from_xml_string(ARM)
    data, rows, rng = mujoco.MjData(model), [], np.random.default_rng(0)
    for k in range(600):
        time = 0.01 * k
        data.ctrl[:] = 0.4 * np.sin(5 * time) + 0.2 * np.sin(11 * time), 0.3 * np.sin(7 * time + 1)
        force = data.ctrl * (1 if unit == "duty" else model.actuator_gear[:, 0])
        rows.append([time, *force, *(data.qpos + 1e-4 * rng.standard_normal(2))])
        mujoco.mj_step(model, data, 2)
    pd.DataFrame(rows, columns=["t", f"shoulder_{unit}", f"elbow_{unit}", "shoulder_rad", "elbow_rad"]).to_csv(
        folder / "log.csv", index=False
    )


@pytest.mark.parametrize(("end", "factor"), [(40.0, 40.0), (1.0, 1.0), (None, 1.0)])
def test_a_share_is_one_of_the_ctrlrange(end: float | None, factor: float, tmp_path: Path) -> None:
    _arm_log(tmp_path, "duty")
    limits = "" if end is None else f'ctrllimited="true" ctrlrange="-{end} {end}" '
    (tmp_path / "arm.xml").write_text(ARM.replace("<motor ", f"<motor {limits}"))
    table = pd.read_csv(tmp_path / "log.csv")
    table[["shoulder_cmd_pct", "elbow_cmd_pct"]] = 100 * table[["shoulder_duty", "elbow_duty"]]
    table.drop(columns=["shoulder_duty", "elbow_duty"]).to_csv(tmp_path / "log.csv", index=False)
    draft = propose(tmp_path / "arm.xml", [tmp_path / "log.csv"], tmp_path)
    assert [(r.unit, r.factor) for r in draft.commands] == [("%", factor)] * 2
    assert all("all of it is" in note for r in draft.commands for note in r.notes if "ctrlrange" in note)
    assert all(any("ctrlrange" in note for note in r.notes) for r in draft.commands)


def test_what_is_attached_is_offered(tmp_path: Path) -> None:
    _arm_log(tmp_path, "torque")
    draft = propose(tmp_path / "arm.xml", [tmp_path / "log.csv"], tmp_path)
    unknowns = {unknown.name: unknown for unknown in draft.parameters}
    assert "attached to lower" in unknowns["tool_mass"].note
    asked = {unknown.name for unknown in draft.free}
    assert {"upper_mass", "lower_mass"} <= asked
    assert not [doubt for doubt in draft.doubts if "no force is known" in doubt]


def test_without_a_known_force_the_masses_are_the_scale(tmp_path: Path) -> None:
    _arm_log(tmp_path, "duty")
    draft = propose(tmp_path / "arm.xml", [tmp_path / "log.csv"], tmp_path)
    asked = {unknown.name for unknown in draft.free}
    left = [u.name for u in draft.parameters if u.name.endswith("_mass") and "no force is known" in u.left_out]
    assert left == ["upper_mass", "lower_mass", "tool_mass"]
    assert {"shoulder_gain", "elbow_gain"} <= asked
    assert any("no force is known" in doubt and left[0] in doubt for doubt in draft.doubts)


def test_an_inertial_unit_alone(tmp_path: Path) -> None:
    (tmp_path / "roller.xml").write_text(ROLLER)
    model = mujoco.MjModel.from_xml_string(ROLLER)
    data, rows = mujoco.MjData(model), []
    data.qvel[:] = 0.5, 0, 0, 1, 5, 1
    for k in range(100):
        mujoco.mj_step(model, data, 2)
        rows.append([0.01 * k, *data.sensordata])
    names = ["t", *(f"{sensor}_{axis}" for sensor in ("gyro", "accelerometer") for axis in "xyz")]
    pd.DataFrame(rows, columns=names).to_csv(tmp_path / "log.csv", index=False)
    draft = propose(tmp_path / "roller.xml", [tmp_path / "log.csv"], tmp_path)
    assert draft.config(tmp_path).likelihood == "state_space"
    assert {"gyro_bias_x", "accelerometer_bias_z"} <= {unknown.name for unknown in draft.free}
    assert any("nothing was simulated" in doubt for doubt in draft.doubts)
