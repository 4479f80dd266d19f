"""Measured quantities of a model: where each is found, and in which unit."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.rotations import rotation_vectors
from sipe_bayes.core.units import UNITS
from sipe_bayes.envs.kinds.tendons import tendon_unit
from sipe_bayes.envs.target import TargetError, named

_AXES = ("x", "y", "z")
_QUANTITIES = {  # of a body, in the world's axes: the sensor that reads it, and its unit
    "position": (mujoco.mjtSensor.mjSENS_FRAMEPOS, "m"),
    "orientation": (mujoco.mjtSensor.mjSENS_FRAMEQUAT, "rad"),
    "linear_velocity": (mujoco.mjtSensor.mjSENS_FRAMELINVEL, "m/s"),
    "angular_velocity": (mujoco.mjtSensor.mjSENS_FRAMEANGVEL, "rad/s"),
}
_CHANNEL = re.compile(
    r"^(?:joint:(?P<joint>.+)\.(?P<what>position|velocity|force)"
    rf"|(?P<body>body:[^\[\]]+\.(?P<quantity>{'|'.join(_QUANTITIES)}))(?:\[(?P<axis>[0-2])\])?"
    r"|sensor:(?P<turned>[^\[\]]+)\.rotation\[(?P<turn>[0-2])\]"
    r"|sensor:(?P<sensor>[^\[\]]+)(?:\[(?P<item>\d+)\])?)$"
)
_TURNS = (mujoco.mjtSensor.mjSENS_FRAMEQUAT, mujoco.mjtSensor.mjSENS_BALLQUAT)

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
_OF_TENDONS = {
    mujoco.mjtSensor.mjSENS_TENDONPOS: "length",
    mujoco.mjtSensor.mjSENS_TENDONVEL: "velocity",
    mujoco.mjtSensor.mjSENS_TENDONACTFRC: "force",
}


@dataclass(frozen=True)
class Channel:
    """One measured quantity.

    Args:
        target: ``joint:NAME.position``, ``joint:NAME.velocity``, ``joint:NAME.force`` (what actuators apply, N m or
            N), ``sensor:NAME[i]``, or of a body's frame in the world's axes ``body:NAME.position``, ``.orientation``,
            ``.linear_velocity``, ``.angular_velocity``, three channels ``[i]`` each. An orientation,
            ``body:NAME.orientation[i]`` or ``sensor:NAME.rotation[i]`` of a sensor that gives a quaternion, is a
            rotation vector (rad).
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
    """Where a channel is found: column ``index`` of the sensordata (``derived``) or of the physics state.

    ``turn``: which number of the rotation vector whose quaternion begins there, for an orientation.
    """

    index: int
    derived: bool
    unit: str
    turn: int | None = None


def is_rotation(channel: Channel) -> bool:
    """Whether a channel is one number of a rotation vector."""
    match = _CHANNEL.match(channel.target)
    return match is not None and (match["quantity"] == "orientation" or match["turned"] is not None)


def components(target: str, name: str, quaternion: bool = False) -> list[Channel]:
    """The three channels of a vector, or of an orientation that comes as a quaternion; NAME_x, NAME_y, NAME_z."""
    part = f"{target}.rotation" if quaternion and target.startswith("sensor:") else target
    return [Channel(f"{part}[{i}]", name and f"{name}_{axis}") for i, axis in enumerate(_AXES)]


def rotation_triples(channels: Sequence[Channel]) -> tuple[tuple[int, int, int], ...]:
    """Places of the rotation vectors; raises TargetError where one of the three numbers is missing."""
    places = {c.target: k for k, c in enumerate(channels) if is_rotation(c)}
    groups = []
    for whole in dict.fromkeys(target.rpartition("[")[0] for target in places):
        parts = [places.get(f"{whole}[{i}]") for i in range(3)]
        if None in parts:
            raise TargetError(f"measurement {whole!r}: an orientation is measured whole; give {whole!r}, without [i]")
        groups.append(tuple(parts))
    return tuple(groups)  # type: ignore[arg-type]


def expanded(model: mujoco.MjModel, channel: Channel) -> list[Channel]:
    """A channel, or where its target stands for a body's vector or for an orientation the three of that."""
    match = _CHANNEL.match(channel.target)
    if match and match["body"] and match["axis"] is None:
        return components(channel.target, channel.name)
    if match and match["sensor"] and match["item"] is None:
        sensor = named(model, "sensor", match["sensor"], f"measurement {channel.label!r}")
        if int(model.sensor_type[sensor]) in map(int, _TURNS):
            return components(channel.target, channel.name, quaternion=True)
    return [channel]


def add_sensors(spec: mujoco.MjSpec, channels: Sequence[Channel]) -> None:
    """Give a spec the sensors that read what is measured of bodies, and forces at joints, called as the targets are."""
    for channel in channels:
        match = _CHANNEL.match(channel.target)
        if match and match["what"] == "force" and spec.joint(match["joint"]) and not spec.sensor(channel.target):
            kind, joint = mujoco.mjtSensor.mjSENS_JOINTACTFRC, match["joint"]
            spec.add_sensor(name=channel.target, type=kind, objtype=mujoco.mjtObj.mjOBJ_JOINT, objname=joint)
        if not match or not match["body"] or spec.sensor(match["body"]) is not None:
            continue
        body = _body_name(match["body"])
        if spec.body(body) is not None:
            kind = _QUANTITIES[match["quantity"]][0]
            spec.add_sensor(name=match["body"], type=kind, objtype=mujoco.mjtObj.mjOBJ_XBODY, objname=body)


def _body_name(target: str) -> str:
    return target.removeprefix("body:").rpartition(".")[0]


def reader_of(model: mujoco.MjModel, channel: Channel) -> Reader:
    """Where a channel is found; raises TargetError for one that the model does not have."""
    where = f"measurement {channel.label!r}"
    match = _CHANNEL.match(channel.target)
    if not match:
        raise TargetError(
            f"{where}: target {channel.target!r} is not one of joint:NAME.position, joint:NAME.velocity, "
            f"joint:NAME.force, sensor:NAME[i], {', '.join(f'body:NAME.{q}' for q in _QUANTITIES)}"
        )
    if match["body"]:
        return _of_body(model, match, where)
    if match["turned"]:
        return _of_turn(model, match["turned"], int(match["turn"]), where)
    if match["joint"]:
        joint = named(model, "joint", match["joint"], where)
        hinge = int(model.jnt_type[joint]) == int(mujoco.mjtJoint.mjJNT_HINGE)
        if not hinge and int(model.jnt_type[joint]) != int(mujoco.mjtJoint.mjJNT_SLIDE):
            raise TargetError(
                f"{where}: joint {match['joint']!r} is neither hinge nor slide; measure its body: "
                "body:NAME.position, body:NAME.orientation"
            )
        if match["what"] == "position":
            return Reader(1 + int(model.jnt_qposadr[joint]), False, "rad" if hinge else "m")
        if match["what"] == "force":
            sensor = named(model, "sensor", channel.target, where)
            return Reader(int(model.sensor_adr[sensor]), True, _sensor_unit(model, sensor))
        return Reader(1 + model.nq + int(model.jnt_dofadr[joint]), False, "rad/s" if hinge else "m/s")
    sensor = named(model, "sensor", match["sensor"], where)
    size, item = int(model.sensor_dim[sensor]), int(match["item"] or 0)
    if (size > 1 and match["item"] is None) or item >= size:
        raise TargetError(
            f"{where}: sensor {match['sensor']!r} has {size} components; write sensor:NAME[i], i < {size}"
        )
    return Reader(int(model.sensor_adr[sensor]) + item, True, _sensor_unit(model, sensor))


def _of_body(model: mujoco.MjModel, match: re.Match[str], where: str) -> Reader:
    named(model, "body", _body_name(match["body"]), where)
    address = int(model.sensor_adr[named(model, "sensor", match["body"], where)])
    axis, unit = int(match["axis"] or 0), _QUANTITIES[match["quantity"]][1]
    if match["quantity"] == "orientation":
        return Reader(address, True, unit, axis)
    return Reader(address + axis, True, unit)


def _of_turn(model: mujoco.MjModel, name: str, turn: int, where: str) -> Reader:
    sensor = named(model, "sensor", name, where)
    if int(model.sensor_type[sensor]) not in map(int, _TURNS):
        raise TargetError(f"{where}: sensor {name!r} gives no quaternion; write sensor:{name}, without .rotation")
    return Reader(int(model.sensor_adr[sensor]), True, "rad", turn)


def read_channels(
    names: Sequence[str],
    readers: Sequence[Reader],
    rotations: Sequence[tuple[int, int, int]],
    states: FloatArray,
    derived: FloatArray | None,
) -> FloatArray:
    """What channels (..., O) are of states (..., S) and sensordata (..., D); those of ``rotations`` are vectors."""
    out = np.empty((*states.shape[:-1], len(readers)))
    for k, reader in enumerate(readers):
        source = derived if reader.derived else states
        if source is None:
            raise ValueError(f"channel {names[k]!r}: needs sensordata, got none")
        if reader.turn is None:
            out[..., k] = source[..., reader.index]
        elif reader.turn == 0:
            triple = next(triple for triple in rotations if k in triple)
            out[..., triple] = rotation_vectors(source[..., reader.index : reader.index + 4])
    return out


def state_column(model: mujoco.MjModel, reader: Reader) -> int | None:
    """The column of the physics state that a reader's quantity is, if it is one."""
    if not reader.derived:
        return reader.index
    if reader.turn is not None:
        return None
    sensor = int(np.flatnonzero(model.sensor_adr == reader.index)[0]) if reader.index in model.sensor_adr else -1
    kind, joint = int(model.sensor_type[sensor]), int(model.sensor_objid[sensor])
    if sensor >= 0 and kind == int(mujoco.mjtSensor.mjSENS_JOINTPOS):
        return 1 + int(model.jnt_qposadr[joint])
    if sensor >= 0 and kind == int(mujoco.mjtSensor.mjSENS_JOINTVEL):
        return 1 + int(model.nq) + int(model.jnt_dofadr[joint])
    return None


def _sensor_unit(model: mujoco.MjModel, sensor: int) -> str:
    kind, joint = mujoco.mjtSensor(int(model.sensor_type[sensor])), int(model.sensor_objid[sensor])
    if kind in _OF_TENDONS:
        known = tendon_unit(model, joint, _OF_TENDONS[kind])
        return known if known in UNITS else ""
    unit = next((unit for unit, kinds in _SENSOR_UNITS.items() if kind in kinds), "")
    if kind in _OF_JOINTS and int(model.jnt_type[joint]) == int(mujoco.mjtJoint.mjJNT_SLIDE):
        return {"rad": "m", "rad/s": "m/s", "N m": "N"}[unit]
    return unit


def check_sensors(model: mujoco.MjModel, channels: Sequence[Channel]) -> None:
    """Raises TargetError for sensors that do not read the present state, which no window could start from."""
    for channel in channels:
        match = _CHANNEL.match(channel.target)
        name = match and (match["sensor"] or match["turned"])
        if name:
            sensor = named(model, "sensor", name, f"measurement {channel.label!r}")
            if model.sensor_delay[sensor] > 0 or model.sensor_interval[sensor, 0] > 0:
                raise TargetError(
                    f"measurement {channel.label!r}: sensor {name!r} has a delay or an interval; "
                    "remove it and shift the log instead"
                )
