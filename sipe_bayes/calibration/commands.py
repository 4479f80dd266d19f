"""What commands are given in, held against the actuators that they drive: units, and what a column's name says.

A plain motor, of gear and gain 1, takes N m at a hinge and N at a slide; a position actuator rad or m, a velocity
actuator rad/s or m/s, a motor with a back-EMF V. A gear, gain or ``factor`` that is not 1, or a gear or gain that is
unknown, converts: V and A then drive a motor too. A muscle and a damper take a share. ``"1"`` says nothing of what a
column is, and always passes. Nothing is commanded in kg or s.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

import mujoco
import numpy as np

from sipe_bayes.calibration.column_names import Kind, read_name
from sipe_bayes.calibration.config import Config
from sipe_bayes.calibration.config_fields import ConfigError
from sipe_bayes.calibration.config_tables import Command
from sipe_bayes.calibration.machine import Drive, drive_of, full_of
from sipe_bayes.core.findings import Code, Finding, finding
from sipe_bayes.core.units import DIMENSIONS, UNITS, find_unit, unit_words
from sipe_bayes.envs.foreign.load import compile_spec, load_spec

_ELECTRIC = ("voltage", "current")
_NEVER = ("mass", "time")
_SHARES = (int(mujoco.mjtGain.mjGAIN_AFFINE), int(mujoco.mjtGain.mjGAIN_MUSCLE))  # what motion gives, times a command
_QUANTITIES = {  # of what turns, and of what slides
    Drive.FORCE: ("torque", "force"),
    Drive.POSITION: ("angle", "length"),
    Drive.VELOCITY: ("angular velocity", "velocity"),
}
_CONVERSION = re.compile(r"(?:N\s?m|Nm|N)\s*(?:/|per)\s*([A-Za-z%]+)")  # "N m/V", "N per A"
_OTHERWISE = {  # kinds of names that are no such command
    Drive.FORCE: (Kind.POSITION, Kind.VELOCITY, Kind.ACCELERATION, Kind.QUATERNION, Kind.TIME),
    Drive.POSITION: (Kind.TORQUE, Kind.CURRENT, Kind.ACCELERATION, Kind.QUATERNION, Kind.TIME),
    Drive.VELOCITY: (Kind.TORQUE, Kind.CURRENT, Kind.ACCELERATION, Kind.QUATERNION, Kind.TIME),
}
_OTHERWISE[Drive.VOLTAGE] = _OTHERWISE[Drive.FORCE]
_TURNING = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_BALL)


def check_commands(config: Config) -> tuple[Finding, ...]:
    """Refuse commands in a unit that their actuators do not take; returns doubts of what columns are called.

    Raises:
        ConfigError: for such a unit.
        ModelError: for a model that cannot be read.
    """
    if not config.commands:
        return ()
    model = compile_spec(load_spec(str(config.model)), str(config.model))
    doubts = []
    for i, command in enumerate(config.commands):
        index = model.actuator(command.actuator).id
        unit, takes = find_unit(command.unit), _dimensions(config, command, model, index)
        if unit.dimension not in takes:
            own = next(iter(takes))
            words = ", ".join(map(repr, unit_words(own)))
            raise ConfigError(
                f"{config.path}: key `commands[{i}].unit`: actuator {command.actuator!r} is given {own}, got "
                f"{unit.word!r} ({unit.dimension}); use one of {words}, or '1' with the `factor` that makes it one"
            )
        doubts += list(_doubts(config, command, drive_of(model, index), full_of(model, index)))
    return tuple(doubts)


def _dimensions(config: Config, command: Command, model: mujoco.MjModel, index: int) -> tuple[str, ...]:
    """What an actuator may be given; the first is what it stands for itself."""
    drive, turns, slides = drive_of(model, index), *_moves(model, index)
    meant = _described(config, command)
    if drive == Drive.OTHER:
        if not meant and command.factor == 1 and int(model.actuator_gaintype[index]) in _SHARES:
            return ("dimensionless",)
        return (*meant, "dimensionless", *(d for d in DIMENSIONS if d not in _NEVER))
    plain = _is_plain(config, command, model, index)
    quantities = _QUANTITIES[Drive.FORCE if drive == Drive.VOLTAGE else drive]
    own = tuple(d for d, moved in zip(quantities, (turns, slides), strict=True) if moved) or quantities
    if drive == Drive.VOLTAGE:
        own = ("voltage", *(own if plain else ()), *(("current",) if command.factor != 1 else ()))
    elif meant and command.factor == 1:
        own = meant
    elif not plain or command.factor != 1:
        own = (*own, *quantities, *_ELECTRIC)
    return (*own, "dimensionless")


def _is_plain(config: Config, command: Command, model: mujoco.MjModel, index: int) -> bool:
    """Whether a unit of the command is a unit of what the actuator does: nothing converts it, known or not."""
    unknown = {target for parameter in config.parameters for target in parameter.targets}
    if unknown & {f"{command.target}.gear", f"{command.target}.gain"}:
        return False
    if int(model.actuator_gaintype[index]) == int(mujoco.mjtGain.mjGAIN_DCMOTOR):  # whose first number is no gain
        return False
    gears = np.abs(model.actuator_gear[index])
    scales = [*gears[gears > 0].tolist()]
    if drive_of(model, index) in (Drive.FORCE, Drive.VOLTAGE):
        scales.append(float(model.actuator_gainprm[index, 0]))
    elif int(model.actuator_gaintype[index]) == int(mujoco.mjtGain.mjGAIN_FIXED):
        _, of_position, of_velocity = model.actuator_biasprm[index, :3].tolist()
        scales.append(-float(model.actuator_gainprm[index, 0]) / (of_position or of_velocity))
    if int(model.actuator_trntype[index]) == int(mujoco.mjtTrn.mjTRN_TENDON):
        scales += np.abs(model.wrap_prm[_wraps(model, index)]).tolist()
    return bool(np.isclose(scales, 1.0).all())


def _wraps(model: mujoco.MjModel, index: int) -> slice:
    """What an actuator's tendon runs over."""
    tendon = int(model.actuator_trnid[index, 0])
    start = int(model.tendon_adr[tendon])
    return slice(start, start + int(model.tendon_num[tendon]))


def _moves(model: mujoco.MjModel, index: int) -> tuple[bool, bool]:
    """Whether an actuator turns something, and whether it pushes something along."""
    kind, at = int(model.actuator_trntype[index]), int(model.actuator_trnid[index, 0])
    joints: list[int] = []
    if kind in (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)):
        joints = [at]
    elif kind == int(mujoco.mjtTrn.mjTRN_TENDON):
        wraps = _wraps(model, index)
        if not (model.wrap_type[wraps] == int(mujoco.mjtWrap.mjWRAP_JOINT)).all():
            return False, True
        joints = model.wrap_objid[wraps].tolist()
    elif kind == int(mujoco.mjtTrn.mjTRN_SLIDERCRANK):
        return False, True
    kinds = {int(model.jnt_type[joint]) for joint in joints}
    if not kinds or int(mujoco.mjtJoint.mjJNT_FREE) in kinds:  # a site, or a body that is free
        gear = model.actuator_gear[index] != 0
        return bool(gear[3:].any()), bool(gear[:3].any())
    return bool(kinds & set(map(int, _TURNING))), int(mujoco.mjtJoint.mjJNT_SLIDE) in kinds


def _described(config: Config, command: Command) -> tuple[str, ...]:
    """What a gear or gain that is unknown is given per, where its description says so: V of "N m/V"."""
    own = {f"{command.target}.gear", f"{command.target}.gain"}
    texts = [p.description for p in config.parameters if own & set(p.targets)]
    words = [word for text in texts for word in _CONVERSION.findall(text)]
    return tuple(UNITS[word].dimension for word in words if word in UNITS)


def _doubts(config: Config, command: Command, drive: Drive, full: float | None) -> Iterator[Finding]:
    """Where a column's name, its unit, or what else it is, speaks against its being this command."""
    label = read_name(command.column)
    measured = [m.target for m in config.measurements if command.column in m.sources and "sensor:" not in m.target]
    is_driven = drive in (Drive.FORCE, Drive.VOLTAGE)
    if is_driven and measured:
        yield _doubt(command, drive, f"measures {measured[0]}")
    elif len(command.column) > 1 and label.kind in _OTHERWISE.get(drive, ()):
        yield _doubt(command, drive, f"is called like a {label.kind.name.lower()}")
    if command.unit == "%" and command.factor == 1 and command.supply is None and full not in (None, 1.0):
        yield _doubt(
            command, drive, f"has 100 % for one unit of control (`factor = {full:g}`: for the whole ctrlrange)"
        )


def _doubt(command: Command, drive: Drive, why: str) -> Finding:
    return finding(
        Code.COMMAND_DOUBTED, column=command.column, actuator=command.actuator, drive=drive.value, reason=why
    )
