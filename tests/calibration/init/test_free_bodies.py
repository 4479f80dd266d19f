"""Of a free body its mass is proposed where something of known force pushes it, and not where it is only thrown."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from sipe_bayes.calibration.init.cases import rough_parameters
from sipe_bayes.calibration.init.draft import Draft, questions
from sipe_bayes.calibration.init.matching import match_columns
from sipe_bayes.calibration.init.propose import propose
from sipe_bayes.calibration.init.readings import first_readings
from sipe_bayes.calibration.init.write import summary, toml_of
from sipe_bayes.calibration.machine import Machine
from sipe_bayes.cli.app import app

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
    unknowns = [unknown.name for unknown in propose(path, [tmp_path / "log.csv"], tmp_path).parameters]
    assert ("puck_mass" in unknowns) == driven
    assert "puck_friction" in unknowns


def pushed(folder: Path, seed: int, noise: float) -> Draft:
    """What is proposed for a slider that pushes the puck now and then, of a machine whose friction is another one."""
    path = folder / "model.xml"
    path.write_text(PUSHED.format(pusher=PUSHER, motor=MOTOR))
    real = PUSHER.replace('damping="3"', 'damping="5" frictionloss=".2"')
    model = mujoco.MjModel.from_xml_string(PUSHED.format(pusher=real, motor=MOTOR).replace('n=".4', 'n=".25'))
    data, rows = mujoco.MjData(model), []
    for k in range(300):
        data.ctrl[:] = 5 * np.sin(2 * np.pi * k / 110) + 1.5 * np.sin(2 * np.pi * k / 37 + seed)
        rows.append([0.01 * k, float(data.ctrl[0]), *data.qpos])
        mujoco.mj_step(model, data, 2)
    table = np.array(rows)
    table[:, 2:] += noise * np.random.default_rng(seed).standard_normal((300, 8))
    names = ["t", "force", "x", "y", "z", "qw", "qx", "qy", "qz", "stroke"]
    pd.DataFrame(table, columns=names).to_csv(folder / "log.csv", index=False)
    return propose(path, [folder / "log.csv"], folder)


@pytest.mark.parametrize("seed", [1, 2])
def test_what_rests_turns_no_units_and_signs(tmp_path: Path, seed: int) -> None:
    """Simulations follow the noise of a height or a tilt worse than a line does, which tells nothing of the force."""
    draft = pushed(tmp_path, seed, 1e-4)
    read = {r.match.column: (r.unit, r.sign) for r in draft.readings if len(r.match.columns) == 1}
    assert read == {"stroke": ("m", 1), "force": ("N", 1)}, draft.open_doubts


def test_in_noise_names_stand_and_nothing_is_odd(tmp_path: Path) -> None:
    draft = pushed(tmp_path, 2, 1e-3)
    assert [(r.unit, r.sign) for r in draft.readings if len(r.match.columns) == 1] == [("m", 1), ("N", 1)]
    path = tmp_path / "calibrate.toml"
    path.write_text(toml_of(draft, "sipe init"))
    result = CliRunner().invoke(app, ["validate", str(path)])
    assert result.exit_code == 0
    assert "nothing is odd" in result.output


POSE = ["{}x{}", "{}y{}", "{}z{}", "{}qw", "{}qx", "{}qy", "{}qz"]
VELOCITIES = ["{}vx{}", "{}vy{}", "{}vz{}", "{}wx{}", "{}wy{}", "{}wz{}"]


@pytest.mark.parametrize("units", [("", "", ""), ("_m", "_m_s", "_rad_s"), ("[mm]", "", "")])
@pytest.mark.parametrize("called", ["puck_", ""])
def test_columns_of_a_free_body_with_their_units_in_their_names(units: tuple[str, str, str], called: str) -> None:
    model = mujoco.MjModel.from_xml_string(PUSHED.format(pusher=PUSHER, motor=MOTOR))
    length, along, about = units
    names = [name.format(called, length) for name in POSE]
    names += [name.format(called, along if k < 3 else about) for k, name in enumerate(VELOCITIES)]
    table = dict.fromkeys([*names, "stroke_m", "stroke_vel", "push_N"], np.arange(30.0))
    matches = match_columns(Machine.of(model), table)
    expected = {"position": names[:3], "orientation": names[3:7], "linear_velocity": names[7:10]}
    expected |= {"angular_velocity": names[10:]}
    found = {match.target: list(match.columns) for match in matches.vectors}
    assert found == {f"body:puck.{quantity}": columns for quantity, columns in expected.items()}
    assert [match.column for match in matches.velocities] == ["stroke_vel"]
    assert not matches.left


@pytest.mark.parametrize(
    ("linear", "turning"), [("lin_vel_w_", "ang_vel_w_"), ("vel_w_", "w_"), ("vel_body_", "w_body_")]
)
def test_a_w_beside_a_velocity_is_the_world(linear: str, turning: str) -> None:
    model = mujoco.MjModel.from_xml_string(PUSHED.format(pusher=PUSHER, motor=MOTOR))
    names = {q: [f"puck_{stem}{axis}" for axis in "xyz"] for q, stem in (("linear", linear), ("angular", turning))}
    table = dict.fromkeys([*names["linear"], *names["angular"], "stroke_m"], np.arange(30.0))
    read = {match.target: list(match.columns) for match in match_columns(Machine.of(model), table).vectors}
    assert read == {f"body:puck.{quantity}_velocity": columns for quantity, columns in names.items()}


def drone(motors: bool) -> Machine:
    """Four thrusts on a free body, and a gyro."""
    places = [(0.2, 0.15), (0.2, -0.15), (-0.2, 0.15), (-0.2, -0.15)]
    sites = "".join(f'<site name="t{k}" pos="{x} {y} 0"/>' for k, (x, y) in enumerate(places))
    thrusts = "".join(f'<motor name="thrust{k}" site="t{k}" gear="0 0 6 0 0 0"/>' for k in range(4))
    return Machine.of(
        mujoco.MjModel.from_xml_string(
            f"""<mujoco><worldbody><body name="base"><freejoint/><geom size=".1" mass="1" contype="0"/>{sites}</body>
            </worldbody><actuator>{thrusts if motors else ""}</actuator>
            <sensor><gyro name="gyro" site="t0"/></sensor></mujoco>"""
        )
    )


def test_as_many_numbered_columns_as_actuators_are_their_commands() -> None:
    """Their name says nothing: m1 to m4; with a command that says so beside them they are none. And gx is a gyro's."""
    table = dict.fromkeys(["m1", "m2", "m3", "m4", "px", "py", "pz", "qw", "qx", "qy", "qz"], np.arange(30.0))
    table |= dict.fromkeys(["gx", "gy", "gz"], np.arange(30.0))
    matches = match_columns(drone(motors=True), table)
    assert [(m.column, m.target) for m in matches.commands] == [(f"m{k + 1}", f"actuator:thrust{k}") for k in range(4)]
    assert {m.target: m.columns[0] for m in matches.vectors}["sensor:gyro"] == "gx"
    beside = match_columns(drone(motors=True), table | dict.fromkeys([f"cmd{k}" for k in range(4)], np.arange(30.0)))
    assert [m.column for m in beside.commands] == ["cmd0", "cmd1", "cmd2", "cmd3"]


def test_a_thrust_that_can_not_push_back_has_no_sign_to_try() -> None:
    """Turned round, commands of a ctrlrange from 0 to 1 would do nothing, and a body that falls be followed as well."""
    for limits, tried in (("", True), (' ctrlrange="0 1"', False), (' ctrlrange="-1 1"', True)):
        motor = MOTOR.replace(' joint="stroke"', f' joint="stroke"{limits}')
        model = mujoco.MjModel.from_xml_string(PUSHED.format(pusher=PUSHER, motor=motor))
        time = 0.01 * np.arange(200)
        table = {"stroke": np.sin(time), "force": np.abs(np.sin(3 * time))}
        machine = Machine.of(model)
        readings = first_readings(machine, match_columns(machine, table), table, {}, None)
        draft = Draft("m.xml", None, None, readings[1], readings[0], (), 1e-3)
        asked = [draft.readings[k].match.target for q in questions(draft, machine) if q.of_sign for k in q.readings]
        assert ("actuator:push" in asked) == tried


def test_where_nothing_else_may_be_unknown_the_mass_is_proposed() -> None:
    """A body that nothing drives or touches: a configuration needs an unknown."""
    model = mujoco.MjModel.from_xml_string(PUSHED.format(pusher="", motor=""))
    model.geom_contype[:] = model.geom_conaffinity[:] = 0
    assert [one.name for one in rough_parameters(model, Machine.of(model), [])] == ["puck_mass"]


@pytest.mark.parametrize(("geom", "said"), [("box", "ball.position, ball.orientation"), ("sphere", "ball.position")])
def test_a_pose_without_columns_is_told(tmp_path: Path, geom: str, said: str) -> None:
    """A ball's orientation is not missed: it moves alike however it is turned."""
    path = tmp_path / "model.xml"
    ball = f'<body name="ball" pos="1 0 .5"><freejoint/><geom type="{geom}" size=".05 .05 .05" mass=".1"/></body>'
    path.write_text(PUSHED.format(pusher=ball, motor=""))
    time = 0.01 * np.arange(60)
    columns = {"t": time, "puck_x_m": 0.1 * time, "puck_y_m": 0.2 * time, "puck_z_m": 0.02 + 1e-4 * np.sin(time)}
    pd.DataFrame(columns).to_csv(tmp_path / "log.csv", index=False)
    draft = propose(path, [tmp_path / "log.csv"], tmp_path)
    assert any(f"no column measures puck.orientation, {said}:" in line for line in summary(draft, "calibrate.toml"))
