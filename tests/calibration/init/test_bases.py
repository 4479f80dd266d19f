"""Bases that only slides and hinges place: no bearing and no gears; what carries them may weigh elsewhere than said."""

from __future__ import annotations

import mujoco
import pytest

from sipe_bayes.calibration.column_names import read_name
from sipe_bayes.calibration.init.cases import rough_parameters
from sipe_bayes.calibration.init.draft import Reading
from sipe_bayes.calibration.init.matching import Match
from sipe_bayes.calibration.machine import Machine, base_joints, bases

WHEEL = '<body name="wheel"><joint name="roll"/><geom size=".05" mass=".1"/></body>'
ARM = '<body name="arm"><joint name="swing" damping=".1"/><geom size=".05" mass=".1"/></body>'
SLIDES = '<joint name="x" type="slide" axis="1 0 0" {0}/><joint name="y" type="slide" axis="0 1 0"/>'
HULL = '<geom name="hull" size=".1" mass="2"/>'


def compiled(bodies: str, driven: str = "roll") -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody>{bodies}</worldbody><actuator><motor name="motor" joint="{driven}"/></actuator></mujoco>'
    )


def flat(more: str = "", wheel: str = WHEEL) -> str:
    return f'<body name="base">{SLIDES.format(more)}<joint name="yaw"/>{HULL}{wheel}</body>'


@pytest.mark.parametrize(
    ("bodies", "driven", "expected"),
    [
        (flat(), "roll", {"x", "y", "yaw"}),
        (  # a body for each joint
            f'<body><joint name="x" type="slide" axis="1 0 0"/><geom size=".01" mass="1e-4"/><body><joint name="y" '
            f'type="slide" axis="0 1 0"/><geom size=".01" mass="1e-4"/><body name="base"><joint name="yaw"/>{HULL}'
            f"{WHEEL}</body></body></body>",
            "roll",
            {"x", "y", "yaw"},
        ),
        (flat(wheel=ARM + WHEEL), "roll", {"x", "y", "yaw"}),  # not what swings below it
        (flat('damping=".1"'), "roll", set()),  # a table on rails
        (flat(), "x", set()),
        (f'<body name="cart"><joint name="x" type="slide" axis="1 0 0"/>{HULL}{WHEEL}</body>', "roll", set()),
        (f'<body name="block">{SLIDES.format("")}{HULL}</body>{WHEEL}', "roll", set()),  # what is pushed
        (f'<body name="base"><freejoint/>{HULL}{WHEEL}</body>', "roll", set()),
    ],
)
def test_joints_that_place_a_base(bodies: str, driven: str, expected: set[str]) -> None:
    model = compiled(bodies, driven)
    assert {model.joint(j).name for j in base_joints(model)} == expected
    free = any(int(kind) == int(mujoco.mjtJoint.mjJNT_FREE) for kind in model.jnt_type)
    assert bases(model) == ({model.body("base").id} if expected or free else set())


def test_what_is_asked_of_a_base() -> None:
    """No friction and no rotor of its joints, but its inertia and centre of mass, with bounds that hold the model's."""
    model = compiled(flat(wheel=ARM + WHEEL))
    names = {f"joint:{joint}.position": f"{joint}_pos" for joint in ("x", "y", "yaw", "roll", "swing")}
    names["actuator:motor"] = "motor_torque"
    readings = [Reading(Match((n,), target, read_name(n, set()), 1.0), "") for target, n in names.items()]
    asked = {u.name: u for u in rough_parameters(model, Machine.of(model), readings)}
    assert {"wheel_mass", "roll_damping", "roll_armature", "swing_frictionloss", "base_mass"} <= {*asked}
    assert not [name for name in asked if name.startswith(("x_", "y_", "yaw_"))]
    assert {f"base_{what}_{axis}" for what in ("com", "inertia") for axis in "xyz"} <= {*asked}
    assert all(asked[f"base_com_{axis}"].low < 0 < asked[f"base_com_{axis}"].high for axis in "xyz")
