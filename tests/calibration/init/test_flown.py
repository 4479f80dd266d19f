"""Machines that thrust carries: their commands, their gyro's unit, and what of them may be unknown."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np

from sipe_bayes.calibration.init.propose import propose
from sipe_bayes.core import rotations

ROTORS = {"m1": (0.06, -0.06, -1), "m2": (-0.06, -0.06, 1), "m3": (-0.06, 0.06, -1), "m4": (0.06, 0.06, 1)}
DRAG = 0.016  # m, torque for each N


def quadrotor(mass: float, gain: float, payload: str = "") -> str:
    sites = "".join(f'<site name="{name}" pos="{x} {y} 0"/>' for name, (x, y, _) in ROTORS.items())
    rotors = "".join(
        f'<motor name="{name}" site="{name}" gear="0 0 {gain} 0 0 {turn * DRAG}" ctrlrange="0 3"/>'
        for name, (_, _, turn) in ROTORS.items()
    )
    return f"""<mujoco><option timestep="0.005" integrator="implicitfast"/><worldbody>
    <body name="frame" pos="0 0 1"><freejoint name="free"/><site name="imu"/>{sites}{payload}
    <geom type="box" size=".06 .06 .015" mass="{mass}" contype="0" conaffinity="0"/></body></worldbody>
    <actuator>{rotors}</actuator><sensor><gyro name="gyro" site="imu"/></sensor></mujoco>"""


def flight(path: Path, model: mujoco.MjModel, gain: float, seed: int) -> None:
    """Four seconds at 100 Hz about a moving point, as a controller that knows the machine flies it."""
    rng, data, rows = np.random.default_rng(seed), mujoco.MjData(model), ["t,m1,m2,m3,m4,x,y,z,qw,qx,qy,qz,gx,gy,gz"]
    pace, phase, weight = rng.uniform(0.2, 0.9, (3, 2)), rng.uniform(0, 6.28, (3, 2)), 9.81 * float(model.body_mass[1])
    mixer = np.array([[1, y, -x, turn * DRAG / gain] for x, y, turn in ROTORS.values()]).T
    for k in range(400):
        wave = np.sin(2 * np.pi * pace * 0.01 * k + phase).mean(1) - np.sin(phase).mean(1)
        off = 0.4 * wave + np.array([0, 0, 1]) - data.qpos[:3]
        wanted = np.clip(4 * off - 3 * data.qvel[:3], -4, 4) + np.array([0, 0, 9.81])
        turn = rotations.turned(rotations.inverse(data.qpos[None, 3:7]), wanted[None])[0]
        lean = np.cross([0, 0, 1], turn / np.linalg.norm(turn))
        torque = [0.35, 0.35, 0.1] * lean - [0.04, 0.04, 0.05] * data.qvel[3:6] + 0.01 * rng.standard_normal(3)
        data.ctrl[:] = np.round(np.clip(np.linalg.solve(mixer, [weight * turn[2] / 9.81, *torque]) / gain, 0, 3), 3)
        pose = data.qpos + 8e-4 * rng.standard_normal(7)
        rate = np.degrees(data.qvel[3:6]) + 0.3 * rng.standard_normal(3)
        rows.append(",".join(f"{x:.5f}" for x in (0.01 * k, *data.ctrl, *pose, *rate)))
        for _ in range(2):
            mujoco.mj_step(model, data)
    path.write_text("\n".join(rows) + "\n")


def test_a_quadrotor(tmp_path: Path) -> None:
    """Of 9 % less thrust than the commands say, with a payload that its model lacks."""
    (tmp_path / "quad.xml").write_text(quadrotor(0.45, 1.0))
    payload = '<geom type="box" size=".02 .03 .01" pos=".01 0 -.03" mass=".08" contype="0" conaffinity="0"/>'
    true = mujoco.MjModel.from_xml_string(quadrotor(0.45, 0.9, payload))
    logs = [tmp_path / f"flight{k}.csv" for k in range(3)]
    for k, log in enumerate(logs):
        flight(log, true, 0.9, k)
    draft = propose(tmp_path / "quad.xml", logs, tmp_path)
    assert [(r.match.column, r.match.target, r.unit) for r in draft.commands] == [
        (name, f"actuator:{name}", "1") for name in ROTORS
    ]
    assert not any("as many" in doubt for doubt in draft.open_doubts)
    readings = {r.match.target: r for r in draft.measurements}
    assert readings["body:frame.position"].unit == "m"
    assert readings["sensor:gyro"].unit == "deg/s"
    assert readings["sensor:gyro"].notes[0] == "deg/s: as fast as what is measured turns"
    unknowns = {unknown.name: unknown for unknown in draft.free}
    assert unknowns["rotors_gain"].targets == tuple(f"actuator:{name}.gain" for name in ROTORS)
    assert {"frame_inertia_x", "frame_inertia_y", "frame_com_x"} <= set(unknowns)
    assert isinstance(draft.window, float)
    assert draft.window < 0.5
