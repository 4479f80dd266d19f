"""Efforts of servos: their sign, their unit, and what is known without them."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pandas as pd
import pytest

from sipe_bayes.calibration.init.draft import Draft
from sipe_bayes.calibration.init.propose import propose
from sipe_bayes.calibration.init.write import summary

ARM = """<mujoco><option timestep="0.004" integrator="implicitfast"/><worldbody>
  <body name="upper"><joint name="shoulder" axis="0 1 0" damping="{damping}"/>
  <geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass="{mass}" contype="0" conaffinity="0"/>
  <body name="lower" pos=".3 0 0"><joint name="elbow" axis="0 1 0" damping="{damping}"/>
  <geom type="capsule" fromto="0 0 0 .2 0 0" size=".02" mass=".4" contype="0" conaffinity="0"/></body></body>
  </worldbody><actuator><position name="shoulder_servo" joint="shoulder" kp="{kp}" kv="1"/>
  <position name="elbow_servo" joint="elbow" kp="20" kv=".5"/></actuator></mujoco>"""


def proposed(folder: Path, scales: dict[str, float], name: str = "effort_{}", rotor: float = 0.0) -> Draft:
    """For a servo arm whose log has the forces of its servos, times the scales, beside positions and set-points."""
    model = mujoco.MjModel.from_xml_string(ARM.format(damping=0.2, mass=0.9, kp=50))
    model.dof_armature[:] = rotor
    model.dof_frictionloss[:] = 4 * rotor
    data, rows, noise = mujoco.MjData(model), [], np.random.default_rng(0)
    for k in range(500):
        t = 0.012 * k
        wanted = np.round([0.4 * np.sin(3 * t) + 0.2 * np.sin(7.1 * t), 0.5 * np.sin(2.3 * t) + 0.3 * np.sin(6 * t)], 4)
        data.ctrl[:] = wanted
        mujoco.mj_forward(model, data)
        seen = data.qpos + noise.normal(0, 5e-4, 2)
        rows.append([t, *wanted, *seen, *(data.actuator_force * list(scales.values()) + noise.normal(0, 0.05, 2))])
        mujoco.mj_step(model, data, nstep=3)
    joints = ("shoulder", "elbow")
    names = [f"{kind}_{joint}" for kind in ("cmd", "pos") for joint in joints]
    columns = ["time", *names, *(name.format(joint) for joint in scales)]
    pd.DataFrame(rows, columns=columns).round(5).to_csv(folder / "log.csv", index=False)
    (folder / "arm.xml").write_text(ARM.format(damping=0.1, mass=1.1, kp=40))
    return propose(folder / "arm.xml", [folder / "log.csv"], folder)


def test_efforts_are_measured_with_their_sign_and_unit_and_make_forces_known(tmp_path: Path) -> None:
    draft = proposed(tmp_path, {"shoulder": 1.0, "elbow": -1000.0})
    forces = {r.match.target: r for r in draft.measurements if r.match.target.endswith(".force")}
    assert {t: (r.unit, r.sign, r.match.column) for t, r in forces.items()} == {
        "joint:shoulder.force": ("N m", 1, "effort_shoulder"),
        "joint:elbow.force": ("mN m", -1, "effort_elbow"),
    }
    assert not any("no force is known" in doubt for doubt in draft.doubts)
    both = {"shoulder_damping", "elbow_damping", "shoulder_servo_kv", "elbow_servo_kv"}  # which efforts tell apart
    assert {"upper_mass", "lower_mass"} | both <= {unknown.name for unknown in draft.free}
    assert draft.config(tmp_path)


def test_efforts_that_move_rotors_and_overcome_friction_that_the_model_lacks_are_known_forces(tmp_path: Path) -> None:
    draft = proposed(tmp_path, {"shoulder": 1.0, "elbow": 1.0}, rotor=0.1)
    forces = [r for r in draft.measurements if r.match.target.endswith(".force")]
    assert all(r.unit == "N m" and not r.doubts for r in forces)
    assert all("explains 9" in note or "explains 100" in note for r in forces for note in r.notes)
    assert {"upper_mass", "lower_mass"} <= {unknown.name for unknown in draft.free}


def test_rotors_that_the_model_lacks_are_free_and_no_delay(tmp_path: Path) -> None:
    """Of ten times the inertia of the lower link, with friction that goes with such gears."""
    draft = proposed(tmp_path, {"shoulder": 1.0, "elbow": 1.0}, "current_{}_A", rotor=0.05)
    free = {unknown.name: (unknown.low, unknown.high) for unknown in draft.free}
    assert not {"shoulder_damping", "elbow_damping"} & {*free}
    assert draft.delay < 0.5
    for joint in ("shoulder", "elbow"):
        assert free[f"{joint}_armature"][1] > 0.05
        assert free[f"{joint}_frictionloss"][1] > 0.2


@pytest.mark.parametrize(
    ("scales", "name", "words"),
    [
        ({"shoulder": 40.0, "elbow": 40.0}, "effort_{}", "times as large"),  # shares of a largest, or counts
        ({"shoulder": 2.0, "elbow": 2.0}, "effort_{}_A", "A is no unit of a force"),
        ({"shoulder": 0.0, "elbow": 0.0}, "tau_measured_{}", "% of its variance"),  # noise
        ({"shoulder": 1.0, "elbow": 1.0}, "torque_cmd_{}", "not used: torque_cmd_shoulder, torque_cmd_elbow"),
    ],
)
def test_what_is_no_effort_is_named_and_left(tmp_path: Path, scales: dict[str, float], name: str, words: str) -> None:
    draft = proposed(tmp_path, scales, name)
    assert not any(r.match.target.endswith(".force") for r in draft.measurements)
    assert any(words in line for line in (*draft.notes, *summary(draft, "calibrate.toml")))
    assert any("no force is known" in doubt for doubt in draft.doubts)


def test_an_effort_without_a_unit_that_is_larger_than_the_models_is_open_and_no_known_force(
    tmp_path: Path,
) -> None:
    draft = proposed(tmp_path, {"shoulder": 2.5, "elbow": 2.5})
    forces = [r for r in draft.measurements if r.match.target.endswith(".force")]
    assert [r.match.column for r in forces] == ["effort_shoulder", "effort_elbow"]
    assert all("if it is no force" in doubt for r in forces for doubt in r.doubts)
    assert all(r.doubts for r in forces)
    assert any("no force is known" in doubt for doubt in draft.doubts)
