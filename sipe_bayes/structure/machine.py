"""The machine that extensions are placed at: its model, and the sizes of its motion, from which their priors come."""

from __future__ import annotations

from dataclasses import dataclass
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
from sipe_bayes.simulation.simulator import Simulator

_SAMPLES = 400  # of the logs, of which forces are computed
_PARALLEL = 1e-6  # of the cosine between two axes


@dataclass(frozen=True)
class JointSizes:
    """Root-mean-squares along the logs of one joint, in SI.

    Args:
        position: rad or m.
        velocity: rad/s or m/s.
        force: N m or N, the largest of what drives, carries and accelerates it.
        inertia: kg m^2 or kg, that it moves.
    """

    position: float
    velocity: float
    force: float
    inertia: float


@dataclass(frozen=True)
class TendonSizes:
    """Along the logs of one tendon that moves, in m and N (in rad and N m where it is made up of hinges' angles).

    Args:
        length: its mean.
        stretch: the standard deviation of its length.
        velocity: root-mean-square.
        force: that the forces of the joints that it moves amount to along it.
        least: the smallest length that it may have; -inf of sums of joints' positions.
    """

    length: float
    stretch: float
    velocity: float
    force: float
    least: float


@dataclass(frozen=True)
class BodySizes:
    """Of one body that moves, as the model has it, in SI.

    Args:
        mass: kg.
        centre: x, y and z of the centre of mass in the body's frame, in m.
        gyration: radius of gyration about it, in m.
        reach: radius of gyration about the nearest joint that turns it, in m; ``gyration`` where none does.
        turned: the axes of the body's frame along which it matters where the centre lies: all but those that every
            joint turns it about.
    """

    mass: float
    centre: tuple[float, float, float]
    gyration: float
    reach: float
    turned: tuple[bool, bool, bool]


@dataclass(frozen=True)
class Machine:
    """An environment with the sizes of its motion along the logs.

    Args:
        environment: the user's model.
        joints: of each hinge and slide joint.
        tendons: of each that joints move.
        forces: root-mean-square of each commanded actuator's force.
        commands: largest size of each command.
        channels: spread of each measured channel.
        logs: names of the logs.
        dt: shortest time between samples, in seconds.
    """

    environment: MjcfEnvironment
    joints: dict[str, JointSizes]
    tendons: dict[str, TendonSizes]
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
            mass, name = float(model.body_mass[index]), str(model.body(index).name)
            if name and mass > 0 and model.body_weldid[index]:
                x, y, z = (float(place) for place in model.body_ipos[index])
                gyration = float(np.sqrt(model.body_inertia[index].max() / mass))
                reach = float(np.hypot(gyration, _lever(model, data, index)))
                sizes[name] = BodySizes(mass, (x, y, z), gyration, reach, _turned(model, data, index))
        return sizes

    @cached_property
    def alike(self) -> tuple[tuple[str, ...], ...]:
        """Commanded actuators of one make: alike in all but where they pull and which way."""
        model, makes = self.model, dict[tuple[float, ...], list[str]]()
        for name in self.environment.actuators:
            k = model.actuator(name).id
            joint = driven_joint(model, k)
            moved = int(model.jnt_type[joint]) if joint >= 0 else -1
            kinds = (moved, model.actuator_trntype[k], model.actuator_dyntype[k], model.actuator_gaintype[k])
            sizes = (np.linalg.norm(model.actuator_gear[k]), model.actuator_biastype[k])
            own = (model.actuator_gainprm, model.actuator_biasprm, model.actuator_dynprm)
            limits = (model.actuator_ctrlrange, model.actuator_forcerange)
            numbers = np.concatenate([kinds, sizes, *(array[k] for array in (*own, *limits))])
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

    def has_added(self, body: str) -> bool:
        """Whether the user says of a log by how much a body is heavier in it."""
        return any(one.target == f"body:{body}.mass" for one in self.environment.added)


def machine_of(windows: BoundLikelihood, theta: FloatArray, starts: FloatArray) -> Machine:
    """The machine as it moves at an estimate.

    Args:
        windows: the logs, of an ``MjcfEnvironment``.
        theta: (N,).
        starts: (W, D).

    Raises:
        ValueError: for another environment.
    """
    simulator = windows.simulator
    environment = simulator.environment
    if not isinstance(environment, MjcfEnvironment):
        raise ValueError("simulator: structures are looked for in a user's MJCF; give a Simulator of one")
    model = simulator.written(theta)
    states, controls = _motion(simulator, windows, theta, starts)
    driving, own = _forces(model, states, controls)
    labels = {a: model.actuator(a).id for a in environment.actuators}
    commands = {a: float(np.abs(windows.actions[..., k]).max()) for k, a in enumerate(environment.actuators)}
    joints = {}
    for joint in range(model.njnt):
        if int(model.jnt_type[joint]) in SINGLE and model.joint(joint).name:
            dof, address = int(model.jnt_dofadr[joint]), int(model.jnt_qposadr[joint])
            inertia = float(own.inertia[dof])
            sizes = (_rms(states[:, 1 + address]), _rms(states[:, 1 + model.nq + dof]), own.size[dof], inertia)
            joints[str(model.joint(joint).name)] = JointSizes(*(max(float(s), 1e-9) for s in sizes))
    forces = {a: max(_rms(driving[:, index]), 1e-9) for a, index in labels.items()}
    spread = np.nanstd(windows.trajectories.observations, axis=(0, 1))
    channels = dict(zip(environment.channels, np.maximum(spread, 1e-9).tolist(), strict=True))
    names = tuple(str(name) for name in windows.trajectories.names)
    tendons = _tendons(model, states, own.size)
    return Machine(environment, joints, tendons, forces, commands, channels, names, float(windows.dt.min()))


def _turned(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> tuple[bool, bool, bool]:
    """Along which axes of a body's frame a place in it is moved by the joints that turn it."""
    axes, turned = data.xmat[body].reshape(3, 3), np.zeros(3, bool)
    while body:
        for joint in range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body]):
            kind = int(model.jnt_type[joint])
            if kind == mujoco.mjtJoint.mjJNT_HINGE:
                turned |= np.abs(axes.T @ data.xaxis[joint]) < 1 - _PARALLEL
            elif kind != mujoco.mjtJoint.mjJNT_SLIDE:
                turned[:] = True
        body = int(model.body_parentid[body])
    x, y, z = turned.tolist()
    return x, y, z


def _lever(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> float:
    """How far a body's centre of mass lies from the nearest joint that turns it; 0 where none does."""
    centre = data.xipos[body]
    while body:
        first = int(model.body_jntadr[body])
        for joint in reversed(range(first, first + int(model.body_jntnum[body]))):
            kind, apart = int(model.jnt_type[joint]), centre - data.xanchor[joint]
            if kind == mujoco.mjtJoint.mjJNT_HINGE:
                return float(np.linalg.norm(np.cross(data.xaxis[joint], apart)))
            if kind == mujoco.mjtJoint.mjJNT_BALL:
                return float(np.linalg.norm(apart))
        body = int(model.body_parentid[body])
    return 0.0


@dataclass(frozen=True)
class _Own:
    """Of each dof: the size of its forces (nv,) and its inertia (nv,)."""

    size: FloatArray
    inertia: FloatArray


def _motion(
    simulator: Simulator, windows: BoundLikelihood, theta: FloatArray, starts: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """States (n, S) and controls (n, U) spread over the windows."""
    begin = windows.states(theta[None], starts[None])[0]
    run = simulator.rollout(theta[None], windows.actions, begin, windows.dt, windows.names)
    assert run.states is not None
    states = run.states[:, :-1].reshape(-1, run.states.shape[-1])
    controls = simulator.environment.control(simulator.model, states, windows.actions.reshape(len(states), -1))
    inside = (np.arange(windows.actions.shape[1]) < windows.steps[:, None]).ravel() & np.isfinite(states).all(1)
    rows = np.flatnonzero(inside)
    rows = rows[np.linspace(0, len(rows) - 1, min(_SAMPLES, len(rows))).astype(int)]
    return states[rows], controls[rows]


def _forces(model: mujoco.MjModel, states: FloatArray, controls: FloatArray) -> tuple[FloatArray, _Own]:
    """Actuator forces (n, nu) along a motion, and the dofs' sizes."""
    data, inertia = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    driving, parts, diagonals = [], [], []
    for state, control in zip(states, controls, strict=True):
        mujoco.mj_setState(model, data, np.ascontiguousarray(state), mujoco.mjtState.mjSTATE_FULLPHYSICS)
        data.ctrl[:] = control
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, inertia)
        driving.append(data.actuator_force.copy())
        diagonals.append(np.diag(inertia).copy())
        parts.append(np.abs([data.qfrc_actuator, data.qfrc_bias, inertia @ data.qacc]).max(0))
    return np.array(driving), _Own(np.sqrt((np.array(parts) ** 2).mean(0)), np.mean(diagonals, axis=0))


def _tendons(model: mujoco.MjModel, states: FloatArray, forces: FloatArray) -> dict[str, TendonSizes]:
    """Of the tendons that move, from states (n, S) and sizes of the dofs' forces (nv,)."""
    data, rows = mujoco.MjData(model), []
    for state in states if model.ntendon else ():
        mujoco.mj_setState(model, data, np.ascontiguousarray(state), mujoco.mjtState.mjSTATE_FULLPHYSICS)
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        arms = np.abs(tendon_arms(model, data))
        rows.append((data.ten_length.copy(), data.ten_velocity.copy(), arms @ forces, (arms**2).sum(1)))
    sizes, gears = {}, {motor_side(model, model.joint(joint).name) for joint in range(model.njnt)}
    for tendon in set(range(model.ntendon)) - gears:  # the motor's side of a joint is that joint's
        length, velocity, pull, square = (np.array([row[k][tendon] for row in rows]) for k in range(4))
        if model.tendon(tendon).name and length.std() > 0 and square.mean() > 0:
            force = float(pull.mean() / square.mean())
            by_joints = int(model.wrap_type[model.tendon_adr[tendon]]) == int(mujoco.mjtWrap.mjWRAP_JOINT)
            least = -np.inf if by_joints else 0.0
            sizes[str(model.tendon(tendon).name)] = TendonSizes(
                float(length.mean()), float(length.std()), max(_rms(velocity), 1e-9), max(force, 1e-9), least
            )
    return sizes


def _rms(x: FloatArray) -> float:
    return float(np.sqrt((x**2).mean()))
