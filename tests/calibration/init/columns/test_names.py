"""What names say."""

import pytest

from sipe_bayes.calibration.init.columns.names import Kind, alike, is_accelerometer, is_gyro, read_name


@pytest.mark.parametrize(
    ("column", "kind", "unit", "number"),
    [
        ("time", Kind.TIME, "", None),
        ("t_ms", Kind.TIME, "ms", None),
        ("us", Kind.TIME, "us", None),
        ("Time [s]", Kind.TIME, "s", None),
        ("timestamp_ns", Kind.TIME, "ns", None),
        ("episode_index", Kind.EPISODE, "", None),
        ("frame_index", Kind.OTHER, "", None),
        ("joint_1_pos", Kind.POSITION, "", 1),
        ("/joint_states.position[0]", Kind.POSITION, "", 0),
        ("observation.state[shoulder_pan.pos]", Kind.POSITION, "", None),
        ("angle [deg]", Kind.POSITION, "deg", None),
        ("x_mm", Kind.POSITION, "mm", None),
        ("dq2", Kind.VELOCITY, "", 2),
        ("theta_dot", Kind.VELOCITY, "", None),
        ("vel_deg_s", Kind.VELOCITY, "deg/s", None),
        ("speed_rad_per_s", Kind.VELOCITY, "rad/s", None),
        ("omega (rpm)", Kind.VELOCITY, "rpm", None),
        ("tau_mNm", Kind.TORQUE, "mN m", None),
        ("torque_cmd", Kind.TORQUE, "", None),
        ("motor_voltage_V", Kind.VOLTAGE, "V", None),
        ("i_A", Kind.CURRENT, "A", None),
        ("cmd", Kind.COMMAND, "", None),
        ("action[shoulder_pan.pos]", Kind.SETPOINT, "", None),
        ("goal_position", Kind.SETPOINT, "", None),
        ("qw", Kind.QUATERNION, "", None),
        ("px", Kind.POSITION, "", None),
        ("θ1", Kind.POSITION, "", 1),
        ("temp_C", Kind.OTHER, "", None),
        ("cell_voltage_2", Kind.OTHER, "", 2),
        ("load_cell_N", Kind.TORQUE, "N", None),
        ("pwm_left", Kind.DUTY, "", None),
        ("duty [%]", Kind.DUTY, "%", None),
        ("battery_voltage", Kind.SUPPLY, "", None),
        ("vbat_mV", Kind.SUPPLY, "mV", None),
        ("battery_current", Kind.CURRENT, "", None),
        ("states[3]", Kind.UNKNOWN, "", 3),
        ("q_d", Kind.UNKNOWN, "", None),
        ("Fcyl_kN", Kind.TORQUE, "kN", None),
        ("valve_%", Kind.UNKNOWN, "%", None),
        ("yaw_psi", Kind.POSITION, "", None),
        ("eta_ψ", Kind.POSITION, "", None),
        ("theta_bar", Kind.POSITION, "", None),
        ("Pressure set (bar)", Kind.SETPOINT, "", None),
        ("u_bar", Kind.COMMAND, "", None),
        ("thrust_kg", Kind.TORQUE, "", None),
        ("load_cell_kg", Kind.TORQUE, "", None),
        ("cost_grad", Kind.UNKNOWN, "", None),
        ("pA_bar", Kind.OTHER, "bar", None),
        ("pressure_B_psi", Kind.OTHER, "", None),
        ("payload_kg", Kind.OTHER, "kg", None),
        ("Ausleger_Grad", Kind.POSITION, "deg", None),
        ("IqY_mA", Kind.CURRENT, "mA", None),
        ("iq_x", Kind.POSITION, "", None),
    ],
)
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


@pytest.mark.parametrize("column", ["gx", "gx_dps", "imu_gx_dps", "gx [deg/s]", "gyro_x_rad_s", "imu.gx_deg_per_s"])
def test_a_gyro_is_known_with_its_unit(column: str) -> None:
    label = read_name(column)
    assert is_gyro(label, label.vector)
    other = read_name(column.replace("gyro_x", "vx").replace("gx", "vx"))
    assert not is_gyro(other, other.vector)


@pytest.mark.parametrize("column", ["ax", "imu_ax", "imu.ax", "base_ax_m_s2", "acc_x"])
def test_an_accelerometer_is_known_whatever_stands_before(column: str) -> None:
    """Its letter is also ampere's."""
    label = read_name(column)
    assert is_accelerometer(label, label.vector)
