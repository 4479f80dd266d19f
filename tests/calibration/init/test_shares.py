"""`sipe init` on columns that say where a joint is in its range: 0 to 100, or -100 to 100."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pandas as pd
import pytest

from sipe_bayes.calibration.config import load_config
from sipe_bayes.calibration.init.draft import Draft, Reading, Scale, questions
from sipe_bayes.calibration.init.matching import match_columns
from sipe_bayes.calibration.init.propose import propose
from sipe_bayes.calibration.init.readings import BOTH_WAYS, PERCENT, first_readings
from sipe_bayes.calibration.init.tables import Clock
from sipe_bayes.calibration.init.write import toml_of
from sipe_bayes.calibration.logs import load_log
from sipe_bayes.calibration.machine import Machine
from sipe_bayes.core.arrays import FloatArray

ARM = """<mujoco><compiler angle="radian"/><option timestep="0.01" integrator="implicitfast"/>
  <worldbody><body name="upper">
  <joint name="elbow" axis="0 1 0" range="-1.2 1.2" damping=".05"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.2" size=".01" mass=".2"/>
  <body name="jaw" pos="0 0 -.2"><joint name="gripper" {jaw} damping=".02"/>
  <geom type="capsule" fromto="0 0 0 .05 0 0" size=".005" mass=".02"/></body></body></worldbody>
  <actuator><position name="elbow" joint="elbow" kp="4" kv=".2"/>
  <position name="gripper" joint="gripper" kp="1" kv=".05"/></actuator></mujoco>"""
HINGE, SLIDE = 'axis="0 0 1" range="-0.17 1.75"', 'type="slide" axis="1 0 0" range="0 0.04"'
LEROBOT = {"measured": "observation.state[{}.pos]", "command": "action[{}.pos]"}
PLAIN = {"measured": "{}_position", "command": "{}_cmd"}
TIME = np.arange(0, 20, 0.02)


def led(low: float, high: float, rate: float = 1.3) -> FloatArray:
    wave = 0.5 - 0.5 * np.cos(rate * TIME) * np.cos(0.31 * TIME)
    return low + (high - low) * (wave - wave.min()) / np.ptp(wave)


def late(values: FloatArray) -> FloatArray:
    return np.concatenate([np.full(3, values[0]), values[:-3]])


def table(form: dict[str, str], elbow: FloatArray, gripper: FloatArray) -> dict[str, FloatArray]:
    of = {"elbow": elbow, "gripper": gripper}
    commands = {form["command"].format(name): values for name, values in of.items()}
    return {form["measured"].format(name): late(values) for name, values in of.items()} | commands


def first(jaw: str, columns: dict[str, FloatArray]) -> tuple[dict[str, Reading], Draft, Machine]:
    """What names and numbers tell, by target."""
    machine, clock = Machine.of(mujoco.MjModel.from_xml_string(ARM.format(jaw=jaw))), Clock("t", "s", 0.02, "")
    measured, commands = first_readings(machine, match_columns(machine, columns), columns, {}, clock)
    draft = Draft("", clock, None, commands, measured, (), 1.0)
    return {r.match.target: r for r in (*measured, *commands)}, draft, machine


@pytest.mark.parametrize(
    ("jaw", "form", "gripper", "likely"),
    [
        (HINGE, LEROBOT, led(0, 95), True),
        (HINGE, PLAIN, led(0, 95), False),  # as well degrees
        (HINGE.replace("1.75", "0.6"), PLAIN, led(0, 95), True), (SLIDE, PLAIN, led(3, 95), True),
    ],
)  # fmt: skip
def test_a_gripper_from_0_to_100_may_be_a_share_of_its_range(
    jaw: str, form: dict[str, str], gripper: FloatArray, likely: bool
) -> None:
    readings, draft, machine = first(jaw, table(form, led(-60, 50, 0.9), gripper))
    for target in ("joint:gripper.position", "actuator:gripper"):
        assert readings[target].shares == (Scale("m" if jaw == SLIDE else "rad", 1.0, PERCENT),)
        assert readings[target].ends == (PERCENT if likely else None)
    both = [q for q in questions(draft, machine) if not q.of_sign and len(q.readings) == 2]
    assert readings["joint:gripper.position"].shares[0] in both[-1].answers, "position and set-point are asked together"
    assert (both[-1].answers[0].ends == PERCENT) == likely  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("form", "elbow", "gripper"),
    [
        (LEROBOT, led(-1.1, 1.0, 0.9), led(0, 1.6)),  # rad
        (LEROBOT, led(-160, 120, 0.9), led(-130, 60)),
        ({"measured": "{}_position_deg", "command": "{}_cmd_deg"}, led(-50, 60, 0.9), led(0, 95)),
    ],
)  # fmt: skip
def test_other_columns_are_none(form: dict[str, str], elbow: FloatArray, gripper: FloatArray) -> None:
    readings, _, _ = first(HINGE, table(form, elbow, gripper))
    assert not any(reading.shares or reading.ends for reading in readings.values())


def test_other_joints_of_a_lerobot_log_may_go_from_minus_100_to_100() -> None:
    readings, _, _ = first(HINGE, table(LEROBOT, led(-92, 80, 0.9), led(0, 95)))
    assert readings["joint:elbow.position"].shares == (Scale("rad", 1.0, BOTH_WAYS),)
    assert readings["joint:elbow.position"].ends is None, "degrees as well"
    readings, _, _ = first(HINGE, table(PLAIN, led(-60, 50, 0.9), led(0, 95)))
    assert not readings["joint:elbow.position"].shares


@pytest.mark.parametrize("word", ["{}_percent", "{}_pct"])
def test_of_what_is_called_a_percentage_nothing_is_asked(word: str) -> None:
    form = {"measured": f"measured_position_{word}", "command": f"cmd_position_{word}"}
    readings, draft, machine = first(HINGE, table(form, led(0, 70, 0.9), led(0, 95)))
    assert [reading.ends for reading in readings.values()] == [PERCENT] * 4
    assert all(question.of_sign for question in questions(draft, machine))


@pytest.mark.parametrize("ends", [PERCENT, BOTH_WAYS])
@pytest.mark.parametrize("sign", [1, -1])
def test_the_ends_of_a_range_are_where_the_column_says(ends: tuple[float, float], sign: int) -> None:
    readings, _, _ = first(HINGE, table(LEROBOT, led(-92, 80, 0.9), led(0, 95)))
    plain = readings["joint:gripper.position"].read_as(Scale("deg"))
    assert (plain.unit, plain.factor, plain.zero, plain.ends) == ("deg", 1.0, 0.0, None)
    read = plain.read_as(Scale("rad", 1.0, ends)).turned_to(sign)
    at = [sign * read.factor * (value - read.zero) for value in ends]
    assert sorted(at) == pytest.approx([-0.17, 1.75], abs=1e-4)
    assert (at[0] < at[1]) == (sign > 0)
    assert read.turned_to(-sign).turned_to(sign) == read
    assert plain.turned_to(sign).read_as(Scale("rad", 1.0, ends)) == read
    assert read.lines_of(Scale("deg")) == ('unit = "deg"  # and no factor, no zero',)


def test_what_simulations_do_not_tell_is_open_with_the_other_written_out(tmp_path: Path) -> None:
    model = mujoco.MjModel.from_xml_string(ARM.format(jaw=HINGE))
    data, wanted = mujoco.MjData(model), np.stack([led(-1.0, 0.9, 2.9), led(-0.1, 1.6, 4.1)], axis=1)
    seen = np.zeros_like(wanted)
    for k, row in enumerate(wanted):
        seen[k], data.ctrl[:] = data.qpos, row
        mujoco.mj_step(model, data, 2)
    seen += 3e-4 * np.random.default_rng(0).standard_normal(seen.shape)
    columns = {"timestamp": TIME}
    for form, values in ((LEROBOT["measured"], seen), (LEROBOT["command"], wanted)):
        columns[form.format("elbow")] = np.rad2deg(values[:, 0])
        columns[form.format("gripper")] = 100 * (values[:, 1] + 0.17) / 1.92
    (tmp_path / "arm.xml").write_text(ARM.format(jaw=HINGE))
    pd.DataFrame(columns).to_csv(tmp_path / "log.csv", index=False)
    draft = propose(tmp_path / "arm.xml", [tmp_path / "log.csv"], tmp_path)
    text = toml_of(draft, "sipe init")
    gripper = next(reading for reading in draft.measurements if "gripper" in reading.match.target)
    assert gripper.ends == PERCENT, "as LeRobot has it"
    assert text.count('unit = "rad"\nfactor = 0.0192\nzero = 8.85417\n') == 2
    assert "a share of the joint's range: 0 at -0.17 rad, 100 at 1.75 rad" in text
    (tmp_path / "calibrate.toml").write_text(text)
    config = load_config(tmp_path / "calibrate.toml")
    trajectory, _ = load_log(config, config.logs[0])
    at = list(config.channels).index(gripper.match.column)
    np.testing.assert_allclose(trajectory.observations[:, at], seen[: len(trajectory) + 1, 1], atol=1e-4)
