"""What names say."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from sipe_bayes.calibration.column_names import Kind, alike, read_name, read_vocabulary
from sipe_bayes.calibration.config_fields import ConfigError


@pytest.mark.parametrize(
    ("column", "kind", "unit", "number"),
    [
        ("time", Kind.TIME, "", None), ("t_ms", Kind.TIME, "ms", None), ("us", Kind.TIME, "us", None),
        ("Time [s]", Kind.TIME, "s", None), ("timestamp_ns", Kind.TIME, "ns", None),
        ("episode_index", Kind.EPISODE, "", None), ("frame_index", Kind.OTHER, "", None),
        ("joint_1_pos", Kind.POSITION, "", 1), ("/joint_states.position[0]", Kind.POSITION, "", 0),
        ("observation.state[shoulder_pan.pos]", Kind.POSITION, "", None), ("angle [deg]", Kind.POSITION, "deg", None),
        ("x_mm", Kind.POSITION, "mm", None), ("dq2", Kind.VELOCITY, "", 2), ("theta_dot", Kind.VELOCITY, "", None),
        ("vel_deg_s", Kind.VELOCITY, "deg/s", None), ("speed_rad_per_s", Kind.VELOCITY, "rad/s", None),
        ("omega (rpm)", Kind.VELOCITY, "rpm", None), ("tau_mNm", Kind.TORQUE, "mN m", None),
        ("torque_cmd", Kind.TORQUE, "", None), ("motor_voltage_V", Kind.VOLTAGE, "V", None),
        ("i_A", Kind.CURRENT, "A", None), ("cmd", Kind.COMMAND, "", None),
        ("action[shoulder_pan.pos]", Kind.SETPOINT, "", None), ("goal_position", Kind.SETPOINT, "", None),
        ("qw", Kind.QUATERNION, "", None), ("px", Kind.POSITION, "", None), ("θ1", Kind.POSITION, "", 1),
        ("temp_C", Kind.OTHER, "", None), ("cell_voltage_2", Kind.OTHER, "", 2),
        ("load_cell_N", Kind.TORQUE, "N", None), ("pwm_left", Kind.DUTY, "", None), ("duty [%]", Kind.DUTY, "%", None),
        ("battery_voltage", Kind.SUPPLY, "", None), ("vbat_mV", Kind.SUPPLY, "mV", None),
        ("battery_current", Kind.CURRENT, "", None), ("states[3]", Kind.UNKNOWN, "", 3),
        ("q_d", Kind.UNKNOWN, "", None), ("Fcyl_kN", Kind.TORQUE, "kN", None), ("valve_%", Kind.UNKNOWN, "%", None),
        ("yaw_psi", Kind.POSITION, "", None), ("eta_ψ", Kind.POSITION, "", None), ("motor.m1", Kind.UNKNOWN, "", 1),
        ("theta_bar", Kind.POSITION, "", None), ("Pressure set (bar)", Kind.SETPOINT, "", None),
        ("u_bar", Kind.COMMAND, "", None), ("thrust_kg", Kind.TORQUE, "", None), ("pwm.m1", Kind.DUTY, "", 1),
        ("load_cell_kg", Kind.TORQUE, "", None), ("cost_grad", Kind.UNKNOWN, "", None),
        ("pA_bar", Kind.OTHER, "bar", None), ("pressure_B_psi", Kind.OTHER, "", None),
        ("payload_kg", Kind.OTHER, "kg", None), ("Ausleger_Grad", Kind.POSITION, "deg", None),
        ("IqY_mA", Kind.CURRENT, "mA", None), ("iq_x", Kind.POSITION, "", None),
        ("/arm_controller/state.desired.positions[2]", Kind.SETPOINT, "", 2),
        ("action.elbow_flex.pos", Kind.SETPOINT, "", None), ("control.positions[elbow]", Kind.SETPOINT, "", None),
        ("joint_pos_target_3", Kind.SETPOINT, "", 3), ("Present_Input_Voltage", Kind.SUPPLY, "", None),
        ("elbow_goal_velocity", Kind.SPEED_SETPOINT, "", None), ("torque_enable", Kind.OTHER, "", None),
        ("actuator_outputs[1]", Kind.DUTY, "", 1), ("vehicle_attitude.q[0]", Kind.QUATERNION, "", 0),
        ("axis_Winkel_Grad", Kind.POSITION, "deg", None),
    ],
)  # fmt: skip
def test_what_a_name_says(column: str, kind: Kind, unit: str, number: int | None) -> None:
    label = read_name(column)
    assert (label.kind, label.unit, label.number) == (kind, unit, number)


def test_names_that_are_spelt_shorter_are_alike() -> None:
    assert alike(("shldr",), "shoulder") > 0.6
    assert alike(("elb",), "elbow") > 0.6
    assert alike(("wrist",), "elbow") == 0.0
    assert alike(("shoulder", "pan"), "shoulder_pan") > alike(("shoulder", "lift"), "shoulder_pan")


def test_a_unit_behind_what_a_joint_is_called() -> None:
    assert read_name("A1_current_A", {"a"}).unit == "A"
    assert read_name("position_A1", {"a"}).unit == ""
    assert read_name("/joint_states.position[drive_cmd]").words == ("drive", "cmd")


@pytest.fixture
def users_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    (tmp_path / "sipe_bayes").mkdir()
    yield tmp_path / "sipe_bayes" / "column_names.toml"
    read_vocabulary.cache_clear()


def test_a_users_file_comes_first(users_file: Path) -> None:
    users_file.write_text(
        """[dutch]
        words = { angle = "hoek", other = "x" }
        units = { deg = "gr" }
        patterns = { "plc.*.{joint}_act" = "position mrad" }"""
    )
    read_vocabulary.cache_clear()
    assert (read_name("hoek_2_gr").kind, read_name("hoek_2_gr").unit) == (Kind.POSITION, "deg")
    assert read_name("x").kind == Kind.OTHER
    label = read_name("plc.unit4.elbow_act")
    assert (label.kind, label.unit, label.words) == (Kind.POSITION, "mrad", ("elbow",))
    assert read_name("theta_dot").kind == Kind.VELOCITY  # what the package knows stays


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[mine.words]\nangel = 'hoek'", "key `mine.words.angel`: unknown; did you mean 'angle'"),
        ("[mine.units]\ndegree = 'gr'", "key `mine.units.degree`: unknown; "),
        ("[mine.patterns]\n'*_stand' = 'positon'", "got 'positon'; did you mean 'position'"),
        ("[mine]\nwrods = {}", "key `mine.wrods`: "), ("[mine.words]\nangle = 3", "key `mine.words.angle`: "),
        ("[mine", "not valid TOML"),
    ],
)  # fmt: skip
def test_a_wrong_users_file_is_named_in_one_line(text: str, message: str, users_file: Path) -> None:
    users_file.write_text(text)
    read_vocabulary.cache_clear()
    with pytest.raises(ConfigError) as caught:
        read_name("q")
    assert str(users_file) in str(caught.value)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
