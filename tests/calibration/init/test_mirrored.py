"""Joints that a log mirrors in both columns: gravity tells of one, and hardly of another."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pandas as pd

from sipe_bayes.calibration.init.draft import Draft
from sipe_bayes.calibration.init.propose import propose

ARM = """<mujoco><option timestep="0.004" integrator="implicitfast"/><worldbody>
  <body name="post"><joint name="pan" axis="{tilt} 0 1" damping="{damping}"/><geom size=".04" mass=".5"/>
  <body name="link"><joint name="lift" axis="0 1 0" damping="{damping}"/>
  <geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass="{mass}"/></body></body></worldbody>
  <actuator><position name="pan" joint="pan" kp="5" kv=".3"/><position name="lift" joint="lift" kp="5" kv=".3"/>
  </actuator></mujoco>"""
DT = 0.02


def mirrored(folder: Path) -> Draft:
    """The proposal for a log in which both joints turn the other way round, set-points too."""
    time = np.arange(0, 12, DT)
    goals = np.stack([0.5 * np.sin(2.1 * time) + 0.2 * np.sin(5 * time), 0.4 * np.sin(1.7 * time + 1)], axis=1)
    model = mujoco.MjModel.from_xml_string(ARM.format(tilt=0.01, damping=0.12, mass=0.5))
    data, seen = mujoco.MjData(model), []
    for goal in goals:
        seen.append(data.qpos.copy())
        data.ctrl[:] = goal
        mujoco.mj_step(model, data, nstep=round(DT / model.opt.timestep))
    noisy = np.array(seen) + np.random.default_rng(0).normal(0, 1e-3, (len(seen), 2))
    (folder / "model.xml").write_text(ARM.format(tilt=0.01, damping=0.08, mass=0.4))
    table = {"time": time}
    for k, joint in enumerate(("pan", "lift")):
        table |= {f"{joint}_position_rad": -noisy[:, k], f"{joint}_goal_rad": -goals[:, k]}
    pd.DataFrame(table).round(5).to_csv(folder / "log.csv", index=False)
    return propose(folder / "model.xml", [folder / "log.csv"], folder)


def test_what_gravity_hardly_tells_stays_open(tmp_path: Path) -> None:
    draft = mirrored(tmp_path)
    (doubt,) = [doubt for doubt in draft.open_doubts if "flipped together" in doubt]
    assert "'pan_position_rad' and 'pan_goal_rad'" in doubt, draft.open_doubts
    signs = {reading.match.column: reading.sign for reading in draft.readings}
    assert (signs["lift_position_rad"], signs["lift_goal_rad"]) == (-1, -1), signs
    notes = [note for r in draft.readings if "lift" in r.match.column for note in r.notes if note.startswith("sign")]
    assert notes
    assert all("flipped" in note or "follows it" in note for note in notes), notes
