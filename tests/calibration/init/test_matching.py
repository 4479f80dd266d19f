"""Which columns are taken for what, by names that may mean several things."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from sipe_bayes.calibration.init.matching import Matches, match_columns
from sipe_bayes.calibration.machine import Machine

POSE = ["px", "py", "pz", "qw", "qx", "qy", "qz"]


def matched(machine: Machine, columns: list[str]) -> Matches:
    return match_columns(machine, dict.fromkeys(columns, np.arange(30.0)))


def compiled(xml: str) -> Machine:
    return Machine.of(mujoco.MjModel.from_xml_string(f"<mujoco>{xml}</mujoco>"))


def flying(sensors: str = "", joint: str = "") -> Machine:
    """A free body with four thrusts."""
    sites = "".join(f'<site name="t{k}"/>' for k in range(4))
    thrusts = "".join(f'<motor name="thrust{k}" site="t{k}" gear="0 0 6 0 0 0"/>' for k in range(4))
    arm = f'<body><joint name="{joint}"/><geom size=".1" mass="1"/></body>' if joint else ""
    base = f'<body name="base"><freejoint/><geom size=".1" mass="1"/>{sites}{arm}</body>'
    return compiled(f"<worldbody>{base}</worldbody><actuator>{thrusts}</actuator><sensor>{sensors}</sensor>")


def chain(*names: str, sensors: str = "") -> Machine:
    """Links one behind the other."""
    bodies = "".join(f'<body><joint name="{name}"/><geom size=".1" mass="1"/><site name="s_{name}"/>' for name in names)
    motors = "".join(f'<motor name="motor_{name}" joint="{name}"/>' for name in names)
    world = f"<worldbody>{bodies}{'</body>' * len(names)}</worldbody>"
    return compiled(f"{world}<actuator>{motors}</actuator><sensor>{sensors}</sensor>")


def numbered(word: str) -> list[str]:
    return [f"{word}{k + 1}" for k in range(4)]


@pytest.mark.parametrize("beside", [[], ["battery_current"], numbered("cell_voltage"), numbered("temp")])
def test_commands_by_their_number_alone_are_told(beside: list[str]) -> None:
    matches = matched(flying(), [*POSE, *beside, *numbered("m")])
    assert [m.column for m in matches.commands] == numbered("m")
    (doubt,) = matches.doubts
    assert doubt.startswith("'m1', 'm2', 'm3', 'm4' are taken for the commands of thrust0, thrust1, thrust2, thrust3")
    several = matched(flying(), [*POSE, *numbered("k"), *numbered("thr")])  # of which that is taken which is called so
    assert [m.column for m in several.commands] == numbered("thr")
    assert [doubt.endswith("; or are these: 'k1', 'k2', 'k3', 'k4'?") for doubt in several.doubts] == [True]


@pytest.mark.parametrize("word", ["temp", "cell", "cell_voltage", "status", "sonar", "pressure"])
def test_what_drives_nothing_is_no_command(word: str) -> None:
    matches = matched(flying(), [*POSE, *numbered(word)])
    assert not matches.commands
    assert list(matches.left) == numbered(word)


@pytest.mark.parametrize(
    ("stem", "beside", "quantity", "sure"),
    [
        ("base_vel_w{}", "", "angular", False), ("base_vel_w{}", "base_vel_{}", "angular", True),
        ("base_vel_w{}_rad_s", "", "angular", True), ("base_vel_w{}_m_s", "", "linear", True),
        ("base_lin_vel_w{}", "", "linear", False), ("base_lin_vel_w_{}", "", "linear", True),
        ("base_vel_w_{}", "", "linear", False), ("base_vel_w_{}", "base_ang_vel_{}", "linear", True),
        ("base_ang_vel_w_{}", "", "angular", True), ("base_w{}", "", "angular", True),
        ("base_v{}", "", "linear", True),
    ],
)  # fmt: skip
def test_a_rate_or_the_world(stem: str, beside: str, quantity: str, sure: bool) -> None:
    names = [stem.format(axis) for axis in "xyz"]
    matches = matched(flying(), [*POSE, *names, *(beside.format(axis) for axis in "xyz" if beside)])
    (match,) = [m for m in matches.vectors if list(m.columns) == names]
    assert (match.target, match.sure) == (f"body:base.{quantity}_velocity", sure)
    assert bool(matches.doubts) is not sure, matches.doubts


@pytest.mark.parametrize("joints", [("gx", "gy"), ("ax", "ay"), ("wx", "wy"), ("arm_ax", "arm_ay")])
@pytest.mark.parametrize("sensors", ["", "gyro"])
def test_joints_that_are_called_as_a_bodys_velocity(joints: tuple[str, str], sensors: str) -> None:
    machine = chain(*joints, sensors=f'<gyro name="imu" site="s_{joints[0]}"/>' if sensors else "")
    for columns in (joints[::-1], [f"{joint}_deg" for joint in joints]):
        matches = matched(machine, [*columns, f"{joints[1]}_vel", f"{joints[0]}_vel", f"{joints[1]}_cmd"])
        assert {m.target: m.column for m in matches.positions} == {
            f"joint:{joint}.position": sorted(columns)[k] for k, joint in enumerate(joints)
        }
        assert {m.target: m.column for m in matches.velocities} == {
            f"joint:{joint}.velocity": f"{joint}_vel" for joint in joints
        }
        assert [(m.column, m.target) for m in matches.commands] == [(f"{joints[1]}_cmd", f"actuator:motor_{joints[1]}")]


def test_an_inertial_unit_that_the_model_lacks_measures_no_joint() -> None:
    matches = matched(chain("shoulder", "elbow"), ["q1", "q2", "gx", "gy", "gz", "ax", "ay", "az"])
    assert not matches.velocities
    assert not matches.vectors


@pytest.mark.parametrize(
    ("sensors", "joint", "target"),
    [
        ('<gyro name="imu" site="t0"/>', "", "sensor:imu"), ("", "", "body:base.angular_velocity"), ("", "gx", None),
    ],
)  # fmt: skip
def test_a_gyro_of_a_free_body(sensors: str, joint: str, target: str | None) -> None:
    """Without one in the model it tells the body's rates about the world's axes, which is told; a joint comes first."""
    matches = matched(flying(sensors, joint), [*POSE, "gx", "gy", "gz"])
    assert next((m.target for m in matches.vectors if "gx" in m.columns), None) == target
    assert any("give the model a <gyro>" in doubt for doubt in matches.doubts) == (
        target == "body:base.angular_velocity"
    )
    assert [m.column for m in matches.positions] == [joint] * bool(joint)


@pytest.mark.parametrize(
    ("stem", "kind"),
    [
        ("g{}", "gyro"), ("g{}_dps", "gyro"), ("imu_g{}_dps", "gyro"), ("g{} [deg/s]", "gyro"), ("v{}", ""),
        ("gyro_{}_rad_s", "gyro"), ("imu.g{}_deg_per_s", "gyro"), ("imu_v{}", ""),
        ("a{}", "accelerometer"), ("imu_a{}", "accelerometer"), ("base_a{}_m_s2", "accelerometer"),
        ("acc_{}", "accelerometer"),
    ],
)  # fmt: skip
def test_an_inertial_unit_is_known_with_its_unit_whatever_stands_before(stem: str, kind: str) -> None:
    """The letter of an acceleration is also ampere's."""
    sensors = "".join(f'<{one} name="{one}" site="s_j"/>' for one in ("gyro", "accelerometer"))
    columns = [stem.format(axis) for axis in "xyz"]
    vectors = matched(chain("j", sensors=sensors), ["q", *columns]).vectors
    assert [(m.target, list(m.columns)) for m in vectors] == ([(f"sensor:{kind}", columns)] if kind else [])


def test_one_rate_of_a_gyro_is_the_joints_whose_slope_it_is() -> None:
    """And no slide's, though its axis is called so; of two hinges the second, where positions tell."""
    joints = '<joint name="x" type="slide"/><joint name="wheel" axis="0 1 0"/><joint name="pitch" axis="0 1 0"/>'
    machine = compiled(f'<worldbody><body>{joints}<geom size=".1" mass="1"/></body></worldbody>')
    time = np.arange(0, 5, 0.01)
    table = {
        "wheel_rad": np.sin(3 * time), "pitch_deg": 10 * np.sin(2 * time + 1), "gyro_y_dps": 20 * np.cos(2 * time + 1),
    }  # fmt: skip
    (velocity,) = match_columns(machine, table).velocities
    assert velocity.target == "joint:pitch.velocity"
    assert velocity.label.unit == "deg/s"
    table |= {"wheel_vel_rad_s": 5 * np.cos(2 * time + 1)}
    named = match_columns(machine, {k: v for k, v in table.items() if not k.startswith("gyro")}).velocities
    assert [m.target for m in named] == ["joint:wheel.velocity"]  # whatever else it is like
    (alone,) = match_columns(machine, {"gyro_y_dps": table["gyro_y_dps"]}).velocities
    assert alone.target == "joint:wheel.velocity"


BEAM = """<worldbody><body name="beam"><joint name="tilt"/><geom size=".1" mass="1"/><body name="ball">
    <joint name="roll" type="slide"/><geom size=".1" mass="1"/></body></body></worldbody>
    <actuator><{kind} name="servo" joint="tilt"/></actuator>"""


@pytest.mark.parametrize(
    ("columns", "driving", "measured"),
    [
        (["servo_deg", "beam_deg", "ball_mm"], "servo_deg", ["beam_deg", "ball_mm"]),
        (["servo", "beam_deg", "ball_mm"], "servo", ["beam_deg", "ball_mm"]),
        (["servo_cmd", "servo_deg", "ball_mm"], "servo_cmd", ["servo_deg", "ball_mm"]),  # which has its command
        (["servo_temp", "beam_deg", "ball_mm"], None, ["beam_deg", "ball_mm"]),
        (["u", "servo_deg", "beam_deg", "ball_mm"], "u", ["beam_deg", "ball_mm"]),
        (["tilt_servo_deg", "ball_mm"], None, ["tilt_servo_deg", "ball_mm"]),  # called as the joint too
    ],
)  # fmt: skip
def test_a_column_called_as_an_actuator_drives_it_where_nothing_else_does(
    columns: list[str], driving: str | None, measured: list[str]
) -> None:
    matches = matched(compiled(BEAM.format(kind="position")), columns)
    assert [m.column for m in matches.commands] == [driving] * (driving is not None)
    assert [m.column for m in matches.positions] == measured


@pytest.mark.parametrize(
    ("columns", "driving"),
    [
        (["Pressure set (bar)", "beam_deg", "ball_mm"], "Pressure set (bar)"),
        (["Pressure (bar)", "beam_deg", "ball_mm"], None),  # which is measured, for all that is said
        (["Pressure set (bar)", "Valve set (V)", "beam_deg", "ball_mm"], None),  # either may
    ],
)  # fmt: skip
def test_the_one_command_drives_the_one_actuator_whatever_it_is_called(columns: list[str], driving: str | None) -> None:
    matches = matched(compiled(BEAM.format(kind="motor")), columns)
    assert [m.column for m in matches.commands] == [driving] * (driving is not None)


SLIDE = """<worldbody><body name="cart"><joint name="drive" type="slide"/><geom size=".1" mass="1"/></body>
</worldbody><actuator><motor name="{name}" joint="drive"/></actuator>"""


@pytest.mark.parametrize(
    ("actuator", "columns", "driving", "measured"),
    [
        ("force", ["force [N]", "drive [m]"], "force [N]", ["drive [m]"]),
        ("motor_drive", ["drive_cmd", "drive_pos"], "drive_cmd", ["drive_pos"]),
        ("push", ["u", "drive"], "u", ["drive"]),
        ("drive", ["drive", "cart [m]"], "drive", ["cart [m]"]),  # an actuator that is called so
    ],
)  # fmt: skip
def test_a_word_for_commands_that_a_joint_is_called_by_is_its_name(
    actuator: str, columns: list[str], driving: str, measured: list[str]
) -> None:
    matches = matched(compiled(SLIDE.format(name=actuator)), columns)
    assert [m.column for m in matches.commands] == [driving]
    assert [m.column for m in matches.positions] == measured


def test_ticks_that_go_back_are_a_joints_and_no_clock() -> None:
    """`beam` is the body of the joint; a clock of ticks only rises."""
    machine, rows = compiled(BEAM.format(kind="motor")), np.arange(30.0)
    table = {"u": rows, "beam_ticks": np.round(100 * np.sin(rows)), "ball_mm": rows}
    assert [m.column for m in match_columns(machine, table).positions] == ["beam_ticks", "ball_mm"]
    assert [m.column for m in match_columns(machine, {**table, "beam_ticks": rows}).positions] == ["ball_mm"]


ARM = """<worldbody><body name="shoulder"><joint name="shoulder_pan"/><geom size=".1" mass="1"/>
<body name="upper_arm"><joint name="shoulder_lift"/><geom size=".1" mass="1"/>
<body name="hand"><joint name="wrist_roll"/><geom size=".1" mass="1"/>
<body name="jaw"><joint name="gripper"/><geom size=".1" mass="1"/></body></body></body></body></worldbody>
<actuator><position name="a" joint="shoulder_pan"/><position name="b" joint="shoulder_lift"/>
<position name="c" joint="wrist_roll"/><position name="d" joint="gripper"/></actuator>"""
JOINTS = ("shoulder_pan", "shoulder_lift", "wrist_roll", "gripper")


@pytest.mark.parametrize("order", [1, -1])
@pytest.mark.parametrize("form", ["{}[{}.pos]", "{}.{}.pos", "{}_{}"])
def test_a_name_that_is_the_joints_own_is_sure_whatever_a_body_is_called(form: str, order: int) -> None:
    machine = compiled(ARM)
    columns = [form.format(of, joint) for of in ("observation.state", "action") for joint in JOINTS]
    matches = matched(machine, columns[::order])
    for match, of, joint in zip(
        (*matches.positions, *matches.commands), ["observation.state"] * 4 + ["action"] * 4, JOINTS * 2, strict=True
    ):
        print(match.target, match.columns, match.score)
        assert match.sure
        assert match.column == form.format(of, joint)


def test_only_what_nothing_names_is_taken_by_order() -> None:
    machine = compiled(ARM)
    by_order = matched(machine, ["q_1", "q_2", "q_3", "q_4"]).positions
    assert [match.named for match in by_order] == [False] * 4
    near = {
        m.target: m for m in matched(machine, [f"{name}_pos" for name in ("shoulder", "arm", "roll", "grip")]).positions
    }
    assert all(match.named for match in near.values())


@pytest.mark.parametrize(
    ("columns", "measured"),
    [
        (["u", "beam_deg", "kugel_weg"], ["beam_deg", "kugel_weg"]),
        (["u", "beam_deg", "kugel_weg", "rinne"], ["beam_deg"]),  # either may
        (["u", "beam_deg", "room_temp"], ["beam_deg"]),
        (["u", "kugel_weg"], []),  # nothing tells that any joint is measured
        (["u", "beam_deg", "counter"], ["beam_deg"]),  # it only rises
        (["u", "beam_deg", "kugel_weg", "counter"], ["beam_deg", "kugel_weg"]),
    ],
)  # fmt: skip
def test_the_one_column_left_measures_the_one_joint_left(columns: list[str], measured: list[str]) -> None:
    walks = np.cumsum(np.random.default_rng(0).standard_normal((len(columns), 60)), axis=1)
    table = {name: np.arange(60.0) if name == "counter" else walk for name, walk in zip(columns, walks, strict=True)}
    matches = match_columns(compiled(BEAM.format(kind="motor")), table)
    assert [m.column for m in matches.positions] == measured
    assert all(not m.sure for m in matches.positions if m.column == "kugel_weg")


@pytest.mark.parametrize(
    ("joints", "columns"),
    [
        (("A1", "A2"), ("{}_position", "{}_velocity", "{}_current", "{}_setpoint")),
        (("A1", "A2"), ("position_{}", "velocity_{}", "torque_{}", "setpoint_{}")),
        (("A1", "A2"), ("Lage_{}_ink", "Drehz_{}", "Strom_{}", "LSoll_{}_ink")),
        (("axisA", "axisB"), ("{}_position", "{}_velocity", "{}_current", "{}_soll")),
        (("F1", "F2"), ("{}_position", "{}_rpm", "{}_current_A", "spare_{}")),
    ],
)  # fmt: skip
def test_joints_of_one_letter_are_no_quantities(joints: tuple[str, str], columns: tuple[str, ...]) -> None:
    names = [column.format(joint) for column in columns for joint in joints]
    random = np.random.default_rng(0)
    matches = match_columns(chain(*joints), {name: random.standard_normal(30) for name in names})
    taken = [*matches.positions, *matches.velocities, *matches.commands]
    assert [match.column for match in taken] == names[:6]
    assert [match.target.split(":")[1].split(".")[0].removeprefix("motor_") for match in taken] == [*joints] * 3
    assert list(matches.left) == names[6:]


FINGER = """<worldbody><site name="palm"/><body name="proximal"><joint name="mcp"/><geom size=".1" mass="1"/>
<body name="distal"><joint name="dip"/><geom size=".1" mass="1"/><site name="tip" pos="1 0 .1"/></body></body>
</worldbody><tendon><spatial name="flexor"><site site="palm"/><site site="tip"/></spatial></tendon>
<actuator><motor name="flexor_motor" tendon="flexor"/></actuator>"""


@pytest.mark.parametrize(("beside", "doubted"), [("enc_flexor", True), ("enc_dip", False), ("enc_b", False)])
def test_the_encoder_of_what_pulls_a_tendon_measures_no_joint(beside: str, doubted: bool) -> None:
    matches = matched(compiled(FINGER), ["cmd_flexor_mA", "mcp_deg", beside])
    targets = {m.column: m.target for m in matches.positions}
    assert targets == {"mcp_deg": "joint:mcp.position"} | ({} if doubted else {beside: "joint:dip.position"})
    assert any("called as what pulls a tendon" in doubt for doubt in matches.doubts) == doubted
    assert [m.column for m in matches.commands] == ["cmd_flexor_mA"]


@pytest.mark.parametrize("joints", ["shoulder elbow wrist", "joint_1 joint_2 joint_3", "A1 A2 A3"])
@pytest.mark.parametrize(
    "columns",
    [
        ("/joint_states.position[{j}]", "/joint_states.velocity[{j}]", "tau{i}", "/joint_states.effort[{j}]"),
        ("q[{k}]", "qd[{k}]", "u{i}", "{j}_current_mA"),  # what is told comes before what is measured
        ("{j}_meas", "omega_{j}", "cmd_{k}", "{j}_effort"),
        ("present_position_{i}", "present_velocity_{i}", "goal_pwm_{i}", "present_current_{i}"),
        ("observation.state.{j}.pos", "{j}_dot", "torque_cmd_{j}", "load_{i}"),
        ("theta{i}", "joint_{i}_vel", "ctrl[{k}]", "tau_meas_{j}"),
    ],
)
def test_columns_of_many_dialects_in_any_order(joints: str, columns: tuple[str, ...]) -> None:
    machine, random = chain(*joints.split()), np.random.default_rng(0)
    table, truth, time = dict[str, np.ndarray](), dict[str, str](), np.arange(0, 9, 0.03)
    for k, joint in enumerate(joints.split()):
        pace = 1.3 + 0.7 * k
        values = (np.sin(pace * time), pace * np.cos(pace * time), *random.standard_normal((2, 300)))
        names = [column.format(i=k + 1, k=k, j=joint) for column in columns]
        table |= dict(zip(names, values, strict=True))
        targets = (f"joint:{joint}.position", f"joint:{joint}.velocity", f"actuator:motor_{joint}")
        truth |= dict(zip(targets, names, strict=False))
    for _ in range(3):
        matches = match_columns(machine, {name: table[name] for name in random.permutation(list(table)).tolist()})
        found = {m.target: m.column for m in (*matches.positions, *matches.velocities, *matches.commands)}
        assert found == truth
