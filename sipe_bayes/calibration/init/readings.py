"""From matched columns to readings: first units, wrap-around, velocities held against slopes, what looks filtered."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sipe_bayes.calibration.column_names import Kind, Label, pieces_of, read_name, vocabulary
from sipe_bayes.calibration.init.draft import Reading, Scale
from sipe_bayes.calibration.init.matching import Match, Matches
from sipe_bayes.calibration.init.shares import with_shares
from sipe_bayes.calibration.init.tables import Clock
from sipe_bayes.calibration.machine import Actuator, Drive, Machine
from sipe_bayes.calibration.signals import Slope, likeness, slope_of, turn_of, white_share
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.units import find_unit, unit_words

Table = Mapping[str, FloatArray]

_FOLLOWS = 0.8  # share of variance from which a column is another's slope
_NEAR = 0.12  # relative: a factor between units that is as near is that factor
_FILTERED = 0.05  # of white noise in the upper frequencies
_LATE = 1.0  # samples
_ALIKE = 0.9  # share of variance from which a command is a set-point
_COUNTS = (4096, 1024, 2048, 8192, 16384, 65536, 4000, 2000, 1000, 400, 10000, 20000, 131072, 360)  # to a turn
_SERVO_COUNTS = (4096, 1024)  # of Dynamixel X and Feetech STS, and of AX and SCS
_FEWEST_COUNTS = 30
_LEAST_TURN, _MOST_TURNS = 0.01, 12.0
_SHARES = (1.0, 100.0)  # that need not be whole numbers
_FULL_DUTIES = (1.0, 100.0, 127.0, 255.0, 400.0, 511.0, 1000.0, 1023.0, 2047.0, 4095.0, 32767.0, 65535.0)
_MILLIVOLTS = 200.0
_PULSES = (800.0, 2200.0)  # us, the widths that servos and speed controllers take
_SHARED = (Drive.FORCE, Drive.VOLTAGE, Drive.OTHER)  # what takes a share of all that there is
_NOISE = 0.01  # of the largest command, what is about zero
_FEW = 0.05  # of the samples, what tells nothing of the side on which a command lies
_TURNS = {360.0: "deg", 2 * np.pi: "rad", 1.0: "rev"}


def straightened(
    tables: Sequence[Table], matches: Matches, machine: Machine
) -> tuple[dict[str, FloatArray], dict[str, float]]:
    """The first table with angles that wrap round in one of them written on, and the turn of each such column."""
    hinges = {f"joint:{joint.name}.position" for joint in machine.joints if joint.hinge}
    columns = [m.column for m in matches.positions if m.target in hinges]
    turns = {c: max((turn_of(table[c]) for table in tables if c in table), default=0.0) for c in columns}
    turns = {column: turn for column, turn in turns.items() if turn}
    return {n: _written_on(v, turns[n]) if n in turns else v for n, v in tables[0].items()}, turns


def _written_on(values: FloatArray, turn: float) -> FloatArray:
    known = np.isfinite(values)
    out = values.copy()
    out[known] = np.unwrap(values[known], period=turn)
    return out


def first_readings(
    machine: Machine, matches: Matches, table: Table, turns: Mapping[str, float], clock: Clock
) -> tuple[tuple[Reading, ...], tuple[Reading, ...]]:
    """Measurements and commands as names and numbers alone tell them."""
    positions = [_position(machine, m, table, turns) for m in matches.positions]
    positions = [_by_velocity(reading, matches, table, clock) for reading in counting_alike(positions, machine)]
    vectors = [_vector(m, table) for m in matches.vectors]
    velocities = [Reading(m, _unit(m, _joint_unit(machine, m, "/s"))) for m in matches.velocities]
    drives = {f"actuator:{actuator.name}": actuator for actuator in machine.actuators}
    commands = [_command(drives[m.target], m, matches, table) for m in matches.commands]
    commands = [_on_its_side(reading, drives[reading.match.target], table) for reading in commands]
    positions, commands = with_shares(positions, commands, machine, table)
    return (*positions, *velocities, *vectors), tuple(commands)


def _joint_unit(machine: Machine, match: Match, per: str = "") -> str:
    joint = next(j for j in machine.joints if match.target.startswith(f"joint:{j.name}."))
    return ("rad" if joint.hinge else "m") + per


def _unit(match: Match, default: str) -> str:
    """The unit in the name where it is of the right kind."""
    named = match.label.unit
    return named if named in unit_words(find_unit(default).dimension) else default


def _position(machine: Machine, match: Match, table: Table, turns: Mapping[str, float]) -> Reading:
    reading = Reading(match, _unit(match, _joint_unit(machine, match)), notes=_matched(match))
    turn = turns.get(match.column)
    if turn:
        unit = _TURNS[turn]
        label = replace(match.label, unit=unit)
        note = f"jumps by {turn:.5g} where it comes round: {unit}, jumps are taken out"
        return replace(reading, match=replace(match, label=label), unit=unit, wraps=True, notes=(*reading.notes, note))
    counts = _counts(table[match.column], match.label) if reading.unit == "rad" and not match.label.unit else ()
    if counts:
        return replace(reading, scales=counts).read_as(counts[0])
    if white_share(table[match.column]) < _FILTERED:
        note = "looks filtered: hardly any noise at its highest frequencies; its lag would count as a delay"
        reading = replace(reading, notes=(*reading.notes, note))
    return reading


def _counts(values: FloatArray, label: Label) -> tuple[Scale, ...]:
    """What whole numbers may be of a turn, the likeliest first; nothing for others.

    Of servos, which are at 0 in the middle of their turn, what stands in their tables.
    """
    known = values[np.isfinite(values)]
    span = float(np.ptp(known)) if len(known) else 0.0
    if span < _FEWEST_COUNTS or (np.mod(known, 1) != 0).any():
        return ()
    if {"present", "goal"} & {*pieces_of(label.column)}:
        servos = [n for n in _SERVO_COUNTS if known.min() >= 0 and known.max() < n]
        return (*(Scale("rev", 1 / n, None, n / 2) for n in servos), Scale("rev", 1 / _SERVO_COUNTS[0]))
    return tuple(Scale("rev", 1 / n) for n in _COUNTS if _LEAST_TURN < span / n < _MOST_TURNS)


def counting_alike(positions: Sequence[Reading], machine: Machine) -> list[Reading]:
    """Positions of which columns that are called alike but for a side, as their joints are, count alike."""
    names = {f"joint:{joint.name}.position": joint.name for joint in machine.joints}

    def stem(reading: Reading) -> tuple[str, ...]:
        """Nothing without a side."""
        pieces = pieces_of(f"{reading.match.column}_{names[reading.match.target]}")
        sides = vocabulary().of("side")
        return tuple(p for p in pieces if p not in sides) if sides.intersection(pieces) else ()

    left: dict[tuple[str, ...], set[Scale]] = {}
    for reading in positions:
        if reading.scales and stem(reading):
            left[stem(reading)] = left.get(stem(reading), {*reading.scales}) & {*reading.scales}
    out = []
    for reading in positions:
        scales = tuple(scale for scale in reading.scales if scale in left.get(stem(reading), ()))
        alike = replace(reading, scales=scales).read_as(scales[0]) if scales else reading
        out.append(alike)
    return out


def _matched(match: Match) -> tuple[str, ...]:
    how = "for the nearest name" if match.named else "by the order of names alone"
    return () if match.sure else (f"taken for {match.target} {how}",)


def _by_velocity(reading: Reading, matches: Matches, table: Table, clock: Clock) -> Reading:
    """Where only the velocity's name has a unit, it tells that of the position too."""
    joint = reading.match.target.removesuffix("position")
    partner = next((m for m in matches.velocities if m.target == f"{joint}velocity"), None)
    if partner is None or reading.match.label.unit or not partner.label.unit:
        return reading
    slope = slope_of(table[reading.match.column], table[partner.column], clock.period)
    if slope.share < _FOLLOWS:
        return reading
    per_second = slope.factor / find_unit(clock.unit).factor  # position's unit, for each unit of the velocity
    wanted = find_unit(partner.label.unit).factor / abs(per_second)
    for scale in sorted(reading.scales, key=lambda s: abs(np.log(wanted / (s.factor * find_unit(s.unit).factor)))):
        note = f"{scale}: {partner.column!r} in {partner.label.unit} is its slope"
        if abs(np.log(wanted / (scale.factor * find_unit(scale.unit).factor))) > _NEAR:
            break
        return replace(reading, unit=scale.unit, factor=scale.factor, scales=(), notes=(*reading.notes, note))
    for word in unit_words(find_unit(reading.unit).dimension):
        if abs(np.log(wanted / find_unit(word).factor)) < _NEAR:
            note = f"{word}: {partner.column!r} in {partner.label.unit} is its slope"
            label = replace(reading.match.label, unit=word)
            match = replace(reading.match, label=label)
            return replace(reading, match=match, unit=word, notes=(*reading.notes, note))
    return reading


def _vector(match: Match, table: Table) -> Reading:
    """Poses and inertial sensors, whose units their sizes tell."""
    kind = match.target.rpartition(".")[2]
    if match.quaternion:
        axes = "by its axes" if match.label.axis else "OPEN"
        reading = Reading(match, "1", notes=(f"a quaternion in the order {match.quaternion}, {axes}",))
        if not match.label.axis:
            doubt = f"is the quaternion {match.quaternion} or xyzw? its columns do not say"
            reading = replace(reading, notes=(), doubts=(doubt,), instead=('quaternion = "xyzw"',))
        return reading
    size = float(np.nanmedian(np.linalg.norm([table[c] for c in match.columns], axis=0)))
    if match.label.kind == Kind.ACCELERATION:
        unit = "g0" if 0.5 < size < 2.0 else "m/s^2"
        return Reading(match, unit, fit=False, notes=(f"{unit}: its usual length is {size:.3g}",))
    if match.label.kind == Kind.VELOCITY:
        unit = _unit(match, "m/s" if kind == "linear_velocity" else "rad/s")
        return Reading(match, unit, fit=False, notes=("starts windows; poses are fitted",))
    return Reading(match, _unit(match, "m"), notes=_matched(match))


def _command(actuator: Actuator, match: Match, matches: Matches, table: Table) -> Reading:
    hinge = actuator.turns
    force = "N m" if hinge else "N"
    winch = (actuator.tendon or actuator.thrust) and match.label.kind != Kind.TORQUE  # of what no gear tells
    of_force = "1" if winch or match.label.kind == Kind.SETPOINT else force  # set is what is no force: a pressure
    default = {
        Drive.FORCE: {Kind.CURRENT: "A", Kind.VOLTAGE: "V"}.get(match.label.kind, of_force),
        Drive.POSITION: "rad" if hinge else "m",
        Drive.VELOCITY: "rad/s" if hinge else "m/s",
        Drive.VOLTAGE: {Kind.TORQUE: force, Kind.CURRENT: "A"}.get(match.label.kind, "V"),
        Drive.OTHER: "1",
    }[actuator.drive]
    share = match.label.unit == "%" and actuator.drive in _SHARED
    pulses = actuator.drive in _SHARED and _pulse(table[match.column], actuator, match.label)
    if share or match.label.kind == Kind.DUTY or pulses:
        return _duty(match, actuator, table)
    named = match.label.unit
    fits = named in (unit_words(find_unit(default).dimension)) or (
        actuator.drive in _SHARED and named not in ("", "rad", "deg", "m", "mm")
    )
    reading = Reading(match, named if named and fits else default, notes=_matched(match))
    if named and not fits:
        reading = replace(reading, match=replace(match, label=replace(match.label, unit="")))
    reading = _looked_through(reading, actuator, matches, table)
    others = [m.column for m in matches.rivals if m.target == match.target]
    if others:
        doubt = f"{match.column!r} or {', '.join(map(repr, others[:3]))}? both may drive {actuator.name}"
        instead = tuple(f'column = "{other}"' for other in others[:3])
        reading = replace(reading, doubts=(*reading.doubts, doubt), instead=(*reading.instead, *instead))
    return reading


def _duty(match: Match, actuator: Actuator, table: Table) -> Reading:
    """A duty's scale, by its size, and the supply that it is a share of."""
    values = table[match.column]
    largest, whole = float(np.nanmax(np.abs(values))), bool((np.mod(values[np.isfinite(values)], 1) == 0).all())
    full = next((f for f in _FULL_DUTIES if largest <= 1.005 * f and (whole or f in _SHARES)), largest)
    unit, zero, factor = "1", 0.0, 1.0 if full == 1 else float(f"{1 / full:.6g}")
    size = f"at most {largest:g} of {full:g}"
    if match.label.unit == "%" or full == _SHARES[1]:
        unit, factor = "%", 1.0
    elif (pulse := _pulse(values, actuator, match.label)) and actuator.drive in _SHARED:
        zero, factor, match = pulse.none, 1 / pulse.span, replace(match, label=replace(match.label, unit=""))
        size = f"a pulse in us, nothing at {zero:g} and all at {zero + pulse.span:g}, as a speed controller takes it"
    reading = Reading(match, unit, factor=factor, zero=zero, notes=(*_matched(match), f"a duty: {size}"))
    if zero and (values == 0).any():
        doubt = f"{match.column!r} is 0 at times, as before a controller is armed, which is read as {-zero * factor:g}"
        reading = replace(reading, doubts=(f"{doubt}: begin the logs later",))
    voltages = [n for n in table if read_name(n).kind == Kind.SUPPLY and np.isfinite(table[n]).any()]
    ends = np.inf if actuator.limits is None else max(np.abs(actuator.limits))
    supplied = [float(np.nanmedian(table[name])) for name in voltages]
    if voltages and ends >= supplied[0] * (1e-3 if supplied[0] > _MILLIVOLTS else 1) / 2:
        volts = "mV" if supplied[0] > _MILLIVOLTS else "V"
        note = f"what arrives is it times {voltages[0]!r}"
        return replace(reading, supply=(voltages[0], volts), notes=(*reading.notes, note))
    if actuator.full is not None:
        note = f"all of it is taken for {actuator.full:g}, where the model's ctrlrange ends"
        return replace(reading, factor=float(f"{factor * actuator.full:.6g}"), notes=(*reading.notes, note))
    if actuator.drive != Drive.VOLTAGE:
        note = "all of it is one unit of control: the model has no ctrlrange from zero or the same to both sides"
        return replace(reading, notes=(*reading.notes, note))
    doubt = f"a share of which voltage? no column tells; multiply `factor` by the supply's volts for {actuator.name}"
    return replace(reading, doubts=(doubt,), instead=(f"factor = {12 * factor:.6g}  # at 12 V",))


class _Pulse(NamedTuple):
    """Of a pulse's width in microseconds: where nothing is driven, and how much more drives fully."""

    none: float
    span: float


def _pulse(values: FloatArray, actuator: Actuator, label: Label) -> _Pulse | None:
    """How a command is read as pulses of a servo's or a speed controller's kind; None where it is none.

    One that is not in microseconds is, where its actuator's ctrlrange ends far below, or has none and it is a duty.
    """
    values = values[np.isfinite(values) & (values != 0)]  # 0: not armed
    if not len(values) or values.min() < _PULSES[0] or values.max() > _PULSES[1]:
        return None
    far_below = label.kind == Kind.DUTY if actuator.limits is None else max(np.abs(actuator.limits)) <= _SHARES[1]
    if label.unit != "us" and not far_below:
        return None
    both_ways = actuator.limits[0] < 0 if actuator.limits else not actuator.flies and values.min() < 1400
    return _Pulse(1500.0, 500.0) if both_ways else _Pulse(1000.0, 1000.0)


def _on_its_side(reading: Reading, actuator: Actuator, table: Table) -> Reading:
    """A command with the sign that the actuator's ctrlrange leaves it, where that lies on one side of zero."""
    if actuator.limits is None or not actuator.one_way:
        return reading
    values = (table[reading.match.column] - reading.zero) * reading.factor * find_unit(reading.unit).factor
    values = values[np.isfinite(values)] * (1 if max(actuator.limits) > 0 else -1)
    least, most = np.sort(np.abs(actuator.limits))
    lost = float((values < -_NOISE * np.abs(values).max()).mean())
    text = f"outside of the ctrlrange {list(actuator.limits)} of {actuator.name}, which makes nothing of it"
    if lost <= _FEW:
        return reading
    if lost < 1 - _FEW and (values > _NOISE * np.abs(values).max()).mean() > _FEW:
        doubt = f"{100 * lost:.0f} % of it lie {text}: look at the range, and at where the command has its zero"
        return replace(reading, doubts=(*reading.doubts, doubt))
    turned = -values[values < 0]
    if reading.supply or np.mean((turned > (1 + _NEAR) * most) | (turned < (1 - _NEAR) * least)) < _FEW:
        doubt = f"all of it lies {text}, and inside with the other sign, which is taken; check it"
        return replace(reading, sign=-1, doubts=(*reading.doubts, doubt), instead=(*reading.instead, "sign = 1"))
    doubt = f"all of it lies {text}, and with the other sign too: look at the range and at the unit"
    return replace(reading, doubts=(*reading.doubts, doubt), instead=(*reading.instead, "sign = -1"))


def _looked_through(reading: Reading, actuator: Actuator, matches: Matches, table: Table) -> Reading:
    """Whether a command is a set-point, and what the actuator makes of it."""
    joint = actuator.joint
    place = None if joint is None else next(
        (m for m in matches.positions if m.target == f"joint:{joint.name}.position"), None
    )  # fmt: skip
    if place is None:
        return reading
    alike = likeness(table[reading.match.column], table[place.column])
    if actuator.drive == Drive.POSITION:
        return reading
    if reading.match.label.kind == Kind.SETPOINT or (
        alike.share > _ALIKE and reading.match.label.kind == Kind.COMMAND and actuator.drive == Drive.FORCE
    ):
        doubt = (
            f"it looks like a set-point of {place.column!r} ({100 * alike.share:.0f} % of its variance), but "
            f"{actuator.name} takes {actuator.drive.value}; make it a <position> actuator, or name the torque"
        )
        return replace(reading, doubts=(*reading.doubts, doubt))
    return reading


def with_velocities(measurements: Sequence[Reading], table: Table, clock: Clock) -> tuple[Reading, ...]:
    """Velocities in the unit and direction that the slopes of their positions ask for."""
    places = {r.match.target: r for r in measurements}
    out = []
    for reading in measurements:
        target = reading.match.target
        place = places.get(target.removesuffix("velocity") + "position") if target.startswith("joint:") else None
        if not target.endswith(".velocity") or place is None:
            out.append(reading)
            continue
        slope = slope_of(table[place.match.column], table[reading.match.column], clock.period)
        out.append(_as_slope(reading, place, slope, clock))
    return tuple(out)


def _as_slope(reading: Reading, place: Reading, slope: Slope, clock: Clock) -> Reading:
    """One velocity beside its position."""
    own, late = place.match.column, slope.lag * clock.period * find_unit(clock.unit).factor
    reading = replace(reading, fit=False)
    if slope.share < _FOLLOWS:
        doubt = (
            f"taken for the velocity of {own!r} by name, but it is not its slope ({100 * slope.share:.0f} % of the "
            "variance); it only starts windows"
        )
        return replace(reading, doubts=(*reading.doubts, doubt))
    wanted = slope.factor * place.sign * find_unit(place.unit).factor * place.factor / find_unit(clock.unit).factor
    wanted /= reading.factor
    words = unit_words(find_unit(reading.unit).dimension)
    word = min(words, key=lambda w: abs(np.log(abs(wanted) / find_unit(w).factor)))
    sign = 1 if wanted > 0 else -1
    near = abs(wanted) / find_unit(word).factor
    notes = [
        f"{'-' if sign < 0 else ''}{word}: the slope of {own!r} is {slope.factor:.4g} times it for each {clock.unit}"
    ]
    if slope.lag > _LATE:
        notes.append(f"late by {slope.lag:.1f} samples ({1e3 * late:.2g} ms), as a filter makes it")
    notes.append("it starts windows and is not fitted: the position says the same")
    doubts = list(reading.doubts)
    named = reading.match.label.unit
    if abs(np.log(near)) > _NEAR:
        doubts.append(
            f"{near:.3g} times the slope of {own!r} even in {word}: one of the two, or the clock, has another unit"
        )
    elif named and named != word and named in words:
        doubts.append(f"its name says {named}, but as the slope of {own!r} it is {word}")
    return replace(reading, unit=word, sign=sign, notes=(*reading.notes, *notes), doubts=tuple(doubts))
