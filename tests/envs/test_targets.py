"""Every target written in place against the model compiled from the edited MjSpec, in all fields."""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.envs import targets
from sipe_bayes.envs.export import write_identified
from sipe_bayes.envs.inertia import body_frame_inertia
from sipe_bayes.envs.internal.elastic import NUMBERS, Elastic, Link
from sipe_bayes.envs.laws.bound import declare
from sipe_bayes.envs.laws.registry import LAW_OF, LAWS
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.envs.target import TargetError
from sipe_bayes.envs.targets import bind
from tests.problems import motors, tendons

XML = f"""<mujoco><option timestep="0.002" density="1.2" viscosity="1e-5"/><worldbody>
  <geom name="floor" type="plane" size="3 3 .1"/>
  <body name="rod" pos="0 0 1">
    <joint name="hinge" axis="0 1 0" damping="0.1" frictionloss="0.01" springref="10"/>
    <geom name="rod" type="capsule" fromto="0 0 0 0 0 -.5" size=".02" mass="1"/><site name="s" pos=".1 0 0"/>
    <body name="tilted" pos="0 0 -.5"><joint name="slide" type="slide" axis="0 0 1" stiffness="3"/>
      <inertial pos=".01 .02 .03" mass=".5" fullinertia=".01 .012 .008 .001 -.002 .0015"/>
      <geom name="ball" size=".05" mass=".1"/></body></body>
  <body name="aligned" pos="1 0 1"><joint name="hinge2" axis="0 1 0" armature=".02"/>
    <inertial pos="0 0 -.2" mass=".3" diaginertia=".004 .003 .002"/><site name="fixed"/></body>
  <body name="box" pos="2 0 1"><freejoint name="free"/>
    <geom name="box" type="box" size=".1 .2 .3" mass="2"/></body>
  <body name="top" pos="3 0 1"><joint name="spin" type="ball"/><geom size=".1" mass="1" pos="0 0 .3"/></body>
  </worldbody>{tendons.XML}<contact><pair name="ends" geom1="box" geom2="ball" solref=".03 .9"/></contact><actuator>
  <motor name="motor" joint="hinge" gear="2"/>
  <position name="position" joint="slide" kp="30" kv="2"/>
  <general name="general" joint="hinge2" gainprm="4" biastype="affine" biasprm=".1 -3 -.2"
    dyntype="filter" dynprm=".1"/>
  <velocity name="velocity" joint="hinge" kv="3"/>
  <motor name="late" joint="hinge2" nsample="10" delay=".004"/>
  <motor name="weak" joint="hinge2" forcerange="-3 3"/>
  <position name="wary" joint="hinge2" kp="1" ctrlrange="-.7 .7"/>
  <general name="slow" joint="hinge2" dyntype="filterexact" dynprm=".02" actearly="true"/>
  {motors.MOTORS}</actuator></mujoco>"""

Edit = Callable[[Any, float], Any]  # of an element, or what to read in the place of the tendons' text


def vector(attribute: str, slot: int) -> Edit:
    """Set one number of a spec element's vector."""

    def edit(element: Any, value: float) -> None:
        numbers = np.array(getattr(element, attribute))
        numbers[slot] = value
        setattr(element, attribute, numbers)

    return edit


def scalar(attribute: str) -> Edit:
    return lambda element, value: setattr(element, attribute, value)


def actuator(slot: int, sign: float = 1.0) -> Edit:
    def edit(element: Any, value: float) -> None:
        element.biastype = mujoco.mjtBias.mjBIAS_AFFINE
        vector("biasprm", slot)(element, sign * value)

    return edit


def springref(element: Any, value: float) -> None:
    element.springref = np.degrees(value)  # the spec's angles are in degrees, the targets' in rad


def kp(element: Any, value: float) -> None:
    vector("gainprm", 0)(element, value)
    actuator(1, -1)(element, value)


def offset(element: Any, value: float) -> None:
    actuator(0)(element, element.biasprm[0] + element.gainprm[0] * value)


def limit(element: Any, value: float) -> None:
    element.forcelimited, element.forcerange = True, [-value, value]


def command_limit(element: Any, value: float) -> None:
    element.ctrllimited, element.ctrlrange = True, [-value, value]


def mass(element: Any, value: float) -> None:
    element.inertia = np.array(element.inertia) * value / element.mass
    element.mass = value


def inertia(row: int, column: int) -> Edit:
    def edit(element: Any, value: float) -> None:
        rotation = np.empty(9)
        mujoco.mju_quat2Mat(rotation, element.iquat)
        rotation = rotation.reshape(3, 3)
        full = rotation @ np.diag(element.inertia) @ rotation.T
        full[row, column] = full[column, row] = value
        if np.count_nonzero(full - np.diag(np.diag(full))):
            element.fullinertia = [*np.diag(full), full[0, 1], full[0, 2], full[1, 2]]
            element.iquat, element.inertia = [1, 0, 0, 0], np.zeros(3)
        else:
            element.inertia = np.diag(full)

    return edit


def elastic(slot: int) -> Edit:
    """One number of the joint that gives way, and what stiffness, damping, inertia and range then are."""

    def edit(spec: Any, value: float) -> None:
        numeric, joint = next(n for n in spec.numerics if n.name == "joint:hinge2.link.elastic"), spec.joint(TWIST)
        vector("data", slot)(numeric, value)
        compliance, loss, inertia, play = np.array(numeric.data)[:4]
        joint.stiffness, joint.damping = [1 / compliance, 0, 0], [loss / compliance, 0, 0]
        joint.armature, joint.limited, joint.range = inertia, play > 0, np.degrees([-play / 2, play / 2])

    return edit


def give_way(spec: Any) -> None:
    """A link behind hinge2 that gives way by 0.1 rad/(N m)."""
    Link("hinge2", Elastic(stiffest=50.0, idle=0.02, start=(0.1, 1.0), inertia=0.03, loss=0.01))(spec)
    elastic(0)(spec, 0.1)


TWIST = "hinge2.link"
HINGE = {"force": "N m", "velocity": "rad/s", "position": "rad"}  # a unit in words as it is at a hinge
HINGE |= {"force/velocity": "N m/(rad/s)", "position/force": "rad/(N m)", "1/force": "1/(N m)"}
LAW_AT = {"joint": "joint:hinge", "actuator": "actuator:motor"}

# (target, value, unit, how the spec is edited)
CASES: list[tuple[str, float, str, Edit]] = [
    ("body:rod.mass", 1.7, "kg", mass),
    ("body:tilted.mass", 0.3, "kg", mass),
    ("body:box.mass", 1.1, "kg", mass),
    ("body:rod.com_x", 0.02, "m", vector("ipos", 0)),
    ("body:tilted.com_y", -0.02, "m", vector("ipos", 1)),
    ("body:aligned.com_z", -0.15, "m", vector("ipos", 2)),
    ("body:rod.inertia_xx", 0.0233, "kg m^2", inertia(0, 0)),
    ("body:tilted.inertia_xx", 0.011, "kg m^2", inertia(0, 0)),
    ("body:tilted.inertia_xy", -0.001, "kg m^2", inertia(0, 1)),
    ("body:tilted.inertia_xz", 0.001, "kg m^2", inertia(0, 2)),
    ("body:aligned.inertia_yy", 0.0035, "kg m^2", inertia(1, 1)),
    ("body:aligned.inertia_yz", 0.0004, "kg m^2", inertia(1, 2)),
    ("body:aligned.inertia_zz", 0.0025, "kg m^2", inertia(2, 2)),
    ("joint:hinge.damping", 0.3, "N m s/rad", vector("damping", 0)),
    ("joint:slide.damping", 0.3, "N s/m", vector("damping", 0)),
    ("joint:spin.damping", 0.3, "N m s/rad", vector("damping", 0)),
    ("joint:free.damping", 0.3, "N s/m", vector("damping", 0)),
    ("joint:hinge.frictionloss", 0.2, "N m", scalar("frictionloss")),
    ("joint:slide.frictionloss", 0.2, "N", scalar("frictionloss")),
    ("joint:hinge.armature", 0.05, "kg m^2", scalar("armature")),
    ("joint:slide.armature", 0.05, "kg", scalar("armature")),
    ("joint:spin.armature", 0.05, "kg m^2", scalar("armature")),
    ("joint:hinge.stiffness", 2.0, "N m/rad", vector("stiffness", 0)),
    ("joint:slide.stiffness", 2.0, "N/m", vector("stiffness", 0)),
    ("joint:hinge.springref", 0.3, "rad", springref),
    ("joint:slide.springref", 0.03, "m", scalar("springref")),
    ("joint:hinge.damping_quadratic", 0.2, "N m/(rad/s)^2", vector("damping", 1)),
    ("joint:slide.damping_cubic", 0.2, "N/(m/s)^3", vector("damping", 2)),
    ("joint:slide.stiffness_quadratic", -4.0, "N/(m)^2", vector("stiffness", 1)),
    ("joint:hinge.stiffness_cubic", 4.0, "N m/(rad)^3", vector("stiffness", 2)),
    *tendons.CASES,
    ("actuator:motor.gear", 3.0, "1", vector("gear", 0)),
    ("actuator:position.gear", 1.5, "1", vector("gear", 0)),
    ("actuator:motor.gain", 2.5, "N m/command", vector("gainprm", 0)),
    ("actuator:position.kp", 20.0, "N/m", kp),
    ("actuator:position.kv", 3.0, "N s/m", actuator(2, -1)),
    ("actuator:motor.kv", 0.5, "N m s/rad", actuator(2, -1)),
    ("actuator:motor.bias_force", 0.4, "N m", actuator(0)),
    ("actuator:general.bias_position", -2.0, "N m/rad", actuator(1)),
    ("actuator:motor.bias_velocity", -0.1, "N m s/rad", actuator(2)),
    ("actuator:motor.offset", 0.2, "command", offset),
    ("actuator:late.delay", 0.01, "s", scalar("delay")),
    ("actuator:weak.force_limit", 2.0, "N m", limit),
    ("actuator:wary.command_limit", 0.4, "rad", command_limit),
    ("actuator:slow.lag", 0.05, "s", vector("dynprm", 0)),
    ("actuator:pid.kp", 4.0, "N m/rad", actuator(1, -1)),
    *((target, value, unit, vector(field, slot)) for target, value, unit, field, slot in motors.CASES),
    ("geom:box.friction", 0.3, "1", vector("friction", 0)),
    ("geom:box.friction_torsional", 0.01, "m", vector("friction", 1)),
    ("geom:floor.friction_rolling", 0.002, "m", vector("friction", 2)),
    ("geom:box.solref_timeconst", 0.05, "s", vector("solref", 0)),
    ("geom:box.solref_dampratio", 0.3, "1", vector("solref", 1)),
    ("geom:floor.solimp_dmin", 0.8, "1", vector("solimp", 0)),
    ("geom:floor.solimp_dmax", 0.99, "1", vector("solimp", 1)),
    ("geom:ball.solimp_width", 0.003, "m", vector("solimp", 2)),
    ("geom:ball.solimp_midpoint", 0.4, "1", vector("solimp", 3)),
    ("geom:ball.solimp_power", 3.0, "1", vector("solimp", 4)),
    ("geom:ball.margin", 0.01, "m", scalar("margin")),
    ("pair:ends.friction", 0.4, "1", tendons.number("friction", 0, 1)),
    ("pair:ends.friction_torsional", 0.01, "m", vector("friction", 2)),
    ("pair:ball/box.friction_rolling", 0.003, "m", tendons.number("friction", 3, 4)),
    ("pair:box/ball.solref_timeconst", 0.05, "s", vector("solref", 0)),
    ("pair:ends.solref_dampratio", 0.3, "1", vector("solref", 1)),
    ("pair:ends.solimp_dmin", 0.8, "1", vector("solimp", 0)),
    ("pair:ends.solimp_dmax", 0.99, "1", vector("solimp", 1)),
    ("pair:ends.solimp_width", 0.003, "m", vector("solimp", 2)),
    ("pair:ends.solimp_midpoint", 0.4, "1", vector("solimp", 3)),
    ("pair:ends.solimp_power", 3.0, "1", vector("solimp", 4)),
    ("pair:ends.margin", 0.01, "m", scalar("margin")),
    ("option.impratio", 3.0, "1", scalar("impratio")),
    ("option.gravity_x", 0.5, "m/s^2", vector("gravity", 0)),
    ("option.gravity_z", -9.5, "m/s^2", vector("gravity", 2)),
    ("option.wind_y", 0.5, "m/s", vector("wind", 1)),
    ("option.density", 2.0, "kg/m^3", scalar("density")),
    ("option.viscosity", 1e-3, "Pa s", scalar("viscosity")),
    *(
        (f"{LAW_AT[kind]}.{attribute}", 0.3, HINGE.get(u := law.numbers[slot].unit, u), vector("data", slot))
        for (kind, attribute), (law, slot) in LAW_OF.items()
    ),
    *((f"joint:{TWIST}.{n.attribute}", 0.2, HINGE.get(n.unit, n.unit), elastic(k)) for k, n in enumerate(NUMBERS)),
]


def frozen_spec(xml: str = XML) -> Any:
    """The spec with its bodies' inertia written out, so that it may be edited, and every law."""
    spec = mujoco.MjSpec.from_string(xml)
    give_way(spec)
    for law in LAWS.values():
        declare(spec, law.kind, LAW_AT[law.kind].partition(":")[2], law)
    model = spec.compile()
    for body in spec.bodies[1:]:
        body.explicitinertial, body.simple = True, False
        i = model.body(body.name).id
        body.mass, body.inertia = float(model.body_mass[i]), model.body_inertia[i]
        body.ipos, body.iquat, body.fullinertia = model.body_ipos[i], model.body_iquat[i], np.full(6, np.nan)
    return spec


def element(spec: Any, target: str) -> Any:
    kind, name, attribute = targets.split(target)
    if (kind, attribute) in LAW_OF:
        label = f"{kind}:{name}.{LAW_OF[kind, attribute][0].name}"
        return next(numeric for numeric in spec.numerics if numeric.name == label)
    if kind == "pair":
        return spec.pairs[0]
    if kind == "tendon":
        return spec.tendon(name if attribute != "coef" else name.rpartition("/")[0])
    if name == TWIST:
        return spec
    return spec.option if kind == "option" else getattr(spec, kind)(name)


def fields(model: Any) -> dict[str, Any]:
    """All numbers of a model but its statistics and bounding volumes."""
    every = {f: getattr(model, f) for f in dir(model) if not f.startswith("_")}
    arrays = {f: np.asarray(v) for f, v in every.items() if isinstance(v, np.ndarray | int) and "bvh" not in f}
    options = {f"opt.{f}": getattr(model.opt, f) for f in dir(model.opt) if not f.startswith("_")}
    return {**arrays, **{f: np.asarray(v) for f, v in options.items() if np.ndim(v) or np.isscalar(v)}}


def assert_same(model: Any, reference: Any, message: str = "") -> None:
    ours, theirs = fields(model), fields(reference)
    assert ours.keys() == theirs.keys()
    assert len(ours) > 200
    for name, value in ours.items():
        np.testing.assert_allclose(value, theirs[name], rtol=1e-10, atol=1e-10, err_msg=f"{message} {name}")


def written(model: Any, *writes: tuple[str, float]) -> Any:
    """A copy of the model with targets written in place and its constants refreshed where needed."""
    other = copy.copy(model)
    for spec, value in writes:
        bind(model, spec).write(other, value)
    if any(bind(model, spec).constants for spec, _ in writes):
        mujoco.mj_setConst(other, mujoco.MjData(other))
    return other


@pytest.mark.parametrize(("target", "value", "unit", "edit"), CASES, ids=[c[0] for c in CASES])
def test_writing_in_place_is_compiling_the_edited_model(target: str, value: float, unit: str, edit: Edit) -> None:
    model, spec = frozen_spec().compile(), frozen_spec()
    text = edit(element(spec, target), value)
    spec = frozen_spec(XML.replace(tendons.XML, text)) if text else spec
    assert_same(written(model, (target, value)), spec.compile(), target)
    bound = bind(model, target)
    assert bound.unit == unit
    assert bound.spec == target
    assert bound.value != value
    assert bind(written(model, (target, value)), target).value == pytest.approx(
        0.0 if target.endswith("offset") else value, abs=1e-15
    )


def test_the_table_covers_every_attribute() -> None:
    covered = {(targets.split(c[0])[0], targets.split(c[0])[2]) for c in CASES}
    every = {(kind, attribute) for kind, legal in targets.ATTRIBUTES.items() for attribute in legal}
    alike = {  # the same lines with another index
        *(("body", f"com_{a}") for a in "xyz"),
        *(("option", f"{f}_{a}") for f in ("gravity", "wind") for a in "xyz"),
    }
    assert every - covered <= alike
    assert covered <= every


@pytest.mark.parametrize("target", [c[0] for c in CASES])
def test_writing_the_present_value_changes_nothing(target: str) -> None:
    model = frozen_spec().compile()
    other = written(model, (target, bind(model, target).value))
    if target.startswith("actuator") and not np.array_equal(other.actuator_biastype, model.actuator_biastype):
        other.actuator_biastype[:] = model.actuator_biastype  # an affine bias of zero is none
    if ".inertia_" not in target:
        assert_same(other, model, target)
    body = model.body(target[5:].split(".")[0]).id if target.startswith("body") else 0
    np.testing.assert_allclose(body_frame_inertia(other, body), body_frame_inertia(model, body), atol=1e-15)


@pytest.mark.parametrize("target", [c[0] for c in CASES])
def test_repeated_writes_do_not_drift(target: str) -> None:
    model, value = frozen_spec().compile(), dict((c[0], c[1]) for c in CASES)[target]
    once = written(model, (target, value))
    often = written(model, *[(target, value * factor) for factor in (1.1, 0.9, 1.02, 1.0) * 25])
    assert_same(often, once, target)


@pytest.mark.parametrize(("target", "value"), [c[:2] for c in CASES], ids=[c[0] for c in CASES])
def test_an_exported_model_has_the_value(target: str, value: float, tmp_path: Path) -> None:
    """The writing of the file compares every field of the model; a target that nothing copies is refused."""
    model = frozen_spec().compile()
    low, high = sorted((bind(model, target).value, value))
    environment = MjcfEnvironment.build(
        XML, [Parameter("p", low, high, targets=(target,))], [], ["joint:hinge.position"], [give_way]
    )
    assert write_identified(environment, np.array([value]), tmp_path / "identified.xml") == []
    exported = mujoco.MjModel.from_xml_path(str(tmp_path / "identified.xml"))
    assert bind(model, target).value != pytest.approx(value)
    expected = 0.0 if target.endswith("offset") else value  # an offset is relative to the model's bias
    assert bind(exported, target).value == pytest.approx(expected, rel=1e-5)


def test_offset_is_gain_times_command() -> None:
    model = frozen_spec().compile()
    torque = []
    for command, shift in ((0.5, 0.2), (0.7, 0.0)):
        data = mujoco.MjData(model)
        data.ctrl[model.actuator("motor").id] = command
        mujoco.mj_forward(written(model, ("actuator:motor.gain", 3.0), ("actuator:motor.offset", shift)), data)
        torque.append(data.actuator_force[model.actuator("motor").id])
    assert torque[0] == pytest.approx(2.1, rel=1e-14)
    assert torque[1] == pytest.approx(torque[0], rel=1e-14)


def test_a_limit_that_the_model_has_not_is_endless(tmp_path: Path) -> None:
    target, model = "actuator:motor.force_limit", frozen_spec().compile()
    assert bind(model, target).value == np.inf
    assert bind(written(model, (target, 1.5)), target).value == 1.5
    environment = MjcfEnvironment.build(XML, [Parameter("p", 1, 5, targets=(target,))], [], ["joint:hinge.position"])
    assert environment.space[0].default == 5.0
    assert write_identified(environment, np.array([1.5]), tmp_path / "identified.xml") == []
    assert bind(mujoco.MjModel.from_xml_path(str(tmp_path / "identified.xml")), target).value == 1.5


WRONG = [
    ("rod.mass", "expected KIND:NAME.ATTRIBUTE with KIND one of"),
    ("body:rod", "expected KIND:NAME.ATTRIBUTE"),
    ("site:s.stiffness", "expected KIND:NAME.ATTRIBUTE"),
    *tendons.WRONG,
    ("body:rod.masss", "a body has no attribute 'masss'; did you mean 'mass'"),
    ("option.quux", "an option has no attribute 'quux'; known: density"),
    ("body:rodd.mass", "the model has no body 'rodd'; did you mean 'rod'"),
    ("joint:zzz.damping", r"no joint 'zzz'; the model has \['hinge', 'slide'"),
    ("body:world.mass", "the body has no mass of its own to scale"),
    ("joint:free.springref", "only hinge and slide joints have this attribute"),
    ("joint:spin.springref", "only hinge and slide joints"),
    (
        "actuator:general.kp",
        "needs a position actuator, whose bias_position -3 is minus its gain 4; give gain and",
    ),
    ("actuator:motor.kp", "needs a position actuator, whose bias_position 0 is minus its gain 1"),
    ("actuator:muscle.gain", "needs an actuator with a fixed gain"),
    ("actuator:muscle.kv", "needs an actuator whose bias is none or affine"),
    ("actuator:muscle.bias_force", "needs an actuator whose bias is none or affine"),
    ("actuator:muscle.offset", "needs an actuator with a fixed gain"),
]


@pytest.mark.parametrize(("target", "words"), WRONG)
def test_wrong_targets_are_named(target: str, words: str) -> None:
    xml = XML.replace("</actuator>", '<muscle name="muscle" joint="hinge" lengthrange="0 1"/></actuator>')
    with pytest.raises(TargetError, match=words) as caught:
        bind(mujoco.MjModel.from_xml_string(xml), target)
    assert repr(target) in str(caught.value)
