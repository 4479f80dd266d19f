"""States along recorded logs: where windows start, as recorded or as the measurements tell, and moved by tangents.

A tangent is (dq (nv), dv (nv), dact (na)).
"""

from __future__ import annotations

import functools
from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import TypeAlias

import mujoco
import numpy as np

from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray
from sipe_bayes.core.rotations import bridged, inverse, product, quaternions, rotation_vectors, turned
from sipe_bayes.core.smoothing import filled, smoothed, smoothed_rotations
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.envs.internal.closed_chains import SD, close, dependent_joints, dofs_of
from sipe_bayes.envs.internal.resting import loose_joints, rest
from sipe_bayes.envs.internal.states import activations_at_rest, joints_at_rest, own_filters, settle
from sipe_bayes.envs.poses import PoseReading, has_pose, inertial_joints, is_round
from sipe_bayes.likelihood.state_space.indirect_positions import LogSamples, indirect_positions
from sipe_bayes.likelihood.state_space.inertial import carried, orientations
from sipe_bayes.simulation.callable_simulator import CallableSimulator
from sipe_bayes.simulation.contacts import Contacts, contacts_along, jumps, may_touch
from sipe_bayes.simulation.simulator import Simulator

Followed: TypeAlias = dict[int, tuple[float, float]]  # sds of a start's position and velocity by the joint's id
STATE_STEP = 1e-5  # rad or m, rad/s or m/s: finite differences by a state


def estimate_states(
    simulator: Simulator, trajectory: Trajectory, raw: bool = False, rows: IntArray | None = None
) -> FloatArray:
    """A first guess of the states (T+1, S) along a log: recorded ones of such a model, else measured ones.

    Measured coordinates are smoothed by local quadratics over 60 ms, with missing samples on lines. Unmeasured
    velocities are the slopes of the positions. Orientations are smoothed in rotation vectors from each sample.
    Positions that channels tell without measuring them are where these fit best (``indirect_positions``), joints of
    closed chains follow, and what contact holds rests on it. What no channel tells stays at the model's reset state.

    Args:
        simulator: of the model.
        trajectory: the log.
        raw: whether positions and measured velocities are those of the samples, not smoothed.
        rows: samples, in order, at which alone closed chains are closed, which takes its time; default all.
    """
    if trajectory.states is not None and are_states(simulator, trajectory.states):
        return trajectory.states
    return _estimated(simulator, trajectory, raw, rows)[0]


def _estimated(
    simulator: Simulator, trajectory: Trajectory, raw: bool, rows: IntArray | None = None
) -> tuple[FloatArray, set[int], Followed]:
    """States (T+1, S) along a log; ids of the joints that channels tell indirectly, and those that follow others."""
    model, states = simulator.model, np.tile(simulator.default_state(), (len(trajectory) + 1, 1))
    columns = simulator.environment.state_columns(model)
    known_samples, seen = filled(trajectory.observations), np.asarray(np.isfinite(trajectory.observations).any(0))
    measured = {column: known_samples[:, c] for c, column in enumerate(columns) if column is not None and seen[c]}
    for position, velocity in velocity_columns(model).items():
        if position in measured and velocity not in measured:
            states[:, velocity] = smoothed(measured[position], trajectory.dt, 1)
    if measured:
        series = np.stack(list(measured.values()), axis=1)
        states[:, list(measured)] = series if raw else smoothed(series, trajectory.dt)
    readings = simulator.environment.poses
    for joint in dict.fromkeys(reading.joint for reading in readings):
        readings_of = [r for r in readings if r.joint == joint and _seen(trajectory, r)]
        _put_pose(model, {r.quantity: r for r in readings_of}, trajectory, states, raw)
    for joint in inertial_joints(model, readings):
        _put_felt(simulator, {r.quantity: r for r in readings if r.joint == joint}, trajectory, states)
    known = measured_joints(simulator, seen)
    indirect = _put_indirect(simulator, trajectory, states, known, measured, raw)
    if rows is None or not len(rows) or may_touch(model):  # what rests is looked for along the log
        rows = np.arange(len(states))
    some, reset = states[rows], simulator.default_state()
    closed = close(model, some, reset, known | indirect, along=len(rows) == len(states))
    follow: Followed = dict.fromkeys(closed, (SD, 10 * SD))
    states[rows] = some
    unknown = set(range(model.njnt)) - known - indirect - set(follow)
    if unknown and may_touch(model) and not simulator.environment.stepwise:
        rates = [column for column in measured if column > model.nq]
        kept, simulated = states[:, rates].copy(), functools.partial(_simulated, simulator, trajectory)
        follow |= rest(model, states, trajectory.dt, loose_joints(model, unknown), simulated)
        states[:, rates] = kept
    return states, indirect, follow


def _simulated(
    simulator: Simulator, trajectory: Trajectory, first: IntArray, starts: FloatArray, ahead: int
) -> FloatArray:
    """States (B, ahead + 1, S) of the model as given from starts (B, S) at samples ``first`` (B,) of a log."""
    actions = np.stack([trajectory.actions[k : k + ahead] for k in first])
    goals = simulator.environment.recorded_goals(trajectory.observations[first])
    given, logs = simulator.space.default_theta[None], [trajectory.name] * len(first)
    runs = simulator.on_processor.rollout(given, actions, starts, dt=trajectory.dt, logs=logs, goals=goals)
    return np.full((len(first), ahead + 1, starts.shape[1]), np.nan) if runs.states is None else runs.states


def _put_indirect(
    simulator: Simulator,
    trajectory: Trajectory,
    states: FloatArray,
    known: set[int],
    measured: Collection[int],
    raw: bool,
) -> set[int]:
    """Write the positions of hinges and slides that channels tell indirectly into states (T+1, S); ids of these joints.

    measured: columns of the states.
    """
    model, samples = simulator.model, LogSamples(simulator, trajectory)
    derived = [c is None for c in simulator.environment.state_columns(model)]
    hidden = [j for j in range(model.njnt) if j not in known and not has_pose(model, j)]
    tell = samples.observed[:, derived].any() and len(trajectory) > 1
    if not hidden or not tell or simulator.environment.memory_size:
        return set()
    direct = np.isin(
        np.arange(2 * model.nv + model.na), [c - 1 - model.nq + model.nv for c in measured if c > model.nq]
    )
    direct[[d for j in known for d in dofs_of(model, j)]] = True
    places, indirect, _ = indirect_positions(samples, states, direct)
    out = {j for j in hidden if indirect[model.jnt_dofadr[j]]}
    for joint in out:
        position = 1 + int(model.jnt_qposadr[joint])
        velocity = 1 + model.nq + int(model.jnt_dofadr[joint])
        states[:, position] = places[:, position] if raw else smoothed(places[:, position], trajectory.dt)
        if velocity not in measured:
            states[:, velocity] = smoothed(places[:, position], trajectory.dt, 1)
    return out


def are_states(simulator: Simulator, states: FloatArray | None) -> bool:
    """Whether recorded states (..., S) are of such a model, not of one with fewer joints, filters or delays."""
    return states is not None and states.shape[-1] >= simulator.engine.physics_size


def velocity_columns(model: mujoco.MjModel) -> dict[int, int]:
    """Columns of positions that have one velocity, with those of the velocities."""
    sizes = {int(mujoco.mjtJoint.mjJNT_FREE): 3, int(mujoco.mjtJoint.mjJNT_BALL): 0}  # of a free joint the place
    out = {}
    for joint in range(model.njnt):
        for i in range(sizes.get(int(model.jnt_type[joint]), 1)):
            out[1 + int(model.jnt_qposadr[joint]) + i] = 1 + model.nq + int(model.jnt_dofadr[joint]) + i
    return out


def _seen(trajectory: Trajectory, reading: PoseReading) -> bool:
    """Whether a sample has all three numbers."""
    return bool(np.isfinite(trajectory.observations[:, reading.channels]).all(-1).any())


def _put_pose(
    model: mujoco.MjModel, poses: dict[str, PoseReading], trajectory: Trajectory, states: FloatArray, raw: bool
) -> None:
    """Write what is poses of one free or ball joint into states (T+1, S): nothing without its orientation."""
    if "orientation" not in poses:
        return
    orientation = poses["orientation"]
    joint, dt = orientation.joint, trajectory.dt
    free = int(model.jnt_type[joint]) == int(mujoco.mjtJoint.mjJNT_FREE)
    place, motion = 1 + int(model.jnt_qposadr[joint]), 1 + model.nq + int(model.jnt_dofadr[joint])
    turning = slice(motion + 3, motion + 6) if free else slice(motion, motion + 3)
    # the joint's own quaternion, and how it turns
    seen = quaternions(bridged(trajectory.observations[:, orientation.channels]))
    body = product(seen, inverse(orientation.turn))
    parent = None if free or orientation.of_joint else _parents(model, joint, states)
    own = rotation_vectors(body if parent is None else product(inverse(parent), body))
    smooth, spin = smoothed_rotations(own, dt)
    turn = quaternions(own if raw else smooth)
    states[:, place + 3 * free : place + 3 * free + 4] = turn
    states[:, turning] = turned(inverse(turn), spin)
    of_body = turn if parent is None else product(parent, turn)
    if "angular_velocity" in poses and (free or poses["angular_velocity"].of_joint):
        velocity = _values(trajectory, poses["angular_velocity"], raw)
        states[:, turning] = _in_body(velocity, poses["angular_velocity"], of_body)
    if free and "position" in poses and not poses["position"].at_origin:
        arm = turned(turn, poses["position"].offset)
        position = _values(trajectory, poses["position"], raw=True) - arm
        states[:, place : place + 3] = position if raw else smoothed(position, dt)
        states[:, motion : motion + 3] = smoothed(position, dt, 1)
    if free and "linear_velocity" in poses:
        reading = poses["linear_velocity"]
        velocity = turned(turn, _in_body(_values(trajectory, reading, raw), reading, turn))
        arm = np.cross(states[:, turning], reading.offset)  # in the body's axes
        states[:, motion : motion + 3] = velocity - turned(turn, arm)


def _put_felt(
    simulator: Simulator, readings: dict[str, PoseReading], trajectory: Trajectory, states: FloatArray
) -> None:
    """Write where an accelerometer, and perhaps a gyro, say that a free body is into states (T+1, S)."""
    model, joint = simulator.model, readings["acceleration"].joint
    strength = float(np.linalg.norm(model.opt.gravity))
    if not strength or not all(_seen(trajectory, reading) for reading in readings.values()):
        return
    felt = {name: turned(r.turn, _values(trajectory, r, raw=True)) for name, r in readings.items() if r.own_axes}
    spin, place = felt.get("angular_velocity"), 1 + int(model.jnt_qposadr[joint])
    up = -model.opt.gravity / strength
    states[:, place + 3 : place + 7] = orientations(felt["acceleration"], spin, trajectory.dt, up)
    states[:] = carried(simulator, joint, trajectory, states, None if spin is None else smoothed(spin, trajectory.dt))


def _values(trajectory: Trajectory, reading: PoseReading, raw: bool) -> FloatArray:
    """The three channels (T+1, 3), missing samples on lines, smoothed unless ``raw``."""
    values = filled(trajectory.observations[:, reading.channels])
    return values if raw else smoothed(values, trajectory.dt)


def _in_body(velocity: FloatArray, reading: PoseReading, of_body: FloatArray) -> FloatArray:
    """A velocity (T+1, 3) in the axes of the joint's body, whose orientation is ``of_body`` (T+1, 4)."""
    if reading.of_joint:
        return velocity
    return turned(reading.turn, velocity) if reading.own_axes else turned(inverse(of_body), velocity)


def _parents(model: mujoco.MjModel, joint: int, states: FloatArray) -> FloatArray:
    """Quaternions (T+1, 4) of the frame in which a ball joint turns its body, at states (T+1, S)."""
    body, data = int(model.jnt_bodyid[joint]), mujoco.MjData(model)
    still = model.body_weldid[model.body_parentid[body]] == 0
    out = np.empty((1 if still else len(states), 4))
    for quaternion, state in zip(out, states, strict=False):
        data.qpos[:] = state[1 : 1 + model.nq]
        mujoco.mj_kinematics(model, data)
        quaternion[:] = data.xquat[model.body_parentid[body]]
    return np.broadcast_to(product(out, model.body_quat[body]), (len(states), 4))


def measured_joints(simulator: Simulator, seen: BoolArray) -> set[int]:
    """Ids of the joints whose position a channel tells, or of which the model itself says how far from rest they start.

    A ball's orientation does not matter. seen: which channels (O,) have a sample.
    """
    model, environment = simulator.model, simulator.environment
    columns = {c for c, has in zip(environment.state_columns(model), seen, strict=True) if has}
    poses = {(r.joint, r.quantity) for r in environment.poses if seen[list(r.channels)].all()}
    placed = {r.joint for r in environment.poses if r.quantity == "position" and r.at_origin}
    out = {*joints_at_rest(model), *inertial_joints(model, environment.poses)}
    for joint in range(model.njnt):
        if has_pose(model, joint):
            known = (joint, "orientation") in poses or (is_round(model, joint) and joint in placed)
            if int(model.jnt_type[joint]) == int(mujoco.mjtJoint.mjJNT_FREE):
                known &= (joint, "position") in poses
        else:
            known = 1 + int(model.jnt_qposadr[joint]) in columns
        if known:
            out.add(joint)
    return out


def unmeasured_joints(simulator: Simulator, trajectories: Trajectories) -> list[int]:
    """Ids of the joints whose position no channel with a sample tells: windows start them at the reset state.

    Not those that channels tell indirectly, a closed chain, or what they rest on, all along every log.
    """
    if are_states(simulator, trajectories.states):
        return []
    known = measured_joints(simulator, _seen_in(trajectories))
    if len(known) < simulator.model.njnt:
        known |= set.intersection(*({*indirect, *follow} for indirect, follow in _inferred(simulator, trajectories)))
    return [joint for joint in range(simulator.model.njnt) if joint not in known]


def all_starts_measured(simulator: Simulator, trajectories: Trajectories) -> bool:
    """Whether logs tell of every state where it is: recorded ones, or a measured position of each joint."""
    if are_states(simulator, trajectories.states):
        return True
    known = activations_at_rest(simulator.model) == simulator.model.na
    return known and not unmeasured_joints(simulator, trajectories)


def _followed(simulator: Simulator, trajectories: Trajectories) -> Followed:
    """The joints that nothing measures and that follow measured ones in every log, with their largest sds."""
    touch = may_touch(simulator.model) and not are_states(simulator, trajectories.states)
    measured = len(measured_joints(simulator, _seen_in(trajectories)))
    if not (simulator.model.neq or touch) or measured == simulator.model.njnt:
        return {}
    logs = [follow for _, follow in _inferred(simulator, trajectories)]
    sds = {j: np.max([own[j] for own in logs], axis=0) for j in set.intersection(*(set(own) for own in logs))}
    return {j: (float(position), float(velocity)) for j, (position, velocity) in sds.items()}


@functools.lru_cache(maxsize=2)  # asked several times of the same logs, and dear of long ones
def _inferred(simulator: Simulator, trajectories: Trajectories) -> list[tuple[set[int], Followed]]:
    """Of each log the ids of the joints that channels tell indirectly, and those that follow."""
    return [_estimated(simulator, replace(trajectory, states=None), False)[1:] for trajectory in trajectories]


def tied_joints(simulator: Simulator, trajectories: Trajectories) -> list[int]:
    """Ids of the joints that nothing measures and that closed chains tie to measured ones at the reset state."""
    known, reset = measured_joints(simulator, _seen_in(trajectories)), simulator.default_state()
    return dependent_joints(simulator.model, known, reset[1 : 1 + simulator.model.nq])


def _seen_in(trajectories: Trajectories) -> BoolArray:
    return np.asarray(np.isfinite(trajectories.observations).any(axis=(0, 1)))


def start_sd(simulator: Simulator, trajectories: Trajectories) -> FloatArray:
    """Prior sds (2 nv + na,) of where windows of logs start: narrow of joints that closed chains or contacts tell.

    And of filters of the model's own, which the commands before have brought to where they are.
    """
    model, out = simulator.model, simulator.environment.start_sd(simulator.model).copy()
    for joint, (position, velocity) in _followed(simulator, trajectories).items():
        dofs = dofs_of(model, joint)
        out[dofs], out[model.nv + dofs] = position, velocity
    if own_filters(model):
        largest = np.abs(simulator.environment.control(model, np.empty(0), trajectories.actions)).max((0, 1))
        settle(model, out, largest)
    return out


def first_states(simulator: Simulator | CallableSimulator, trajectories: Trajectories) -> FloatArray:
    """Starting states (R, S) of R recorded trajectories: recorded, else estimated from the measurements."""
    if isinstance(simulator, CallableSimulator):
        return np.empty((len(trajectories), 0))
    return np.stack([estimate_states(simulator, t)[0] for t in trajectories])


def contacts_of(simulator: Simulator, logs: Sequence[Trajectory]) -> Contacts:
    """What bodies touch along logs, apart by smoothed states and in touch by those of the samples."""
    if not may_touch(simulator.model):
        return Contacts()
    smooth, sampled = ([estimate_states(simulator, log, raw) for log in logs] for raw in (False, True))
    contacts = contacts_along(simulator, smooth, sampled)
    steady = contacts.touch and not contacts.change
    return replace(contacts, rough=True) if steady and jumps(simulator, logs, smooth) else contacts
