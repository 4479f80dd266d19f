"""Tendons: what their numbers do beside the table of all targets."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.envs.export import write_identified
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.envs.target import TargetError
from sipe_bayes.envs.targets import bind

PAIR = """<mujoco><compiler angle="radian"/><worldbody><site name="anchor" pos="0 0 1"/>
  <body name="one"><joint name="one" axis="0 1 0" springref=".3"/><geom size=".05"/><site name="rim" pos=".1 0 .2"/>
  </body><body name="two" pos="1 0 0"><joint name="two" axis="0 1 0" springref="-.2"/><geom size=".05"/></body>
  </worldbody><tendon><spatial name="cable" stiffness="2"><site site="anchor"/><site site="rim"/></spatial>
  <fixed name="belt" stiffness="2"{rest}><joint joint="one" coef="{coef}"/><joint joint="two" coef="-1"/></fixed>
  </tendon></mujoco>"""


def model_of(coef: float = 1.0, rest: str = "") -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(PAIR.format(coef=coef, rest=rest))


@pytest.mark.parametrize("rest", ["", ' springlength="0.1"'])
def test_a_tendon_rests_with_the_springs_of_its_joints_unless_it_says_where(rest: str) -> None:
    model, reference = model_of(rest=rest), model_of(1.7, rest)
    for value in (0.4, 1.7):
        bind(model_of(rest=rest), "tendon:belt/one.coef").write(model, value)
    np.testing.assert_allclose(model.tendon_lengthspring, reference.tendon_lengthspring, atol=1e-12)
    np.testing.assert_allclose(model.wrap_prm, reference.wrap_prm)


def test_a_spring_of_a_joint_leaves_tendons_where_they_rest(tmp_path: Path) -> None:
    """MuJoCo would let them rest anew on compiling what is written, which then were not what was calibrated."""
    parameter = Parameter("p", -1.0, 1.0, targets=("joint:one.springref",))
    environment = MjcfEnvironment.build(PAIR.format(coef=1, rest=""), [parameter], [], ["joint:one.position"])
    assert write_identified(environment, np.array([0.7]), tmp_path / "identified.xml") == []
    exported = mujoco.MjModel.from_xml_path(str(tmp_path / "identified.xml"))
    np.testing.assert_allclose(exported.tendon_lengthspring, model_of().tendon_lengthspring, rtol=1e-5)
    assert bind(exported, "joint:one.springref").value == pytest.approx(0.7)


def test_the_greatest_length_at_rest_is_not_below_the_least() -> None:
    model, plain = model_of(rest=' springlength="0.1 0.4"'), model_of(rest=' springlength="0.1 0.4"')
    low, high = (bind(plain, f"tendon:belt.springlength_{end}") for end in ("low", "high"))
    assert low.order < high.order
    for first, then, expected in ((0.6, 0.2, [0.6, 0.6]), (0.1, 0.2, [0.1, 0.2]), (0.6, 0.9, [0.6, 0.9])):
        low.write(model, first)
        high.write(model, then)
        assert model.tendon_lengthspring[1].tolist() == expected
    low.write(model, 0.2)  # by itself: up to the model's own
    assert model.tendon_lengthspring[1].tolist() == [0.2, 0.4]


def test_inertia_of_a_tendon_couples_bodies_that_are_simple_without_it() -> None:
    parameter = Parameter("p", 0.0, 1.0, targets=("tendon:belt.armature",))
    environment = MjcfEnvironment.build(PAIR.format(coef=1, rest=""), [parameter], [], ["joint:one.position"])
    model = environment.compile()
    assert model_of().body_simple.any()
    environment.write(model, np.array([0.5]))
    mujoco.mj_setConst(model, mujoco.MjData(model))
    reference = mujoco.MjModel.from_xml_string(PAIR.format(coef=1, rest=' armature="0.5"'))
    accelerations = []
    for one in (model, reference):
        data = mujoco.MjData(one)
        data.qfrc_applied[:] = 1.0, 0.0
        mujoco.mj_forward(one, data)
        accelerations.append(data.qacc.copy())
    assert abs(accelerations[1][1]) > 1.0
    np.testing.assert_allclose(*accelerations, rtol=1e-10)


def test_two_targets_of_one_rest_are_refused() -> None:
    parameters = [
        Parameter(name, 0.0, 0.9, targets=(f"tendon:belt.{name}",)) for name in ("springlength", "springlength_high")
    ]
    with pytest.raises(TargetError, match="writes what parameter 'springlength' writes too; keep one"):
        MjcfEnvironment.build(PAIR.format(coef=1, rest=""), parameters, [], ["joint:one.position"])


SENSORS = """<sensor><tendonpos name="a" tendon="cable"/><tendonvel name="b" tendon="cable"/>
  <tendonactuatorfrc name="c" tendon="cable"/><tendonpos name="d" tendon="belt"/></sensor></mujoco>"""


def test_sensors_of_tendons_have_their_units() -> None:
    xml = PAIR.format(coef=1, rest="").replace("</mujoco>", SENSORS)
    channels = [f"sensor:{name}" for name in "abcd"]
    parameters = [Parameter("p", 0.0, 5.0, targets=("tendon:cable.stiffness",))]
    assert MjcfEnvironment.build(xml, parameters, [], channels).channel_units == ("m", "m/s", "N", "rad")
    drum = xml.replace('coef="1"', 'coef="0.02"')
    assert MjcfEnvironment.build(drum, parameters, [], channels).channel_units == ("m", "m/s", "N", "")
