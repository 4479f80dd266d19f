"""Joints that a machine has and its model lacks: a gear or a link that gives way, a gap in it, a base that moves.

An edit of the MJCF brings such a joint, with ``<numeric name="joint:NAME.elastic" data="..."/>``: its compliance; the
time constant of its loss, damping over stiffness; its own inertia; the gap in which it moves freely; the largest
stiffness that the physics step resolves, at which a compliance ends; and its axis. Written without compliance and gap
it is rigid: it has no axis and moves nothing, so that the machine moves as the plain model to the last bits. Until it
is written to it has the stiffest spring.

- ``Gear``: between the motor and the joint, whose position is measured behind it. A fixed tendon ``NAME.motor`` is the
  motor's side, the joint's position and the twist ``NAME.gear`` together; it carries the actuators and the armature.
- ``Link``: behind the joint, whose position is measured at the motor. The twist is ``NAME.link``.
- ``Base``: the machine's base, ``base_x`` and ``base_y``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.envs.internal.states import declare_start
from sipe_bayes.envs.laws.base import Number

NUMBERS = (
    Number("compliance", "position/force", minimum=0.0),
    Number("compliance_loss", "s", minimum=0.0, shape=True),
    Number("compliance_inertia", "inertia", minimum=0.0, shape=True),
    Number("play", "position", minimum=0.0),
)
ELASTIC = "elastic"  # what their numeric is called
_SIZE = len(NUMBERS) + 5  # of its numeric: further the stiffest, the idle inertia, the axis
_LIGHT = 1e-14  # kg and kg m^2, of a body that must have some
_STIFF_STEPS = 2.0  # physics steps in which the end of a gap stops what meets it
_HARD = [0.99, 0.99, 0.001, 0.5, 2.0]  # and how hard it is, MuJoCo's solimp
_KEPT = (  # of a joint that is put behind another one
    *("name", "type", "axis", "pos", "ref", "springref", "stiffness", "damping", "springdamper", "springyield"),
    *("range", "limited", "margin", "solref_limit", "solimp_limit", "armature", "frictionloss", "solref_friction"),
    *("solimp_friction", "actfrcrange", "actfrclimited", "actgravcomp", "group", "userdata"),
)


@dataclass(frozen=True)
class Elastic:
    """What an elastic joint begins with.

    Args:
        stiffest: stiffness that the physics step resolves, N m/rad or N/m.
        idle: what it carries while it is rigid and moves nothing, kg m^2 or kg.
        start: standard deviations of where windows start, position and velocity.
        inertia: of its own, kg m^2 or kg.
        loss: damping over stiffness, in seconds.
    """

    stiffest: float
    idle: float
    start: tuple[float, float]
    inertia: float = 0.0
    loss: float = 0.0

    def add(self, spec: mujoco.MjSpec, body: mujoco.MjsBody, like: Joint) -> None:
        """Give a body the joint, rigid, behind those that it has."""
        joint, zero = body.add_joint(), np.zeros(3)
        joint.name, joint.type, joint.axis, joint.pos = like.name, mujoco.mjtJoint(like.kind), like.axis, like.pos
        joint.damping, joint.stiffness, joint.range, joint.limited = zero, [self.stiffest, 0.0, 0.0], [0.0, 0.0], False
        joint.frictionloss = joint.ref = joint.springref = joint.springyield = joint.margin = 0.0
        joint.armature, joint.solref_limit = self.idle, [_STIFF_STEPS * spec.option.timestep, 1.0]
        joint.solimp_limit = _HARD
        axis = np.asarray(like.axis) / np.linalg.norm(like.axis)
        numbers = [0.0, self.loss, self.inertia, 0.0, self.stiffest, self.idle, *axis]
        spec.add_numeric(name=f"joint:{like.name}.{ELASTIC}", data=numbers, size=len(numbers))
        declare_start(spec, f"joint:{like.name}", self.start)


@dataclass(frozen=True)
class Joint:
    """Name, kind and place of a joint in its body's frame."""

    name: str
    kind: int
    axis: Sequence[float] | FloatArray
    pos: Sequence[float] | FloatArray


@dataclass(frozen=True)
class Gear:
    """An edit: a joint's actuators and armature move to the other side of an elastic gear."""

    joint: str
    elastic: Elastic

    def __call__(self, spec: mujoco.MjSpec) -> None:
        """Put the gear between them."""
        joint, motor, twist = spec.joint(self.joint), f"{self.joint}.motor", f"{self.joint}.gear"
        if spec.joint(twist) is not None:
            raise ValueError(f"joint {twist!r}: is there already; take one elastic piece at a joint")
        rotor = joint.parent.add_body(name=twist, pos=joint.pos)
        rotor.explicitinertial, rotor.ipos, rotor.mass, rotor.inertia = True, np.zeros(3), _LIGHT, np.full(3, _LIGHT)
        self.elastic.add(spec, rotor, Joint(twist, int(joint.type), joint.axis, np.zeros(3)))
        tendon = spec.add_tendon(name=motor)
        tendon.wrap_joint(self.joint, 1.0)
        tendon.wrap_joint(twist, 1.0)
        tendon.armature, joint.armature = joint.armature, 0.0
        for actuator in spec.actuators:
            if int(actuator.trntype) == int(mujoco.mjtTrn.mjTRN_JOINT) and actuator.target == self.joint:
                actuator.trntype, actuator.target = mujoco.mjtTrn.mjTRN_TENDON, motor


@dataclass(frozen=True)
class Link:
    """An edit: a body is joined to its joint by a spring. The joint must be the last one of its body."""

    joint: str
    elastic: Elastic

    def __call__(self, spec: mujoco.MjSpec) -> None:
        """Put the spring between them."""
        joint = spec.joint(self.joint)
        if joint.parent.joints[-1].name != self.joint:
            raise ValueError(f"joint {self.joint!r}: is not the last one of its body; nothing can give way behind it")
        twist = Joint(f"{self.joint}.link", int(joint.type), joint.axis, joint.pos)
        self.elastic.add(spec, joint.parent, twist)


@dataclass(frozen=True)
class Base:
    """An edit: a root body's base moves along x and y of the world.

    Args:
        body: the root body.
        axes: x and y in its frame.
        elastic: of both.
    """

    body: str
    axes: tuple[tuple[float, ...], ...]
    elastic: Elastic

    def __call__(self, spec: mujoco.MjSpec) -> None:
        """Put the base's joints before those that the body has."""
        body = spec.body(self.body)
        own = [{kept: _copied(getattr(joint, kept)) for kept in _KEPT} for joint in body.joints]
        for joint in list(body.joints):
            spec.delete(joint)
        for name, axis in zip(("base_x", "base_y"), self.axes, strict=True):
            self.elastic.add(spec, body, Joint(name, int(mujoco.mjtJoint.mjJNT_SLIDE), axis, np.zeros(3)))
        for values in own:
            joint = body.add_joint()
            for kept, value in values.items():
                setattr(joint, kept, value)


def _copied(value: object) -> object:
    return value.copy() if isinstance(value, np.ndarray) else value


def motor_side(model: mujoco.MjModel, joint: str) -> int:
    """The tendon that is the motor's side of a joint's elastic gear; -1 without one."""
    return int(mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_TENDON, f"{joint}.motor"))


def realise(model: mujoco.MjModel, joint: int, first: int) -> None:
    """Write what an elastic joint's numbers, from ``first`` on, amount to."""
    compliance, loss, inertia, play, stiffest, idle, *axis = model.numeric_data[first : first + _SIZE].tolist()
    dof, moves = int(model.jnt_dofadr[joint]), compliance > 0 or play > 0
    stiffness = min(1 / compliance, stiffest) if compliance > 0 else 0.0
    model.dof_armature[dof] = inertia if moves else idle
    model.jnt_stiffness[joint], model.dof_damping[dof] = stiffness, stiffness * loss
    model.jnt_limited[joint], model.jnt_range[joint] = play > 0, (-play / 2, play / 2)
    twists = (model.wrap_type == int(mujoco.mjtWrap.mjWRAP_JOINT)) & (model.wrap_objid == joint)
    if twists.any():  # of a gear: the motor's side is the joint's
        model.wrap_prm[twists] = float(moves)
    else:
        model.jnt_axis[joint] = axis if moves else 0.0
