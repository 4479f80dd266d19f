"""`sipe init` on encoder counts, duties and logs without a clock."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pandas as pd
import pytest

from sipe_bayes.calibration.config import load_config
from sipe_bayes.calibration.init.decisions import as_well
from sipe_bayes.calibration.init.draft import Draft, Scale
from sipe_bayes.calibration.init.matching import match_columns
from sipe_bayes.calibration.init.propose import propose
from sipe_bayes.calibration.init.readings import first_readings
from sipe_bayes.calibration.init.tables import Clock
from sipe_bayes.calibration.init.write import toml_of
from sipe_bayes.calibration.machine import Machine
from sipe_bayes.calibration.problem import prepare
from sipe_bayes.calibration.readers.base import LogError
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.likelihood import StateSpace
from sipe_bayes.simulation.simulator import Simulator

DRIVE = """<mujoco><option timestep="0.005" integrator="implicitfast"/><worldbody><body name="rod">
  <joint name="shaft" axis="0 1 0" damping=".002"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.2" size=".01" mass=".2"/></body></worldbody><actuator>
  <dcmotor name="motor" joint="shaft" resistance="1" motorconst=".1"/></actuator></mujoco>"""
ROCKING = """<mujoco><option timestep="0.005" integrator="implicitfast"/><worldbody>
  <geom type="plane" size="3 3 .1"/><body name="trunk" pos="0 0 .05"><freejoint/>
  <geom type="box" size=".1 .1 .05" mass="1"/><site name="imu"/>
  <body name="rod" pos="0 0 .05"><joint name="arm" axis="0 1 0" damping=".05"/>
  <geom type="capsule" fromto="0 0 0 0 0 .2" size=".01" mass=".2" contype="0" conaffinity="0"/></body></body>
  </worldbody>
  <actuator><position name="arm" joint="arm" kp="5" kv=".1"/></actuator>
  <sensor><gyro name="gyro" site="imu"/><accelerometer name="imu" site="imu"/></sensor></mujoco>"""
DT, STEPS = 0.01, 640


def swing() -> tuple[FloatArray, FloatArray, FloatArray]:
    """Angles (rad), duties and volts of a swing that nonlinear gravity shapes."""
    damping = Parameter("damping", 0.0, 0.004, targets=("joint:shaft.damping",))
    simulator = Simulator(MjcfEnvironment.build(DRIVE, [damping], ["motor"], ["joint:shaft.position"]), 1)
    time = DT * np.arange(STEPS)
    duty = np.round(200 * np.sin(2.1 * time) * np.cos(0.7 * time)) / 255
    volts = 12 - 1.5 * np.sin(0.4 * time)
    actions = (duty * volts)[None, :, None]
    seen = simulator.rollout(np.full((1, 1), 0.5), actions, simulator.default_state()[None], DT).observations[0, :, 0]
    return seen + 5e-4 * np.random.default_rng(0).standard_normal(STEPS + 1), duty, volts


def proposed(folder: Path, columns: dict[str, FloatArray], rate: float | None = None) -> Draft:
    (folder / "model.xml").write_text(DRIVE)
    pd.DataFrame(columns).to_csv(folder / "log.csv", index=False)
    draft = propose(folder / "model.xml", [folder / "log.csv"], folder, rate)
    (folder / "calibrate.toml").write_text(toml_of(draft, "sipe init"))
    load_config(folder / "calibrate.toml")
    return draft


@pytest.mark.parametrize("counts", [1024, 4096])
def test_counts_of_an_encoder_and_a_duty_of_a_battery(tmp_path: Path, counts: int) -> None:
    """Whole numbers of 255 and of a turn, a battery in mV; the counts next to them (4000) may be told beside them."""
    angle, duty, volts = swing()
    draft = proposed(
        tmp_path,
        {
            "time": DT * np.arange(STEPS),
            "encoder": np.round(angle[:-1] * counts / (2 * np.pi)),
            "pwm": np.round(255 * duty),
            "battery_mV": 1000 * volts,
        },
    )
    (command,), (position,) = draft.commands, draft.measurements
    assert (command.unit, command.supply) == ("1", ("battery_mV", "mV"))
    assert command.factor == pytest.approx(1 / 255, rel=1e-5)
    assert (position.unit, round(1 / position.factor)) == ("rev", counts), position
    problem = prepare(tmp_path / "calibrate.toml", 1)
    held = np.round(255 * duty) / 255 * volts
    np.testing.assert_allclose(problem.train.actions[0, :400, 0], held[:400], atol=2e-4)
    assert {"motor_resistance", "motor_constant"} & {u.name for u in draft.parameters}


def test_a_duty_without_a_supply_stays_open(tmp_path: Path) -> None:
    angle, duty, _ = swing()
    draft = proposed(tmp_path, {"time": DT * np.arange(STEPS), "angle_rad": angle[:-1], "duty": duty})
    assert any("a share of which voltage?" in doubt for doubt in draft.open_doubts), draft.open_doubts


def test_a_log_without_a_clock_needs_its_rate(tmp_path: Path) -> None:
    angle, duty, volts = swing()
    columns = {"angle_rad": angle[:-1], "voltage": duty * volts}
    with pytest.raises(LogError, match=r"no column is a clock .* give the rows' Hz: --rate 500"):
        proposed(tmp_path, columns)
    draft = proposed(tmp_path, columns, rate=1 / DT)
    assert [m.unit for m in draft.measurements] == ["rad"]
    text = (tmp_path / "calibrate.toml").read_text()
    assert "time = {rate = 100.0}" in text
    assert prepare(tmp_path / "calibrate.toml", 1).train[0].dt == pytest.approx(DT)
    (tmp_path / "calibrate.toml").write_text(text.replace("time = {rate = 100.0}", ""))
    with pytest.raises(LogError, match=r"no column 'time' in log.csv; .* needs its Hz, `columns.time.rate`"):
        prepare(tmp_path / "calibrate.toml", 1)
    proposed(tmp_path, {"time": DT * np.arange(STEPS), **columns})
    (tmp_path / "calibrate.toml").write_text(text)
    with pytest.raises(LogError, match="is for logs without a clock, but there is a column 'time'"):
        prepare(tmp_path / "calibrate.toml", 1)


def test_an_inertial_unit_that_alone_tells_of_a_body_is_fitted_with_its_biases(tmp_path: Path) -> None:
    """A box on the floor that rocks under an arm."""
    model = mujoco.MjModel.from_xml_string(ROCKING)
    data, rows = mujoco.MjData(model), []
    for k in range(400):
        mujoco.mj_forward(model, data)
        data.ctrl[0] = 0.8 * np.sin(0.06 * k)
        rows.append([0.01 * k, data.ctrl[0], data.qpos[7], *data.sensordata])
        mujoco.mj_step(model, data, 2)
    axes = [f"{sensor}_{axis}" for sensor in ("gyro", "acc") for axis in "xyz"]
    pd.DataFrame(rows, columns=["time", "goal_arm", "arm", *axes]).to_csv(tmp_path / "log.csv", index=False)
    (tmp_path / "model.xml").write_text(ROCKING)
    draft = propose(tmp_path / "model.xml", [tmp_path / "log.csv"], tmp_path)
    (tmp_path / "calibrate.toml").write_text(toml_of(draft, "sipe init"))
    problem = prepare(tmp_path / "calibrate.toml", 1)
    assert isinstance(problem.likelihood, StateSpace)
    assert {f"imu_bias_{axis}" for axis in "xyz"} < set(problem.environment.space.names)
    assert {m.target for m in problem.config.measurements if m.fit} == {
        "joint:arm.position",
        "sensor:gyro",
        "sensor:imu",
    }
    assert not any("trunk." in doubt for doubt in draft.open_doubts)


@pytest.mark.parametrize(
    ("answer", "rivals", "words"),
    [
        (Scale("m"), [(Scale("mm"), 1.0)], "m or mm? the model explains the log as well with either"),
        (Scale("N m"), [(Scale("mN m"), 1.5)], "N m or mN m? the model explains the log as well with either"),
        (
            Scale("rev", 1 / 4096),
            [(Scale("rev", 1 / 8192), 1.6), (Scale("rev", 1 / 4000), 1.0)],
            "4096 counts a rev or 4000, 8192? the model explains the log as well with either",
        ),
    ],
)
def test_what_may_be_right_as_well_is_one_line(answer: Scale, rivals: list[tuple[Scale, float]], words: str) -> None:
    """The nearest first; of counts the number alone."""
    assert as_well(answer, rivals) == words


def test_encoders_of_two_sides_count_alike() -> None:
    """One that went through few turns and one that went through many: what both may be; an arm's have their own."""
    few_turns, many_turns = Scale("rev", 1 / 131072), Scale("rev", 1 / 360)  # beyond which one of both went

    def counts(one: str, other: str) -> list[tuple[Scale, ...]]:
        wheels = "".join(f'<body><joint name="{joint}"/><geom size=".1"/></body>' for joint in (one, other))
        machine = Machine.of(mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{wheels}</worldbody></mujoco>"))
        swing, clock = np.sin(np.arange(99)), Clock("t", "s", 0.01, "")
        table = {f"enc_{one}": np.round(400 * swing), f"enc_{other}": np.round(9e4 * swing)}
        return [r.scales for r in first_readings(machine, match_columns(machine, table), table, {}, clock)[0]]

    left, right = counts("left", "right")
    assert left == right != ()
    assert not {few_turns, many_turns} & {*left}
    shoulder, elbow = counts("shoulder", "elbow")
    assert (many_turns in shoulder, few_turns in elbow) == (True, True)
