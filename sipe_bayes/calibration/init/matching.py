"""Which column is which quantity of the model: by names, numbers and order, and by what is the slope of what."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import scipy.optimize

from sipe_bayes.calibration.column_names import Kind, Label, alike, pieces_of, read_name, unit_of, vocabulary
from sipe_bayes.calibration.machine import Actuator, Drive, Joint, Machine
from sipe_bayes.calibration.signals import slope_of
from sipe_bayes.core.arrays import FloatArray

SURE = 1.0
"""A score from which names alone decide."""


@dataclass(frozen=True)
class Match:
    """Columns that are taken for a quantity of the model; score: how well the names agree; named: whether any does."""

    columns: tuple[str, ...]
    target: str
    label: Label
    score: float
    quaternion: str = ""
    named: bool = False

    @property
    def column(self) -> str:
        """The one column, or the first."""
        return self.columns[0]

    @property
    def sure(self) -> bool:
        """Whether names alone tell it."""
        return self.score >= SURE


@dataclass(frozen=True)
class Matches:
    """Every quantity of the model that has a column; rivals: commands that would do as well; doubts: of all columns.

    forces: what actuators with another command apply at their joints.
    """

    positions: tuple[Match, ...]
    velocities: tuple[Match, ...]
    commands: tuple[Match, ...]
    vectors: tuple[Match, ...]
    rivals: tuple[Match, ...]
    left: tuple[str, ...]
    doubts: tuple[str, ...] = ()
    forces: tuple[Match, ...] = ()


Table = Mapping[str, FloatArray]
Families = Mapping[str, list[Label]]

_NEVER = -2.0
_IN_ORDER = 1e-6  # where names do not decide, columns come in the order of what they are of
_EXACTLY = 0.5  # for a column that has all words of a joint's name, over one that has those of another's body
_CALLED = 0.65  # how alike a column and a joint are, from which it is called after it
_TENDONS = 0.3  # how alike a column and a tendon's actuator are, from which it is called after that and not a joint
_BACK = 0.01  # of its steps, from which a column that goes back is no clock
_RIVAL = 3.0  # by which a column for a command may fit worse than the chosen one and still be named


def match_columns(machine: Machine, table: Table) -> Matches:
    """Match varying columns to a model; table: column -> (n,) numbers of one log, without its clocks."""
    own = _own_words(machine)
    labels = [read_name(name, own) for name in table]
    labels = [replace(x, kind=Kind.UNKNOWN) if x.kind == Kind.TIME and _falls(table[x.column]) else x for x in labels]
    labels = [label for label in labels if label.kind not in (Kind.TIME, Kind.EPISODE)]
    vectors, labels = match_vectors(machine, labels)
    vectors, open_vectors = held_open(vectors)
    labels = _called_as_actuators(machine, _called_as_joints(machine, labels), _SAYS_NOTHING)
    labels = [replace(x, kind=Kind.OTHER) if x.kind == Kind.UNKNOWN and x.unit == "%" else x for x in labels]
    unnamed = {label.column for label in labels if label.kind == Kind.UNKNOWN}
    labels, open_commands = _unravelled(machine, labels, table)
    labels, of_tendons = _of_tendons(machine, labels)
    offsets = _ordinals(labels)
    positions = _assigned(machine.joints, labels, Kind.POSITION, offsets)
    velocities = _by_position(positions, _assigned(machine.joints, labels, Kind.VELOCITY, offsets), table)
    measured = {m.column for m in (*positions, *velocities)}
    over = [x for x in labels if x.column not in measured]
    commands, rivals = _commands(machine, _called_as_actuators(machine, over, _WANTED), offsets)
    forces = _forces(machine, labels, offsets, commands)
    used = {c for m in (*positions, *velocities, *commands, *vectors, *forces) for c in m.columns}
    spare = [label for label in labels if label.column in unnamed - used]
    positions += _left_over(machine, positions, spare, table)
    used |= {match.column for match in positions}
    left = tuple(name for name in table if name not in used)
    doubts = (*open_vectors, *open_commands, *of_tendons)
    return Matches(
        tuple(positions), tuple(velocities), tuple(commands), tuple(vectors), tuple(rivals), left, doubts, tuple(forces)
    )


def _of_tendons(machine: Machine, labels: list[Label]) -> tuple[list[Label], list[str]]:
    """Labels of which those called as an actuator of a tendon, and as no joint, measure no joint; and what they may."""
    pulling = [actuator.name for actuator in machine.actuators if actuator.tendon and actuator.joint is None]
    joints = [name for joint in machine.joints for name in (joint.name, joint.body)]

    def called(label: Label, names: Sequence[str]) -> float:
        return max((alike(label.words, name) for name in names), default=0.0)

    kinds = (Kind.POSITION, Kind.VELOCITY)
    away = {x.column for x in labels if x.kind in kinds and called(x, pulling) > max(called(x, joints), _TENDONS)}
    if not away:
        return labels, []
    which = ", ".join(map(repr, sorted(away)))
    doubt = f"{which}: called as what pulls a tendon, and no joint's; a <tendonpos> of the MJCF may be their target"
    return [replace(x, kind=Kind.OTHER) if x.column in away else x for x in labels], [doubt]


def _left_over(machine: Machine, positions: Sequence[Match], unnamed: Sequence[Label], table: Table) -> list[Match]:
    """The one column whose name says nothing, for the one joint that no column measures: pendel_winkel for a pivot.

    One that only rises counts something.
    """
    measured = {match.target for match in positions}
    bare = [joint for joint in machine.joints if f"joint:{joint.name}.position" not in measured]
    moving = [label for label in unnamed if _falls(table[label.column])]
    if not positions or not len(bare) == len(moving) == 1:
        return []
    return [Match((moving[0].column,), f"joint:{bare[0].name}.position", replace(moving[0], kind=Kind.POSITION), 0.0)]


def _falls(values: FloatArray) -> bool:
    """Whether a column goes back, as the ticks of a wheel do and those of a clock do not."""
    steps = np.diff(values[np.isfinite(values)])
    return bool((steps < 0).sum() > _BACK * max(1, (steps != 0).sum()))


def _own_words(machine: Machine) -> set[str]:
    """Words of quantities that are none here: a joint is called so, or nothing has an inertial unit.

    Of these ``gx`` and ``ax`` are short enough to be anything; ``drive`` is a joint's where no actuator is called so.
    """
    joints = {piece for joint in machine.joints for piece in pieces_of(joint.name)}
    driving = {actuator.name for actuator in machine.actuators}
    gauges = {"bar", "mbar", "pa", "kpa", "mpa", "kg"}
    own = joints & (vocabulary().of("short") | gauges | (vocabulary().of("command") - driving))
    sensors = {kind for _, kind in machine.sensors}
    for kind, letter in (("gyro", "g"), ("accelerometer", "a")):
        if not machine.bodies and kind not in sensors:
            own |= {letter + axis for axis in "xyz"}
    return own


def _ordinals(labels: Sequence[Label]) -> dict[str, int]:
    """Of a column with a number, its place within its family, counted from 0."""
    families: dict[str, set[int]] = defaultdict(set)
    for label in labels:
        if label.number is not None:
            families[label.stem].add(label.number)
    return {
        x.column: sorted(families[x.stem]).index(x.number)
        for x in labels
        if x.number is not None and len(families[x.stem]) > 1
    }


def _affinity(label: Label, name: str, rank: int, hinge: bool | None, place: int | None, count: int) -> float:
    """How well a column's name fits an object of the model."""
    score = 3.0 * alike(label.words, name)
    if label.words and not score:
        score -= 0.3 * len(label.words)  # it speaks of something else
    own = number_of(name)
    if place is not None:
        same = label.number == own if own is not None and not label.words else place == rank
        score += 1.2 if place == rank else 1.0 if same else -1.5
    elif label.number is not None and own is not None and count > 1:
        score += 1.2 if label.number == own else -1.5
    if hinge is not None and label.angular is not None:
        score += 0.6 if label.angular == hinge else _NEVER
    return score - 0.01 * rank


def _of_joint(label: Label, joint: Joint, place: int | None, count: int) -> float:
    """How well a column's name fits a joint, by its own name or its body's."""
    own, body = (
        _affinity(label, name, joint.rank, joint.hinge, place, count) for name in (joint.name, joint.body or joint.name)
    )
    return max(own + _EXACTLY * is_exactly(label, joint.name), body - 0.1)


def _solved(scores: FloatArray) -> list[tuple[int, int]]:
    """Pairs (column, object) of the best assignment that are not excluded."""
    rows, objects = scipy.optimize.linear_sum_assignment(-np.maximum(scores, _NEVER - 1))
    return [(int(i), int(j)) for i, j in zip(rows, objects, strict=True) if scores[i, j] > _NEVER / 2]


def _assigned(joints: Sequence[Joint], labels: Sequence[Label], kind: Kind, places: Mapping[str, int]) -> list[Match]:
    """Columns of positions, velocities or forces, each to the joint that it fits best."""
    labels = [label for label in labels if label.kind == kind]
    if not labels or not joints:
        return []
    scores = np.array([[_of_joint(x, j, places.get(x.column), len(joints)) for j in joints] for x in labels])
    scores += [[0.05 * x.measured - 0.002 * k] for k, x in enumerate(labels)]
    scores += _IN_ORDER * np.outer(range(len(labels)), range(len(joints)))
    word = {Kind.POSITION: "position", Kind.TORQUE: "force"}.get(kind, "velocity")
    alone = len(labels) == len(joints) == 1
    pairs = sorted(_solved(scores), key=lambda pair: pair[1])
    names = [joint.name for joint in joints]
    return [
        Match(
            (labels[i].column,), f"joint:{names[j]}.{word}", labels[i],
            SURE if alone or _only(labels[i], names, j) else _surety(scores, i, j),
            named=max(alike(labels[i].words, names[j]), alike(labels[i].words, joints[j].body)) > 0,
        )
        for i, j in pairs
    ]  # fmt: skip


def _only(label: Label, names: Sequence[str], j: int) -> bool:
    """Whether a column is called exactly as one of the names, and as no other."""
    return [k for k, name in enumerate(names) if is_exactly(label, name)] == [j]


def _surety(scores: FloatArray, i: int, j: int) -> float:
    """By how much a pair is better than the next best object for its column."""
    others = np.delete(scores[i], j)
    return float(min(scores[i, j], scores[i, j] - others.max()) if others.size else scores[i, j] + 0.5)


def _by_position(positions: Sequence[Match], velocities: Sequence[Match], table: Table) -> list[Match]:
    """Velocities exchanged among the joints, and those without a name given to others, where slopes tell so."""
    places = {m.target.removesuffix("position"): table[m.column] for m in positions}
    targets = list(dict.fromkeys([*(m.target for m in velocities), *(f"{place}velocity" for place in places)]))
    scores = np.zeros((len(velocities), len(targets)))
    for i, match in enumerate(velocities):
        for j, target in enumerate(targets):
            place = places.get(target.removesuffix("velocity"))
            share = 0.0 if place is None else slope_of(place, table[match.column]).share
            given = j < len(velocities) or not match.named  # what is called after a joint is no other one's
            scores[i, j] = (share if given else -1.0) + 0.2 * (i == j)
    rows, objects = scipy.optimize.linear_sum_assignment(-scores)
    pairs = sorted(zip(objects.tolist(), rows.tolist(), strict=True))
    return [replace(velocities[i], target=targets[j]) for j, i in pairs]


_FORCE = {Kind.TORQUE: 3.0, Kind.COMMAND: 2.6, Kind.CURRENT: 2.0, Kind.VOLTAGE: 1.8, Kind.DUTY: 1.7, Kind.SETPOINT: 0.3}
_VOLTS = {Kind.VOLTAGE: 3.0, Kind.DUTY: 2.8, Kind.COMMAND: 2.6, Kind.CURRENT: 0.5, Kind.TORQUE: 0.3, Kind.SETPOINT: 0.2}
_ANY = {Kind.COMMAND: 3.0, Kind.DUTY: 2.8, Kind.SETPOINT: 2.4, Kind.TORQUE: 2.0, Kind.VOLTAGE: 2.0, Kind.CURRENT: 1.5}
_DRIVING = {Kind.COMMAND, Kind.SETPOINT, Kind.SPEED_SETPOINT, Kind.TORQUE, Kind.DUTY}
_WANTED = {Kind.POSITION: Kind.SETPOINT, Kind.VELOCITY: Kind.SPEED_SETPOINT}
_SAYS_NOTHING = {Kind.UNKNOWN: Kind.COMMAND}
_FITS: dict[Drive, dict[Kind, float]] = {
    Drive.FORCE: _FORCE,
    Drive.POSITION: {Kind.SETPOINT: 3.0, Kind.COMMAND: 2.6},
    Drive.VELOCITY: {Kind.SPEED_SETPOINT: 3.0, Kind.COMMAND: 2.6, Kind.SETPOINT: 0.3},
    Drive.VOLTAGE: _VOLTS,
    Drive.OTHER: _ANY,
}


def _commands(machine: Machine, labels: Sequence[Label], places: Mapping[str, int]) -> tuple[list[Match], list[Match]]:
    """Columns of commands to actuators, and those that would have fitted as well."""
    actuators = machine.actuators
    labels = [x for x in labels if any(x.kind in fits for fits in _FITS.values()) or x.kind == Kind.SPEED_SETPOINT]
    if not labels or not actuators:
        return [], []

    def score(label: Label, actuator: Actuator) -> float:
        fit = _FITS[actuator.drive].get(label.kind)
        if fit is None:
            return _NEVER - 1
        place, count = places.get(label.column), len(actuators)
        by_name = _affinity(label, actuator.name, actuator.rank, None, place, count)
        joint = actuator.joint
        by_joint = _of_joint(label, replace(joint, rank=actuator.rank), place, count) if joint else by_name
        return fit - 2.6 + max(by_name, by_joint - 0.05) - 0.3 * label.measured

    scores = np.array([[score(x, a) for a in actuators] for x in labels])
    scores -= [[0.002 * k] for k in range(len(labels))]
    scores += _IN_ORDER * np.outer(range(len(labels)), range(len(actuators)))
    pairs = sorted(_solved(scores), key=lambda pair: pair[1])
    alone, names = len(actuators) == 1, [actuator.name for actuator in actuators]
    moved = [actuator.joint.name if actuator.joint else "" for actuator in actuators]
    rest = [i for i, x in enumerate(labels) if x.commanded and i not in {i for i, _ in pairs}]
    undriven = sorted(set(range(len(actuators))) - {j for _, j in pairs})
    if len(rest) == len(undriven) == 1:  # whatever it is called
        pairs.append((rest[0], undriven[0]))
    commands, rivals = [], []
    for i, j in pairs:
        target = f"actuator:{actuators[j].name}"
        exactly = _only(labels[i], names, j) or _only(labels[i], moved, j)
        surety = SURE if alone or exactly else _surety(scores, i, j)
        named = max(alike(labels[i].words, names[j]), alike(labels[i].words, moved[j])) > 0
        commands.append(Match((labels[i].column,), target, labels[i], surety, named=named))
        for k in np.argsort(-scores[:, j]):
            free = k not in {i for i, _ in pairs}
            if free and scores[k, j] > max(scores[i, j] - _RIVAL, -0.5):
                rivals.append(Match((labels[k].column,), target, labels[k], float(scores[k, j])))
    return commands, rivals


def _forces(
    machine: Machine, labels: Sequence[Label], places: Mapping[str, int], commands: Sequence[Match]
) -> list[Match]:
    """Columns of what actuators apply at joints, of those that another column commands."""
    driven = {m.target: m.label for m in commands}
    joints = [
        a.joint for a in machine.actuators
        if a.joint and (label := driven.get(f"actuator:{a.name}")) and label.kind != Kind.TORQUE
    ]  # fmt: skip
    taken = {label.column for label in driven.values()}
    felt = [x for x in labels if x.kind == Kind.TORQUE and x.column not in taken and not x.commanded]
    return _assigned(list(dict.fromkeys(joints)), felt, Kind.TORQUE, places)


def _called_as_joints(machine: Machine, labels: list[Label]) -> list[Label]:
    """Labels of which those with nothing but the name of a joint or its body are positions, where it has no other."""

    def speaks(label: Label, joint: Joint) -> bool:
        return max(alike(label.words, joint.name), alike(label.words, joint.body)) > _CALLED

    places = [x for x in labels if x.kind == Kind.POSITION]
    open_joints = [j for j in machine.joints if not any(speaks(x, j) for x in places)]
    return [
        replace(x, kind=Kind.POSITION) if x.kind == Kind.UNKNOWN and any(speaks(x, j) for j in open_joints) else x
        for x in labels
    ]


def _called_as_actuators(machine: Machine, labels: list[Label], become: Mapping[Kind, Kind]) -> list[Label]:
    """Labels of which those called as an actuator, and as no joint, drive it, where fewer columns drive than it needs.

    Args:
        machine: the model's.
        labels: of the columns.
        become: the kinds that may be such columns, and what they then are.
    """
    driving = [x for x in labels if x.kind in _DRIVING or x.kind in (Kind.CURRENT, Kind.VOLTAGE)]
    if len(driving) >= len(machine.actuators):
        return labels
    undriven = [a.name for a in machine.actuators if not any(alike(x.words, a.name) > _CALLED for x in driving)]
    joints = [name for joint in machine.joints for name in (joint.name, joint.body)]

    def called(label: Label, names: Sequence[str]) -> float:
        return max((alike(label.words, name) for name in names), default=0.0)

    def drives(label: Label) -> bool:
        family = label.kind is Kind.UNKNOWN and label.number is not None  # of such there is doubt
        whole = [name for name in undriven if tuple(pieces_of(name)) == label.words and name not in joints]
        named = bool(whole) or called(label, undriven) > max(_CALLED, called(label, joints))
        return label.kind in become and not family and not label.measured and named

    return [replace(x, kind=become[x.kind]) if drives(x) else x for x in labels]


def _unravelled(machine: Machine, labels: list[Label], table: Table) -> tuple[list[Label], list[str]]:
    """Labels with kinds for columns whose names say none, by their number and by what is whose slope; and doubts."""
    unknown = [x for x in labels if x.kind == Kind.UNKNOWN]
    families: dict[str, list[Label]] = defaultdict(list)
    for label in unknown:
        families[label.stem if label.number is not None else ""].append(label)
    known = {x.column: x for x in labels}
    joints = len(machine.joints)
    have = sum(x.kind == Kind.POSITION for x in labels)
    states = {s for s, family in families.items() if s and joints and not have and len(family) in (joints, 2 * joints)}
    driving, doubts = _by_number(machine, {s: f for s, f in families.items() if s and s not in states}, labels)
    for stem, family in families.items():
        family = sorted(family, key=lambda x: x.number or 0)
        kinds = [Kind.OTHER] * len(family)
        if stem in states:
            kinds = _kinds(family, table, joints)
        elif stem == driving:
            kinds = [Kind.COMMAND] * len(family)
        elif not stem:
            kinds = _by_slopes(family, labels, table)
        for label, kind in zip(family, kinds, strict=True):
            place = None if kind == Kind.OTHER or not stem else [k for k in kinds[: family.index(label)]].count(kind)
            number = label.number if place is None else place
            known[label.column] = replace(label, kind=kind, number=number, stem=f"{label.stem}{kind.name}")
    return list(known.values()), doubts


def _by_number(machine: Machine, families: Families, labels: list[Label]) -> tuple[str | None, list[str]]:
    """The stem of the family that is taken for commands, since it has a column for each actuator; and doubts."""
    count, kinds = len(machine.actuators), [x.kind for x in labels]
    felt = sum(kind in (Kind.CURRENT, Kind.VOLTAGE) for kind in kinds)  # one may be the battery's
    as_many = {stem: family for stem, family in families.items() if len(family) == count > 1}
    if not as_many or felt >= count or any(kind in _DRIVING for kind in kinds):
        return None, []

    def likeness(stem: str) -> float:
        return max(alike(as_many[stem][0].words, actuator.name) for actuator in machine.actuators)

    own = {actuator.name.lower() for actuator in machine.actuators}
    for stem, family in as_many.items():
        if {x.column.lower() for x in family} == own and len(as_many) == 1:
            return stem, []
    chosen, *others = sorted(as_many, key=likeness, reverse=True)
    names = {stem: ", ".join(repr(x.column) for x in family) for stem, family in as_many.items()}
    rivals = "".join(f"; or are these: {names[stem]}?" for stem in others)
    driven = ", ".join(actuator.name for actuator in machine.actuators)
    text = f"{names[chosen]} are taken for the commands of {driven} since they are as many: their names do not say so"
    return chosen, [f"{text}{rivals or '; check it'}"]


def _kinds(family: Sequence[Label], table: Table, joints: int) -> list[Kind]:
    """Positions of a state array, then velocities; or one after the other, where the slopes tell so."""
    if len(family) == joints:
        return [Kind.POSITION] * joints
    interleaved = [Kind.POSITION, Kind.VELOCITY] * joints
    blocks = [Kind.POSITION] * joints + [Kind.VELOCITY] * joints
    values = [table[x.column] for x in family]
    return interleaved if joints > 1 and _slopes(values, 2, 1) > _slopes(values, 1, joints) else blocks


def _slopes(values: Sequence[FloatArray], step: int, ahead: int) -> float:
    """How well each column ``ahead`` of another is its slope."""
    pairs = [(values[i], values[i + ahead]) for i in range(0, len(values) - ahead, step)][: len(values) // 2]
    return sum(slope_of(p, v).share for p, v in pairs)


def _by_slopes(family: Sequence[Label], labels: Sequence[Label], table: Table) -> list[Kind]:
    """A column is a velocity where it is the slope of a position, or of another one of them, which then is one."""
    kinds = {x.column: Kind.OTHER for x in family}
    places = [x.column for x in labels if x.kind == Kind.POSITION]
    for label in family:
        if any(slope_of(table[p], table[label.column]).share > 0.8 for p in places):
            kinds[label.column] = Kind.VELOCITY
        elif "d" in label.column.lower() and label.column.lower().rstrip("0123456789").endswith("d"):
            kinds[label.column] = Kind.SETPOINT  # q_d that is no slope: desired
        elif not places:
            others = [x.column for x in family if x is not label]
            if any(slope_of(table[label.column], table[o]).share > 0.8 for o in others):
                kinds[label.column] = Kind.POSITION
            elif any(slope_of(table[o], table[label.column]).share > 0.8 for o in others):
                kinds[label.column] = Kind.VELOCITY
    return list(kinds.values())


def match_vectors(machine: Machine, labels: list[Label]) -> tuple[list[Match], list[Label]]:
    """Poses of free bodies and readings of inertial sensors: groups of three or four columns; and what is left."""
    groups: dict[str, list[Label]] = defaultdict(list)
    for label in labels:
        if label.axis or label.number is not None:
            groups[label.vector if label.axis else label.stem].append(label)
    out: list[Match] = []
    taken: set[str] = set()
    for wanted, size, target_of in _wanted(machine):
        for stem, group in groups.items():
            part = [x for x in group if x.column not in taken]
            fitting = [x for x in part if wanted(x, stem)]
            if len(fitting) != size:
                continue
            order = "xyz" if size == 3 else ("wxyz" if fitting[0].axis in ("w", "") else "xyzw")
            if fitting[0].axis:
                fitting = sorted(fitting, key=lambda x: order.index(x.axis))
            else:
                fitting = sorted(fitting, key=lambda x: x.number or 0)
            target, score = target_of(stem)
            if any(m.target == target for m in out):
                continue
            quaternion = order if size == 4 else ""
            columns = tuple(x.column for x in fitting)
            taken |= set(columns)
            sure = score if fitting[0].axis or size == 3 else 0.0
            out.append(Match(columns, target, fitting[0], sure, quaternion))
    return out, [x for x in labels if x.column not in taken]


Wanted = tuple[Callable[[Label, str], bool], int, Callable[[str], tuple[str, float]]]


def _wanted(machine: Machine) -> list[Wanted]:
    """What vectors a model may have: whether a column is one of them, how many, and the target of a stem."""
    out: list[Wanted] = [
        (is_gyro if kind == "gyro" else is_accelerometer, 3, partial(_sensor, name)) for name, kind in machine.sensors
    ]
    if machine.bodies:
        turns = partial(is_turn, alone=not machine.joints)
        out.append((turns, 4, partial(_body, machine, "orientation")))
        out.append((lambda x, s: x.kind == Kind.POSITION and not turns(x, s), 3, partial(_body, machine, "position")))
        out.append((is_spin, 3, partial(_body, machine, "angular_velocity")))
        out.append(
            (lambda x, s: x.kind == Kind.VELOCITY and not is_spin(x, s), 3, partial(_body, machine, "linear_velocity"))
        )
    return out


def held_open(vectors: Sequence[Match]) -> tuple[list[Match], list[str]]:
    """Vectors, of which none that may be another one is sure unless that one is there; and what is to be said."""
    reasons = [two_ways(m.label, m.target) if m.target.startswith("body:") else "" for m in vectors]
    clear = {match.target for match, why in zip(vectors, reasons, strict=True) if not why}
    other = {"linear_velocity": "angular_velocity", "angular_velocity": "linear_velocity"}
    out, doubts = [], []
    for match, why in zip(vectors, reasons, strict=True):
        body, _, quantity = match.target.rpartition(".")
        if why and ("<gyro>" in why or f"{body}.{other[quantity]}" not in clear):
            names = ", ".join(map(repr, match.columns))
            doubts.append(f"{names} are taken for {match.target}: {why}")
            match = replace(match, score=0.0)
        out.append(match)
    return out, doubts


def _sensor(name: str, stem: str) -> tuple[str, float]:
    return f"sensor:{name}", SURE


def _body(machine: Machine, quantity: str, stem: str) -> tuple[str, float]:
    """The free body that a stem speaks of, and how sure that is."""
    words = read_name(stem).words
    best = max(machine.bodies, key=lambda name: alike(words, name))
    return f"body:{best}.{quantity}", SURE if len(machine.bodies) == 1 or alike(words, best) > 0.5 else 0.0


def is_exactly(label: Label, name: str) -> bool:
    """Whether a column is called as something of the model, but for words of its quantity and of the log's format."""
    own = pieces_of(name)
    numbers = {label.number} if label.number is not None else set[int]()
    return (
        bool(own)
        and {*own} <= {*pieces_of(label.column)}
        and {*label.words} <= {*own}
        and numbers <= {int(piece) for piece in own if piece.isdigit()}
    )


def number_of(name: str) -> int | None:
    """The last number in a name of the model."""
    numbers = re.findall(r"\d+", name)
    return int(numbers[-1]) if numbers else None


def _speaks(stem: str, *words: str) -> bool:
    return any(word in stem.lower() for word in words)


def _ends(stem: str, letter: str) -> bool:
    """Whether a component's name, without its axis and unit, ends with a letter."""
    pieces = pieces_of(stem)
    units = [piece == "per" or piece.isdigit() or bool(unit_of([piece])) for piece in pieces]
    while len(pieces) > 1 and pieces[-1] != letter and units[len(pieces) - 1]:
        pieces.pop()
    return pieces[-1:] == [letter]


def is_gyro(label: Label, stem: str) -> bool:
    """Whether a component of a vector with this name is a gyro's."""
    return label.kind == Kind.VELOCITY and (_speaks(stem, "gyro", "omega", "ang") or _ends(stem, "g"))


def is_accelerometer(label: Label, stem: str) -> bool:
    """Whether it is an accelerometer's."""
    return label.kind == Kind.ACCELERATION and (_speaks(stem, "acc", "linear") or _ends(stem, "a"))


def is_turn(label: Label, stem: str, alone: bool = False) -> bool:
    """Whether it is a quaternion's; alone: q[0] to q[3] of a machine without joints are one too."""
    spelt = _speaks(stem, "quat", "orientation") or (alone and pieces_of(stem)[-1:] == ["q"])
    return label.kind == Kind.QUATERNION or (label.number is not None and spelt)


def is_spin(label: Label, stem: str) -> bool:
    """Whether it is an angular velocity's."""
    if label.kind != Kind.VELOCITY:
        return False
    if label.unit.startswith(("rad", "deg", "rev", "rpm")) or label.unit in ("m", "mm", "cm", "m/s", "mm/s", "cm/s"):
        return not label.unit.startswith(("m", "cm"))
    if _speaks(stem, "ang", "omega", "gyro"):
        return True
    if vocabulary().of("about") & {*pieces_of(label.column)}:
        return not _speaks(stem, "lin")
    return bool({"w", "g"} & {*pieces_of(stem)}) and not _speaks(stem, "vel", "lin")  # beside these `w` is the frame


def two_ways(label: Label, target: str) -> str:
    """Why the velocity of a body that a component's name was taken for may be another one; "" where it is clear."""
    pieces = {*pieces_of(label.column)}
    if label.kind != Kind.VELOCITY or _speaks(label.vector, "ang", "omega"):
        return ""
    if {"gx", "gy", "gz"} & pieces:
        return "a gyro tells it in the body's own axes: if it is one, give the model a <gyro>"
    glued, linear = bool(vocabulary().of("about") & pieces), _speaks(label.vector, "lin")
    if label.unit or not (linear or _speaks(label.vector, "vel")) or not (glued or ("w" in pieces and not linear)):
        return ""
    other = "linear" if target.endswith("angular_velocity") else "angular"
    return f"or are they its {other} velocity, since `w` is the world as well as a rate?"
