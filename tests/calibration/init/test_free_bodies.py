"""Of a free body its mass is proposed where something of known force pushes it, and not where it is only thrown."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pandas as pd
import pytest

from sipe_bayes.calibration.init.propose import propose

PUSHED = """<mujoco><option timestep="0.005" integrator="implicitfast"/><worldbody>
  <geom name="table" type="plane" size="3 3 .1"/><body name="puck" pos=".12 0 .02"><freejoint/>
  <geom name="puck" type="cylinder" size=".04 .02" mass=".2" friction=".4 .005 .0001"/></body>{pusher}</worldbody>
  {motor}</mujoco>"""
PUSHER = """<body name="slider" pos="0 0 .03"><joint name="stroke" type="slide" axis="1 0 0" damping="3"/>
  <geom type="box" size=".02 .06 .02" mass=".3"/></body>"""
MOTOR = '<actuator><motor name="push" joint="stroke"/></actuator>'


@pytest.mark.parametrize("driven", [True, False])
def test_the_mass_of_a_free_body(tmp_path: Path, driven: bool) -> None:
    path = tmp_path / "model.xml"
    path.write_text(PUSHED.format(pusher=PUSHER if driven else "", motor=MOTOR if driven else ""))
    model = mujoco.MjModel.from_xml_path(str(path))
    data, rows = mujoco.MjData(model), []
    if not driven:
        data.qvel[:3] = 0.6, 0.2, 0.5
    for k in range(60):
        force = 6 * np.sin(np.pi * k / 30) * (k < 30)
        rows.append([0.01 * k, force, *data.qpos[:7], *data.qpos[7:]])
        data.ctrl[:] = force
        mujoco.mj_step(model, data, 2)
    names = ["t", "push_N", "x", "y", "z", "qw", "qx", "qy", "qz", "stroke_m"][: len(rows[0])]
    logs = pd.DataFrame(rows, columns=names)
    (logs if driven else logs.drop(columns="push_N")).to_csv(tmp_path / "log.csv", index=False)
    unknowns = [unknown.name for unknown in propose(path, [tmp_path / "log.csv"], tmp_path).unknowns]
    print(unknowns)
    assert ("puck_mass" in unknowns) == driven
    assert "puck_friction" in unknowns
