r"""Forces that MJCF has no element for, written before every physics step.

A law's numbers stand in the model itself, as a custom ``<numeric name="joint:NAME.LAW" data="..."/>``, so that they are
written like any parameter, travel with a saved MJCF and are found again on loading it. ``laws_of`` reads which laws a
compiled model has; the engine asks each of them before every physics step for a generalised force, or for dry friction
that it adds to the joint's own. What a law needs beyond position, velocity and command (the torque that the joint
passes on, the actuator's force) is measured by one physics step without the laws' friction, which is then forgotten: a
step costs two.

With tau_t the torque that a joint passes on to the body it carries (gravity and inertia included, the armature's not),
v the joint's velocity, q its position, u the command and f the actuator's force:

- ``load_friction``: dry friction grows by p \|tau_t\| (M. Duclusaud et al. 2024, "Extended Friction Models for the
  Physics Simulation of Servo Actuators", https://arxiv.org/abs/2410.08650, their load-dependent models).
- ``direction``: dry friction grows by p sign(v); and a force -p' \|v\|.
- ``stribeck``: dry friction grows by p exp(-(v / v_s)^2) (R. Stribeck 1902).
- ``cogging``: a force a sin(n q) + b cos(n q).
- ``force_drop``: the actuator's force falls short by p f \|f\|.
- ``residual``: a Gaussian process of (q, v, u) by random Fourier features (A. Rahimi, B. Recht 2007, "Random Features
  for Large-Scale Kernel Machines").

Deviations:

- The torque that a joint passes on is that of the step without the laws' own friction.
- ``force_drop`` takes the force that the actuator has without it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import mujoco
import numpy as np

from sipe_bayes.core.arrays import FloatArray

_FEATURES = 12  # of the residual's Gaussian process
_SINGLE = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))


class LawError(ValueError):
    """A law where it cannot act."""


@dataclass(frozen=True)
class Number:
    """One number of a law.

    Args:
        attribute: of the target that writes it.
        unit: of its value.
        neutral: where the law does nothing; of a shape, where a model has it until a parameter writes it.
        minimum: the smallest value.
        shape: whether it is the shape of a force, not its size: then no value of it stands for the plain model.
    """

    attribute: str
    unit: str
    neutral: float = 0.0
    minimum: float = -np.inf
    shape: bool = False


@dataclass(frozen=True)
class Now:
    """What B simulations are at before a physics step.

    Args:
        numbers: (B, K), the law's.
        position: (B,), of the joint, rad or m.
        velocity: (B,).
        command: (B,), of the actuator; zero where none drives the joint.
        sensed: (B,), the torque that the joint passes on, or the actuator's force; zero where the law asks for neither.
    """

    numbers: FloatArray
    position: FloatArray
    velocity: FloatArray
    command: FloatArray
    sensed: FloatArray


class Law(ABC):
    """A force at a joint that MJCF has no element for.

    ``kind`` says what it is declared at; ``senses`` whether it needs the transmitted torque or the actuator's force. A
    law gives a force or friction. Adding one takes a class and a line in ``LAWS``.
    """

    name: ClassVar[str]
    kind: ClassVar[str] = "joint"
    senses: ClassVar[str] = ""  # "torque" of a joint, "force" of an actuator
    friction: ClassVar[bool] = True  # whether ``value`` is dry friction or a force
    numbers: ClassVar[tuple[Number, ...]]

    @abstractmethod
    def value(self, now: Now) -> FloatArray:
        """Dry friction (B,) to add to the joint's, N m or N; or a force (B,), of an actuator before its gear."""


class LoadFriction(Law):
    """Dry friction that grows with the transmitted torque."""

    name, senses = "load_friction", "torque"
    numbers = (Number("load_friction", "1", minimum=0.0),)

    def value(self, now: Now) -> FloatArray:
        """P |tau_t|."""
        return now.numbers[:, 0] * np.abs(now.sensed)


class DirectionFriction(Law):
    """Dry friction that differs by direction."""

    name = "direction_friction"
    numbers = (Number("direction_friction", "force"),)

    def value(self, now: Now) -> FloatArray:
        """P sign(v)."""
        return now.numbers[:, 0] * np.sign(now.velocity)


class DirectionDamping(Law):
    """Viscous friction that differs by direction."""

    name, friction = "direction_damping", False
    numbers = (Number("direction_damping", "force/velocity"),)

    def value(self, now: Now) -> FloatArray:
        """-p |v|."""
        return -now.numbers[:, 0] * np.abs(now.velocity)


class Stribeck(Law):
    """Dry friction that is larger at low speed."""

    name = "stribeck"
    numbers = (
        Number("stribeck_friction", "force", minimum=0.0),
        Number("stribeck_velocity", "velocity", 1.0, 1e-12, shape=True),
    )

    def value(self, now: Now) -> FloatArray:
        """P exp(-(v / v_s)^2)."""
        excess, speed = now.numbers.T
        return excess * np.exp(-((now.velocity / speed) ** 2))


class Cogging(Law):
    """A torque that goes round with the position."""

    name, friction = "cogging", False
    numbers = (
        Number("cogging_sin", "force"),
        Number("cogging_cos", "force"),
        Number("cogging_poles", "1", 1.0, shape=True),
    )

    def value(self, now: Now) -> FloatArray:
        """A sin(n q) + b cos(n q)."""
        a, b, poles = now.numbers.T
        return a * np.sin(poles * now.position) + b * np.cos(poles * now.position)


class ForceDrop(Law):
    """An actuator whose force falls short the more of it is asked for."""

    name, kind, senses, friction = "force_drop", "actuator", "force", False
    numbers = (Number("force_drop", "1/force"),)

    def value(self, now: Now) -> FloatArray:
        """-p f |f|."""
        return -now.numbers[:, 0] * now.sensed * np.abs(now.sensed)


def _frequencies() -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(0)
    return rng.standard_normal((3, _FEATURES)), rng.uniform(0, 2 * np.pi, _FEATURES)


class Residual(Law):
    """A force that no named law gives: a function of position, velocity and command."""

    name, friction = "residual", False
    scales = ("residual_position", "residual_velocity", "residual_command")
    numbers = (
        *(Number(scale, "", 1.0, 1e-12, shape=True) for scale in scales),
        *(Number(f"residual_{k}", "force") for k in range(_FEATURES)),
    )
    frequencies, phases = _frequencies()

    def value(self, now: Now) -> FloatArray:
        """Sum over k of w_k cos(omega_k . (q / l_q, v / l_v, u / l_u) + b_k)."""
        inputs = np.stack([now.position, now.velocity, now.command], axis=1) / now.numbers[:, :3]
        # a column at a time: the last bit of a matrix product depends on the batch
        angles = sum((inputs[:, i, None] * row for i, row in enumerate(self.frequencies)), self.phases)
        features = np.cos(angles) * np.sqrt(2 / _FEATURES)
        return (now.numbers[:, 3:] * features).sum(1)


LAWS: dict[str, Law] = {
    law.name: law
    for law in (
        LoadFriction(),
        DirectionFriction(),
        DirectionDamping(),
        Stribeck(),
        Cogging(),
        ForceDrop(),
        Residual(),
    )
}
LAW_OF = {(law.kind, number.attribute): (law, k) for law in LAWS.values() for k, number in enumerate(law.numbers)}


@dataclass(frozen=True)
class BoundLaw:
    """A law of a compiled model.

    Args:
        law: which.
        numbers: slice of ``numeric_data``.
        position: column of the physics state.
        velocity: column of the physics state.
        dof: where it acts.
        actuator: that drives the joint, or whose law it is; -1 without.
        control: column of the controls; -1 without.
        sensor: column of the sensordata; -1 where the law senses nothing.
    """

    law: Law
    numbers: slice
    position: int
    velocity: int
    dof: int
    actuator: int
    control: int
    sensor: int

    def value(
        self, numbers: FloatArray, states: FloatArray, controls: FloatArray, sensors: FloatArray | None
    ) -> FloatArray:
        """The law's friction or force (B,).

        Args:
            numbers: (B, K) of the model's ``numeric_data``.
            states: (B, S).
            controls: (B, U).
            sensors: (B, D), None where no law senses.
        """
        nothing = np.zeros(len(states))
        command = controls[:, self.control] if self.control >= 0 else nothing
        sensed = nothing if self.sensor < 0 or sensors is None else sensors[:, self.sensor]
        own = numbers[:, self.numbers]
        return self.law.value(Now(own, states[:, self.position], states[:, self.velocity], command, sensed))


def declare(spec: mujoco.MjSpec, kind: str, name: str, law: Law) -> None:
    """Give a spec the numbers of a law at their neutral values, and the sensor that it needs; once.

    Raises:
        LawError: where there is no single joint to act on.
    """
    label = f"{kind}:{name}.{law.name}"
    if any(numeric.name == label for numeric in spec.numerics):
        return
    spec.add_numeric(name=label, data=[number.neutral for number in law.numbers], size=len(law.numbers))
    if law.senses == "force":
        sensor = mujoco.mjtSensor.mjSENS_ACTUATORFRC
        spec.add_sensor(name=label, type=sensor, objtype=mujoco.mjtObj.mjOBJ_ACTUATOR, objname=name)
    elif law.senses == "torque":
        joint = spec.joint(name)
        if joint is None or int(joint.type) not in _SINGLE:
            raise LawError(f"target {label!r}: only hinge and slide joints have this attribute")
        along, hinge = np.empty(4), int(joint.type) == _SINGLE[0]
        mujoco.mju_quatZ2Vec(along, np.asarray(joint.axis, float))
        joint.parent.add_site(name=label, pos=joint.pos, quat=along)
        sensor = mujoco.mjtSensor.mjSENS_TORQUE if hinge else mujoco.mjtSensor.mjSENS_FORCE
        spec.add_sensor(name=label, type=sensor, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=label)


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


def laws_of(model: mujoco.MjModel) -> tuple[BoundLaw, ...]:
    """The laws that a compiled model's numerics declare."""
    found = []
    for index in range(model.nnumeric):
        label = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_NUMERIC, index) or ""
        head, _, name = label.rpartition(".")
        kind, _, owner = head.partition(":")
        if name in LAWS and LAWS[name].kind == kind:
            first = int(model.numeric_adr[index])
            found.append(_bound(model, LAWS[name], owner, slice(first, first + int(model.numeric_size[index])), label))
    return tuple(found)


def _bound(model: mujoco.MjModel, law: Law, owner: str, numbers: slice, label: str) -> BoundLaw:
    kind = mujoco.mjtObj.mjOBJ_JOINT if law.kind == "joint" else mujoco.mjtObj.mjOBJ_ACTUATOR
    index = mujoco.mj_name2id(model, kind, owner)
    if index < 0 or numbers.stop - numbers.start != len(law.numbers):
        raise LawError(f"model: the numeric {label!r} wants a {law.kind} {owner!r} and {len(law.numbers)} numbers")
    if law.kind == "joint":
        joint, actuator = index, _driver(model, index)
    else:
        joint, actuator = driven_joint(model, index), index
    if joint < 0 or int(model.jnt_type[joint]) not in _SINGLE:
        raise LawError(f"target {label!r}: only hinge and slide joints, and actuators of one, have this attribute")
    sensor = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SENSOR, label) if law.senses else -1
    if law.senses and sensor < 0:
        raise LawError(f"model: the numeric {label!r} wants a sensor of the same name")
    column = int(model.sensor_adr[sensor]) + (2 if law.senses == "torque" else 0) if sensor >= 0 else -1
    control = int(model.actuator_ctrladr[actuator]) if actuator >= 0 else -1
    position, dof = 1 + int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
    return BoundLaw(law, numbers, position, 1 + model.nq + dof, dof, actuator, control, column)


def driven_joint(model: mujoco.MjModel, actuator: int) -> int:
    """The joint that an actuator drives by itself, or -1."""
    if int(model.actuator_trntype[actuator]) != int(mujoco.mjtTrn.mjTRN_JOINT):
        return -1
    return int(model.actuator_trnid[actuator, 0])


def _driver(model: mujoco.MjModel, joint: int) -> int:
    drivers: Sequence[int] = [a for a in range(model.nactuator) if driven_joint(model, a) == joint]
    return drivers[0] if drivers else -1
