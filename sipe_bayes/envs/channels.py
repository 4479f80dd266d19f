"""Measured quantities of a model: where each is found, and in which unit."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from sipe_bayes.envs.targets import TargetError, named

_CHANNEL = re.compile(
    r"^(?:joint:(?P<joint>.+)\.(?P<what>position|velocity)|sensor:(?P<sensor>[^\[\]]+)(?:\[(?P<item>\d+)\])?)$"
)

_SENSOR_UNITS = {
    "rad": (mujoco.mjtSensor.mjSENS_JOINTPOS,),
    "rad/s": (
        mujoco.mjtSensor.mjSENS_JOINTVEL,
        mujoco.mjtSensor.mjSENS_GYRO,
        mujoco.mjtSensor.mjSENS_FRAMEANGVEL,
        mujoco.mjtSensor.mjSENS_BALLANGVEL,
    ),
    "rad/s^2": (mujoco.mjtSensor.mjSENS_FRAMEANGACC,),
    "m/s^2": (mujoco.mjtSensor.mjSENS_ACCELEROMETER, mujoco.mjtSensor.mjSENS_FRAMELINACC),
    "m/s": (
        mujoco.mjtSensor.mjSENS_VELOCIMETER,
        mujoco.mjtSensor.mjSENS_FRAMELINVEL,
        mujoco.mjtSensor.mjSENS_SUBTREELINVEL,
    ),
    "m": (mujoco.mjtSensor.mjSENS_FRAMEPOS, mujoco.mjtSensor.mjSENS_SUBTREECOM, mujoco.mjtSensor.mjSENS_RANGEFINDER),
    "N": (mujoco.mjtSensor.mjSENS_FORCE, mujoco.mjtSensor.mjSENS_TOUCH),
    "N m": (mujoco.mjtSensor.mjSENS_TORQUE, mujoco.mjtSensor.mjSENS_JOINTACTFRC),
}
_OF_JOINTS = (mujoco.mjtSensor.mjSENS_JOINTPOS, mujoco.mjtSensor.mjSENS_JOINTVEL, mujoco.mjtSensor.mjSENS_JOINTACTFRC)


@dataclass(frozen=True)
class Channel:
    """One measured quantity.

    Args:
        target: ``joint:NAME.position``, ``joint:NAME.velocity`` or ``sensor:NAME[i]``.
        name: what it is called; default the target.
        unit: filled in from the model.
    """

    target: str
    name: str = ""
    unit: str = ""

    @property
    def label(self) -> str:
        """The name, or the target without one."""
        return self.name or self.target


@dataclass(frozen=True)
class Reader:
    """Where a channel is found: column ``index`` of the sensordata (``derived``) or of the physics state."""

    index: int
    derived: bool
    unit: str


def reader_of(model: mujoco.MjModel, channel: Channel) -> Reader:
    """Where a channel is found; raises TargetError for one that the model does not have."""
    where = f"measurement {channel.label!r}"
    match = _CHANNEL.match(channel.target)
    if not match:
        raise TargetError(
            f"{where}: target {channel.target!r} is not one of joint:NAME.position, joint:NAME.velocity, sensor:NAME[i]"
        )
    if match["joint"]:
        joint = named(model, "joint", match["joint"], where)
        hinge = int(model.jnt_type[joint]) == int(mujoco.mjtJoint.mjJNT_HINGE)
        if not hinge and int(model.jnt_type[joint]) != int(mujoco.mjtJoint.mjJNT_SLIDE):
            raise TargetError(f"{where}: joint {match['joint']!r} is neither hinge nor slide; measure it by a sensor")
        if match["what"] == "position":
            return Reader(1 + int(model.jnt_qposadr[joint]), False, "rad" if hinge else "m")
        return Reader(1 + model.nq + int(model.jnt_dofadr[joint]), False, "rad/s" if hinge else "m/s")
    sensor = named(model, "sensor", match["sensor"], where)
    size, item = int(model.sensor_dim[sensor]), int(match["item"] or 0)
    if (size > 1 and match["item"] is None) or item >= size:
        raise TargetError(
            f"{where}: sensor {match['sensor']!r} has {size} components; write sensor:NAME[i], i < {size}"
        )
    return Reader(int(model.sensor_adr[sensor]) + item, True, _sensor_unit(model, sensor))


def state_column(model: mujoco.MjModel, reader: Reader) -> int | None:
    """The column of the physics state that a reader's quantity is, if it is one."""
    if not reader.derived:
        return reader.index
    sensor = int(np.flatnonzero(model.sensor_adr == reader.index)[0]) if reader.index in model.sensor_adr else -1
    kind, joint = int(model.sensor_type[sensor]), int(model.sensor_objid[sensor])
    if sensor >= 0 and kind == int(mujoco.mjtSensor.mjSENS_JOINTPOS):
        return 1 + int(model.jnt_qposadr[joint])
    if sensor >= 0 and kind == int(mujoco.mjtSensor.mjSENS_JOINTVEL):
        return 1 + int(model.nq) + int(model.jnt_dofadr[joint])
    return None


def _sensor_unit(model: mujoco.MjModel, sensor: int) -> str:
    kind, joint = mujoco.mjtSensor(int(model.sensor_type[sensor])), int(model.sensor_objid[sensor])
    unit = next((unit for unit, kinds in _SENSOR_UNITS.items() if kind in kinds), "")
    if kind in _OF_JOINTS and int(model.jnt_type[joint]) == int(mujoco.mjtJoint.mjJNT_SLIDE):
        return {"rad": "m", "rad/s": "m/s", "N m": "N"}[unit]
    return unit


def check_sensors(model: mujoco.MjModel, channels: Sequence[Channel]) -> None:
    """Raises TargetError for sensors that do not read the present state, which no window could start from."""
    for channel in channels:
        match = _CHANNEL.match(channel.target)
        if match and match["sensor"]:
            sensor = named(model, "sensor", match["sensor"], f"measurement {channel.label!r}")
            if model.sensor_delay[sensor] > 0 or model.sensor_interval[sensor, 0] > 0:
                raise TargetError(
                    f"measurement {channel.label!r}: sensor {match['sensor']!r} has a delay or an interval; "
                    "remove it and shift the log instead"
                )
