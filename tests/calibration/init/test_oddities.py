"""What is odd in logs: each thing is named where it is, and nothing of it where it is not."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pandas as pd
import pytest

from sipe_bayes.calibration.init.propose import propose

ARM = """<mujoco><compiler angle="radian"/><option timestep=".002" integrator="implicitfast"/><worldbody>{floor}
  <body name="upper" pos="0 0 .8"><joint name="lift" axis="0 1 0" damping=".2" armature=".01" range="{low} {high}"/>
  <inertial pos=".15 0 0" mass=".6" diaginertia="{inertia} .006 .006"/>
  <geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass="0"/></body></worldbody>
  <actuator><position name="lift" joint="lift" kp="{kp}" kv=".8" ctrlrange="{ends}"/></actuator></mujoco>"""
PLAIN = {"floor": "", "low": -1.5, "high": 1.5, "inertia": 0.005, "kp": 25, "ends": "-2 2"}
STIFF = 2500  # N m/rad, with which the arm swings faster than its log
Table = dict[str, np.ndarray]


def made(off: bool = False, kp: float = 25) -> Table:
    """A log of a servo that lifts an arm, with a drive that is off in its last third or is not."""
    model = mujoco.MjModel.from_xml_string(ARM.format(**{**PLAIN, "kp": kp}).replace('damping=".2"', 'damping=".3"'))
    data, rows, noise = mujoco.MjData(model), [], np.random.default_rng(0)
    for k in range(900):
        t = 0.02 * k
        goal = 0.5 * np.sin(1.7 * t) + 0.3 * np.sin(3.9 * t)
        rows.append((t, goal, float(data.qpos[0]) + noise.normal(0, 5e-4), float(data.qfrc_actuator[0])))
        model.actuator_gainprm[0, 0] = 0.0 if off and k > 600 else kp
        model.actuator_biasprm[0, 1:3] = (0.0, 0.0) if off and k > 600 else (-kp, -0.8)
        data.ctrl[:] = goal
        mujoco.mj_step(model, data, 10)
    return dict(zip(("time", "lift_goal", "lift_position", "current"), np.array(rows).T, strict=True))


def jumped(table: Table) -> None:
    table["lift_position"][500:] += 1.2


def enabled(table: Table) -> None:
    table["torque_enable"] = (np.arange(900) < 800).astype(float)


def unsigned(table: Table) -> None:
    table["present_current"] = np.abs(table["current"])


CASES: dict[str, tuple[dict[str, object], Callable[[Table], None] | None, str]] = {
    "limit": ({"low": -0.35, "high": 0.35}, None, "at or beyond the range of lift"),
    "angle": ({"low": -0.03, "high": 0.03}, None, "radians that are read as degrees"),
    "set-point": ({"ends": "-.4 .4"}, None, "of the set-points lie beyond the range"),
    "enable": ({}, enabled, "'torque_enable' is 0 in"),
    "unsigned": ({}, unsigned, "without a change of sign"),
    "jump": ({}, jumped, "jumps 1 time"),
    "step": ({"kp": 90_000}, None, "is too long for the gains of the servos"),
    "inertia": ({"inertia": 2.0}, None, "times as large as its geoms"),
    "contact": ({"floor": '<geom type="plane" size="2 2 .1" pos="0 0 .79"/>'}, None, "the model touches something"),
    "slow": ({"kp": STIFF}, None, "are slower than the servos"),
    "off": ({}, None, "is not at its set-point from"),
}


def said(folder: Path, table: Table, model: dict[str, object]) -> list[str]:
    """What is open in the proposal."""
    text = ARM.format(**{**PLAIN, **model})
    if "inertia" in model:
        text = text.replace('.006 .006"', '2 2"')
    (folder / "model.xml").write_text(text)
    pd.DataFrame(table).drop(columns="current").to_csv(folder / "log.csv", index=False)
    return propose(folder / "model.xml", [folder / "log.csv"], folder).open_doubts


def test_nothing_is_odd_in_a_clean_log(tmp_path: Path) -> None:
    doubts = said(tmp_path, made(), {})
    assert not [words for _, _, words in CASES.values() if any(words in doubt for doubt in doubts)]


@pytest.mark.parametrize("code", CASES)
def test_what_is_odd_is_named(code: str, tmp_path: Path) -> None:
    model, change, words = CASES[code]
    table = made(off=code == "off", kp=STIFF if code == "slow" else 25)
    if change is not None:
        change(table)
    doubts = said(tmp_path, table, model)
    assert any(words in doubt for doubt in doubts), doubts
