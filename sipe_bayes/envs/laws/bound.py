"""The laws of a compiled model, and how a model gets one.

A law's numbers stand in the model itself, as a custom ``<numeric name="joint:NAME.LAW" data="..."/>``, so that they are
written like any parameter, travel with a saved MJCF and are found again on loading it. ``laws_of`` reads which laws a
compiled model has; the engine asks each of them before every physics step for a generalised force, or for dry friction
that it adds to the joint's own. What a law needs beyond position, velocity and command (the torque that the joint
passes on, the actuator's force) is measured by one physics step without the laws' friction, which is then forgotten: a
step costs two. What a law remembers are the activations of an actuator of the same name, which has no force.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.envs.internal.states import declare_start
from sipe_bayes.envs.laws.base import SINGLE, Law, LawError, Now
from sipe_bayes.envs.laws.registry import LAW_OF, LAWS

_BY_JOINT = int(mujoco.mjtTrn.mjTRN_JOINT)
_MEMORY = int(mujoco.mjtDyn.mjDYN_USER)  # an actuator whose activations nothing in MuJoCo changes
_SURE = 10.0  # at a tenth of the usual speed a direction counts
_MEMORY_SD = 0.6  # of what a law remembers, which lies between -1 and 1


@dataclass(frozen=True)
class BoundLaw:
    """A law of a compiled model.

    Args:
        law: which.
        numbers: slice of ``numeric_data``.
        position: column of the physics state.
        velocity: column of the physics state.
        dof: where it acts; -1 where a helper does.
        actuator: that drives the joint, or whose law it is; -1 without.
        helper: actuator beside one that drives no single joint, which gives the law's force through the same
            transmission; -1 where ``dof`` is where it acts.
        control: column of the controls; -1 without.
        sensor: column of the sensordata; -1 where the law senses nothing.
        peers: columns of the sensordata of all objects with this law.
        memory: columns of the physics state that it remembers in.
    """

    law: Law
    numbers: slice
    position: int
    velocity: int
    dof: int
    actuator: int
    helper: int
    control: int
    sensor: int
    peers: tuple[int, ...]
    memory: slice

    def now(self, numbers: FloatArray, states: FloatArray, controls: FloatArray, sensors: FloatArray | None) -> Now:
        """What the law is asked with.

        Args:
            numbers: (B, K) of the model's ``numeric_data``.
            states: (B, S).
            controls: (B, U).
            sensors: (B, D), None where no law senses.
        """
        nothing = np.zeros(len(states))
        command = controls[:, self.control] if self.control >= 0 else nothing
        sensed, total = nothing, nothing
        if self.sensor >= 0 and sensors is not None:
            sensed = sensors[:, self.sensor]
            total = sum((np.abs(sensors[:, peer]) for peer in self.peers), nothing)
        position, velocity, memory = states[:, self.position], states[:, self.velocity], states[:, self.memory]
        return Now(numbers[:, self.numbers], position, velocity, command, sensed, total, memory)


def declare(spec: mujoco.MjSpec, kind: str, name: str, law: Law) -> None:
    """Give a spec the numbers of a law at their neutral values, the sensor and the memory that it needs; once.

    Raises:
        LawError: where there is no single joint to act on.
    """
    label = f"{kind}:{name}.{law.name}"
    if any(numeric.name == label for numeric in spec.numerics):
        return
    spec.add_numeric(name=label, data=[number.neutral for number in law.numbers], size=len(law.numbers))
    if kind == "actuator":
        _help(spec, name, label)
    if law.senses == "force":
        sensor = mujoco.mjtSensor.mjSENS_ACTUATORFRC
        spec.add_sensor(name=label, type=sensor, objtype=mujoco.mjtObj.mjOBJ_ACTUATOR, objname=name)
    elif law.senses == "torque":
        joint = spec.joint(name)
        if joint is None or int(joint.type) not in SINGLE:
            raise LawError(f"target {label!r}: only hinge and slide joints have this attribute")
        along, hinge = np.empty(4), int(joint.type) == SINGLE[0]
        mujoco.mju_quatZ2Vec(along, np.asarray(joint.axis, float))
        joint.parent.add_site(name=label, pos=joint.pos, quat=along)
        sensor = mujoco.mjtSensor.mjSENS_TORQUE if hinge else mujoco.mjtSensor.mjSENS_FORCE
        spec.add_sensor(name=label, type=sensor, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=label)
    if law.memory:
        memory = spec.add_actuator(name=label, trntype=mujoco.mjtTrn.mjTRN_JOINT, target=name)
        _plain(memory)
        memory.dyntype, memory.actdim = mujoco.mjtDyn.mjDYN_USER, law.memory
        memory.gainprm = np.zeros(len(memory.gainprm))
        declare_start(spec, f"actuator:{label}", [_MEMORY_SD] * law.memory)


def _help(spec: mujoco.MjSpec, name: str, label: str) -> None:
    """An actuator of a force of its own, beside one that drives no single joint, through the same transmission."""
    own = spec.actuator(name)
    if own is None or int(own.trntype) == _BY_JOINT:
        return
    helper = spec.add_actuator(name=label, trntype=own.trntype, target=own.target)
    _plain(helper)
    helper.refsite, helper.slidersite, helper.cranklength = own.refsite, own.slidersite, own.cranklength
    helper.gear = own.gear


def _plain(actuator: mujoco.MjsActuator) -> None:
    """Without what a model's defaults give to its actuators: a force of its command, of any size, at once."""
    actuator.set_to_motor()
    for numbers in (actuator.biasprm, actuator.dynprm, actuator.damping):
        numbers[:] = 0.0
    actuator.gainprm = np.eye(1, len(actuator.gainprm))[0]
    actuator.delay, actuator.nsample, actuator.armature = 0.0, 0, 0.0
    free = int(mujoco.mjtLimited.mjLIMITED_FALSE)
    actuator.ctrllimited = actuator.forcelimited = actuator.actlimited = free


@dataclass(frozen=True)
class LawNumbers:
    """An edit that declares a law, some of its numbers at other values than the neutral ones.

    Args:
        owner: ``joint:NAME`` or ``actuator:NAME``.
        law: its name.
        values: (attribute, value) of the numbers that a law keeps where it does nothing.
    """

    owner: str
    law: str
    values: tuple[tuple[str, float], ...]

    def __call__(self, spec: mujoco.MjSpec) -> None:
        """Declare it."""
        kind, _, name = self.owner.partition(":")
        declare(spec, kind, name, LAWS[self.law])
        numeric = next(n for n in spec.numerics if n.name == f"{self.owner}.{self.law}")
        data = np.array(numeric.data, float)
        for attribute, value in self.values:
            data[LAW_OF[kind, attribute][1]] = value
        numeric.data = data


def is_of_law(actuator: str) -> bool:
    """Whether an actuator is a law's own, as a model that was written with laws has them; nothing commands it."""
    head, _, name = actuator.rpartition(".")
    return ":" in head and name in LAWS


def laws_of(model: mujoco.MjModel) -> tuple[BoundLaw, ...]:
    """The laws that a compiled model's numerics declare."""
    bounds: list[BoundLaw] = []
    for index in range(model.nnumeric):
        label = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_NUMERIC, index) or ""
        head, _, name = label.rpartition(".")
        kind, _, owner = head.partition(":")
        if name in LAWS and LAWS[name].kind == kind:
            first = int(model.numeric_adr[index])
            bounds.append(_bound(model, LAWS[name], owner, slice(first, first + int(model.numeric_size[index])), label))
    peers = {law.name: tuple(bound.sensor for bound in bounds if bound.law is law) for law in LAWS.values()}
    return tuple(replace(bound, peers=peers[bound.law.name]) for bound in bounds)


def _bound(model: mujoco.MjModel, law: Law, owner: str, numbers: slice, label: str) -> BoundLaw:
    kind = mujoco.mjtObj.mjOBJ_JOINT if law.kind == "joint" else mujoco.mjtObj.mjOBJ_ACTUATOR
    index = mujoco.mj_name2id(model, kind, owner)
    if index < 0 or numbers.stop - numbers.start != len(law.numbers):
        raise LawError(f"model: the numeric {label!r} wants a {law.kind} {owner!r} and {len(law.numbers)} numbers")
    if law.kind == "joint":
        joint, actuator = index, _driver(model, index)
    else:
        joint, actuator = driven_joint(model, index), index
    helper = mujoco.mj_name2id(model, kind, label) if law.kind == "actuator" and joint < 0 else -1
    if helper < 0 and (joint < 0 or int(model.jnt_type[joint]) not in SINGLE):
        raise LawError(
            f"target {label!r}: only hinge and slide joints, and actuators of anything but a ball, have this attribute"
        )
    sensor = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SENSOR, label) if law.senses else -1
    if law.senses and sensor < 0:
        raise LawError(f"model: the numeric {label!r} wants a sensor of the same name")
    column = int(model.sensor_adr[sensor]) + (2 if law.senses == "torque" else 0) if sensor >= 0 else -1
    control = int(model.actuator_ctrladr[actuator]) if actuator >= 0 else -1
    memory = _memory(model, law, label)
    if helper >= 0:
        return BoundLaw(law, numbers, 0, 0, -1, actuator, helper, control, column, (), memory)
    position, dof = 1 + int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
    return BoundLaw(law, numbers, position, 1 + model.nq + dof, dof, actuator, -1, control, column, (), memory)


def _memory(model: mujoco.MjModel, law: Law, label: str) -> slice:
    if not law.memory:
        return slice(0, 0)
    keeper = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_ACTUATOR, label)
    if keeper < 0 or int(model.actuator_actnum[keeper]) != law.memory:
        raise LawError(f"model: the numeric {label!r} wants an actuator of the same name with {law.memory} activations")
    first = 1 + model.nq + model.nv + int(model.actuator_actadr[keeper])
    return slice(first, first + law.memory)


def driven_joint(model: mujoco.MjModel, actuator: int) -> int:
    """The joint that an actuator drives by itself, or -1."""
    if int(model.actuator_trntype[actuator]) != _BY_JOINT:
        return -1
    return int(model.actuator_trnid[actuator, 0])


def _driver(model: mujoco.MjModel, joint: int) -> int:
    drives = (a for a in range(model.nactuator) if int(model.actuator_dyntype[a]) != _MEMORY)
    drivers: Sequence[int] = [a for a in drives if driven_joint(model, a) == joint]
    return drivers[0] if drivers else -1


def moving_on(laws: Sequence[BoundLaw], states: FloatArray) -> FloatArray:
    """States (W, S) in which laws remember that the motion has long gone on in its direction."""
    states = states.copy()
    for bound in laws:
        if bound.law.memory:
            velocity = states[:, bound.velocity]
            usual = np.sqrt((velocity**2).mean())
            states[:, bound.memory] = bound.law.moving(np.tanh(_SURE * velocity / usual if usual else 0 * velocity))
    return states
