"""Commands to actuators that take one sign alone, or that pull a tendon."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pandas as pd
import pytest

from sipe_bayes.calibration.init.draft import Draft
from sipe_bayes.calibration.init.propose import propose
from sipe_bayes.calibration.init.write import toml_of

PENDULUM = """<mujoco><option timestep="0.005" integrator="implicitfast"/><worldbody><body>
  <joint name="hinge" axis="0 1 0" damping=".05"/><geom type="capsule" fromto="0 0 0 0 0 -.4" size=".02" mass=".5"/>
  </body></worldbody><actuator><motor name="fan" joint="hinge"{}/></actuator></mujoco>"""


def driven(folder: Path, model: str, limits: str, factor: float, column: str = "fan_torque") -> Draft:
    """What is proposed for a machine that is pushed one way, whose commands are logged times ``factor``."""
    (folder / "model.xml").write_text(model.format(limits))
    compiled = mujoco.MjModel.from_xml_string(model.format(""))
    data, rows = mujoco.MjData(compiled), []
    for k in range(600):
        data.ctrl[:] = 0.8 * max(0.0, np.sin(0.07 * k) * np.cos(0.011 * k))
        rows.append([0.01 * k, factor * data.ctrl[0], *data.qpos])
        mujoco.mj_step(compiled, data, 2)
    table = np.array(rows)
    table[:, 2:] += 1e-3 * np.random.default_rng(0).standard_normal((len(table), compiled.nq))
    names = [compiled.joint(k).name for k in range(compiled.njnt)]
    pd.DataFrame(table, columns=["t", column, *names]).to_csv(folder / "log.csv", index=False)
    return propose(folder / "model.xml", [folder / "log.csv"], folder)


@pytest.mark.parametrize(
    ("limits", "factor", "sign", "words"),
    [
        (' ctrlrange="0 1"', -1.0, -1, "and inside with the other sign, which is taken"),
        (' ctrlrange="0 1"', 1.0, 1, ""),
        (' ctrlrange="-1 0"', 1.0, -1, "and inside with the other sign, which is taken"),
        (' ctrlrange="0 1"', -20.0, 1, "and with the other sign too"),
    ],
)
def test_commands_that_a_range_clips_all(tmp_path: Path, limits: str, factor: float, sign: int, words: str) -> None:
    draft = driven(tmp_path, PENDULUM, limits, factor)
    (command,) = draft.commands
    about = [doubt for doubt in command.doubts if "ctrlrange" in doubt]
    assert (command.sign, len(about)) == (sign, bool(words)), command
    assert all(words in doubt for doubt in about)
    assert (f"sign = {-sign}" in toml_of(draft, "sipe init")) == bool(words)


def test_commands_that_a_range_clips_in_part(tmp_path: Path) -> None:
    draft = driven(tmp_path, PENDULUM, ' ctrlrange="0 1"', 1.0)
    table = pd.read_csv(tmp_path / "log.csv")
    table["fan_torque"] -= 0.2
    table.to_csv(tmp_path / "log.csv", index=False)
    assert not draft.open_doubts
    draft = propose(tmp_path / "model.xml", [tmp_path / "log.csv"], tmp_path)
    assert any("% of it lie outside of the ctrlrange [0.0, 1.0] of fan" in doubt for doubt in draft.open_doubts)


FINGER = """<mujoco><option timestep="0.005" integrator="implicitfast"/><worldbody><site name="winch" pos=".1 0 0"/>
  <body name="proximal"><joint name="mcp" axis="0 1 0" damping=".02" stiffness=".3"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.1" size=".01" mass=".1"/><site name="tip" pos="0.02 0 -.08"/>
  <body name="distal" pos="0 0 -.1"><joint name="pip" axis="0 1 0" damping=".02" stiffness=".3"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.08" size=".01" mass=".05"/></body></body></worldbody>
  <tendon>{}</tendon><actuator><motor name="fan" tendon="cable"/></actuator></mujoco>"""
FIXED = '<fixed name="cable"><joint joint="mcp" coef=".5"/><joint joint="pip" coef=".3"/></fixed>'
SPATIAL = '<spatial name="cable"><site site="winch"/><site site="tip"/></spatial>'


@pytest.mark.parametrize("cable", [FIXED, SPATIAL])
@pytest.mark.parametrize("column", ["u", "winch_torque", "cable_N"])
def test_the_gain_of_a_tendon_is_free_unless_its_command_is_a_force(tmp_path: Path, cable: str, column: str) -> None:
    model = FINGER.format(cable) + "<!--{}-->"
    draft = driven(tmp_path, model, "", 1.0, column)
    units = {"u": "1", "winch_torque": "N m" if cable == FIXED else "N", "cable_N": "N"}
    assert [reading.unit for reading in draft.commands] == [units[column]]
    assert ("fan_gain" in {unknown.name for unknown in draft.free}) == (column == "u")
    assert any("all forces are relative to" in doubt for doubt in draft.open_doubts) == (column == "u")


def test_the_damping_beside_a_velocity_servo_is_free(tmp_path: Path) -> None:
    """Its gain is that of the set-point too: fixed at the model's, the damping would be what forces are relative to."""
    model = PENDULUM.replace('<motor name="fan" joint="hinge"', '<velocity name="fan" joint="hinge" kv=".4"')
    draft = driven(tmp_path, model, "", 1.0, "hinge_cmd_vel")
    assert {"fan_kv", "hinge_damping"} <= {unknown.name for unknown in draft.free}


def test_a_tendon_without_a_lever_in_the_models_own_pose_is_proposed(tmp_path: Path) -> None:
    """A cable that runs straight through the joint's axis there, and pulls beside it along the log."""
    model = """<mujoco><option timestep="0.002"/><worldbody><site name="a" pos="0 0 1"/><body><joint name="elbow"
      axis="0 1 0" damping=".02"/><geom size=".05" pos="0 0 -.5" mass="1"/><site name="c" pos="0 0 -.5"/></body>
      </worldbody>
      <tendon><spatial name="cable" damping=".3"><site site="a"/><site site="c"/></spatial></tendon>
      <actuator><motor name="m" tendon="cable"/></actuator></mujoco>"""
    (tmp_path / "model.xml").write_text(model.replace('damping=".3"', 'damping=".1"'))
    compiled = mujoco.MjModel.from_xml_string(model)
    data, rows = mujoco.MjData(compiled), []
    data.qpos[0] = 0.8
    for k in range(600):
        data.ctrl[0] = 3 * np.sin(0.02 * k) + 2 * np.sin(0.055 * k)
        rows.append([0.01 * k, data.ctrl[0], data.qpos[0] + 1e-4 * np.cos(7 * k), data.qvel[0]])
        mujoco.mj_step(compiled, data, 5)
    names = ["time", "m_force_N", "elbow_pos_rad", "elbow_vel_rad_s"]
    pd.DataFrame(rows, columns=names).to_csv(tmp_path / "log.csv", index=False)
    draft = propose(tmp_path / "model.xml", [tmp_path / "log.csv"], tmp_path)
    assert any("tendon:cable.damping" in one.targets for one in draft.free)
