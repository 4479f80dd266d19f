"""What a command is given in fits its actuator, or is refused in a line; what its column is called is doubted."""

from __future__ import annotations

from pathlib import Path

import pytest

from sipe_bayes.calibration.commands import check_commands
from sipe_bayes.calibration.config import Config, load_config
from sipe_bayes.calibration.config_fields import ConfigError
from sipe_bayes.core.findings import Code
from sipe_bayes.core.units import DIMENSIONS, unit_words

MODEL = """\
<mujoco>
  <worldbody>
    <body name="carriage">
      <joint name="slide" type="slide" axis="1 0 0"/><geom size="0.1" mass="1"/>
      <body name="arm"><joint name="hinge" axis="0 1 0"/><geom size="0.1" pos="0 0 0.3" mass="1"/><site name="tip"/>
        <body name="hand" pos="0 0 1"><joint name="ball" type="ball"/><geom size="0.1" mass="1"/></body>
      </body>
    </body>
  </worldbody>
  <tendon><fixed name="belt"><joint joint="hinge" coef="1"/></fixed>
    <fixed name="drum"><joint joint="hinge" coef="0.05"/></fixed></tendon>
  <actuator>{actuator}</actuator>
</mujoco>
"""
CONFIG = """\
model = "model.xml"
window = 0.5
commands = [{{ actuator = "driven", column = "{column}", unit = "1", factor = {factor} }}]
measurements = [{{ column = "angle", target = "joint:hinge.position", unit = "rad" }}]
logs = [{{ file = "log.csv" }}]
parameters = [{{ name = "unknown", target = "{target}", bounds = [0.5, 2.0], description = "{description}" }}]
"""
POWERED = [dimension for dimension in DIMENSIONS if dimension not in ("mass", "time")]
TORQUE, FORCE, ELECTRIC = ["torque"], ["force"], ["voltage", "current"]
MOTOR = '<motor name="driven" joint="hinge"/>'
EMF = '<general name="driven" joint="hinge" gainprm="{gain}" biastype="affine" biasprm="0 0 -0.01"/>'
CASES = [  # actuator, factor, what else there is, the dimensions that it takes beside dimensionless
    (MOTOR, 1, {}, TORQUE),
    ('<motor name="driven" joint="hinge" gear="-1"/>', 1, {}, TORQUE),
    ('<motor name="driven" joint="slide"/>', 1, {}, FORCE),
    ('<motor name="driven" joint="ball" gear="0 0 1"/>', 1, {}, TORQUE),
    ('<motor name="driven" site="tip" gear="0 0 1 0 0 0"/>', 1, {}, FORCE),
    ('<motor name="driven" site="tip" gear="0 0 0 1 0 0"/>', 1, {}, TORQUE),
    ('<motor name="driven" tendon="belt"/>', 1, {}, TORQUE),
    ('<motor name="driven" tendon="drum"/>', 1, {}, TORQUE + FORCE + ELECTRIC),
    ('<motor name="driven" joint="hinge" gear="0.3"/>', 1, {}, TORQUE + FORCE + ELECTRIC),
    (MOTOR, 0.105, {}, TORQUE + FORCE + ELECTRIC),
    (MOTOR, 1, {"target": "actuator:driven.gain"}, TORQUE + FORCE + ELECTRIC),
    (MOTOR, 1, {"target": "actuator:driven.gear", "description": "gear, N m/V"}, ["voltage"]),
    (MOTOR, 1, {"target": "actuator:driven.gear", "description": "motor constant in N m per A"}, ["current"]),
    ('<general name="driven" joint="slide" dyntype="filter" dynprm="0.1"/>', 1, {}, FORCE),
    (EMF.format(gain=0.05), 1, {}, ["voltage"]),
    (EMF.format(gain=1), 1, {}, ["voltage", "torque"]),
    ('<dcmotor name="driven" joint="hinge" resistance="2" motorconst="0.3"/>', 1, {}, ["voltage"]),
    ('<position name="driven" joint="hinge" kp="9"/>', 1, {}, ["angle"]),
    ('<position name="driven" joint="slide" kp="9" kv="1"/>', 1, {}, ["length"]),
    ('<position name="driven" joint="slide" kp="9"/>', 0.1, {}, ["length", "angle", *ELECTRIC]),
    ('<velocity name="driven" joint="hinge" kv="9"/>', 1, {}, ["angular velocity"]),
    ('<velocity name="driven" joint="slide" kv="9"/>', 1, {}, ["velocity"]),
    ('<intvelocity name="driven" joint="hinge" kp="9" actrange="-1 1"/>', 1, {}, ["angular velocity"]),
    ('<damper name="driven" joint="hinge" kv="9" ctrlrange="0 1"/>', 1, {}, ["dimensionless"]),
    ('<damper name="driven" joint="hinge" kv="9" ctrlrange="0 1"/>', 0.1, {}, ["dimensionless", *POWERED]),
    ('<muscle name="driven" joint="hinge" lengthrange="0 1"/>', 1, {}, ["dimensionless"]),
    ('<dcmotor name="driven" joint="hinge" resistance="1" motorconst="0.3"/>', 1, {}, ["voltage"]),
]  # fmt: skip


def configured(folder: Path, actuator: str, factor: float = 1, column: str = "u", **parameter: str) -> Config:
    """A configuration whose command is dimensionless."""
    (folder / "model.xml").write_text(MODEL.format(actuator=actuator))
    (folder / "log.csv").write_text("time,u,angle\n0,0,0\n0.1,0,0\n")
    parameter = {"target": "joint:hinge.damping", "description": ""} | parameter
    (folder / "config.toml").write_text(CONFIG.format(factor=f"{factor:.6f}", column=column, **parameter))
    return load_config(folder / "config.toml")


def check(config: Config, unit: str) -> list[Code]:
    """The doubts of its command, given in a unit."""
    (command,) = config.commands
    config = config.model_copy(update={"commands": (command.model_copy(update={"unit": unit}),)})
    return [doubt.code for doubt in check_commands(config)]


@pytest.mark.parametrize(("actuator", "factor", "parameter", "takes"), CASES)
def test_every_unit_passes_or_is_refused(
    actuator: str, factor: float, parameter: dict[str, str], takes: list[str], tmp_path: Path
) -> None:
    config = configured(tmp_path, actuator, factor, **parameter)
    for dimension in DIMENSIONS:
        word = unit_words(dimension)[-1]
        if dimension in (*takes, "dimensionless"):
            assert check(config, word) == []
            continue
        with pytest.raises(ConfigError) as refused:
            check(config, word)
        line = str(refused.value)
        assert "\n" not in line
        assert all(part in line for part in ("commands[0].unit", "'driven'", repr(word), takes[0], "; use one of"))


@pytest.mark.parametrize("actuator", sorted({case[0] for case in CASES}))
def test_nothing_is_commanded_in_kg(actuator: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"'kg' \(mass\)"):
        check(configured(tmp_path, actuator, factor=9.81), "kg")


@pytest.mark.parametrize(
    ("actuator", "column", "unit", "doubted"),
    [
        (MOTOR, "joint_position", "N m", True),
        (MOTOR, "theta", "1", True),
        (MOTOR, "angle", "N m", True),  # which the configuration measures
        (EMF.format(gain=0.05), "hinge_velocity", "V", True),
        ('<position name="driven" joint="hinge"/>', "hinge_torque", "rad", True),
        ('<position name="driven" joint="hinge"/>', "hinge_position", "rad", False),
        ('<velocity name="driven" joint="hinge"/>', "speed", "rad/s", False),
        *[(MOTOR, column, "N m", False) for column in ("torque", "u", "x", "ctrl[0]", "motor", "goal", "tau_hinge")],
        (EMF.format(gain=0.05), "volts", "V", False),
        ('<motor name="driven" joint="hinge" ctrllimited="true" ctrlrange="-80 80"/>', "duty", "%", True),
        ('<motor name="driven" joint="hinge" ctrllimited="true" ctrlrange="-1 1"/>', "duty", "%", False),
        (MOTOR, "duty", "%", False),
    ],
)
def test_a_column_of_another_name_is_doubted(
    actuator: str, column: str, unit: str, doubted: bool, tmp_path: Path
) -> None:
    assert check(configured(tmp_path, actuator, column=column), unit) == [Code.COMMAND_DOUBTED] * doubted
