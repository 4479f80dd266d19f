"""The machine that extensions are placed at: its model, and the sizes of its motion, from which their priors come."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import mujoco
import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.envs.internal.elastic import motor_side
from sipe_bayes.envs.kinds.tendons import tendon_arms
from sipe_bayes.envs.laws.base import SINGLE
from sipe_bayes.envs.laws.bound import driven_joint
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.likelihood import BoundLikelihood


@dataclass(frozen=True)
class Sizes:
    """The sizes of a motion at a site, in SI (rad and N m of a hinge); nan of what it does not have.

    Args:
        position: root-mean-square of a joint's, spread of a tendon's length or of what a channel measures.
        velocity: root-mean-square, of an actuator that of the joint that it drives.
        force: the largest of what drives, carries and accelerates a joint, or of that of its joints along a tendon;
            root-mean-square of an actuator's, of several the largest.
        inertia, command: that a joint moves; the largest.
        length, least: a tendon's mean, and the smallest that it may have: -inf of sums of joints' positions.
        dt, step: shortest time between samples, and that of the physics.
    """

    position: float = math.nan
    velocity: float = math.nan
    force: float = math.nan
    inertia: float = math.nan
    command: float = math.nan
    length: float = math.nan
    least: float = math.nan
    dt: float = math.nan
    step: float = math.nan

    def shortest(self, share: float, most: float) -> float:
        """A distance over which the usual force may be built up: a share of the usual one, at least what a step can."""
        return min(max(share * self.position, self.force * self.step**2 / self.inertia), most / 2)


@dataclass(frozen=True)
class BodySizes:
    """Of a body that moves, in kg and m: its centre of mass (3,) in its own frame, and radii of gyration about that.

    ``reach`` is the one about the nearest joint that turns it; along the axes ``turned`` (3,) of the frame it matters
    where the centre lies: all but those that every joint turns it about.
    """

    mass: float
    centre: tuple[float, ...]
    gyration: float
    reach: float
    turned: tuple[bool, ...]


@dataclass(frozen=True)
class Machine:
    """An environment, the user's model, with the sizes of its motion along the logs, by name.

    ``forces`` are root-mean-squares of commanded actuators, ``commands`` their largest, ``channels`` the spreads of
    measurements; ``dt`` is the shortest time between samples, in seconds.
    """

    environment: MjcfEnvironment
    joints: dict[str, Sizes]
    tendons: dict[str, Sizes]
    forces: dict[str, float]
    commands: dict[str, float]
    channels: dict[str, float]
    logs: tuple[str, ...]
    dt: float

    @property
    def timestep(self) -> float:
        """Seconds of a physics step."""
        return float(self.model.opt.timestep)

    @cached_property
    def model(self) -> mujoco.MjModel:
        """The environment's model, as it is compiled; not to be written to."""
        return self.environment.compile()

    @cached_property
    def bodies(self) -> dict[str, BodySizes]:
        """Bodies with a name and a mass that joints move."""
        model, sizes = self.model, {}
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        for index in range(1, model.nbody):
            mass, name, centre = float(model.body_mass[index]), str(model.body(index).name), model.body_ipos[index]
            if name and mass > 0 and model.body_weldid[index]:
                gyration, (lever, turned) = (
                    float(np.sqrt(model.body_inertia[index].max() / mass)),
                    _turning(data, index),
                )
                sizes[name] = BodySizes(
                    mass, tuple(centre.tolist()), gyration, float(np.hypot(gyration, lever)), turned
                )
        return sizes

    @cached_property
    def alike(self) -> tuple[tuple[str, ...], ...]:
        """Commanded actuators of one make: alike in all but where they pull and which way."""
        model, makes = self.model, dict[tuple[float, ...], list[str]]()
        types, limits = ("trntype", "dyntype", "gaintype", "biastype"), ("ctrlrange", "forcerange")
        kinds = (*types, "gainprm", "biasprm", "dynprm", *limits)
        for name in self.environment.actuators:
            k = model.actuator(name).id
            joint = driven_joint(model, k)
            own = (np.ravel(getattr(model, f"actuator_{kind}")[k]) for kind in kinds)
            moved = int(model.jnt_type[joint]) if joint >= 0 else -1
            numbers = np.concatenate([[moved, np.linalg.norm(model.actuator_gear[k])], *own])
            makes.setdefault(tuple(np.round(numbers, 9).tolist()), []).append(name)
        return tuple(tuple(names) for names in makes.values() if len(names) > 1)

    def is_hinge(self, joint: str) -> bool:
        """Whether it turns."""
        return int(self.model.joint(joint).type[0]) == SINGLE[0]

    def joint_of(self, actuator: str) -> str | None:
        """The hinge or slide joint that an actuator drives by itself."""
        model = self.model
        joint = driven_joint(model, model.actuator(actuator).id)
        return str(model.joint(joint).name) if joint >= 0 and model.joint(joint).name in self.joints else None

    def is_position(self, actuator: str) -> bool:
        """Whether its command is a set-point: its force falls with the position or the velocity."""
        index = self.model.actuator(actuator).id
        return bool((self.model.actuator_biasprm[index, 1:3] != 0).any())

    def written(self) -> frozenset[str]:
        """Targets that the user's parameters write."""
        return frozenset(t for p in self.environment.parameters for t in p.targets)


def machine_of(windows: BoundLikelihood, theta: FloatArray, starts: FloatArray) -> Machine:
    """The machine as it moves along the logs at an estimate theta (N,), from starts (W, D).

    Raises:
        ValueError: for an environment that is no ``MjcfEnvironment``.
    """
    environment = windows.simulator.environment
    if not isinstance(environment, MjcfEnvironment):
        raise ValueError("simulator: structures are looked for in a user's MJCF; give a Simulator of one")
    model = windows.simulator.written(theta)
    states, controls = _motion(windows, theta, starts)
    along = _along(model, states, controls)
    pulls, inertias = np.sqrt((along["force"] ** 2).mean(0)), along["inertia"].mean(0)
    commands = {a: float(np.abs(windows.actions[..., k]).max()) for k, a in enumerate(environment.actuators)}
    joints = {}
    for joint in range(model.njnt):
        if int(model.jnt_type[joint]) in SINGLE and model.joint(joint).name:
            dof, address = int(model.jnt_dofadr[joint]), int(model.jnt_qposadr[joint])
            sizes = _rms(states[:, 1 + address]), _rms(states[:, 1 + model.nq + dof]), pulls[dof], inertias[dof]
            joints[str(model.joint(joint).name)] = Sizes(*(max(float(s), 1e-9) for s in sizes))
    forces = {a: max(_rms(along["driving"][:, model.actuator(a).id]), 1e-9) for a in environment.actuators}
    spread = np.maximum(np.nanstd(windows.trajectories.observations, axis=(0, 1)), 1e-9)
    channels = dict(zip(environment.channels, spread.tolist(), strict=True))
    names, tendons = tuple(str(name) for name in windows.trajectories.names), _tendons(model, along, pulls)
    return Machine(environment, joints, tendons, forces, commands, channels, names, float(windows.dt.min()))


def _turning(data: mujoco.MjData, body: int) -> tuple[float, tuple[bool, ...]]:
    """How far a body's centre of mass lies from the nearest joint that turns it, 0 where none does; and ``turned``."""
    model, axes, levers, turned = data.model, data.xmat[body].reshape(3, 3), list[float](), np.zeros(3, bool)
    above = body
    while above:
        first = int(model.body_jntadr[above])
        for joint in reversed(range(first, first + int(model.body_jntnum[above]))):
            kind, apart = int(model.jnt_type[joint]), data.xipos[body] - data.xanchor[joint]
            if kind == mujoco.mjtJoint.mjJNT_HINGE:
                levers.append(float(np.linalg.norm(np.cross(data.xaxis[joint], apart))))
                turned |= np.abs(axes.T @ data.xaxis[joint]) < 1 - 1e-6
            elif kind != mujoco.mjtJoint.mjJNT_SLIDE:
                levers += [float(np.linalg.norm(apart))] * (kind == mujoco.mjtJoint.mjJNT_BALL)
                turned[:] = True
        above = int(model.body_parentid[above])
    return next(iter(levers), 0.0), tuple(turned.tolist())


def _motion(windows: BoundLikelihood, theta: FloatArray, starts: FloatArray) -> tuple[FloatArray, FloatArray]:
    """States (n, S) and controls (n, U) spread over the windows."""
    simulator, begin = windows.simulator, windows.states(theta[None], starts[None])[0]
    run = simulator.rollout(theta[None], windows.actions, begin, windows.dt, windows.names)
    assert run.states is not None
    states = run.states[:, :-1].reshape(-1, run.states.shape[-1])
    controls = simulator.environment.control(simulator.model, states, windows.actions.reshape(len(states), -1))
    inside = (np.arange(windows.actions.shape[1]) < windows.steps[:, None]).ravel() & np.isfinite(states).all(1)
    rows = np.flatnonzero(inside)
    rows = rows[np.linspace(0, len(rows) - 1, min(400, len(rows))).astype(int)]
    return states[rows], controls[rows]


def _along(model: mujoco.MjModel, states: FloatArray, controls: FloatArray) -> dict[str, FloatArray]:
    """By name, of states (n, S) with controls (n, U): actuators' forces (n, nu), dofs' inertias and forces (n, nv).

    Those are the largest of what drives, carries and accelerates a dof. And tendons' lengths, velocities, and arms.
    """
    data, inertia, rows = mujoco.MjData(model), np.zeros((model.nv, model.nv)), []
    for state, control in zip(states, controls, strict=True):
        mujoco.mj_setState(model, data, np.ascontiguousarray(state), mujoco.mjtState.mjSTATE_FULLPHYSICS)
        data.ctrl[:] = control
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, inertia)
        forces = np.abs([data.qfrc_actuator, data.qfrc_bias, inertia @ data.qacc]).max(0)
        tendons = data.ten_length.copy(), data.ten_velocity.copy(), np.abs(tendon_arms(model, data))
        rows.append((data.actuator_force.copy(), np.diag(inertia).copy(), forces, *tendons))
    names = ("driving", "inertia", "force", "length", "velocity", "arms")
    return {name: np.array(column) for name, column in zip(names, zip(*rows, strict=True), strict=True)}


def _tendons(model: mujoco.MjModel, along: dict[str, FloatArray], forces: FloatArray) -> dict[str, Sizes]:
    """Of the tendons that move, beside sizes of the dofs' forces (nv,)."""
    sizes, gears = {}, {motor_side(model, model.joint(joint).name) for joint in range(model.njnt)}
    for tendon in set(range(model.ntendon)) - gears:  # the motor's side of a joint is that joint's
        length, velocity, arms = along["length"][:, tendon], along["velocity"][:, tendon], along["arms"][:, tendon]
        pull, square = arms @ forces, (arms**2).sum(1)
        if model.tendon(tendon).name and length.std() > 0 and square.mean() > 0:
            by_joints = int(model.wrap_type[model.tendon_adr[tendon]]) == int(mujoco.mjtWrap.mjWRAP_JOINT)
            least, force = -np.inf if by_joints else 0.0, max(float(pull.mean() / square.mean()), 1e-9)
            moving = Sizes(float(length.std()), max(_rms(velocity), 1e-9), force)
            sizes[str(model.tendon(tendon).name)] = replace(moving, length=float(length.mean()), least=least)
    return sizes


def _rms(x: FloatArray) -> float:
    return float(np.sqrt((x**2).mean()))
