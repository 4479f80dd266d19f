"""A body that flies under thrusts: its delay, unknowns that look alike, and forces that are known by no unit."""

from __future__ import annotations

from collections import deque
from pathlib import Path

import mujoco
import numpy as np
import pandas as pd
import pytest

from sipe_bayes.calibration.init.draft import Draft
from sipe_bayes.calibration.init.propose import propose
from sipe_bayes.calibration.init.selection import RELATIVE

PLACES = np.array([(0.2, 0.15), (0.2, -0.15), (-0.2, 0.15), (-0.2, -0.15)])
SITES = "".join(f'<site name="t{k}" pos="{x} {y} 0"/>' for k, (x, y) in enumerate(PLACES))
THRUSTS = "".join(f'<motor name="rotor{k}" site="t{k}" gear="0 0 1 0 0 0"/>' for k in range(4))
DRONE = f"""<mujoco><option timestep="0.005" integrator="implicitfast"/><worldbody><body name="base" pos="0 0 5">
  <freejoint/><geom type="box" size=".2 .15 .04" mass="1" contype="0" conaffinity="0"/>{SITES}
  <body name="payload"><geom type="box" size=".2 .15 .04" mass=".3" contype="0" conaffinity="0"/></body></body>
  </worldbody><actuator>{THRUSTS}</actuator></mujoco>"""
DT = 0.01


def flown(folder: Path, late: int, unit: str) -> Draft:
    """What is proposed for a drone that is a fifth heavier, whose commands come ``late`` samples after they are logged.

    It is held level by a controller, and shaken.
    """
    (folder / "model.xml").write_text(DRONE)
    model = mujoco.MjModel.from_xml_string(DRONE.replace('mass="1"', 'mass="1.2"'))
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    hover = 9.81 * float(model.body_mass.sum()) / 4
    waiting, phases, rows = deque([np.full(4, hover)] * late), rng.uniform(0, 6, (4, 3)), []
    for k in range(500):
        level, turning = np.zeros(3), data.qvel[3:6]
        mujoco.mju_rotVecQuat(level, np.array([0.0, 0.0, 1.0]), data.qpos[3:7] * [1, -1, -1, -1])
        about_x, about_y = -3 * level[1] - 0.8 * turning[0], 3 * level[0] - 0.8 * turning[1]
        thrust = hover + (5 - data.qpos[2]) - 0.75 * data.qvel[2] + about_x * PLACES[:, 1] - about_y * PLACES[:, 0]
        waiting.append(thrust + 0.25 * np.sin(2 * np.pi * np.array([0.7, 1.1, 1.7]) * k * DT + phases).sum(axis=1))
        rows.append([k * DT, *waiting[-1], *data.qpos])
        data.ctrl[:] = waiting.popleft()
        mujoco.mj_step(model, data, 2)
    names = ["t", *(f"rotor{k}_{unit}" for k in range(4)), "x", "y", "z", "qw", "qx", "qy", "qz"]
    table = np.array(rows)
    table[:, 5:] += 5e-4 * rng.standard_normal((len(table), 7))
    pd.DataFrame(table, columns=names).to_csv(folder / "log.csv", index=False)
    return propose(folder / "model.xml", [folder / "log.csv"], folder)


@pytest.mark.parametrize("late", [4, 0])
def test_a_delay_of_what_flies_and_two_masses_that_look_alike(tmp_path: Path, late: int) -> None:
    draft = flown(tmp_path, late, "N")
    left_out = {unknown.name: unknown.left_out for unknown in draft.parameters}
    assert round(draft.delay) == late
    assert ("delay" in left_out) == (late > 0)
    assert not left_out["base_mass"]
    assert "shows as base_mass does" in left_out["payload_mass"]


def test_forces_that_are_known_by_no_unit_are_relative_to_a_mass(tmp_path: Path) -> None:
    draft = flown(tmp_path, 4, "V")
    left_out = {unknown.name: unknown.left_out for unknown in draft.parameters}
    assert round(draft.delay) == 4
    assert RELATIVE in (left_out["base_mass"], left_out["payload_mass"])
    (gain,) = (unknown for unknown in draft.parameters if unknown.name == "rotors_gain")
    assert (gain.left_out, len(gain.targets)) == ("", 4)
    assert any("relative to" in doubt for doubt in draft.open_doubts)
