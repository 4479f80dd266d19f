"""Which parameters may be unknown, and between which bounds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import mujoco
import numpy as np

from sipe_bayes.calibration.column_names import Kind
from sipe_bayes.calibration.init.draft import Reading, Unknown
from sipe_bayes.calibration.init.unknowns.contacts import contacts, word_of
from sipe_bayes.calibration.init.unknowns.resistance import of_joint, of_tendons
from sipe_bayes.calibration.machine import Actuator, Drive, Joint, Machine, Sizes, bases
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.envs.inertia import body_frame_inertia
from sipe_bayes.envs.internal.closed_chains import dependent_joints
from sipe_bayes.envs.sensing import of_sensor
from sipe_bayes.envs.targets import bind

_SPRING = "a spring that the model does not have"
_STIFF, _PER_METRE = 4.0, 10.0  # of the usual force, the force of a spring that is turned by 1 rad, or is 0.1 m long


def candidates(
    model: mujoco.MjModel,
    machine: Machine,
    readings: Sequence[Reading],
    sizes: Sizes,
    touching: Sequence[int] = (),
) -> list[Unknown]:
    """Parameters that may be unknown, those first that show most.

    Args:
        model: as given.
        machine: what of it logs hold.
        readings: measurements and commands.
        sizes: of the motion.
        touching: ids of bodies that touch what stands still in the logs, beside those that move freely.
    """
    measured = {r.match.target.removeprefix("joint:").rpartition(".")[0] for r in readings if not r.commanded}
    joints = [joint for joint in machine.joints if joint.name in measured]
    passive = _follow(model, machine, joints)
    driven = _driven(machine, readings)
    gains = _shared_by_rotors(
        model, [u for a, r in driven for u in (*_of_actuator(model, a, r), *_lag_of(model, a))], driven
    )
    behind = [int(model.joint(joint.name).bodyid[0]) for joint in (*joints, *passive)]
    bodies = [model.body(body).id for body in machine.bodies]  # what is pushed, or carries joints
    free = bodies if driven else []  # what is only thrown moves alike whatever its mass
    masses, attached = _masses(model, [*behind, *free])
    of_joints = of_tendons(model, [a for a, _ in driven], sizes) if joints else []
    of_joints += [u for joint in joints if not joint.base for u in of_joint(model, joint, sizes)]
    damped = {f"joint:{a.joint.name}.damping" for a, _ in driven if a.joint is not None and _feeds_back(model, a)}
    of_joints = [
        unknown for unknown in of_joints if unknown.targets[0] not in damped
    ]  # the gain of a speed is the same
    rotors = {actuator.joint for actuator in machine.actuators}
    of_joints += [u for joint in passive for u in of_joint(model, joint, sizes, rotor=joint in rotors)]
    flown = [body for body in bodies if body in {_thrust_at(model, a) for a, _ in driven}]
    shapes = [unknown for body in flown if not attached for unknown in _of_base(model, body)]
    proposed = gains + masses + shapes + of_joints + attached + _zeros(readings)
    proposed += contacts(model, {*bodies, *touching})
    carrying = bases(model) - {*flown} if driven and not attached else ()
    proposed += [unknown for body in carrying for unknown in _of_base(model, body)]
    return proposed or _masses(model, bodies)[0]


def _feeds_back(model: mujoco.MjModel, actuator: Actuator) -> bool:
    """Whether a gain of the velocity is asked for."""
    index = model.actuator(actuator.name).id
    fixed = int(model.actuator_gaintype[index]) == int(mujoco.mjtGain.mjGAIN_FIXED)
    return fixed and actuator.drive != Drive.FORCE and bool(model.actuator_biasprm[index, 2])


def _follow(model: mujoco.MjModel, machine: Machine, joints: Sequence[Joint]) -> list[Joint]:
    """Joints that nothing measures, and that closed chains make follow those that are measured."""
    tied = dependent_joints(model, {model.joint(joint.name).id for joint in joints})
    return [j for j in machine.joints if model.joint(j.name).id in tied and not j.base]


def _shared_by_rotors(
    model: mujoco.MjModel, gains: list[Unknown], driven: Sequence[tuple[Actuator, Reading]]
) -> list[Unknown]:
    """Gains of rotors that are alike in the model as one: each by itself, they show as a centre of mass does."""
    rotors = {f"actuator:{actuator.name}.gain": _thrust_at(model, actuator) for actuator, _ in driven}
    alike: dict[tuple[int, str], list[Unknown]] = {}
    for unknown in gains:
        if body := rotors.get(unknown.targets[0]):
            alike.setdefault((body, unknown.note), []).append(unknown)
    shared = [some for some in alike.values() if len(some) > 1]
    single = [unknown for unknown in gains if not any(unknown in some for some in shared)]
    every = [
        replace(some[0], name=f"rotors_gain_{k}" if k else "rotors_gain", targets=tuple(u.targets[0] for u in some))
        for k, some in enumerate(shared)
    ]
    return [*every, *single]


def _thrust_at(model: mujoco.MjModel, actuator: Actuator) -> int:
    """The id of the body that an actuator at a site pushes; 0 of others."""
    site = int(model.actuator_trnid[model.actuator(actuator.name).id, 0])
    return int(model.body_weldid[model.site_bodyid[site]]) if actuator.thrust else 0


def _of_base(model: mujoco.MjModel, body: int) -> list[Unknown]:
    """Inertia and centre of mass of what nothing holds; what is attached to it would stand for these."""
    name, own = model.body(body).name, np.diag(body_frame_inertia(model, body))
    at, word = f"body:{name}", word_of(name)
    half = float(f"{np.sqrt(own.mean() / max(float(model.body_mass[body]), 1e-9)) / 2:.1g}")
    inertia = [
        _factor(f"{word}_inertia_{x}", f"{at}.inertia_{x}{x}", 0.4, 2.5, f"{value:.3g} kg m^2 in the model")
        for x, value in zip("xyz", own, strict=True)
    ]
    centre = [
        Unknown(f"{word}_com_{x}", (f"{at}.com_{x}",), *_around(value, half), False, "centre of mass")
        for x, value in zip("xyz", np.round(model.body_ipos[body], 4).tolist(), strict=True)
    ]
    return [*inertia, *centre]


def _around(value: float, half: float) -> tuple[float, float]:
    return float(f"{value - half:.4g}"), float(f"{value + half:.4g}")


def _zeros(readings: Sequence[Reading]) -> list[Unknown]:
    """What is left of zeros that simulations alone tell, but of those that a servo's set-points have, too."""
    shared = {r.unsure for r in readings if r.commanded}
    return [
        Unknown(
            f"{word_of(r.match.column)}_zero", (f"sensor:{r.match.column}.bias",), -r.unsure, r.unsure, False,
            f"SI, what is left of the zero error of {r.match.column!r}",
        )
        for r in readings if r.unsure and r.unsure not in shared
    ]  # fmt: skip


def springs(model: mujoco.MjModel, machine: Machine, readings: Sequence[Reading], sizes: Sizes) -> list[Unknown]:
    """Springs that the model lacks at joints that move: left out of a fit they look like delays."""
    measured = {r.match.target for r in readings if not r.commanded}
    joints = [j for j in machine.joints if f"joint:{j.name}.position" in measured and not j.base]
    joints += _follow(model, machine, joints)
    held = {a.joint for a in machine.actuators if a.drive == Drive.POSITION}  # a spring shows as the gain does
    joints = [joint for joint in joints if joint not in held]
    soft = [j for j in joints if not float(np.ravel(model.joint(j.name).stiffness)[0])]
    return [
        Unknown(
            f"{word_of(joint.name)}_spring", (f"joint:{joint.name}.stiffness",), 0.0,
            _STIFF * sizes.force[joint.name] * (1.0 if joint.hinge else _PER_METRE), False, _SPRING,
        )
        for joint in soft
    ]  # fmt: skip


def _driven(machine: Machine, readings: Sequence[Reading]) -> list[tuple[Actuator, Reading]]:
    return [(a, r) for a in machine.actuators for r in readings if r.match.target == f"actuator:{a.name}"]


def scale_is_open(model: mujoco.MjModel, machine: Machine, readings: Sequence[Reading]) -> bool:
    """Whether no force is known: with all forces and masses as many times larger, everything moves alike."""
    driven = _driven(machine, readings)
    known_force = any(r.match.label.kind == Kind.TORQUE or r.unit in ("N m", "N") for _, r in driven)
    known_force |= any(r.match.target.endswith(".force") and not r.doubts for r in readings)
    gains = [unknown for a, r in driven for unknown in _of_actuator(model, a, r)]
    return not driven or (bool(gains) and not known_force)


def _of_actuator(model: mujoco.MjModel, actuator: Actuator, reading: Reading) -> list[Unknown]:
    """Gains of an actuator whose command is no force."""
    name, at = actuator.name, f"actuator:{actuator.name}"
    index = model.actuator(name).id
    gain, (_, _, of_velocity) = float(model.actuator_gainprm[index, 0]), model.actuator_biasprm[index, :3]
    word = word_of(name)
    if int(model.actuator_gaintype[index]) == int(mujoco.mjtGain.mjGAIN_DCMOTOR):
        constant, kp = float(model.actuator_gainprm[index, 1]), float(model.actuator_gainprm[index, 4])
        own = [_factor(f"{word}_resistance", f"{at}.resistance", 0.5, 2.0, f"{gain:g} Ohm in the model")]
        own += [_factor(f"{word}_constant", f"{at}.motor_constant", 0.5, 2.0, f"{constant:g} N m/A in the model")]
        follows = [_factor(f"{word}_kp", f"{at}.kp", 0.3, 3.0, f"position gain, {kp:g} in the model")]
        return follows if actuator.drive == Drive.POSITION else own
    of_position = float(model.actuator_biasprm[index, 1])
    if actuator.drive == Drive.POSITION and not np.isclose(gain, -of_position):
        return [_factor(f"{word}_gain", f"{at}.gain", 0.3, 3.0, f"gain, {gain:g} in the model")]
    if actuator.drive == Drive.POSITION:
        out = [_factor(f"{word}_kp", f"{at}.kp", 0.3, 3.0, f"position gain, {gain:g} in the model")]
        if of_velocity:
            return [*out, _factor(f"{word}_kv", f"{at}.kv", 0.1, 4.0, f"velocity gain, {-of_velocity:g} in the model")]
        return out
    if actuator.drive == Drive.VOLTAGE and int(model.actuator_gaintype[index]) == int(mujoco.mjtGain.mjGAIN_FIXED):
        back = _factor(f"{word}_back_emf", f"{at}.bias_velocity", 0.2, 4.0, "back-EMF")
        return [_factor(f"{word}_gain", f"{at}.gain", 0.3, 3.0, f"force for each unit, {gain:g} in the model"), back]
    if actuator.drive == Drive.VELOCITY:
        both = (f"{at}.gain", f"{at}.bias_velocity")
        return [Unknown(f"{word}_kv", both, 0.2, 5.0, True, f"velocity gain, {gain:g} in the model")]
    in_force = reading.match.label.kind == Kind.TORQUE or reading.unit in ("N m", "mN m", "N", "mN")
    if actuator.drive != Drive.FORCE or in_force:
        return []
    gear = float(model.actuator_gear[index, 0]) or float(np.linalg.norm(model.actuator_gear[index]))  # at a site
    note = f"gain, {gain:g} in the model, before the gear of {gear:g}: the command is no force"
    return [_factor(f"{word}_gain", f"{at}.gain", 0.3, 3.0, note)]


def _lag_of(model: mujoco.MjModel, actuator: Actuator) -> list[Unknown]:
    """The time constant of a filter that the model has."""
    index, filters = model.actuator(actuator.name).id, (mujoco.mjtDyn.mjDYN_FILTER, mujoco.mjtDyn.mjDYN_FILTEREXACT)
    tau = float(model.actuator_dynprm[index, 0])
    if int(model.actuator_dyntype[index]) not in map(int, filters) or not tau > 0:
        return []
    target, note = f"actuator:{actuator.name}.lag", f"time constant of its filter, {tau:g} s in the model"
    unknown = _factor(f"{word_of(actuator.name)}_lag", target, 0.2, 5.0, note)
    low = max(unknown.low, least_of(model, unknown))  # of Euler's steps a step
    return [replace(unknown, low=low)] if low < 1 else []


def _factor(name: str, target: str, low: float, high: float, note: str) -> Unknown:
    return Unknown(name, (target,), low, high, True, note)


def _masses(model: mujoco.MjModel, bodies: Sequence[int]) -> tuple[list[Unknown], list[Unknown]]:
    """The heaviest of what moves with each body, and what else is attached to it: payloads, tools."""
    heaviest: list[Unknown] = []
    attached: list[Unknown] = []
    for moving in dict.fromkeys(int(model.body_weldid[body]) for body in bodies):
        moved = [b for b in range(1, model.nbody) if int(model.body_weldid[b]) == moving]
        by_mass = sorted(moved, key=lambda b: -float(model.body_mass[b]))
        for k, body in enumerate(by_mass):
            mass, name = float(model.body_mass[body]), model.body(body).name
            if mass > 0 and name:
                note = f"{mass:g} kg in the model" + (f", attached to {model.body(by_mass[0]).name}" if k else "")
                unknown = _factor(f"{word_of(name)}_mass", f"body:{name}.mass", 0.5, 2.0, note)
                (attached if k else heaviest).append(unknown)
    return heaviest, attached


def as_parameters(model: mujoco.MjModel, unknowns: Sequence[Unknown]) -> list[Parameter]:
    """Unknowns as parameters of an environment; those that the model can not have are left out."""
    out = []
    for unknown in unknowns:
        values = [0.0 if of_sensor(target) else bind(model, target).value for target in unknown.targets]
        own = values[0] if np.isfinite(values[0]) else None
        if unknown.relative:
            if own:
                out.append(Parameter(unknown.name, unknown.low, unknown.high, targets=unknown.targets, relative=True))
            continue
        low, high = unknown.low, unknown.high
        if own is not None:
            low, high = min(low, own), max(high, own)
        scale: Literal["linear", "log"] = "linear" if unknown.expected is None else "log"
        out.append(Parameter(unknown.name, low, high, scale=scale, targets=unknown.targets))
    return out


def least_of(model: mujoco.MjModel, unknown: Unknown) -> float:
    """The least that its targets may be, in terms of what bounds are of; factors of negative ones have none."""
    bound = [bind(model, target) for target in unknown.targets if not of_sensor(target)]
    scales = [(t.minimum, t.value if unknown.relative else 1.0) for t in bound]
    return max((1.01 * minimum / scale for minimum, scale in scales if scale > 0), default=-np.inf)
