"""What of a compiled model a log may hold: hinges and slides, actuators, free bodies, inertial sensors."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import mujoco
import numpy as np
from mujoco import mjtJoint, mjtTrn

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.envs.kinds.tendons import tendon_arms
from sipe_bayes.envs.laws.bound import is_of_law

_BRISK = 10.0  # rad/s^2 or m/s^2: of motions that are not known
_SCALAR = (int(mjtJoint.mjJNT_HINGE), int(mjtJoint.mjJNT_SLIDE))


class Drive(Enum):
    """What an actuator is given."""

    FORCE = "a torque or force"
    POSITION = "a set-point of the position"
    VELOCITY = "a set-point of the velocity"
    VOLTAGE = "a voltage"
    OTHER = "a command"


@dataclass(frozen=True)
class Joint:
    """A hinge or slide and its body; rank: its place among these; base: whether it only says where an undriven base is.

    Such a joint has no bearing and no gears: see ``base_joints``. reach: its range, rad or m; None where it has none.
    """

    name: str
    body: str
    hinge: bool
    rank: int
    base: bool = False
    reach: tuple[float, float] | None = None


@dataclass(frozen=True)
class Actuator:
    """An actuator with one control, what it is given, and the joint that it moves; full: what a whole duty stands for.

    That is the end of its ctrlrange, which begins at zero or as far below; None where it has no such range.
    limits: its ctrlrange, to which commands are clipped; None where it has none. tendon: whether it pulls a tendon,
    the first of whose joints is its joint where these make it up. thrust: whether it pushes at a site; flies: whether
    what it pushes moves freely.
    """

    name: str
    drive: Drive
    joint: Joint | None
    rank: int
    full: float | None = None
    limits: tuple[float, float] | None = None
    tendon: bool = False
    thrust: bool = False
    flies: bool = False

    @property
    def turns(self) -> bool:
        """Whether it moves something about an axis, else along a line."""
        return not (self.tendon or self.thrust) if self.joint is None else self.joint.hinge

    @property
    def one_way(self) -> bool:
        """Whether its ctrlrange lies on one side of zero, so that a command of the other sign does nothing."""
        return self.limits is not None and self.limits[0] * self.limits[1] >= 0


@dataclass(frozen=True)
class Machine:
    """What of a model a log may hold."""

    joints: tuple[Joint, ...]
    actuators: tuple[Actuator, ...]
    bodies: tuple[str, ...]  # that move freely
    sensors: tuple[tuple[str, str], ...]  # name and quantity of those of three numbers

    @property
    def flies(self) -> bool:
        """Whether thrust moves what is free."""
        return any(actuator.flies for actuator in self.actuators)

    @classmethod
    def of(cls, model: mujoco.MjModel) -> Machine:
        """Read a compiled model: its hinges and slides with a name, and its actuators with a name that are no law's."""
        owners = [model.body(int(body)).name for body in model.jnt_bodyid]
        named = [j for j in range(model.njnt) if model.jnt_type[j] in _SCALAR and model.joint(j).name]
        of_base, joints = base_joints(model), dict[int, Joint]()
        for rank, j in enumerate(named):
            reach = (float(model.jnt_range[j, 0]), float(model.jnt_range[j, 1])) if model.jnt_limited[j] else None
            hinge = bool(model.jnt_type[j] == mjtJoint.mjJNT_HINGE)
            joints[j] = Joint(model.joint(j).name, owners[j], hinge, rank, j in of_base, reach)
        driving = [i for i in range(model.nu) if (name := model.actuator(i).name) and not is_of_law(name)]
        actuators = []
        for rank, i in enumerate(driving):
            low, high = model.actuator_ctrlrange[i].tolist()
            limits = (low, high) if model.actuator_ctrllimited[i] else None
            tendon, thrust = bool(model.actuator_trntype[i] == mjtTrn.mjTRN_TENDON), _is_thrust(model, i)
            owner = int(model.body_weldid[model.site_bodyid[model.actuator_trnid[i, 0]]]) if thrust else 0
            first = int(model.body_jntadr[owner])
            flies = thrust and first >= 0 and bool(model.jnt_type[first] == mjtJoint.mjJNT_FREE)
            moved, drive = joints.get(_joint_of(model, i)), drive_of(model, i)
            parts = (full_of(model, i), limits, tendon, thrust, flies)
            actuators.append(Actuator(model.actuator(i).name, drive, moved, rank, *parts))
        bodies = [owners[j] for j in range(model.njnt) if model.jnt_type[j] not in _SCALAR and owners[j]]
        kinds = {int(mujoco.mjtSensor.mjSENS_GYRO): "gyro", int(mujoco.mjtSensor.mjSENS_ACCELEROMETER): "accelerometer"}
        sensors = [(model.sensor(i).name, kinds.get(int(model.sensor_type[i]), "")) for i in range(model.nsensor)]
        return cls(tuple(joints.values()), tuple(actuators), tuple(bodies), tuple(s for s in sensors if s[1]))


@dataclass(frozen=True)
class Sizes:
    """Of each joint by name: force or torque, speed and inertia that are usual in the logs, in SI.

    Of each tendon that moves as ``tendon:NAME``, along its length.
    """

    force: dict[str, float]
    speed: dict[str, float]
    inertia: dict[str, float]

    @classmethod
    def of(
        cls, model: mujoco.MjModel, machine: Machine, states: FloatArray | None, controls: FloatArray | None
    ) -> Sizes:
        """Read from states (n, S) and controls (n, nu) of the logs; from the model alone where there are none."""
        data, full = mujoco.MjData(model), np.zeros((model.nv, model.nv))
        forces, speeds, inertias = [], [], []
        for k in range(1 if states is None else len(states)):
            if states is not None:
                data.qpos[:], data.qvel[:] = np.split(states[k, 1 : 1 + model.nq + model.nv], [model.nq])
            if controls is not None:
                data.ctrl[:] = controls[k]
            mujoco.mj_forward(model, data)
            mujoco.mj_fullM(model, data, full)
            arms, inertia = tendon_arms(model, data), np.diag(full)
            yielding = np.einsum("tv,vt->t", arms, np.linalg.solve(full, arms.T)) if len(arms) else np.zeros(0)
            carried = np.divide(1.0, yielding, out=np.zeros(len(arms)), where=yielding > 0)  # at the tendon's end
            inertias.append([*inertia, *carried])
            velocity = np.full(model.nv, 3.0) if states is None else data.qvel
            speeds.append(np.abs([*velocity, *((np.abs(arms) if states is None else arms) @ velocity)]))
            force = np.abs([*data.qfrc_actuator, *_pulls(model, data)])
            force[: model.nv] += np.abs(data.qfrc_bias)
            if states is None:
                force[: model.nv] += 0.5 * 9.81 * np.sqrt(inertia)
                force += _BRISK * np.array(inertias[-1])
            forces.append(force)
        sizes = np.quantile(forces, 0.9, axis=0), np.quantile(speeds, 0.9, axis=0), np.mean(inertias, axis=0)
        at = {joint.name: int(model.joint(joint.name).dofadr[0]) for joint in machine.joints}
        moved = [t for t in range(model.ntendon) if sizes[2][model.nv + t] > 0]
        at |= {f"tendon:{model.tendon(t).name}": model.nv + t for t in moved}
        least = zip(sizes, (1e-9, 1e-3, 1e-12), strict=True)
        return cls(*({name: max(float(values[i]), low) for name, i in at.items()} for values, low in least))


def _pulls(model: mujoco.MjModel, data: mujoco.MjData) -> FloatArray:
    """What actuators and its own spring pull at each tendon (ntendon,), as sizes."""
    pulls = model.tendon_stiffness * np.abs(data.ten_length - np.clip(data.ten_length, *model.tendon_lengthspring.T))
    at = model.actuator_trntype == mjtTrn.mjTRN_TENDON
    np.add.at(pulls, model.actuator_trnid[at, 0], np.abs(data.actuator_force * model.actuator_gear[:, 0])[at])
    return np.asarray(pulls)


def base_joints(model: mujoco.MjModel) -> dict[int, int]:
    """Slides and hinges that stand for a planar or free base, each with the id of the base's body.

    These are the joints between the world and the first body with a mass, two slides at least, of which nothing drives,
    sprung or rubs in the model, where actuators move joints of what it carries.
    """
    driven = {_joint_of(model, i) for i in range(model.nu)}
    weighs = model.body_mass > 0.01 * model.body_subtreemass  # unlike what bodies get that only hold joints apart
    dof = model.jnt_dofadr
    resists = model.jnt_stiffness + model.dof_damping[dof] + model.dof_frictionloss[dof] + model.dof_armature[dof] > 0
    out: dict[int, int] = {}
    for body in range(1, model.nbody):
        above = _above(model, body)
        joints = [j for j in range(model.njnt) if model.jnt_bodyid[j] in (body, *above)]
        first = weighs[body] and not weighs[above].any()
        held = any(j in driven or resists[j] for j in joints)
        slides = int(np.sum(model.jnt_type[joints] == mjtJoint.mjJNT_SLIDE))
        if first and slides >= 2 and not held and _carries_motors(model, body):
            out |= dict.fromkeys(joints, body)
    return out


def bases(model: mujoco.MjModel) -> set[int]:
    """Ids of the bodies that nothing holds and that carry what actuators move: of rovers, walkers, drones with arms."""
    loose = {int(body) for body in model.jnt_bodyid[model.jnt_type == mjtJoint.mjJNT_FREE]}
    return {body for body in loose if _carries_motors(model, body)} | set(base_joints(model).values())


def _carries_motors(model: mujoco.MjModel, body: int) -> bool:
    moved = (_joint_of(model, i) for i in range(model.nu))
    return any(body in _above(model, int(model.jnt_bodyid[j])) for j in moved if j >= 0)


def _above(model: mujoco.MjModel, body: int) -> list[int]:
    """The bodies that carry a body, without the world."""
    parent = int(model.body_parentid[body])
    return [parent, *_above(model, parent)] if parent else []


def _is_thrust(model: mujoco.MjModel, index: int) -> bool:
    """Whether an actuator pushes a body at a site of it, in no other site's axes."""
    at_site = model.actuator_trntype[index] == mjtTrn.mjTRN_SITE and model.actuator_trnid[index, 1] < 0
    return bool(at_site and model.actuator_gear[index, :3].any())


def drive_of(model: mujoco.MjModel, index: int) -> Drive:
    """What an actuator of a compiled model is given."""
    kind, inputs = int(model.actuator_gaintype[index]), mujoco.mjtCtrlInput
    if kind in (mujoco.mjtGain.mjGAIN_DCMOTOR, mujoco.mjtGain.mjGAIN_PID):
        given = {int(inputs.mjINPUT_POS): Drive.POSITION, int(inputs.mjINPUT_VEL): Drive.VELOCITY}
        given[int(inputs.mjINPUT_VOLTAGE)] = Drive.VOLTAGE
        return given.get(int(model.actuator_ctrlspec[index]), Drive.OTHER)
    if kind != mujoco.mjtGain.mjGAIN_FIXED:
        return Drive.OTHER
    if model.actuator_biastype[index] == mujoco.mjtBias.mjBIAS_NONE:
        return Drive.FORCE
    gain, (_, of_position, of_velocity) = float(model.actuator_gainprm[index, 0]), model.actuator_biasprm[index, :3]
    if model.actuator_dyntype[index] == mujoco.mjtDyn.mjDYN_INTEGRATOR:  # <intvelocity>
        return Drive.VELOCITY if of_position else Drive.OTHER
    if of_position:
        return Drive.POSITION
    if not of_velocity:
        return Drive.FORCE
    return Drive.VELOCITY if np.isclose(gain, -of_velocity) else Drive.VOLTAGE


def full_of(model: mujoco.MjModel, index: int) -> float | None:
    """The end of a ctrlrange that begins at zero or as far below it; None where an actuator has no such range."""
    low, high = model.actuator_ctrlrange[index].tolist()
    even = bool(model.actuator_ctrllimited[index]) and high > 0 and low in (0.0, -high)
    return float(high) if even else None


def _joint_of(model: mujoco.MjModel, index: int) -> int:
    """The joint that an actuator moves, itself or by its tendon's first; -1 for none, and for tendons through sites."""
    kind, at = int(model.actuator_trntype[index]), int(model.actuator_trnid[index, 0])
    if kind == mjtTrn.mjTRN_TENDON:
        first = model.tendon_adr[at]
        return int(model.wrap_objid[first]) if model.wrap_type[first] == mujoco.mjtWrap.mjWRAP_JOINT else -1
    return at if kind in (mjtTrn.mjTRN_JOINT, mjtTrn.mjTRN_JOINTINPARENT) else -1


def top_of(model: mujoco.MjModel, geom: int, tops: set[int]) -> int:
    """The free body that a geom moves with; 0 for none."""
    body = int(model.geom_bodyid[geom])
    return next((one for one in reversed([body, *_above(model, body)]) if one in tops), 0)


def touched_by(model: mujoco.MjModel, geom: int) -> list[int]:
    """The geoms that stand still and that a geom may touch."""
    kinds, with_kinds = model.geom_contype, model.geom_conaffinity
    meets = (kinds[geom] & with_kinds) | (kinds & with_kinds[geom])
    return np.flatnonzero((meets != 0) & (model.body_weldid[model.geom_bodyid] == 0)).tolist()


def touching_bodies(model: mujoco.MjModel, states: FloatArray) -> set[int]:
    """Ids of the bodies that touch what stands still in states (n, S)."""
    data, out = mujoco.MjData(model), set[int]()
    for state in states:
        data.qpos[:] = state[1 : 1 + model.nq]
        mujoco.mj_fwdPosition(model, data)
        bodies = model.geom_bodyid[data.contact.geom]  # (C, 2)
        still = model.body_weldid[bodies] == 0
        out |= set(bodies[~still & still[:, ::-1]].tolist())
    return out


def own_friction(model: mujoco.MjModel, geom: int) -> float:
    """A geom's sliding friction."""
    return float(model.geom_friction[geom, 0])


def counts(model: mujoco.MjModel, geom: int, other: int) -> bool:
    """Whether a geom's friction counts where it touches another one."""
    return bool(model.geom_priority[geom] >= model.geom_priority[other])


def friction_of(model: mujoco.MjModel, geom: int, other: int) -> float:
    """The sliding friction of two geoms that touch."""
    return max(own_friction(model, a) for a, b in ((geom, other), (other, geom)) if counts(model, a, b))
