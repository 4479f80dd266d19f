"""Which measurements tell the pose of a free or ball joint, and how the measured frame sits on the joint's body."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import mujoco
import numpy as np

from sipe_bayes.core import rotations
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.envs.channels import Reader

Quantity = Literal["position", "orientation", "linear_velocity", "angular_velocity", "acceleration"]

_FREE, _BALL = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_BALL)
_QUANTITIES: dict[int, Quantity] = {
    int(mujoco.mjtSensor.mjSENS_FRAMEPOS): "position",
    int(mujoco.mjtSensor.mjSENS_FRAMEQUAT): "orientation",
    int(mujoco.mjtSensor.mjSENS_BALLQUAT): "orientation",
    int(mujoco.mjtSensor.mjSENS_FRAMELINVEL): "linear_velocity",
    int(mujoco.mjtSensor.mjSENS_VELOCIMETER): "linear_velocity",
    int(mujoco.mjtSensor.mjSENS_FRAMEANGVEL): "angular_velocity",
    int(mujoco.mjtSensor.mjSENS_GYRO): "angular_velocity",
    int(mujoco.mjtSensor.mjSENS_BALLANGVEL): "angular_velocity",
    int(mujoco.mjtSensor.mjSENS_ACCELEROMETER): "acceleration",
}
_OWN_AXES = (
    int(mujoco.mjtSensor.mjSENS_VELOCIMETER),
    int(mujoco.mjtSensor.mjSENS_GYRO),
    int(mujoco.mjtSensor.mjSENS_ACCELEROMETER),
)
_FELT_POSE_SD = 0.1  # m and rad, what gravity and resting on the ground leave of a pose's error
_FELT_VELOCITY_SD = 1.0  # m/s and rad/s
_OF_BALLS = (int(mujoco.mjtSensor.mjSENS_BALLQUAT), int(mujoco.mjtSensor.mjSENS_BALLANGVEL))


@dataclass(frozen=True)
class PoseReading:
    """Three channels that tell something of the pose of a free or ball joint.

    Args:
        joint: its id.
        quantity: what they tell of the measured frame.
        channels: which they are.
        offset: (3,) where the frame is on the joint's body, m.
        turn: (4,) quaternion of the frame in the body's axes.
        own_axes: whether a velocity is in the frame's axes, else in the world's.
        of_joint: whether it is the joint's own quaternion or velocity, whatever carries it.
    """

    joint: int
    quantity: Quantity
    channels: tuple[int, int, int]
    offset: FloatArray
    turn: FloatArray
    own_axes: bool = False
    of_joint: bool = False

    @property
    def at_origin(self) -> bool:
        """Whether the frame's origin is the body's."""
        return not self.offset.any()


def has_pose(model: mujoco.MjModel, joint: int) -> bool:
    """Whether a joint is free or a ball, so that it has an orientation."""
    return int(model.jnt_type[joint]) in (_FREE, _BALL)


def is_round(model: mujoco.MjModel, joint: int) -> bool:
    """Whether a free joint's body moves alike however it is turned: what touches are spheres about its centre of mass.

    Nothing hangs on it, and its inertia is the same about every axis.
    """
    body = int(model.jnt_bodyid[joint])
    own = (model.geom_bodyid == body) & ((model.geom_contype != 0) | (model.geom_conaffinity != 0))
    spheres = (model.geom_type[own] == int(mujoco.mjtGeom.mjGEOM_SPHERE)).all()
    centred = np.allclose(model.geom_pos[own], model.body_ipos[body], atol=1e-9)
    inertia = model.body_inertia[body]
    alone = not (model.body_parentid[1:] == body).any() and int(model.jnt_type[joint]) == _FREE
    return bool(alone and own.any() and spheres and centred and np.ptp(inertia) <= 1e-6 * inertia.max())


def inertial_joints(model: mujoco.MjModel, readings: Sequence[PoseReading]) -> tuple[int, ...]:
    """Free joints whose body has an accelerometer, and no measured orientation or position."""
    told = {(r.joint, r.quantity) for r in readings}
    joints = dict.fromkeys(r.joint for r in readings if r.quantity == "acceleration")
    placed = {joint for joint, quantity in told if quantity in ("position", "orientation")}
    return tuple(j for j in joints if j not in placed and int(model.jnt_type[j]) == _FREE)


def felt_sd(model: mujoco.MjModel, readings: Sequence[PoseReading], wide: FloatArray) -> FloatArray:
    """Prior sds (2 nv + na,) of a start: ``wide``, but closer of free joints that only inertial sensors tell of.

    Their yaw and place in the plane nothing tells; a prior that leaves them open would leave the equations singular.
    """
    sd = wide.copy()
    for joint in inertial_joints(model, readings):
        first = int(model.jnt_dofadr[joint])
        sd[first : first + 6] = _FELT_POSE_SD
        sd[model.nv + first : model.nv + first + 6] = _FELT_VELOCITY_SD
    return sd


def pose_readings(model: mujoco.MjModel, readers: Sequence[Reader]) -> tuple[PoseReading, ...]:
    """What the channels tell of free and ball joints; a vector counts where all three of its numbers are measured."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    places = {(r.index, r.turn): channel for channel, r in enumerate(readers) if r.derived}
    readings = []
    for sensor in range(model.nsensor):
        quantity, address = _QUANTITIES.get(int(model.sensor_type[sensor])), int(model.sensor_adr[sensor])
        keys = [(address, i) if quantity == "orientation" else (address + i, None) for i in range(3)]
        if quantity is not None and all(key in places for key in keys):
            x, y, z = (places[key] for key in keys)
            reading = _reading(model, data, sensor, quantity, (x, y, z))
            readings += [] if reading is None else [reading]
    return tuple(readings)


def _reading(
    model: mujoco.MjModel, data: mujoco.MjData, sensor: int, quantity: Quantity, channels: tuple[int, int, int]
) -> PoseReading | None:
    """None where the sensor's frame is not fixed to the body of a free or ball joint, or moves with its reference."""
    kind = int(model.sensor_type[sensor])
    if kind in _OF_BALLS:
        still = np.zeros(3), np.array([1.0, 0, 0, 0])
        return PoseReading(int(model.sensor_objid[sensor]), quantity, channels, *still, of_joint=True)
    frame = _frame(model, data, int(model.sensor_objtype[sensor]), int(model.sensor_objid[sensor]))
    if frame is None or int(model.sensor_refid[sensor]) >= 0:
        return None
    carrier = int(model.body_weldid[frame[0]])
    joint = int(model.body_jntadr[carrier])
    if int(model.body_jntnum[carrier]) != 1 or not has_pose(model, joint):
        return None
    back = rotations.inverse(data.xquat[carrier])
    offset = rotations.turned(back, frame[1] - data.xpos[carrier])
    offset = np.where(np.abs(offset) < 1e-12, 0.0, offset)
    turn = rotations.product(back, frame[2])
    return PoseReading(joint, quantity, channels, offset, turn, own_axes=kind in _OWN_AXES)


def _frame(
    model: mujoco.MjModel, data: mujoco.MjData, kind: int, index: int
) -> tuple[int, FloatArray, FloatArray] | None:
    """Body, position and quaternion of a frame as the model is compiled; None of one that is not told."""
    objects = mujoco.mjtObj
    if kind == int(objects.mjOBJ_XBODY):
        return index, data.xpos[index], data.xquat[index]
    of = {
        int(objects.mjOBJ_BODY): (np.arange(model.nbody), data.xipos, data.ximat),
        int(objects.mjOBJ_GEOM): (model.geom_bodyid, data.geom_xpos, data.geom_xmat),
        int(objects.mjOBJ_SITE): (model.site_bodyid, data.site_xpos, data.site_xmat),
    }
    if kind not in of:
        return None
    bodies, positions, matrices = of[kind]
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, matrices[index])
    return int(bodies[index]), positions[index], quaternion


def pose_columns(
    model: mujoco.MjModel, readings: Sequence[PoseReading], columns: Sequence[int | None]
) -> tuple[int | None, ...]:
    """``columns`` of the physics state by channel, with those that channels tell of free joints."""
    columns = list(columns)
    for reading in readings:
        if int(model.jnt_type[reading.joint]) != _FREE or not reading.at_origin or reading.own_axes:
            continue
        first = {
            "position": 1 + int(model.jnt_qposadr[reading.joint]),
            "linear_velocity": 1 + model.nq + int(model.jnt_dofadr[reading.joint]),
        }.get(reading.quantity)
        if first is not None:
            for i, channel in enumerate(reading.channels):
                columns[channel] = first + i
    return tuple(columns)
