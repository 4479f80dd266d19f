"""What a parameter may change in a MuJoCo model: targets such as ``"body:rod.mass"``, read and written in place.

A target is ``KIND:NAME.ATTRIBUTE`` (``option.ATTRIBUTE`` for the model's options). ``bind`` looks it up in a compiled
model and returns a ``Target`` that knows its unit, its present value and how to write another one into any copy of that
model. Writing is always relative to the model the target was bound to, so it may be repeated in any order of values.
Mass scales the inertia with it; an inertia component is set in the body's own frame, about its centre of mass, and must
stay physical: no principal moment may exceed the sum of the other two. Several inertia components of a body compose,
each leaving the others as they stand; ``restore_inertia`` brings back the model's own before them.
"""

from __future__ import annotations

import re
from dataclasses import replace

import mujoco
import numpy as np

from sipe_bayes.core.validation import nearest_name
from sipe_bayes.envs.inertia import body_frame_inertia
from sipe_bayes.envs.internal.elastic import ELASTIC, NUMBERS, motor_side, realise
from sipe_bayes.envs.kinds.contacts import GEOM_CONTACTS, PAIR_CONTACTS, pair_index
from sipe_bayes.envs.kinds.tendons import TENDONS, wrap_index
from sipe_bayes.envs.laws.base import SINGLE, Number
from sipe_bayes.envs.laws.registry import LAW_OF
from sipe_bayes.envs.target import Check, Maker, Target, TargetError, actuator_unit, entry, named

_PATTERN = re.compile(r"^(?:(body|joint|tendon|actuator|geom|pair):(.+)|(option))\.([a-z0-9_]+)$")
_AXES = ("x", "y", "z")
_DC_MOTOR, _PID = mujoco.mjtGain.mjGAIN_DCMOTOR, mujoco.mjtGain.mjGAIN_PID


def split(spec: str, parameter: str = "") -> tuple[str, str, str]:
    """(kind, name, attribute) of a target; raises TargetError, which names the parameter where it is given."""
    match = _PATTERN.match(spec)
    if not match:
        kinds = sorted(set(ATTRIBUTES) - {"option"})
        owner = f"parameter {parameter!r}: " if parameter else ""
        raise TargetError(
            f"{owner}target {spec!r}: expected KIND:NAME.ATTRIBUTE with KIND one of {kinds}, or option.ATTRIBUTE"
        )
    kind, name, option, attribute = match.groups()
    return (option or kind, name or "", attribute)


def bind(model: mujoco.MjModel, spec: str) -> Target:
    """The target ``spec`` of ``model``; raises TargetError naming what is unknown."""
    kind, name, attribute = split(spec)
    legal = ATTRIBUTES[kind]
    if attribute not in legal:
        article = "an" if kind[0] in "ao" else "a"
        hint = nearest_name(attribute, legal) or f"; known: {', '.join(sorted(legal))}"
        raise TargetError(f"target {spec!r}: {article} {kind} has no attribute {attribute!r}{hint}")
    if kind in ("option", "pair"):
        index = 0 if kind == "option" else pair_index(model, name, spec)
    elif (kind, attribute) == ("tendon", "coef"):
        index = wrap_index(model, name, spec)
    else:
        index = named(model, kind, name, f"target {spec!r}")
    target = legal[attribute](model, spec, index)
    return replace(target, unit=actuator_unit(model, index, target.unit)) if kind == "actuator" else target


def _hinge(model: mujoco.MjModel, joint: int) -> bool:
    return int(model.jnt_type[joint]) in (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_BALL))


def _dof(field: str, hinge_unit: str, slide_unit: str, constants: bool = False) -> Maker:
    def make(model: mujoco.MjModel, spec: str, joint: int) -> Target:
        start = int(model.jnt_dofadr[joint])
        sizes = {int(mujoco.mjtJoint.mjJNT_FREE): 6, int(mujoco.mjtJoint.mjJNT_BALL): 3}
        size = sizes.get(int(model.jnt_type[joint]), 1)
        unit = hinge_unit if _hinge(model, joint) else slide_unit
        value = float(getattr(model, field)[start])
        tendon = motor_side(model, split(spec)[1]) if field == "dof_armature" else -1
        if tendon >= 0:
            return entry("tendon_armature", unit, constants=True, minimum=0.0)(model, spec, tendon)

        def write(other: mujoco.MjModel, number: float) -> None:
            getattr(other, field)[start : start + size] = number

        return Target(spec, unit, value, write, constants=constants, minimum=0.0)

    return make


def _joint_stiffness(model: mujoco.MjModel, spec: str, joint: int) -> Target:
    unit = "N m/rad" if _hinge(model, joint) else "N/m"
    return entry("jnt_stiffness", unit, minimum=0.0)(model, spec, joint)


def _joint_springref(model: mujoco.MjModel, spec: str, joint: int) -> Target:
    if int(model.jnt_type[joint]) not in SINGLE:
        raise TargetError(f"target {spec!r}: only hinge and slide joints have this attribute")
    unit = "rad" if _hinge(model, joint) else "m"
    return entry("qpos_spring", unit)(model, spec, int(model.jnt_qposadr[joint]))


def _fixed_gain(model: mujoco.MjModel, spec: str, actuator: int) -> None:
    if int(model.actuator_gaintype[actuator]) != int(mujoco.mjtGain.mjGAIN_FIXED):
        raise TargetError(f"target {spec!r}: needs an actuator with a fixed gain (motor, position, velocity, general)")


def _affine_bias(model: mujoco.MjModel, spec: str, actuator: int) -> None:
    legal = (int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE))
    if int(model.actuator_biastype[actuator]) not in legal:
        raise TargetError(f"target {spec!r}: needs an actuator whose bias is none or affine")


def _actuator_bias(slot: int, unit: str) -> Maker:
    def make(model: mujoco.MjModel, spec: str, actuator: int) -> Target:
        _affine_bias(model, spec, actuator)

        def write(other: mujoco.MjModel, value: float) -> None:
            other.actuator_biastype[actuator] = mujoco.mjtBias.mjBIAS_AFFINE
            other.actuator_biasprm[actuator, slot] = value

        return Target(spec, unit, float(model.actuator_biasprm[actuator, slot]), write)

    return make


def _kind(kind: mujoco.mjtGain) -> Check:
    """The check that an actuator is a ``dcmotor`` or a ``pid``."""

    def check(model: mujoco.MjModel, spec: str, actuator: int) -> None:
        if int(model.actuator_gaintype[actuator]) != int(kind):
            raise TargetError(f"target {spec!r}: needs a {kind.name.removeprefix('mjGAIN_').lower()} actuator")

    return check


def _of_kind(motor: Maker, pid: Maker, other: Maker) -> Maker:
    """What a ``dcmotor``, a ``pid`` and any other actuator keep in places of their own."""
    makers = {int(_DC_MOTOR): motor, int(_PID): pid}
    return lambda model, spec, index: makers.get(int(model.actuator_gaintype[index]), other)(model, spec, index)


def _minus_bias(slot: int, unit: str) -> Maker:
    def make(model: mujoco.MjModel, spec: str, actuator: int) -> Target:
        def write(other: mujoco.MjModel, value: float) -> None:
            other.actuator_biasprm[actuator, slot] = -value

        return Target(spec, unit, -float(model.actuator_biasprm[actuator, slot]), write, minimum=0.0)

    return make


def _actuator_kp(model: mujoco.MjModel, spec: str, actuator: int) -> Target:
    _fixed_gain(model, spec, actuator)
    _affine_bias(model, spec, actuator)
    gain, position = float(model.actuator_gainprm[actuator, 0]), float(model.actuator_biasprm[actuator, 1])
    if gain != -position:
        raise TargetError(
            f"target {spec!r}: needs a position actuator, whose bias_position {position:g} is minus its gain "
            f"{gain:g}; give gain and bias_position instead"
        )

    def write(other: mujoco.MjModel, value: float) -> None:
        other.actuator_biastype[actuator] = mujoco.mjtBias.mjBIAS_AFFINE
        other.actuator_gainprm[actuator, 0] = value
        other.actuator_biasprm[actuator, 1] = -value

    return Target(spec, "force/position", gain, write, minimum=0.0)


def _actuator_kv(model: mujoco.MjModel, spec: str, actuator: int) -> Target:
    _affine_bias(model, spec, actuator)

    def write(other: mujoco.MjModel, value: float) -> None:
        other.actuator_biastype[actuator] = mujoco.mjtBias.mjBIAS_AFFINE
        other.actuator_biasprm[actuator, 2] = -value

    return Target(spec, "force/velocity", -float(model.actuator_biasprm[actuator, 2]), write, minimum=0.0)


def _actuator_offset(model: mujoco.MjModel, spec: str, actuator: int) -> Target:
    """A constant added to the command behind its limits and dynamics: gain * offset joins the model's bias force."""
    _fixed_gain(model, spec, actuator)
    _affine_bias(model, spec, actuator)
    base = float(model.actuator_biasprm[actuator, 0])

    def write(other: mujoco.MjModel, value: float) -> None:
        other.actuator_biastype[actuator] = mujoco.mjtBias.mjBIAS_AFFINE
        other.actuator_biasprm[actuator, 0] = base + other.actuator_gainprm[actuator, 0] * value

    return Target(spec, "command", 0.0, write, order=2, physical=False)


def _actuator_delay(model: mujoco.MjModel, spec: str, actuator: int) -> Target:
    """The command is interpolated between physics steps, below one by ``simulation.short_delays``.

    A jump of the command so turns into two, which an actuator at its limit can not tell from one: the effect rises in
    stairs, each as long as a physics step, over which a difference has the mean slope.
    """

    def write(other: mujoco.MjModel, value: float) -> None:
        other.actuator_delay[actuator] = value

    present, step = float(model.actuator_delay[actuator]), float(model.opt.timestep)
    return Target(spec, "s", present, write, minimum=0.0, physical=False, step=step)


def _body_mass(model: mujoco.MjModel, spec: str, body: int) -> Target:
    mass, inertia = float(model.body_mass[body]), model.body_inertia[body].copy()
    axes = model.body_iquat[body].copy()
    if mass <= 0:
        raise TargetError(f"target {spec!r}: the body has no mass of its own to scale; give it one in the MJCF")

    def write(other: mujoco.MjModel, value: float) -> None:
        other.body_mass[body] = value
        other.body_inertia[body], other.body_iquat[body] = inertia * (value / mass), axes

    return Target(spec, "kg", mass, write, constants=True, minimum=0.0)


def _body_inertia(row: int, column: int) -> Maker:
    def make(model: mujoco.MjModel, spec: str, body: int) -> Target:
        def write(other: mujoco.MjModel, value: float) -> None:
            matrix = body_frame_inertia(other, body)
            matrix[row, column] = matrix[column, row] = value
            moments, quaternion = np.diag(matrix).copy(), np.array([1.0, 0, 0, 0])
            if np.count_nonzero(matrix - np.diag(moments)):
                mujoco.mju_eig3(moments, np.empty(9), quaternion, np.ascontiguousarray(matrix).ravel())
            other.body_inertia[body], other.body_iquat[body] = moments, quaternion

        value = float(body_frame_inertia(model, body)[row, column])
        minimum = 0.0 if row == column else -np.inf
        return Target(spec, "kg m^2", value, write, order=2, constants=True, minimum=minimum)

    return make


def _option(field: str, slot: int | None, unit: str) -> Maker:
    def make(model: mujoco.MjModel, spec: str, index: int) -> Target:
        def write(other: mujoco.MjModel, value: float) -> None:
            if slot is None:
                setattr(other.opt, field, value)
            else:
                getattr(other.opt, field)[slot] = value

        value = getattr(model.opt, field)
        return Target(spec, unit, float(value if slot is None else value[slot]), write)

    return make


def _joint_polynomial(field: str, slot: int, power: int) -> Maker:
    """A coefficient of damping (of v |v|, v^3) or stiffness (of x^2, x^3); see MuJoCo's polynomial forces."""

    def make(model: mujoco.MjModel, spec: str, joint: int) -> Target:
        motion = ("rad" if _hinge(model, joint) else "m") + ("/s" if field == "dof_dampingpoly" else "")
        unit = f"{'N m' if _hinge(model, joint) else 'N'}/({motion})^{power}"
        index = int(model.jnt_dofadr[joint]) if field == "dof_dampingpoly" else joint
        minimum = 0.0 if field == "dof_dampingpoly" else -np.inf
        return entry(field, unit, slot, minimum=minimum)(model, spec, index)

    return make


def _limit(field: str, unit: str, at: str = "") -> Maker:
    """The largest force or command either way; without one in the model its value is endless."""

    def make(model: mujoco.MjModel, spec: str, actuator: int) -> Target:
        index = int(getattr(model, at)[actuator]) if at else actuator

        def write(other: mujoco.MjModel, value: float) -> None:
            getattr(other, f"{field}limited")[index] = True
            getattr(other, f"{field}range")[index] = -value, value

        limited = bool(getattr(model, f"{field}limited")[index])
        present = float(np.abs(getattr(model, f"{field}range")[index]).max()) if limited else np.inf
        return Target(spec, unit, present, write, minimum=0.0)

    return make


def _lag(model: mujoco.MjModel, spec: str, actuator: int) -> Target:
    kind, tau = int(model.actuator_dyntype[actuator]), float(model.actuator_dynprm[actuator, 0])
    step, dyn = float(model.opt.timestep), mujoco.mjtDyn
    inductance = kind == int(dyn.mjDYN_DCMOTOR) and tau > 0
    if not inductance and kind not in (int(dyn.mjDYN_FILTER), int(dyn.mjDYN_FILTEREXACT)):
        raise TargetError(f'target {spec!r}: needs an actuator with dyntype="filterexact", or a dcmotor\'s inductance')
    least = step if kind == int(dyn.mjDYN_FILTER) else 0.0  # by Euler's steps shorter ones overshoot
    target = entry("actuator_dynprm", "s", 0, minimum=least)(model, spec, actuator)
    return replace(target, step=2 * step, below=2 * step)  # shorter ones than a physics step act alike


def _numeric(number: Number, label: str, slot: int) -> Maker:
    """A number of a law (``envs.laws``) or of an elastic joint, which stands among the model's numerics."""
    elastic = label == ELASTIC

    def make(model: mujoco.MjModel, spec: str, index: int) -> Target:
        numeric = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, f"{spec.rpartition('.')[0]}.{label}")
        if numeric < 0:
            remedy = "an extension brings such a joint" if elastic else "build an MjcfEnvironment of it"
            raise TargetError(f"target {spec!r}: the model does not declare it; {remedy}")
        at = int(model.numeric_adr[numeric]) + slot

        def write(other: mujoco.MjModel, value: float) -> None:
            other.numeric_data[at] = value
            if elastic:
                realise(other, index, at - slot)

        value = float(model.numeric_data[at])
        unit = _of_joint(number.unit, _hinge(model, index)) if spec.startswith("joint:") else number.unit
        return Target(spec, unit, value, write, constants=elastic, minimum=number.minimum, shape=number.shape)

    return make


def _of_joint(unit: str, hinge: bool) -> str:
    """A unit in words, such as ``force/velocity``, at a hinge or a slide."""
    words = {"force": ("N m", "N"), "velocity": ("rad/s", "m/s"), "position": ("rad", "m")}
    top, slash, bottom = (words[w][not hinge] if w in words else w for w in unit.partition("/"))
    return f"{top}/({bottom})" if slash and not bottom.isalnum() else f"{top}{slash}{bottom}"


def _laws(kind: str) -> dict[str, Maker]:
    rows = ((attribute, *of) for (at, attribute), of in LAW_OF.items() if at == kind)
    return {attribute: _numeric(law.numbers[slot], law.name, slot) for attribute, law, slot in rows}


def _motor(slot: int, unit: str) -> Maker:
    return entry("actuator_gainprm", unit, slot, _kind(_DC_MOTOR), minimum=0.0)


_pid_ki = entry("actuator_gainprm", "force/(position s)", 0, _kind(_PID), minimum=0.0)


ATTRIBUTES: dict[str, dict[str, Maker]] = {  # kind -> attribute -> what binds it
    "body": {
        "mass": _body_mass,
        **{f"com_{a}": entry("body_ipos", "m", i, order=1, constants=True) for i, a in enumerate(_AXES)},
        **{f"inertia_{_AXES[i]}{_AXES[j]}": _body_inertia(i, j) for i in range(3) for j in range(i, 3)},
    },
    "joint": {
        "damping": _dof("dof_damping", "N m s/rad", "N s/m"),
        "frictionloss": _dof("dof_frictionloss", "N m", "N"),
        "armature": _dof("dof_armature", "kg m^2", "kg", constants=True),
        "stiffness": _joint_stiffness,
        "springref": _joint_springref,
        "damping_quadratic": _joint_polynomial("dof_dampingpoly", 0, 2),
        "damping_cubic": _joint_polynomial("dof_dampingpoly", 1, 3),
        "stiffness_quadratic": _joint_polynomial("jnt_stiffnesspoly", 0, 2),
        "stiffness_cubic": _joint_polynomial("jnt_stiffnesspoly", 1, 3),
        **{number.attribute: _numeric(number, ELASTIC, slot) for slot, number in enumerate(NUMBERS)},
        **_laws("joint"),
    },
    "tendon": TENDONS,
    "actuator": {
        "gear": entry("actuator_gear", "1", 0, constants=True),
        "gain": entry("actuator_gainprm", "force/command", 0, _fixed_gain),
        "kp": _of_kind(_motor(4, "N m/rad"), _minus_bias(1, "force/position"), _actuator_kp),
        "kv": _of_kind(_motor(6, "N m s/rad"), _minus_bias(2, "force/velocity"), _actuator_kv),
        "ki": _of_kind(_motor(5, "N m/(rad s)"), _pid_ki, _pid_ki),
        "resistance": _motor(0, "Ohm"),
        "motor_constant": _motor(1, "N m/A"),
        "voltage_limit": _motor(7, "V"),
        "bias_force": _actuator_bias(0, "force"),
        "bias_position": _actuator_bias(1, "force/position"),
        "bias_velocity": _actuator_bias(2, "force/velocity"),
        "offset": _actuator_offset,
        "delay": _actuator_delay,
        "force_limit": _limit("actuator_force", "force"),
        "command_limit": _limit("actuator_ctrl", "command", "actuator_ctrladr"),
        "lag": _lag,
        **_laws("actuator"),
    },
    "geom": {
        "friction": entry("geom_friction", "1", 0, minimum=0.0),
        "friction_torsional": entry("geom_friction", "m", 1, minimum=0.0),
        "friction_rolling": entry("geom_friction", "m", 2, minimum=0.0),
        **GEOM_CONTACTS,
    },
    "pair": PAIR_CONTACTS,
    "option": {
        **{f"gravity_{a}": _option("gravity", i, "m/s^2") for i, a in enumerate(_AXES)},
        **{f"wind_{a}": _option("wind", i, "m/s") for i, a in enumerate(_AXES)},
        "density": _option("density", None, "kg/m^3"),
        "viscosity": _option("viscosity", None, "Pa s"),
        "impratio": _option("impratio", None, "1"),
    },
}
