"""What of tendons is asked for: friction and inertia of those that are pulled, of others what the model has."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from sipe_bayes.calibration.column_names import read_name
from sipe_bayes.calibration.init.draft import Reading
from sipe_bayes.calibration.init.matching import Match
from sipe_bayes.calibration.init.parameters import candidates
from sipe_bayes.calibration.machine import Machine, Sizes

HAND = """<mujoco><compiler angle="radian"/><worldbody><site name="anchor" pos="-.03 0 -.01"/>
  <body><joint name="mcp" axis="0 1 0" range="0 2"/><geom type="capsule" fromto="0 0 0 .05 0 0" size=".01" mass=".05"/>
  <site name="a" pos=".02 0 -.02"/><body pos=".05 0 0"><joint name="pip" axis="0 1 0"/>
  <geom type="capsule" fromto="0 0 0 .05 0 0" size=".01" mass=".03"/><site name="b" pos=".02 0 -.02"/></body></body>
  </worldbody><tendon>
  <spatial name="flexor"{}><site site="anchor"/><site site="a"/><site site="b"/></spatial>
  <fixed name="coupler" stiffness="2"><joint joint="mcp" coef="1"/><joint joint="pip" coef="-1"/></fixed>
  <fixed name="idle"><joint joint="mcp" coef=".01"/><joint joint="pip" coef=".01"/></fixed>
  <fixed name="drum"><joint joint="pip" coef=".01"/></fixed>
  <fixed name="still" damping="1"><joint joint="pip" coef="0"/></fixed></tendon>
  <actuator><motor name="winch" tendon="flexor"/><motor name="other" tendon="drum"/></actuator></mujoco>"""


def asked(*driven: str, flexor: str = "") -> list[str]:
    model = mujoco.MjModel.from_xml_string(HAND.format(flexor))
    machine = Machine.of(model)
    targets = ("joint:mcp.position", *(f"actuator:{name}" for name in driven))
    readings = [Reading(Match((target,), target, read_name("u", set()), 1.0), "N") for target in targets]
    proposed = candidates(model, machine, readings, Sizes.of(model, machine, None, None))
    tendons = [one for one in proposed if one.targets[0].startswith("tendon:")]
    assert all(one.high > 0 and one.relative == ("stiffness" in one.name) for one in tendons)
    return [one.name for one in tendons]


PULLED = ["flexor_damping", "flexor_frictionloss", "flexor_armature"]


def test_what_is_asked_for_of_tendons() -> None:
    assert asked() == ["coupler_stiffness"]
    assert asked("winch") == [*PULLED, "coupler_stiffness"]
    assert asked("other") == ["coupler_stiffness"]
    assert asked("winch", flexor=' stiffness="3"') == [*PULLED, "flexor_stiffness", "coupler_stiffness"]
    assert asked(flexor=' damping="3"') == ["flexor_damping", "coupler_stiffness"]


def test_sizes_along_a_tendon_are_those_of_its_length() -> None:
    """Of a drum the joint's over its radius, of a cable those of what pulls it and of its own spring."""
    model = mujoco.MjModel.from_xml_string(HAND.format(' stiffness="30" springlength=".05"'))
    states = np.zeros((1, mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)))
    states[0, 1 + model.nq + 1] = 0.8
    sizes = Sizes.of(model, Machine.of(model), states, np.array([[3.0, 0.0]]))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert "tendon:still" not in sizes.force
    assert sizes.speed["tendon:drum"] == pytest.approx(0.008)
    full = np.zeros((2, 2))
    mujoco.mj_fullM(model, data, full)
    assert sizes.inertia["tendon:drum"] == pytest.approx(1 / (1e-4 * np.linalg.inv(full)[1, 1]))
    assert sizes.force["tendon:flexor"] == pytest.approx(3.0 + 30 * abs(data.ten_length[0] - 0.05))
