r"""Where a free body was that nothing but its own accelerometer and gyro tell of: a first guess of its poses.

The gyro is integrated to turns q_k from the first sample. A machine that stays near its place accelerates by nothing on
average, so that the mean of q_j a_j over the second around a sample points up, which tells roll and pitch there and
takes the gyro's drift back; without a gyro the mean of a_j alone. The yaw begins at zero. Nothing tells it, nor the
place, and the chain's wide prior leaves them open.

The body begins so high that the nearest of the geoms that it carries touches what does not move, and settles there.
From then on the model carries it: each control step is simulated with the joints as measured and the gyro's turning,
and where it ends the body is at the next sample. So it stands on its feet with the forces that hold it.
"""

from __future__ import annotations

import mujoco
import numpy as np
import scipy.ndimage

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.rotations import product, quaternions, turned
from sipe_bayes.core.trajectory import Trajectory
from sipe_bayes.simulation.simulator import Simulator

_AROUND = 1.0  # s, over which accelerations average out
_SETTLES, _CALMED = 0.5, 0.8  # s in which it comes to rest, and the share of its velocity that a step leaves
_FAR = 10.0  # m, beyond which distances are not looked for
_LANDINGS = 3  # times the height is corrected: across a slope a shift upwards is more than the distance


def orientations(acceleration: FloatArray, spin: FloatArray | None, dt: float, up: FloatArray) -> FloatArray:
    """Quaternions (T+1, 4) of a body that stays near its place.

    Args:
        acceleration: (T+1, 3) in the body's axes, gravity's reaction included, m/s^2.
        spin: (T+1, 3) its angular velocity in the body's axes, rad/s, None where it is not measured.
        dt: s from sample to sample.
        up: (3,) against gravity, of length one.
    """
    turns = np.zeros((len(acceleration), 4))
    turns[:, 0] = 1.0
    if spin is not None:
        steps = quaternions(0.5 * (spin[1:] + spin[:-1]) * dt)
        for k, step in enumerate(steps):
            turns[k + 1] = product(turns[k], step)
        turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    width = min(2 * round(_AROUND / dt) + 1, 2 * len(turns) - 1)
    felt = turned(turns, acceleration)
    counts = scipy.ndimage.uniform_filter1d(np.ones(len(turns)), width, mode="constant")
    mean = scipy.ndimage.uniform_filter1d(felt, width, axis=0, mode="constant") / counts[:, None]
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
    # the shortest turn that takes the mean upwards
    scalar = 1 + mean @ up
    level = np.concatenate([np.maximum(scalar, 1e-6)[:, None], np.cross(mean, up)], axis=1)
    level /= np.linalg.norm(level, axis=1, keepdims=True)
    return product(level, turns)


def carried(
    simulator: Simulator, joint: int, trajectory: Trajectory, states: FloatArray, spin: FloatArray | None
) -> FloatArray:
    """States (T+1, S) with the poses and velocities of a free joint that the model itself comes to.

    Args:
        simulator: of the model, as it is given.
        joint: the free joint.
        trajectory: the log.
        states: (T+1, S), measured joints, and of the free one the orientation.
        spin: (T+1, 3) its angular velocity in the body's axes, rad/s, None where it is not measured.
    """
    model, out = simulator.model, states.copy()
    place, motion = 1 + int(model.jnt_qposadr[joint]), 1 + model.nq + int(model.jnt_dofadr[joint])
    pose, velocity = slice(place, place + 7), slice(motion, motion + 6)
    theta, dt = np.clip(simulator.space.default_theta, 0.0, 1.0)[None], trajectory.dt
    free = [*range(*pose.indices(model.nq + 1)), *range(*velocity.indices(model.nq + model.nv + 1))]
    joints = np.setdiff1d(np.arange(1, 1 + model.nq + model.nv), free)
    timestep = np.array([simulator.physics_steps(dt)[1]])

    def ahead(state: FloatArray, k: int) -> FloatArray | None:
        """The state (S,) a control step after sample k; None where it diverges."""
        rollout = simulator.rollout(theta, trajectory.actions[None, k : k + 1], state[None], dt, [trajectory.name])
        return None if rollout.states is None or not rollout.valid.all() else rollout.states[0, 1]

    here = simulator.environment.history(model, out[:1].copy(), [trajectory.actions[:1]], timestep)[0]
    here[pose], here[velocity] = _landed(model, joint, here), 0.0
    for _ in range(round(_SETTLES / dt)):
        end = ahead(here, 0)
        if end is None:
            break
        here = end
        here[joints], here[velocity] = out[0, joints], _CALMED * end[velocity]
    here[velocity] = 0.0
    for k in range(len(trajectory) + 1):
        here[joints] = out[k, joints]
        if spin is not None:
            here[motion + 3 : motion + 6] = spin[k]
        out[k, free] = here[free]
        end = ahead(here, k) if k < len(trajectory) else None
        here = here if end is None else end
    return out


def _landed(model: mujoco.MjModel, joint: int, state: FloatArray) -> FloatArray:
    """The pose (7,) of a free joint with the nearest of the geoms that it carries on what does not move."""
    place, data = int(model.jnt_qposadr[joint]), mujoco.MjData(model)
    carried, still = _geoms(model, int(model.jnt_bodyid[joint]))
    pairs = [(a, b) for a in carried for b in still if _collide(model, a, b)]
    up = -model.opt.gravity / np.linalg.norm(model.opt.gravity)
    data.qpos[:] = state[1 : 1 + model.nq]
    for _ in range(_LANDINGS if pairs else 0):
        mujoco.mj_kinematics(model, data)
        gap = min(mujoco.mj_geomDistance(model, data, a, b, _FAR, None) for a, b in pairs)
        data.qpos[place : place + 3] -= gap * up if gap < _FAR else 0.0
    return np.array(data.qpos[place : place + 7])


def _geoms(model: mujoco.MjModel, body: int) -> tuple[list[int], list[int]]:
    """Geoms of the bodies that a body carries, itself among them, and those that do not move."""
    carried = {body}
    for other in range(body + 1, model.nbody):
        if int(model.body_parentid[other]) in carried:
            carried.add(other)
    bodies = model.geom_bodyid
    still = [g for g in range(model.ngeom) if int(model.body_weldid[bodies[g]]) == 0]
    return [g for g in range(model.ngeom) if int(bodies[g]) in carried], still


def _collide(model: mujoco.MjModel, a: int, b: int) -> bool:
    kinds, wanted = model.geom_contype, model.geom_conaffinity
    return bool(kinds[a] & wanted[b] or kinds[b] & wanted[a])
