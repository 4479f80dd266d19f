"""Inertia written in a body's own frame: components compose, mass comes first, what no rigid body has is seen."""

from __future__ import annotations

import copy
from typing import Any

import mujoco
import numpy as np
import pytest

from sipe_bayes.envs.inertia import body_frame_inertia, check_inertia
from sipe_bayes.envs.targets import bind

XML = """<mujoco><worldbody>
  <body name="tilted"><joint name="slide" type="slide"/>
    <inertial pos=".01 .02 .03" mass=".5" fullinertia=".01 .012 .008 .001 -.002 .0015"/></body>
  <body name="aligned" pos="1 0 1"><joint name="hinge"/>
    <inertial pos="0 0 -.2" mass=".3" diaginertia=".004 .003 .002"/></body></worldbody></mujoco>"""


def written(model: Any, *writes: tuple[str, float]) -> Any:
    """A copy of the model with targets written in place and its constants refreshed."""
    other = copy.copy(model)
    for spec, value in writes:
        bind(model, spec).write(other, value)
    mujoco.mj_setConst(other, mujoco.MjData(other))
    return other


def test_mass_before_inertia_in_any_earlier_state() -> None:
    """Mass brings the model's own inertia and axes back, so an earlier tilt leaves nothing behind."""
    model = mujoco.MjModel.from_xml_string(XML)
    writes = [("body:aligned.mass", 0.4), ("body:aligned.inertia_xy", 0.0002)]
    once = written(model, *writes)
    again = written(model, ("body:aligned.inertia_xy", 0.0009), ("body:aligned.com_z", -0.2), *writes)
    for field in ("body_mass", "body_inertia", "body_iquat", "body_ipos", "body_invweight0", "dof_M0"):
        np.testing.assert_allclose(getattr(again, field), getattr(once, field), rtol=1e-10, atol=1e-10, err_msg=field)
    body = model.body("aligned").id
    expected = np.diag([0.004, 0.003, 0.002]) * 4 / 3
    expected[0, 1] = expected[1, 0] = 0.0002
    np.testing.assert_allclose(body_frame_inertia(once, body), expected, atol=1e-16)


def test_inertia_components_compose_in_the_body_frame() -> None:
    model = mujoco.MjModel.from_xml_string(XML)
    full = np.array([[0.011, 0.0005, 0.001], [0.0005, 0.013, -0.0007], [0.001, -0.0007, 0.009]])
    names = {(i, j): f"body:tilted.inertia_{'xyz'[i]}{'xyz'[j]}" for i in range(3) for j in range(i, 3)}
    orders = [list(names), list(names)[::-1]]
    for order in orders:
        other = written(model, *[(names[slot], float(full[slot])) for slot in order])
        np.testing.assert_allclose(body_frame_inertia(other, model.body("tilted").id), full, atol=1e-15)
        for slot in order:
            assert bind(other, names[slot]).value == pytest.approx(full[slot], abs=1e-15)


@pytest.mark.parametrize(
    ("moments", "physical"),
    [([1, 1, 1], True), ([1, 2, 3], True), ([3, 1, 2], True), ([1, 1, 2.1], False), ([-0.1, 1, 1], False)],
)
def test_physical_inertia(moments: list[float], physical: bool) -> None:
    model = mujoco.MjModel.from_xml_string(XML)
    model.body_inertia[1] = moments
    assert check_inertia(model, [1]) is physical
