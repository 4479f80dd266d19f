"""From matched columns to readings: first units, counts and shares, wrap-around, velocities held against slopes.

Of LeRobot a gripper goes from 0 (closed) to 100 (open), and other joints in degrees or from -100 to 100.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from sipe_bayes.calibration.column_names import Kind, Label, pieces_of, read_name, read_vocabulary
from sipe_bayes.calibration.init.draft import Reading, Scale
from sipe_bayes.calibration.init.matching import Match, Matches
from sipe_bayes.calibration.init.tables import Clock
from sipe_bayes.calibration.machine import Actuator, Drive, Joint, Machine
from sipe_bayes.calibration.signals import likeness, slope_of, turn_of, white_share
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.units import find_unit, unit_words

Table = Mapping[str, FloatArray]

PERCENT, BOTH_WAYS = (0.0, 100.0), (-100.0, 100.0)
_FOLLOWS = 0.8  # share of variance from which a column is another's slope, or follows it
_NEAR = 0.12  # relative: a factor between units that is as near is that factor
_COUNTS = (4096, 1024, 2048, 8192, 16384, 65536, 4000, 2000, 1000, 400, 10000, 20000, 131072, 360)  # to a turn
_SERVO_COUNTS = (4096, 1024)  # of Dynamixel X and Feetech STS, and of AX and SCS
_FULL_DUTIES = (1.0, 100.0, 127.0, 255.0, 400.0, 511.0, 1000.0, 1023.0, 2047.0, 4095.0, 32767.0, 65535.0)
_MILLIVOLTS = 200.0
_SHARED = (Drive.FORCE, Drive.VOLTAGE, Drive.OTHER)  # what takes a share of all that there is


def straightened(
    tables: Sequence[Table], matches: Matches, machine: Machine
) -> tuple[dict[str, FloatArray], dict[str, float]]:
    """The first table with angles that wrap round in one of them written on, and the turn of each such column."""
    hinges = {f"joint:{joint.name}.position" for joint in machine.joints if joint.hinge}
    columns = [m.column for m in matches.positions if m.target in hinges]
    turns = {c: max((turn_of(table[c]) for table in tables if c in table), default=0.0) for c in columns}
    turns = {column: turn for column, turn in turns.items() if turn}
    out = dict(tables[0])
    for column, turn in turns.items():
        known = np.isfinite(out[column])
        out[column] = out[column].copy()
        out[column][known] = np.unwrap(out[column][known], period=turn)
    return out, turns


def first_readings(
    machine: Machine, matches: Matches, table: Table, turns: Mapping[str, float], clock: Clock
) -> tuple[tuple[Reading, ...], tuple[Reading, ...]]:
    """Measurements and commands as names and numbers alone tell them."""
    positions = [_read_position(machine, m, table, turns) for m in matches.positions]
    positions = [_use_velocity(reading, matches, table, clock) for reading in _share_counts(positions, machine)]
    vectors = [_read_vector(m, table) for m in matches.vectors]
    velocities = [Reading(m, _choose_unit(m, _find_joint_unit(machine, m, "/s"))) for m in matches.velocities]
    drives = {f"actuator:{actuator.name}": actuator for actuator in machine.actuators}
    commands = [_read_command(drives[m.target], m, matches, table) for m in matches.commands]
    commands = [_turn_into_range(reading, drives[reading.match.target], table) for reading in commands]
    positions, commands = _add_shares(positions, commands, machine, table)
    return (*positions, *velocities, *vectors), tuple(commands)


def _find_joint_unit(machine: Machine, match: Match, per: str = "") -> str:
    joint = next(j for j in machine.joints if match.target.startswith(f"joint:{j.name}."))
    return ("rad" if joint.hinge else "m") + per


def _choose_unit(match: Match, default: str) -> str:
    """The unit in the name where it is of the right kind."""
    named = match.label.unit
    return named if named in unit_words(find_unit(default).dimension) else default


def _name_unit(reading: Reading, unit: str) -> Reading:
    """A reading as if its column's name said a unit, or none."""
    return replace(reading, match=replace(reading.match, label=replace(reading.match.label, unit=unit)))


def _note_match(match: Match) -> tuple[str, ...]:
    how = "for the nearest name" if match.named else "by the order of names alone"
    return () if match.sure else (f"taken for {match.target} {how}",)


def _read_position(machine: Machine, match: Match, table: Table, turns: Mapping[str, float]) -> Reading:
    reading = Reading(match, _choose_unit(match, _find_joint_unit(machine, match)), notes=_note_match(match))
    if turn := turns.get(match.column):
        unit = {360.0: "deg", 2 * np.pi: "rad", 1.0: "rev"}[turn]
        note = f"jumps by {turn:.5g} where it comes round: {unit}, jumps are taken out"
        return replace(_name_unit(reading, unit), unit=unit, wraps=True).add_evidence(note)
    counts = _find_counts(table[match.column], match.label) if reading.unit == "rad" and not match.label.unit else ()
    if counts:
        return replace(reading, scales=counts).read_as(counts[0])
    if white_share(table[match.column]) < 0.05:
        return reading.add_evidence(
            "looks filtered: hardly any noise at its highest frequencies; its lag would count as a delay"
        )
    return reading


def _find_counts(values: FloatArray, label: Label) -> tuple[Scale, ...]:
    """What whole numbers may be of a turn, the likeliest first; nothing for others.

    Of servos, which are at 0 in the middle of their turn, what stands in their tables.
    """
    known = values[np.isfinite(values)]
    span = float(np.ptp(known)) if len(known) else 0.0
    if span < 30 or (np.mod(known, 1) != 0).any():
        return ()
    if read_vocabulary().of("registers").intersection(pieces_of(label.column)):
        servos = [n for n in _SERVO_COUNTS if known.min() >= 0 and known.max() < n]
        return (*(Scale("rev", 1 / n, None, n / 2) for n in servos), Scale("rev", 1 / _SERVO_COUNTS[0]))
    return tuple(Scale("rev", 1 / n) for n in _COUNTS if 0.01 < span / n < 12.0)


def _share_counts(positions: Sequence[Reading], machine: Machine) -> list[Reading]:
    """Positions of which columns that are called alike but for a side, as their joints are, count alike."""
    names = {f"joint:{joint.name}.position": joint.name for joint in machine.joints}
    sides, pairs = read_vocabulary().of("side"), defaultdict[tuple[str, ...], list[int]](list)
    for k, reading in enumerate(positions):
        pieces = pieces_of(f"{reading.match.column}_{names[reading.match.target]}")
        if reading.scales and sides.intersection(pieces):
            pairs[tuple(piece for piece in pieces if piece not in sides)].append(k)
    out = list(positions)
    for pair in pairs.values():
        scales = tuple(s for s in out[pair[0]].scales if all(s in out[k].scales for k in pair))
        for k in pair if scales else ():
            out[k] = replace(out[k], scales=scales).read_as(scales[0])
    return out


def _use_velocity(reading: Reading, matches: Matches, table: Table, clock: Clock) -> Reading:
    """Where only the velocity's name has a unit, it tells that of the position too."""
    joint = reading.match.target.removesuffix("position")
    partner = next((m for m in matches.velocities if m.target == f"{joint}velocity"), None)
    if partner is None or reading.match.label.unit or not partner.label.unit:
        return reading
    slope = slope_of(table[reading.match.column], table[partner.column], clock.period)
    # of the position, for each of its units
    wanted = find_unit(partner.label.unit).factor * find_unit(clock.unit).factor / abs(slope.factor)

    def off(scale: Scale) -> float:
        return abs(float(np.log(wanted / (scale.factor * find_unit(scale.unit).factor))))

    units = [Scale(word) for word in unit_words(find_unit(reading.unit).dimension)]
    near = [scale for scale in (*sorted(reading.scales, key=off), *units) if off(scale) < _NEAR]
    if slope.share < _FOLLOWS or not near:
        return reading
    unit, factor, *_ = near[0]
    read = reading if near[0] in reading.scales else _name_unit(reading, unit)
    note = f"{near[0]}: {partner.column!r} in {partner.label.unit} is its slope"
    return replace(read, factor=factor, unit=unit, scales=()).add_evidence(note)


def _read_vector(match: Match, table: Table) -> Reading:
    """Poses and inertial sensors, whose units their sizes tell."""
    if match.quaternion and not match.label.axis:
        doubt = f"is the quaternion {match.quaternion} or xyzw? its columns do not say"
        return Reading(match, "1", doubts=(doubt,), instead=('quaternion = "xyzw"',))
    if match.quaternion:
        return Reading(match, "1", notes=(f"a quaternion in the order {match.quaternion}, by its axes",))
    size = float(np.nanmedian(np.linalg.norm([table[c] for c in match.columns], axis=0)))
    if match.label.kind == Kind.ACCELERATION:
        unit = "g0" if 0.5 < size < 2.0 else "m/s^2"
        return Reading(match, unit, fit=False, notes=(f"{unit}: its usual length is {size:.3g}",))
    if match.label.kind == Kind.VELOCITY:
        unit = _choose_unit(match, "m/s" if match.target.endswith("linear_velocity") else "rad/s")
        return Reading(match, unit, fit=False, notes=("starts windows; poses are fitted",))
    return Reading(match, _choose_unit(match, "m"), notes=_note_match(match))


def _read_command(actuator: Actuator, match: Match, matches: Matches, table: Table) -> Reading:
    kind, named, shared = match.label.kind, match.label.unit, actuator.drive in _SHARED
    force = "N m" if actuator.turns else "N"
    winch = (actuator.tendon or actuator.thrust) and kind != Kind.TORQUE  # of what no gear tells
    of_force = "1" if winch or kind == Kind.SETPOINT else force  # set is what is no force: a pressure
    default = {
        Drive.FORCE: {Kind.CURRENT: "A", Kind.VOLTAGE: "V"}.get(kind, of_force),
        Drive.POSITION: "rad" if actuator.turns else "m",
        Drive.VELOCITY: "rad/s" if actuator.turns else "m/s",
        Drive.VOLTAGE: {Kind.TORQUE: force, Kind.CURRENT: "A"}.get(kind, "V"),
        Drive.OTHER: "1",
    }[actuator.drive]
    pulse = _find_pulse(table[match.column], actuator, match.label) if shared else None
    if (named == "%" and shared) or kind == Kind.DUTY or pulse:
        return _read_duty(match, actuator, table, pulse)
    fits = named in unit_words(find_unit(default).dimension) or (shared and named not in ("", "rad", "deg", "m", "mm"))
    reading = Reading(match, named if named and fits else default, notes=_note_match(match))
    reading = reading if fits else _name_unit(reading, "")
    place = next(
        (m for m in matches.positions if actuator.joint and m.target == f"joint:{actuator.joint.name}.position"), None
    )
    if place is not None and actuator.drive != Drive.POSITION:
        share = likeness(table[match.column], table[place.column]).share
        if kind == Kind.SETPOINT or (share > 0.9 and kind == Kind.COMMAND and actuator.drive == Drive.FORCE):
            doubt = (
                f"it looks like a set-point of {place.column!r} ({100 * share:.0f} % of its variance), but "
                f"{actuator.name} takes {actuator.drive.value}; make it a <position> actuator, or name the torque"
            )
            reading = reading.add_evidence("", doubt)
    others = [m.column for m in matches.rivals if m.target == match.target][:3]
    if others:
        doubt = f"{match.column!r} or {', '.join(map(repr, others))}? both may drive {actuator.name}"
        reading = reading.add_evidence("", doubt, *(f'column = "{other}"' for other in others))
    return reading


def _read_duty(match: Match, actuator: Actuator, table: Table, pulse: tuple[float, float] | None) -> Reading:
    """A duty's scale, by its size, and the supply that it is a share of; pulse: as ``_pulse`` says."""
    values = table[match.column]
    largest, whole = float(np.nanmax(np.abs(values))), bool((np.mod(values[np.isfinite(values)], 1) == 0).all())
    full = next((f for f in _FULL_DUTIES if largest <= 1.005 * f and (whole or f in (1.0, 100.0))), largest)
    reading = Reading(match, "1", factor=1.0 if full == 1 else float(f"{1 / full:.6g}"))
    size = f"at most {largest:g} of {full:g}"
    if match.label.unit == "%" or full == 100:
        reading = replace(reading, unit="%", factor=1.0)
    elif pulse:
        reading = replace(_name_unit(reading, ""), zero=pulse[0], factor=1 / pulse[1])
        size = f"a pulse in us, nothing at {pulse[0]:g} and all at {sum(pulse):g}, as a speed controller takes it"
    reading = replace(reading, notes=(*_note_match(match), f"a duty: {size}"))
    factor, zero = reading.factor, reading.zero
    if zero and (values == 0).any():
        armed = f"{match.column!r} is 0 at times, as before a controller is armed, which is read as {-zero * factor:g}"
        reading = reading.add_evidence("", f"{armed}: begin the logs later")
    voltages = [n for n in table if read_name(n).kind == Kind.SUPPLY and np.isfinite(table[n]).any()]
    supplied = float(np.nanmedian(table[voltages[0]])) if voltages else 0.0
    volts = ("mV", 1e-3) if supplied > _MILLIVOLTS else ("V", 1.0)
    if voltages and (actuator.limits is None or max(np.abs(actuator.limits)) >= supplied * volts[1] / 2):
        reading = replace(reading, supply=(voltages[0], volts[0]))
        return reading.add_evidence(f"what arrives is it times {voltages[0]!r}")
    if actuator.full is not None:
        reading = replace(reading, factor=float(f"{factor * actuator.full:.6g}"))
        return reading.add_evidence(f"all of it is taken for {actuator.full:g}, where the model's ctrlrange ends")
    if actuator.drive != Drive.VOLTAGE:
        note = "all of it is one unit of control: the model has no ctrlrange from zero or the same to both sides"
        return reading.add_evidence(note)
    doubt = f"a share of which voltage? no column tells; multiply `factor` by the supply's volts for {actuator.name}"
    return replace(reading, doubts=(doubt,), instead=(f"factor = {12 * factor:.6g}  # at 12 V",))


def _find_pulse(values: FloatArray, actuator: Actuator, label: Label) -> tuple[float, float] | None:
    """Of a command that is the width of a servo's or speed controller's pulse, in us: where it is none, and its span.

    One that is not in microseconds is, where its actuator's ctrlrange ends far below, or has none and it is a duty.
    """
    values = values[np.isfinite(values) & (values != 0)]  # 0: not armed
    if not len(values) or values.min() < 800 or values.max() > 2200:
        return None
    far_below = label.kind == Kind.DUTY if actuator.limits is None else max(np.abs(actuator.limits)) <= 100
    if label.unit != "us" and not far_below:
        return None
    both_ways = actuator.limits[0] < 0 if actuator.limits else not actuator.flies and values.min() < 1400
    return (1500.0, 500.0) if both_ways else (1000.0, 1000.0)


def _turn_into_range(reading: Reading, actuator: Actuator, table: Table) -> Reading:
    """A command with the sign that the actuator's ctrlrange leaves it, where that lies on one side of zero."""
    if actuator.limits is None or not actuator.one_way:
        return reading
    values = (table[reading.match.column] - reading.zero) * reading.factor * find_unit(reading.unit).factor
    values = values[np.isfinite(values)] * (1 if max(actuator.limits) > 0 else -1)
    least, most = np.sort(np.abs(actuator.limits))
    noise, few = 0.01 * np.abs(values).max(), 0.05
    lost = float((values < -noise).mean())
    text = f"outside of the ctrlrange {list(actuator.limits)} of {actuator.name}, which makes nothing of it"
    if lost <= few:
        return reading
    if lost < 1 - few and (values > noise).mean() > few:
        doubt = f"{100 * lost:.0f} % of it lie {text}: look at the range, and at where the command has its zero"
        return reading.add_evidence("", doubt)
    turned = -values[values < 0]
    if reading.supply or np.mean((turned > (1 + _NEAR) * most) | (turned < (1 - _NEAR) * least)) < few:
        doubt = f"all of it lies {text}, and inside with the other sign, which is taken; check it"
        return replace(reading, sign=-1).add_evidence("", doubt, "sign = 1")
    doubt = f"all of it lies {text}, and with the other sign too: look at the range and at the unit"
    return reading.add_evidence("", doubt, "sign = -1")


def with_velocities(measurements: Sequence[Reading], table: Table, clock: Clock) -> tuple[Reading, ...]:
    """Velocities in the unit and direction that the slopes of their positions ask for."""
    places = {r.match.target.removesuffix("position") + "velocity": r for r in measurements if r.joint}
    pairs = [(reading, places.get(reading.match.target)) for reading in measurements]
    return tuple(one if place is None else _hold_against_slope(one, place, table, clock) for one, place in pairs)


def _hold_against_slope(reading: Reading, place: Reading, table: Table, clock: Clock) -> Reading:
    """One velocity beside its position."""
    own, second, named = place.match.column, find_unit(clock.unit).factor, reading.match.label.unit
    slope, reading = slope_of(table[own], table[reading.match.column], clock.period), replace(reading, fit=False)
    if slope.share < _FOLLOWS:
        is_no_slope = f"it is not its slope ({100 * slope.share:.0f} % of the variance)"
        doubt = f"taken for the velocity of {own!r} by name, but {is_no_slope}; it only starts windows"
        return reading.add_evidence("", doubt)
    wanted = slope.factor * place.sign * find_unit(place.unit).factor * place.factor / second / reading.factor
    words = unit_words(find_unit(reading.unit).dimension)
    word = min(words, key=lambda w: abs(np.log(abs(wanted) / find_unit(w).factor)))
    sign, near = 1 if wanted > 0 else -1, abs(wanted) / find_unit(word).factor
    times = f"the slope of {own!r} is {slope.factor:.4g} times it for each {clock.unit}"
    reading = replace(reading, unit=word, sign=sign).add_evidence(f"{'-' if sign < 0 else ''}{word}: {times}")
    if slope.lag > 1:
        late = 1e3 * slope.lag * clock.period * second
        reading = reading.add_evidence(f"late by {slope.lag:.1f} samples ({late:.2g} ms), as a filter makes it")
    doubt = ""
    if abs(np.log(near)) > _NEAR:
        doubt = f"{near:.3g} times the slope of {own!r} even in {word}: one of the two, or the clock, has another unit"
    elif named and named != word and named in words:
        doubt = f"its name says {named}, but as the slope of {own!r} it is {word}"
    return reading.add_evidence("it starts windows and is not fitted: the position says the same", doubt)


def _add_shares(
    positions: Sequence[Reading], commands: Sequence[Reading], machine: Machine, table: Table
) -> tuple[list[Reading], list[Reading]]:
    """Positions and set-points with the shares of a range that they may be, and read so where that is the likeliest."""
    joints = {f"joint:{joint.name}.position": joint for joint in machine.joints if joint.reach}
    servos = {f"actuator:{a.name}": a.joint for a in machine.actuators if a.drive == Drive.POSITION and a.joint}
    lerobot = any(name.startswith("observation.state") or name.endswith(".pos") for name in table)
    out, groups = [*positions, *commands], []
    for k, reading in enumerate(positions):
        if (joint := joints.get(reading.match.target)) and not reading.wraps:
            follow = [i for i, other in enumerate(out) if servos.get(other.match.target) == joint]
            groups.append((joint, [k, *follow], [table[out[i].match.column] for i in (k, *follow)]))
    bodies = [columns for joint, members, columns in groups if not _grips(joint, out[members[0]])]
    both_ways = lerobot and all(_stays_within(values, BOTH_WAYS) for columns in bodies for values in columns)
    for joint, members, columns in groups:
        alike = [likeness(values, columns[0]) for values in columns[1:]]  # set-points that have the position's unit
        if not all(x.share > _FOLLOWS and abs(np.log(max(x.factor, 1e-9))) < np.log(1.4) for x in alike):
            continue
        ends, likely = _find_ends(out[members[0]], joint, columns, lerobot, both_ways)
        says, share = _is_percent(out[members[0]]), Scale("rad" if joint.hinge else "m", 1.0, ends)
        for k in members if ends else ():
            reading = replace(out[k], shares=() if says else (share,), reach=joint.reach)
            if says:  # of which nothing else is asked
                reading = replace(_name_unit(reading, ""), scales=()).add_evidence(f"{share}, as its name says")
            out[k] = reading.read_as(share) if likely else reading
    return out[: len(positions)], out[len(positions) :]


def _grips(joint: Joint, reading: Reading) -> bool:
    return bool(read_vocabulary().of("gripper").intersection(pieces_of(f"{joint.name}_{reading.match.column}")))


def _stays_within(values: FloatArray, ends: tuple[float, float]) -> bool:
    """Whether a column stays within the ends, but for the 3 % by which a joint moves beyond its calibrated range."""
    known = values[np.isfinite(values)]
    return bool(known.size and known.min() >= ends[0] - 3 and known.max() <= ends[1] + 3)


def _is_percent(reading: Reading) -> bool:
    """Whether a column's name says that it is a percentage."""
    return "%" in (reading.match.label.unit, *(read_vocabulary().units.get(p) for p in pieces_of(reading.match.column)))


def _find_ends(
    reading: Reading, joint: Joint, columns: Sequence[FloatArray], lerobot: bool, both_ways: bool
) -> tuple[tuple[float, float] | None, bool]:
    """What a joint's columns may say at the ends of its range, and whether that is likelier than any unit."""
    one_way = all(_stays_within(values, PERCENT) for values in columns)
    if _is_percent(reading):
        return PERCENT if one_way else BOTH_WAYS, True
    if reading.match.label.unit or max(float(np.nanmax(np.abs(values))) for values in columns) < 7:  # as well rad
        return None, False
    low, high = joint.reach or (-np.inf, np.inf)
    smallest, values = find_unit("deg" if joint.hinge else "mm").factor, columns[0]
    leaves = bool(smallest * np.nanmax(values) > 1.15 * max(high, 0.0) or smallest * np.ptp(values) > high - low)
    if _grips(joint, reading):
        return PERCENT if one_way else None, one_way and (lerobot or leaves)
    return BOTH_WAYS if lerobot and both_ways else PERCENT if one_way and leaves else None, False
