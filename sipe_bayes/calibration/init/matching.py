"""Which column is which quantity of the model: a score of names, numbers and units for each pair, and one assignment.

Slopes then tell velocities apart, and what names leave open is told by how many columns there are of it.
"""

from __future__ import annotations

import itertools
import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.optimize

from sipe_bayes.calibration.column_names import Kind, Label, alike, pieces_of, read_name, read_vocabulary
from sipe_bayes.calibration.machine import Drive, Machine
from sipe_bayes.calibration.signals import slope_of
from sipe_bayes.core.arrays import FloatArray

SURE = 1.0
"""A score from which names alone decide."""
Table = Mapping[str, FloatArray]


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


@dataclass(frozen=True)
class _Target:
    """A scalar of the model: its names, the best first, and its place among those of its quantity."""

    name: str
    quantity: str
    names: tuple[str, ...]
    rank: int
    hinge: bool | None
    drive: Drive | None = None


_NEVER = -1.0  # a score up to which a column is not taken for a target
_CALLED = 0.65  # how alike a column and a part are, from which it is called after it
_FITS: dict[Drive | str, dict[Kind, float]] = {  # how well kinds of columns fit what an actuator or joint has
    "position": {Kind.POSITION: 0.0},
    "velocity": {Kind.VELOCITY: 0.0},
    "force": {Kind.TORQUE: 0.0},
    Drive.POSITION: {Kind.SETPOINT: 0.4, Kind.COMMAND: 0.0},
    Drive.VELOCITY: {Kind.SPEED_SETPOINT: 0.4, Kind.COMMAND: 0.0, Kind.SETPOINT: -2.3},
    Drive.FORCE: {Kind.TORQUE: 0.4, Kind.COMMAND: 0.0, Kind.CURRENT: -0.6, Kind.VOLTAGE: -0.8, Kind.DUTY: -0.9},
    Drive.VOLTAGE: {Kind.VOLTAGE: 0.4, Kind.DUTY: 0.2, Kind.COMMAND: 0.0, Kind.CURRENT: -2.1, Kind.TORQUE: -2.3},
    Drive.OTHER: {Kind.COMMAND: 0.4, Kind.DUTY: 0.2, Kind.TORQUE: -0.6, Kind.VOLTAGE: -0.6, Kind.CURRENT: -1.1},
}
for _drive, _fit in ((Drive.FORCE, -2.3), (Drive.VOLTAGE, -2.4), (Drive.OTHER, -0.2)):
    _FITS[_drive][Kind.SETPOINT] = _fit
_BECOMES = {Kind.UNKNOWN: Kind.COMMAND, Kind.POSITION: Kind.SETPOINT, Kind.VELOCITY: Kind.SPEED_SETPOINT}
_DRIVING = {Kind.COMMAND, Kind.SETPOINT, Kind.SPEED_SETPOINT, Kind.TORQUE, Kind.DUTY}


def match_columns(machine: Machine, table: Table) -> Matches:
    """Match varying columns to a model; table: column -> (n,) numbers of one log, without its clocks."""
    own = _find_own_words(machine)
    labels = [read_name(name, own) for name in table]
    labels = [replace(x, kind=Kind.UNKNOWN) if x.kind == Kind.TIME and _falls(table[x.column]) else x for x in labels]
    labels = [label for label in labels if label.kind not in (Kind.TIME, Kind.EPISODE)]
    vectors, labels, open_vectors = _match_vectors(machine, labels)
    labels, of_tendons = _leave_out_tendons(machine, labels)
    targets = _list_targets(machine)
    named = {m.column: m.label.kind for m in _assign(machine, labels, targets)[0]}
    labels = [replace(x, kind=named.get(x.column, x.kind)) if x.kind == Kind.UNKNOWN else x for x in labels]
    labels = [replace(x, kind=Kind.OTHER) if x.kind == Kind.UNKNOWN and x.unit == "%" else x for x in labels]
    unnamed = [label for label in labels if label.kind == Kind.UNKNOWN]
    labels, open_commands = _unravel(machine, labels, table)
    matches, rivals = _assign(machine, labels, targets)
    used = {match.column for match in matches}
    torques = {m.target for m in matches if m.label.kind == Kind.TORQUE}
    driven = {m.target for m in matches} - torques
    joints = {a.joint.name for a in machine.actuators if a.joint and f"actuator:{a.name}" in driven}
    felt = [x for x in labels if x.kind == Kind.TORQUE and x.column not in used and not x.commanded]
    forces, _ = _assign(machine, felt, [t for t in _list_targets(machine, "force") if t.names[0] in joints])
    positions = [m for m in matches if m.target.endswith(".position")]
    velocities = _exchange_velocities(positions, [m for m in matches if m.target.endswith(".velocity")], table)
    commands = [m for m in matches if m.target.startswith("actuator:")]
    moving = [x for x in unnamed if x.column not in used and _falls(table[x.column])]
    if positions:  # pendel_winkel for a pivot; what only rises counts something
        positions += _match_last(moving, [t for t in targets if t.quantity == "position"], positions, Kind.POSITION)
    driving = [x for x in labels if x.commanded and x.kind in {*_DRIVING, Kind.CURRENT, Kind.VOLTAGE}]
    driving = [x for x in driving if x.column not in used]
    commands += _match_last(driving, [t for t in targets if t.drive], commands)
    rivals = [rival for rival in rivals if rival.column not in {m.column for m in (*positions, *velocities, *commands)}]
    everything = (*positions, *velocities, *commands, *vectors, *forces)
    used = {column for match in everything for column in match.columns}
    left = tuple(name for name in table if name not in used)
    doubts = (*open_vectors, *open_commands, *of_tendons)
    return Matches(
        tuple(positions), tuple(velocities), tuple(commands), tuple(vectors), tuple(rivals), left, doubts, tuple(forces)
    )


def _find_own_words(machine: Machine) -> set[str]:
    """Words of quantities that are none here: a joint is called so, or nothing has an inertial unit.

    ``drive`` is a joint's where no actuator is called so; units of pressures are, where a joint is called so.
    """
    words = read_vocabulary()
    commands = words.of("command") - {actuator.name for actuator in machine.actuators}
    gauges = {word for word, unit in words.units.items() if unit in ("bar", "mbar", "Pa", "kPa", "MPa", "kg")}
    own = {p for joint in machine.joints for p in pieces_of(joint.name)} & (words.of("short") | commands | gauges)
    sensors = {kind for _, kind in machine.sensors}
    for kind, letter in (("gyro", "g"), ("accelerometer", "a")):
        if not machine.bodies and kind not in sensors:
            own |= {letter + axis for axis in "xyz"}
    return own


def _falls(values: FloatArray) -> bool:
    """Whether a column goes back in a hundredth of its steps, as ticks of a wheel do and a clock does not."""
    steps = np.diff(values[np.isfinite(values)])
    return bool((steps < 0).sum() > 0.01 * max(1, (steps != 0).sum()))


def _list_targets(machine: Machine, *quantities: str) -> list[_Target]:
    """Of the joints and actuators."""
    joints = [
        _Target(f"joint:{j.name}.{quantity}", quantity, (j.name, j.body), j.rank, j.hinge)
        for quantity in quantities or ("position", "velocity")
        for j in machine.joints
    ]
    actuators = [
        _Target(
            f"actuator:{a.name}", "command", (a.name, *((a.joint.name, a.joint.body) if a.joint else ("", ""))),
            a.rank, a.joint.hinge if a.joint else None, a.drive,
        )
        for a in machine.actuators
    ]  # fmt: skip
    return joints + actuators * (not quantities)


def _assign(machine: Machine, labels: Sequence[Label], targets: Sequence[_Target]) -> tuple[list[Match], list[Match]]:
    """Columns with the targets that fit best together, in the targets' order; and rivals of those that drive."""
    if not labels or not targets:
        return [], []
    places = _find_places(labels)
    kinds = [[_find_kind(machine, x, t) for t in targets] for x in labels]
    counts = [sum(t.quantity == other.quantity for other in targets) for t in targets]
    scores = np.full((len(labels), len(targets)), -np.inf)
    base = np.zeros_like(scores)
    for (i, x), (j, t) in ((one, other) for one in enumerate(labels) for other in enumerate(targets)):
        if taken := kinds[i][j]:
            order = 0.002 * i - 1e-6 * i * j  # where names do not decide, columns come in the order of the targets
            fit = _FITS[t.drive or t.quantity][taken] - (0.3 if t.drive else -0.05) * x.measured
            scores[i, j] = fit + _score_names(x, t, places.get(x.column), counts[j]) - order
            felt = t.drive and not x.commanded and x.kind != Kind.DUTY  # it may be measured at the drive
            by_name = taken != x.kind or fit <= _NEVER or (felt and x.measured)
            base[i, j] = 4.0 if by_name else 12.0 if felt else 20.0  # what comes first, whatever it is called
    possible = scores > _NEVER
    rows, columns = scipy.optimize.linear_sum_assignment(np.where(possible, base + scores, 0.0), maximize=True)
    pairs = sorted((int(j), int(i)) for i, j in zip(rows, columns, strict=True) if possible[i, j])
    taken_rows = {i for _, i in pairs}
    matches, rivals = [], []
    for j, i in pairs:
        x, t = replace(labels[i], kind=kinds[i][j] or labels[i].kind), targets[j]
        surety, named = _rate_pair(x, targets, scores, i, j), alike(x.words, *t.names) > 0
        matches.append(Match((x.column,), t.name, x, surety, named=named))
        for k in np.argsort(-scores[:, j]) if targets[j].drive else ():
            rival = k not in taken_rows and kinds[k][j] == labels[k].kind
            if rival and scores[k, j] > max(scores[i, j] - 3.0, -0.5):
                rivals.append(Match((labels[k].column,), targets[j].name, labels[k], float(scores[k, j])))
    return matches, rivals


def _rate_pair(label: Label, targets: Sequence[_Target], scores: FloatArray, i: int, j: int) -> float:
    """By how much target j is better for column i than the next best of its quantity."""
    same = [k for k, target in enumerate(targets) if target.quantity == targets[j].quantity]
    drives = targets[j].drive is not None
    alone = len(same) == 1 and (drives or np.isfinite(scores[:, j]).sum() == 1)
    if alone or any([k for k in same if is_exactly(label, targets[k].names[n])] == [j] for n in range(1 + drives)):
        return SURE
    others = [scores[i, k] for k in same if k != j]
    return float(min(scores[i, j], scores[i, j] - max(others)) if others else scores[i, j] + 0.5)


def _find_kind(machine: Machine, label: Label, target: _Target) -> Kind | None:
    """The kind of quantity that a column would be for a target; None where it can not be."""
    fits = _FITS[target.drive or target.quantity]
    if label.kind in fits:
        return label.kind
    if target.quantity == "position" and label.kind == Kind.UNKNOWN:
        return Kind.POSITION if alike(label.words, *target.names) > _CALLED else None
    becomes = _BECOMES.get(label.kind)
    family = label.kind == Kind.UNKNOWN and label.number is not None  # of such there is doubt
    if target.drive is None or becomes not in fits or label.measured or family:
        return None
    joints = [name for joint in machine.joints for name in (joint.name, joint.body)]
    whole = tuple(pieces_of(target.names[0])) == label.words and target.names[0] not in joints
    called = alike(label.words, target.names[0]) > max(_CALLED, alike(label.words, *joints))
    return becomes if whole or called else None


def _find_places(labels: Sequence[Label]) -> dict[str, int]:
    """Of a column with a number, its place within its family, counted from 0."""
    families: dict[str, set[int]] = defaultdict(set)
    numbered = [(x, x.number) for x in labels if x.number is not None]
    for x, number in numbered:
        families[x.stem].add(number)
    return {x.column: sorted(family).index(n) for x, n in numbered if len(family := families[x.stem]) > 1}


def _score_names(label: Label, target: _Target, place: int | None, count: int) -> float:
    """How well a column's name, number and unit fit a target."""
    out = []
    for k, name in enumerate(target.names):
        score = 3.0 * alike(label.words, name) - 0.05 * k * (2 - bool(target.drive))
        if label.words and not alike(label.words, name):
            score -= 0.3 * len(label.words)  # it speaks of something else
        numbers = re.findall(r"\d+", name)
        number = int(numbers[-1]) if numbers else None
        if place is not None:
            same = label.number == number if number is not None and not label.words else place == target.rank
            score += 1.2 if place == target.rank else 1.0 if same else -1.5
        elif label.number is not None and number is not None and count > 1:
            score += 1.2 if label.number == number else -1.5
        out.append(score + 0.5 * is_exactly(label, name) * (k < len(target.names) - 1))
    turns = 0.0
    if target.hinge is not None and label.angular is not None:
        turns = 0.6 if label.angular == target.hinge else 0.0 if target.drive else -2.0
    return max(out) + turns - 0.01 * target.rank


def is_exactly(label: Label, name: str) -> bool:
    """Whether a column is called as something of the model, but for words of its quantity and of the log's format."""
    own = {*pieces_of(name)}
    number = set[str]() if label.number is None else {str(label.number)}
    return bool(own) and own <= {*pieces_of(label.column)} and {*label.words} <= own and number <= own


def _match_last(
    labels: Sequence[Label], targets: Sequence[_Target], matches: Sequence[Match], kind: Kind | None = None
) -> list[Match]:
    """The one column that is left, whatever it is called, for the one target that is."""
    bare = [t for t in targets if all(m.target != t.name for m in matches)]
    if not len(bare) == len(labels) == 1:
        return []
    score = SURE if len(targets) == 1 else 0.0
    return [Match((labels[0].column,), bare[0].name, replace(labels[0], kind=kind or labels[0].kind), score)]


def _exchange_velocities(positions: Sequence[Match], velocities: Sequence[Match], table: Table) -> list[Match]:
    """Velocities exchanged among the joints, and those without a name given to others, where slopes tell so."""
    places = {m.target.removesuffix("position") + "velocity": table[m.column] for m in positions}
    targets = list(dict.fromkeys([*(m.target for m in velocities), *places]))
    scores = np.zeros((len(velocities), len(targets)))
    for i, match in enumerate(velocities):
        for j, target in enumerate(targets):
            share = slope_of(places[target], table[match.column]).share if target in places else 0.0
            given = j < len(velocities) or not match.named  # what is called after a joint is no other one's
            scores[i, j] = (share if given else -1.0) + 0.2 * (i == j)
    pairs = sorted(zip(*scipy.optimize.linear_sum_assignment(scores, maximize=True)[::-1], strict=True))
    return [replace(velocities[i], target=targets[j]) for j, i in pairs]


def _leave_out_tendons(machine: Machine, labels: list[Label]) -> tuple[list[Label], list[str]]:
    """Labels of which those called as an actuator of a tendon, and as no joint, measure no joint; and what they may."""
    pulling = [actuator.name for actuator in machine.actuators if actuator.tendon and actuator.joint is None]
    joints = [name for joint in machine.joints for name in (joint.name, joint.body)]
    away = [
        x.column
        for x in labels
        if x.kind in (Kind.POSITION, Kind.VELOCITY) and alike(x.words, *pulling) > max(alike(x.words, *joints), 0.3)
    ]
    which = ", ".join(map(repr, sorted(away)))
    doubt = f"{which}: called as what pulls a tendon, and no joint's; a <tendonpos> of the MJCF may be their target"
    return [replace(x, kind=Kind.OTHER) if x.column in away else x for x in labels], [doubt] * bool(away)


def _unravel(machine: Machine, labels: list[Label], table: Table) -> tuple[list[Label], list[str]]:
    """Labels with kinds for columns whose names say none, by their number and by what is whose slope; and doubts."""
    families: dict[str, list[Label]] = defaultdict(list)
    for label in sorted((x for x in labels if x.kind == Kind.UNKNOWN), key=lambda x: x.number or 0):
        families[label.stem if label.number is not None else ""].append(label)
    count, positions = len(machine.joints), [x.column for x in labels if x.kind == Kind.POSITION]
    known = {x.column: x for x in labels}
    for label in families.pop("", []):
        shares = [slope_of(table[place], table[label.column]).share for place in positions]
        desired = label.column.lower().rstrip("0123456789").endswith("d")  # q_d that is no slope
        kind = Kind.VELOCITY if max(shares, default=0.0) > 0.8 else Kind.SETPOINT if desired else Kind.OTHER
        known[label.column] = replace(label, kind=kind)
    states = [s for s, f in families.items() if count and not positions and len(f) in (count, 2 * count)]
    driving, doubts = _find_driving(machine, {s: f for s, f in families.items() if s not in states}, labels)
    for stem, family in families.items():
        kinds = [Kind.COMMAND if stem == driving else Kind.OTHER] * len(family)
        if stem in states:
            values = [table[x.column] for x in family]
            pairs, blocks = _sum_slopes(values, 2, 1), _sum_slopes(values, 1, count)
            both = [Kind.POSITION, Kind.VELOCITY]
            woven = count > 1 and len(family) > count and pairs > blocks
            kinds = both * count if woven else [kind for kind in both for _ in range(count)]
        for k, (label, kind) in enumerate(zip(family, kinds, strict=False)):
            number = label.number if kind == Kind.OTHER else kinds[:k].count(kind)
            known[label.column] = replace(label, kind=kind, number=number, stem=f"{label.stem}{kind.name}")
    return list(known.values()), doubts


def _sum_slopes(values: Sequence[FloatArray], step: int, ahead: int) -> float:
    """How well each column ``ahead`` of another is its slope."""
    pairs = [(values[i], values[i + ahead]) for i in range(0, len(values) - ahead, step)][: len(values) // 2]
    return sum(slope_of(p, v).share for p, v in pairs)


def _find_driving(
    machine: Machine, families: Mapping[str, list[Label]], labels: Sequence[Label]
) -> tuple[str | None, list[str]]:
    """The stem of the family that is taken for commands, since it has a column for each actuator; and doubts."""
    actuators, kinds = [actuator.name for actuator in machine.actuators], [x.kind for x in labels]
    felt = sum(kind in (Kind.CURRENT, Kind.VOLTAGE) for kind in kinds)  # one may be the battery's
    as_many = {stem: family for stem, family in families.items() if len(family) == len(actuators) > 1}
    if not as_many or felt >= len(actuators) or _DRIVING.intersection(kinds):
        return None, []
    chosen, *others = sorted(as_many, key=lambda stem: alike(as_many[stem][0].words, *actuators), reverse=True)
    if not others and {x.column.lower() for x in as_many[chosen]} == {name.lower() for name in actuators}:
        return chosen, []
    names = {stem: ", ".join(repr(x.column) for x in family) for stem, family in as_many.items()}
    rivals = "".join(f"; or are these: {names[stem]}?" for stem in others)
    driven = ", ".join(actuators)
    text = f"{names[chosen]} are taken for the commands of {driven} since they are as many: their names do not say so"
    return chosen, [f"{text}{rivals or '; check it'}"]


def _match_vectors(machine: Machine, labels: list[Label]) -> tuple[list[Match], list[Label], list[str]]:
    """Poses of free bodies and readings of inertial sensors, of three or four columns; other labels; and doubts."""
    groups: dict[str, list[Label]] = defaultdict(list)
    for label in labels:
        if label.axis or label.number is not None:
            groups[label.vector if label.axis else label.stem].append(label)
    wanted = [(f"sensor:{name}", kind) for name, kind in machine.sensors]
    wanted += [("body:", kind) for kind in ("orientation", "position", "angular_velocity", "linear_velocity")]
    out: dict[str, Match] = {}
    for (target, kind), (stem, group) in itertools.product(wanted if machine.bodies else wanted[:-4], groups.items()):
        taken = {column for match in out.values() for column in match.columns}
        fitting = [x for x in group if x.column not in taken and kind in _find_vectors(machine, x, stem)]
        size, score = 4 if kind == "orientation" else 3, SURE
        if target == "body:":
            alikeness = {name: alike(read_name(stem).words, name) for name in machine.bodies}
            best = max(machine.bodies, key=alikeness.__getitem__)
            score = SURE if len(machine.bodies) == 1 or alikeness[best] > 0.5 else 0.0
            target = f"body:{best}.{kind}"
        if len(fitting) != size or target in out:
            continue
        order = "xyz" if size == 3 else "wxyz" if fitting[0].axis in ("w", "") else "xyzw"
        at = {x.column: order.index(x.axis) if x.axis else x.number or 0 for x in fitting}
        columns = tuple(sorted(at, key=at.__getitem__))
        label = next(x for x in fitting if x.column == columns[0])
        out[target] = Match(columns, target, label, score if label.axis or size == 3 else 0.0, order * (size == 4))
    reasons = {target: _doubt_velocity(match.label, target) for target, match in out.items()}
    doubts = []
    for target, why in reasons.items():
        other = target.replace("angular", "~").replace("linear", "angular").replace("~", "linear")
        if why and ("<gyro>" in why or reasons.get(other, "missing")):  # clear where the other one is there
            out[target] = replace(out[target], score=0.0)
            doubts.append(f"{', '.join(map(repr, out[target].columns))} are taken for {target}: {why}")
    taken = {column for match in out.values() for column in match.columns}
    return list(out.values()), [x for x in labels if x.column not in taken], doubts


def _find_vectors(machine: Machine, label: Label, stem: str) -> set[str]:
    """The vectors of which a column may be a component, by its name and that without its axis."""
    if label.kind == Kind.ACCELERATION:
        return {"accelerometer"} if _has_any(stem, "acc", "linear") or label.last.rstrip("xyz") == "a" else set()
    if label.kind == Kind.VELOCITY:
        gyro = {"gyro"} if _has_any(stem, "gyro", "omega", "ang") or label.last.rstrip("xyz") == "g" else set()
        return {"angular_velocity" if _is_spin(label, stem) else "linear_velocity", *gyro}
    spelt = _has_any(stem, "quat", "orientation") or (not machine.joints and pieces_of(stem)[-1:] == ["q"])
    if label.kind == Kind.QUATERNION or (spelt and label.number is not None):
        return {"orientation"}
    return {"position"} if label.kind == Kind.POSITION else set()


def _has_any(stem: str, *words: str) -> bool:
    return any(word in stem.lower() for word in words)


def _is_spin(label: Label, stem: str) -> bool:
    """Whether a velocity is an angular one."""
    if label.unit or _has_any(stem, "ang", "omega", "gyro"):
        return not label.unit or label.unit.startswith(("rad", "deg", "rev", "rpm"))
    if label.last in read_vocabulary().of("about"):
        return not _has_any(stem, "lin")
    return bool({"w", "g"} & {*pieces_of(stem)}) and not _has_any(stem, "vel", "lin")  # beside these `w` is the frame


def _doubt_velocity(label: Label, target: str) -> str:
    """Why the velocity of a body that a component's name was taken for may be another one; "" where it is clear."""
    if not target.startswith("body:") or label.kind != Kind.VELOCITY or _has_any(label.vector, "ang", "omega"):
        return ""
    if label.last in ("gx", "gy", "gz"):
        return "a gyro tells it in the body's own axes: if it is one, give the model a <gyro>"
    linear = _has_any(label.vector, "lin")
    either = label.last in read_vocabulary().of("about") or ("w" in pieces_of(label.column) and not linear)
    if label.unit or not either or not (linear or _has_any(label.vector, "vel")):
        return ""
    other = "linear" if target.endswith("angular_velocity") else "angular"
    return f"or are they its {other} velocity, since `w` is the world as well as a rate?"
