"""Columns that are zero elsewhere than the model: heights above the floor, encoders; and what no simulation follows."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pandas as pd
import pytest

from sipe_bayes.calibration.checks.followed import not_followed
from sipe_bayes.calibration.init.draft import Draft
from sipe_bayes.calibration.init.propose import propose
from sipe_bayes.calibration.init.write import summary, toml_of
from sipe_bayes.calibration.problem import prepare
from sipe_bayes.core.arrays import FloatArray

HOPPER = """<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>
  <geom name="floor" type="plane" size="1 1 .1" solref="{soft} 1"/>
  <body name="carriage" pos="0 0 .5"><joint name="guide" type="slide" axis="0 0 1" ref="{ref}" damping="{damping}"/>
  <geom name="foot" size=".03" pos="0 0 -.4" mass="{mass}" solref="{soft} 1"/></body></worldbody>
  <actuator><motor name="lift" joint="guide"/></actuator></mujoco>"""
PENDULUM = """<mujoco><option timestep="0.004" integrator="implicitfast"/><worldbody>
  <body name="rod"><joint name="hinge" axis="0 1 0" damping="{damping}"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.4" size=".01" mass="{mass}"/></body></worldbody>
  <actuator><motor name="motor" joint="hinge"/></actuator></mujoco>"""
CRANE = """<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>
  <body name="cart"><joint name="rail" type="slide" axis="1 0 0" damping="{damping}" frictionloss="{dry}"/>
  <geom type="box" size=".1 .06 .04" mass="{cart}"/><body name="pendulum"><joint name="pivot" axis="0 -1 0"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.6" size=".006" mass=".21"/>
  <geom size=".03" pos="0 0 -.6" mass="{bob}"/></body></body></worldbody>
  <actuator><motor name="drive" joint="rail"/></actuator></mujoco>"""
HEIGHT = "guide_height_m"
TIME = np.arange(0, 8, 0.008)
TORQUE = np.round(0.6 * np.sin(4 * TIME) + 0.4 * np.sin(9.1 * TIME), 3)


def flown(text: str, start: float, commands: FloatArray, dt: float) -> FloatArray:
    """Positions (n,) of a machine of one joint under commands (n,), or (n, J) of one of several."""
    model = mujoco.MjModel.from_xml_string(text)
    data, out = mujoco.MjData(model), []
    data.qpos[:] = start
    for command in commands:
        out.append(data.qpos.copy())
        data.ctrl[:] = command
        mujoco.mj_step(model, data, nstep=round(dt / model.opt.timestep))
    return np.squeeze(out)


def hopper(folder: Path, ref: float = 0.0, floor: bool = True) -> Draft:
    """The proposal for a hopper whose log has the height of its carriage above the floor."""
    time = np.arange(0, 6, 0.004)
    force = np.round(4 + 10 * np.sign(np.sin(11 * time)) + 3 * np.sin(5 * time), 3)
    text = HOPPER.format(soft=0.02, ref=ref, damping=0.8, mass=0.9)
    height = 0.5 - ref + flown(text, ref, force, 0.004)
    height += np.random.default_rng(1).normal(0, 3e-4, len(time))
    given = HOPPER.format(soft=0.03, ref=ref, damping=0.5, mass=1.0)
    (folder / "model.xml").write_text(given)
    table = {"time": time, HEIGHT: height if floor else height - 0.5 + ref, "lift_force_N": force}
    pd.DataFrame(table).round(5).to_csv(folder / "log.csv", index=False)
    return propose(folder / "model.xml", [folder / "log.csv"], folder)


@pytest.mark.parametrize(("ref", "floor"), [(0.0, True), (0.2, True), (0.0, False)])
def test_a_height_above_the_floor_is_no_position_of_a_slide(tmp_path: Path, ref: float, floor: bool) -> None:
    draft = hopper(tmp_path, ref, floor)
    (reading,) = draft.measurements
    assert (reading.zero, reading.unsure) == pytest.approx((0.5 - ref if floor else 0.0, 0.0))
    assert any("where the body 'carriage' is in the world" in note for note in reading.notes) == floor
    assert ("zero 0." in summary(draft, "calibrate.toml")[0]) == floor
    names = {target for unknown in draft.free for target in unknown.targets}
    assert "geom:foot.solref_timeconst" in names, "what touches the floor in the log is asked for"


def test_what_stays_above_the_floor_is_asked_for_no_contact(tmp_path: Path) -> None:
    time = np.arange(0, 6, 0.004)
    force = np.round(9.3 + 2 * np.sin(6 * time), 3)
    height = flown(HOPPER.format(soft=0.02, ref=0, damping=3.0, mass=0.9), 1.0, force, 0.004)
    (tmp_path / "model.xml").write_text(HOPPER.format(soft=0.02, ref=0, damping=2.0, mass=1.0))
    pd.DataFrame({"time": time, HEIGHT: height, "lift_force_N": force}).to_csv(tmp_path / "log.csv", index=False)
    draft = propose(tmp_path / "model.xml", [tmp_path / "log.csv"], tmp_path)
    assert not any("geom:" in target for unknown in draft.parameters for target in unknown.targets)


@pytest.mark.parametrize("zero", [0.8, -1.1])
def test_the_zero_of_an_encoder_is_asked_for_where_simulations_alone_tell_it(tmp_path: Path, zero: float) -> None:
    angle = flown(PENDULUM.format(damping=0.02, mass=0.5), 0.3, TORQUE, 0.008) + zero
    angle += np.random.default_rng(2).normal(0, 1e-3, len(TIME))
    (tmp_path / "model.xml").write_text(PENDULUM.format(damping=0.03, mass=0.4))
    table = pd.DataFrame({"time": TIME, "hinge_rad": angle, "motor_torque_Nm": TORQUE})
    table.round(5).to_csv(tmp_path / "log.csv", index=False)
    draft = propose(tmp_path / "model.xml", [tmp_path / "log.csv"], tmp_path)
    (reading,) = draft.measurements
    assert abs(reading.zero - zero) < reading.unsure, (reading.zero, reading.unsure)
    assert any("which these logs alone tell" in doubt for doubt in draft.open_doubts)
    assert "hinge_rad_zero" in {unknown.name for unknown in draft.free}
    (tmp_path / "calibrate.toml").write_text(toml_of(draft, "sipe init"))
    problem = prepare(tmp_path / "calibrate.toml", 1)
    assert np.allclose(problem.train[0].observations[:5, 0], table["hinge_rad"][:5] - reading.zero, atol=1e-4)


@pytest.mark.parametrize("zero", [137.3, -50.0])
def test_the_zero_of_what_hangs_from_a_cart_that_the_model_has_wrong(tmp_path: Path, zero: float) -> None:
    """Units and signs that were chosen without a zero are wrong ones, and no name says what the column is."""
    logs, noise = [], np.random.default_rng(1)
    for k in range(3):
        time = np.arange(0, 20, 0.01)
        force = sum(3.5 * np.sin((1.4 + 0.9 * k + 2.3 * j) * time + j) for j in range(3))
        motion = flown(CRANE.format(damping=4.4, dry=1.1, cart=2.9, bob=0.6), 0.0, np.round(force, 2), 0.01)
        table = {
            "zeit_ms": 1e3 * time,
            "kat_pos_mm": 1e3 * motion[:, 0] + noise.normal(0, 0.05, len(time)),
            "winkel": np.round((np.degrees(motion[:, 1]) + zero) / 0.18) * 0.18,
            "kraft_soll_N": np.round(force, 2),
        }
        pd.DataFrame(table).round(4).to_csv(tmp_path / f"log{k}.csv", index=False)
        logs.append(tmp_path / f"log{k}.csv")
    (tmp_path / "crane.xml").write_text(CRANE.format(damping=1.0, dry=0.5, cart=2.0, bob=0.45))
    by_target = {r.match.target: r for r in propose(tmp_path / "crane.xml", logs, tmp_path).measurements}
    angle = by_target["joint:pivot.position"]
    assert (angle.match.column, angle.sign, angle.unit) == ("winkel", 1, "deg")
    assert abs(angle.zero - zero) < 3


def test_a_column_that_nothing_follows_is_named_before_a_fit(tmp_path: Path) -> None:
    angle = flown(PENDULUM.format(damping=0.02, mass=0.5), 0.3, TORQUE, 0.008)
    (tmp_path / "model.xml").write_text(PENDULUM.format(damping=0.03, mass=0.4))
    pd.DataFrame({"time": TIME, "hinge_rad": angle, "motor_torque_Nm": TORQUE}).to_csv(tmp_path / "log.csv")
    path = tmp_path / "calibrate.toml"
    path.write_text(toml_of(propose(tmp_path / "model.xml", [tmp_path / "log.csv"], tmp_path), "sipe init"))
    assert not_followed(prepare(path, 1)) == ()
    path.write_text(path.read_text().replace('unit = "N m"\n', 'unit = "N m"\nsign = -1\n'))
    (noticed,) = not_followed(prepare(path, 1))
    assert "the model explains little of the forces that move 'hinge_rad'" in noticed.text
