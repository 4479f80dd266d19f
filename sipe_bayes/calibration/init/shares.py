"""Positions and set-points that may be told as a share of their joint's range: 0 to 100, or -100 to 100.

LeRobot logs a gripper from 0 (closed) to 100 (open), and other joints in degrees or from -100 to 100.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from sipe_bayes.calibration.column_names import pieces_of
from sipe_bayes.calibration.init.draft import Reading, Scale
from sipe_bayes.calibration.machine import Drive, Joint, Machine
from sipe_bayes.calibration.signals import likeness
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.units import find_unit

PERCENT, BOTH_WAYS = (0.0, 100.0), (-100.0, 100.0)
_GRIPPERS = {"gripper", "grippers", "grip", "grasp", "jaw", "jaws", "finger", "fingers", "claw", "pincer"}
_PERCENTS = {"%", "pct", "percent", "percentage"}
_BEYOND = 3.0  # percent, by which a joint may be moved beyond the range to which it was calibrated
_MOST_RADIANS = 7.0  # up to which a column may as well be in rad
_OUTSIDE = 1.15  # times a joint's range, from which a column moves too far for a unit
_FOLLOWS, _SAME = 0.8, np.log(1.4)  # share of variance, and how near to one, where a set-point has a position's unit


def with_shares(
    positions: Sequence[Reading], commands: Sequence[Reading], machine: Machine, table: Mapping[str, FloatArray]
) -> tuple[list[Reading], list[Reading]]:
    """Positions and set-points with the shares of a range that they may be, and read so where that is the likeliest.

    Args:
        positions: of joints.
        commands: of actuators.
        machine: the model's.
        table: column -> (n,) numbers.
    """
    joints = {f"joint:{joint.name}.position": joint for joint in machine.joints}
    servos = {f"actuator:{a.name}": a.joint for a in machine.actuators if a.drive == Drive.POSITION and a.joint}
    lerobot = any(name.startswith("observation.state") or name.endswith(".pos") for name in table)
    out, driven = list(positions), list(commands)
    pairs = [
        (k, joint, [i for i, c in enumerate(driven) if servos.get(c.match.target) == joint])
        for k, reading in enumerate(out)
        if (joint := joints.get(reading.match.target)) and joint.reach and not reading.wraps
    ]
    bodies = [_columns(k, follow, out, driven, table) for k, joint, follow in pairs if not _grips(joint, out[k])]
    both_ways = lerobot and all(_within(values, BOTH_WAYS) for columns in bodies for values in columns)
    for k, joint, follow in pairs:
        columns = _columns(k, follow, out, driven, table)
        if not all(_is_same(values, columns[0]) for values in columns[1:]):
            continue
        shares, likely = _shares_of(out[k], joint, columns, lerobot, both_ways)
        says = _says(out[k])
        for of, place in ((out, k), *((driven, i) for i in follow)):
            of[place] = _put(of[place], joint, shares, likely, says)
    return out, driven


def _columns(
    k: int, follow: Sequence[int], out: Sequence[Reading], driven: Sequence[Reading], table: Mapping[str, FloatArray]
) -> list[FloatArray]:
    """Of a position and its set-points."""
    return [table[reading.match.column] for reading in (out[k], *(driven[i] for i in follow))]


def _grips(joint: Joint, reading: Reading) -> bool:
    return bool(_GRIPPERS.intersection((*pieces_of(joint.name), *pieces_of(reading.match.column))))


def _within(values: FloatArray, ends: tuple[float, float]) -> bool:
    known = values[np.isfinite(values)]
    return bool(known.size and known.min() >= ends[0] - _BEYOND and known.max() <= ends[1] + _BEYOND)


def _is_same(command: FloatArray, measured: FloatArray) -> bool:
    """Whether a set-point has the unit of the position that follows it."""
    alike = likeness(command, measured)
    return alike.share > _FOLLOWS and bool(abs(np.log(max(alike.factor, 1e-9))) < _SAME)


def _says(reading: Reading) -> bool:
    """Whether its name says that it is a percentage."""
    return reading.match.label.unit == "%" or bool(_PERCENTS.intersection(pieces_of(reading.match.column)))


def _shares_of(
    reading: Reading, joint: Joint, columns: Sequence[FloatArray], lerobot: bool, both_ways: bool
) -> tuple[tuple[Scale, ...], bool]:
    """What shares a joint's columns may be, and whether that is likelier than any unit."""
    whole, halves = (Scale("rad" if joint.hinge else "m", 1.0, ends) for ends in (PERCENT, BOTH_WAYS))
    one_way = all(_within(values, PERCENT) for values in columns)
    if _says(reading):
        return (whole if one_way else halves,), True
    largest = max(float(np.nanmax(np.abs(values))) for values in columns)
    if reading.match.label.unit or largest < _MOST_RADIANS:
        return (), False
    if _grips(joint, reading):
        return (whole,) * one_way, one_way and (lerobot or _leaves(columns[0], joint))
    if lerobot and both_ways:
        return (halves,), False
    return (whole,) * (one_way and _leaves(columns[0], joint)), False


def _leaves(values: FloatArray, joint: Joint) -> bool:
    """Whether a column moves further than its joint can, in every unit."""
    low, high = joint.reach or (-np.inf, np.inf)
    smallest = find_unit("deg" if joint.hinge else "mm").factor
    return bool(smallest * np.nanmax(values) > _OUTSIDE * max(high, 0.0) or smallest * np.ptp(values) > high - low)


def _put(reading: Reading, joint: Joint, shares: tuple[Scale, ...], likely: bool, says: bool) -> Reading:
    """A reading with shares; of what is called a percentage nothing else is asked."""
    if not shares:
        return reading
    if says:
        match = replace(reading.match, label=replace(reading.match.label, unit=""))
        notes = (*reading.notes, f"{shares[0]}, as its name says")
        return replace(reading, match=match, scales=(), reach=joint.reach, notes=notes).read_as(shares[0])
    reading = replace(reading, shares=shares, reach=joint.reach)
    return reading.read_as(shares[0]) if likely else reading
