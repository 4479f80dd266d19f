"""Units of an actuator's numbers, where the model tells what it moves and what its command is compared with."""

from __future__ import annotations

import mujoco
import pytest

from sipe_bayes.envs.targets import bind

XML = """<mujoco><worldbody><body><joint name="hinge"/><geom size=".1"/>
  <body pos="0 0 1"><joint name="slide" type="slide"/><geom size=".1"/></body></body></worldbody>
  <tendon><fixed name="tendon"><joint joint="hinge" coef="1"/></fixed></tendon><actuator>
  <motor name="motor" joint="hinge"/><velocity name="velocity" joint="hinge" kv="3"/>
  <position name="position" joint="slide" kp="30" kv="2"/><intvelocity name="steps" joint="hinge" kp="5"
  actrange="-3 3"/><general name="general" joint="slide" gainprm="4" biastype="affine" biasprm=".1 -3 -.2"/>
  <motor name="pulled" tendon="tendon"/></actuator></mujoco>"""


@pytest.mark.parametrize(
    ("target", "unit"),
    [
        ("velocity.gain", "N m s/rad"),
        ("velocity.kv", "N m s/rad"),
        ("velocity.offset", "rad/s"),
        ("velocity.force_limit", "N m"),
        ("position.kp", "N/m"),
        ("position.gain", "N/m"),
        ("position.kv", "N s/m"),
        ("position.offset", "m"),
        ("steps.gain", "N m/rad"),
        ("steps.command_limit", "command"),
        ("general.gain", "N/command"),
        ("motor.gain", "N m/command"),
        ("motor.offset", "command"),
        ("pulled.gain", "force/command"),
        ("pulled.bias_velocity", "force/velocity"),
    ],
)
def test_a_unit_is_as_definite_as_the_model(target: str, unit: str) -> None:
    assert bind(mujoco.MjModel.from_xml_string(XML), f"actuator:{target}").unit == unit
