"""What of a compiled model a log may hold: hinges and slides, actuators, free bodies, inertial sensors."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import mujoco
import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.envs.kinds.tendons import tendon_arms
from sipe_bayes.envs.laws.bound import is_of_law

_GRAVITY, _BRISK = 9.81, 10.0  # m/s^2, rad/s^2 or m/s^2: motions of unknown machines
_NO_MASS = 0.01  # of all that a body carries


class Drive(Enum):
    """What an actuator is given."""

    FORCE = "a torque or force"
    POSITION = "a set-point of the position"
    VELOCITY = "a set-point of the velocity"
    VOLTAGE = "a voltage"
    OTHER = "a command"


_INPUTS = {
    int(mujoco.mjtCtrlInput.mjINPUT_POS): Drive.POSITION,
    int(mujoco.mjtCtrlInput.mjINPUT_VEL): Drive.VELOCITY,
    int(mujoco.mjtCtrlInput.mjINPUT_VOLTAGE): Drive.VOLTAGE,
}


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
        """Read a compiled model."""
        scalar = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
        named = [i for i in range(model.njnt) if int(model.jnt_type[i]) in scalar and model.joint(i).name]
        of_base = base_joints(model)
        joints = [
            Joint(
                model.joint(i).name,
                model.body(int(model.jnt_bodyid[i])).name,
                int(model.jnt_type[i]) == scalar[0],
                k,
                i in of_base,
                (float(model.jnt_range[i, 0]), float(model.jnt_range[i, 1])) if model.jnt_limited[i] else None,
            )
            for k, i in enumerate(named)
        ]
        by_id = dict(zip(named, joints, strict=True))
        actuators = [
            Actuator(
                model.actuator(i).name,
                drive_of(model, i),
                by_id.get(_joint_of(model, i)),
                k,
                full_of(model, i),
                _limits_of(model, i),
                int(model.actuator_trntype[i]) == int(mujoco.mjtTrn.mjTRN_TENDON),
                _is_thrust(model, i),
                _is_thrust(model, i) and _is_free(model, i),
            )
            for k, i in enumerate(_commanded(model))
        ]
        free = [i for i in range(model.njnt) if int(model.jnt_type[i]) not in scalar]
        bodies = [model.body(int(model.jnt_bodyid[i])).name for i in free]
        kinds = {int(mujoco.mjtSensor.mjSENS_GYRO): "gyro", int(mujoco.mjtSensor.mjSENS_ACCELEROMETER): "accelerometer"}
        sensors = [(model.sensor(i).name, kinds.get(int(model.sensor_type[i]), "")) for i in range(model.nsensor)]
        return cls(tuple(joints), tuple(actuators), tuple(b for b in bodies if b), tuple(s for s in sensors if s[1]))


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
        data = mujoco.MjData(model)
        forces, speeds, inertias = [], [], []
        rows = 1 if states is None else len(states)
        for k in range(rows):
            if states is not None:
                data.qpos[:] = states[k, 1 : 1 + model.nq]
                data.qvel[:] = states[k, 1 + model.nq : 1 + model.nq + model.nv]
            if controls is not None:
                data.ctrl[:] = controls[k]
            mujoco.mj_forward(model, data)
            full = np.zeros((model.nv, model.nv))
            mujoco.mj_fullM(model, data, full)
            inertia = np.diag(full).copy()
            speed = np.abs(data.qvel.copy())
            moving = _BRISK * inertia if states is None else np.zeros(model.nv)
            gravity = np.abs(data.qfrc_bias) + (0.5 * _GRAVITY * np.sqrt(inertia) if states is None else 0.0)
            arms = tendon_arms(model, data)
            carried = _carried(full, arms)
            pulls = _pulls(model, data) + (_BRISK * carried if states is None else 0.0)
            forces.append([*(np.abs(data.qfrc_actuator) + gravity + moving), *pulls])
            usual = np.full(model.nv, 3.0)
            speeds.append(
                [*speed, *np.abs(arms @ data.qvel)] if states is not None else [*usual, *np.abs(arms) @ usual]
            )
            inertias.append([*inertia, *carried])
        force, speed = np.quantile(forces, 0.9, axis=0), np.quantile(speeds, 0.9, axis=0)
        inertia = np.mean(inertias, axis=0)
        at = {joint.name: int(model.joint(joint.name).dofadr[0]) for joint in machine.joints}
        moved = [t for t in range(model.ntendon) if inertia[model.nv + t] > 0]
        at |= {f"tendon:{model.tendon(t).name}": model.nv + t for t in moved}

        def by_name(values: FloatArray, least: float) -> dict[str, float]:
            return {name: max(float(values[i]), least) for name, i in at.items()}

        return cls(by_name(force, 1e-9), by_name(speed, 1e-3), by_name(inertia, 1e-12))


def base_joints(model: mujoco.MjModel) -> dict[int, int]:
    """Slides and hinges that stand for a planar or free base, each with the id of the base's body.

    These are the joints between the world and the first body with a mass, two slides at least, of which nothing drives,
    sprung or rubs in the model, where actuators move joints of what it carries.
    """
    driven = {_joint_of(model, i) for i in range(model.nu)}
    out: dict[int, int] = {}
    for body in range(1, model.nbody):
        above = _above(model, body)
        if any(_has_mass(model, b) for b in above) or not _has_mass(model, body):
            continue
        joints = [j for j in range(model.njnt) if int(model.jnt_bodyid[j]) in (body, *above)]
        slides = sum(int(model.jnt_type[j]) == int(mujoco.mjtJoint.mjJNT_SLIDE) for j in joints)
        held = any(j in driven or _resists(model, j) for j in joints)
        if slides >= 2 and not held and _carries_motors(model, body):
            out |= dict.fromkeys(joints, body)
    return out


def bases(model: mujoco.MjModel) -> set[int]:
    """Ids of the bodies that nothing holds and that carry what actuators move: of rovers, walkers, drones with arms."""
    free = [j for j in range(model.njnt) if int(model.jnt_type[j]) == int(mujoco.mjtJoint.mjJNT_FREE)]
    loose = {int(model.jnt_bodyid[j]) for j in free}
    return {body for body in loose if _carries_motors(model, body)} | set(base_joints(model).values())


def _carries_motors(model: mujoco.MjModel, body: int) -> bool:
    moved = (_joint_of(model, i) for i in range(model.nu))
    return any(body in _above(model, int(model.jnt_bodyid[j])) for j in moved if j >= 0)


def _above(model: mujoco.MjModel, body: int) -> list[int]:
    """The bodies that carry a body, without the world."""
    out, parent = list[int](), int(model.body_parentid[body])
    while parent:
        out.append(parent)
        parent = int(model.body_parentid[parent])
    return out


def _has_mass(model: mujoco.MjModel, body: int) -> bool:
    """Whether it weighs more than what bodies get that only hold joints apart."""
    return float(model.body_mass[body]) > _NO_MASS * float(model.body_subtreemass[body])


def _resists(model: mujoco.MjModel, joint: int) -> bool:
    dof = int(model.jnt_dofadr[joint])
    fields = (model.dof_damping, model.dof_frictionloss, model.dof_armature)
    return bool(model.jnt_stiffness[joint]) or any(bool(field[dof]) for field in fields)


def _carried(inertia: FloatArray, arms: FloatArray) -> FloatArray:
    """What each tendon moves as a mass at its end, of joints' inertia (nv, nv); 0 of those that nothing moves."""
    yielding = np.einsum("tv,vt->t", arms, np.linalg.solve(inertia, arms.T)) if len(arms) else np.zeros(0)
    return np.divide(1.0, yielding, out=np.zeros(len(arms)), where=yielding > 0)


def _pulls(model: mujoco.MjModel, data: mujoco.MjData) -> FloatArray:
    """What actuators and its own spring pull at each tendon (ntendon,), as sizes."""
    pulls = model.tendon_stiffness * np.abs(data.ten_length - np.clip(data.ten_length, *model.tendon_lengthspring.T))
    at = model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_TENDON)
    np.add.at(pulls, model.actuator_trnid[at, 0], np.abs(data.actuator_force * model.actuator_gear[:, 0])[at])
    return np.asarray(pulls)


def _commanded(model: mujoco.MjModel) -> list[int]:
    """Actuators with a name, of no law."""
    names = [model.actuator(i).name for i in range(model.nu)]
    return [i for i, name in enumerate(names) if name and not is_of_law(name)]


def _is_thrust(model: mujoco.MjModel, index: int) -> bool:
    """Whether an actuator pushes a body at a site of it, in no other site's axes."""
    if int(model.actuator_trntype[index]) != int(mujoco.mjtTrn.mjTRN_SITE) or model.actuator_trnid[index, 1] >= 0:
        return False
    return bool(model.actuator_gear[index, :3].any())


def _is_free(model: mujoco.MjModel, index: int) -> bool:
    """Whether the body of an actuator's site moves freely."""
    body = int(model.body_weldid[model.site_bodyid[model.actuator_trnid[index, 0]]])
    joint = int(model.body_jntadr[body])
    return joint >= 0 and int(model.jnt_type[joint]) == int(mujoco.mjtJoint.mjJNT_FREE)


def drive_of(model: mujoco.MjModel, index: int) -> Drive:
    """What an actuator of a compiled model is given."""
    kind, inputs = int(model.actuator_gaintype[index]), int(model.actuator_ctrlspec[index])
    if kind in (int(mujoco.mjtGain.mjGAIN_DCMOTOR), int(mujoco.mjtGain.mjGAIN_PID)):
        return _INPUTS.get(inputs, Drive.OTHER)
    if int(model.actuator_gaintype[index]) != int(mujoco.mjtGain.mjGAIN_FIXED):
        return Drive.OTHER
    if int(model.actuator_biastype[index]) == int(mujoco.mjtBias.mjBIAS_NONE):
        return Drive.FORCE
    gain, (_, of_position, of_velocity) = float(model.actuator_gainprm[index, 0]), model.actuator_biasprm[index, :3]
    if int(model.actuator_dyntype[index]) == int(mujoco.mjtDyn.mjDYN_INTEGRATOR):  # <intvelocity>
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


def _limits_of(model: mujoco.MjModel, index: int) -> tuple[float, float] | None:
    low, high = model.actuator_ctrlrange[index].tolist()
    return (low, high) if model.actuator_ctrllimited[index] else None


def _joint_of(model: mujoco.MjModel, index: int) -> int:
    """The joint that an actuator moves, itself or by its tendon's first; -1 for none, and for tendons through sites."""
    kind, at = int(model.actuator_trntype[index]), int(model.actuator_trnid[index, 0])
    if kind == int(mujoco.mjtTrn.mjTRN_TENDON):
        first = model.tendon_adr[at]
        by_joints = int(model.wrap_type[first]) == int(mujoco.mjtWrap.mjWRAP_JOINT)
        return int(model.wrap_objid[first]) if by_joints else -1
    return at if kind in (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)) else -1


def top_of(model: mujoco.MjModel, geom: int, tops: set[int]) -> int:
    """The free body that a geom moves with; 0 for none."""
    body, top = int(model.geom_bodyid[geom]), 0
    while body:
        top, body = (body if body in tops else top), int(model.body_parentid[body])
    return top


def touched_by(model: mujoco.MjModel, geom: int) -> list[int]:
    """The geoms that stand still and that a geom may touch."""
    kinds, with_kinds = model.geom_contype, model.geom_conaffinity
    meets = (kinds[geom] & with_kinds) | (kinds & with_kinds[geom])
    return [g for g in range(model.ngeom) if meets[g] and int(model.body_weldid[model.geom_bodyid[g]]) == 0]


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
