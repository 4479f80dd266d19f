"""What is proposed, as data: how columns are read, with evidence and doubts, logs, unknowns; and its configuration.

What names leave open of units and signs is a list of questions with their answers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sipe_bayes.calibration.column_names import Kind, pieces_of
from sipe_bayes.calibration.config import Config
from sipe_bayes.calibration.config_fields import Use
from sipe_bayes.calibration.init.matching import Match
from sipe_bayes.calibration.init.tables import Clock
from sipe_bayes.calibration.machine import Drive, Machine

Row = dict[str, object]
_IN_TURNS = {"estimate", "input", "odrive", "turns"}  # words of columns that drives log in turns
_WIDE = 1.5  # sd of the logarithm of what a regression says of a gain


class Scale(NamedTuple):
    """A unit word, and what a column is multiplied by beside it; or what it says at the ends of its joint's range.

    zero: what a column of counts says in the middle of its turn, where it is at 0 there.
    """

    unit: str
    factor: float = 1.0
    ends: tuple[float, float] | None = None
    zero: float = 0.0

    def __str__(self) -> str:
        if self.ends:
            return f"{self.ends[0]:g} to {self.ends[1]:g} of the joint's range"
        middle = f" with 0 at {self.zero:g}" if self.zero else ""
        return self.unit if self.factor == 1 else f"{1 / self.factor:g} counts a {self.unit}{middle}"


@dataclass(frozen=True)
class Reading:
    """How columns are read.

    Args:
        match: the columns and what they are.
        unit: unit word.
        sign: 1 or -1.
        factor: beside the unit.
        zero: what the column says where the model has 0.
        unsure: SI, by how much that may be wrong where simulations alone tell it.
        wraps: whether jumps by a turn are taken out.
        fit: False for what only starts windows.
        scales: what it may be in place of units of its kind: counts.
        shares: what it may be besides: shares of its joint's range.
        reach: that range, rad or m.
        ends: what the column says at the ends of it, where it is read so.
        supply: column of the voltage that a duty is a share of, and its unit.
        notes: the evidence, each a comment.
        doubts: what could not be decided, each a comment and told.
        instead: lines of TOML that are the alternative where something could not be decided.
    """

    match: Match
    unit: str
    sign: int = 1
    factor: float = 1.0
    zero: float = 0.0
    unsure: float = 0.0
    wraps: bool = False
    fit: bool = True
    scales: tuple[Scale, ...] = ()
    shares: tuple[Scale, ...] = ()
    reach: tuple[float, float] | None = None
    ends: tuple[float, float] | None = None
    supply: tuple[str, str] | None = None
    notes: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()
    instead: tuple[str, ...] = ()

    @property
    def commanded(self) -> bool:
        """Whether it drives an actuator."""
        return self.match.target.startswith("actuator:")

    @property
    def scale(self) -> Scale:
        """What it is read as."""
        if self.ends:
            return Scale(self.unit, 1.0, self.ends)
        middle = any(scale.zero == self.zero for scale in self.scales)
        return Scale(self.unit, self.factor, None, self.zero if middle else 0.0)

    def read_as(self, scale: Scale) -> Reading:
        """With another scale, which has a zero of its own where it is a share of the joint's range."""
        if scale.ends is None or self.reach is None:
            zero = scale.zero if self.ends or scale.zero or self.scale.zero else self.zero
            return replace(self, unit=scale.unit, factor=scale.factor, zero=zero, ends=None)
        if scale.ends == self.ends:
            return self
        factor = (self.reach[1] - self.reach[0]) / (scale.ends[1] - scale.ends[0])
        read = replace(self, unit=scale.unit, factor=float(f"{factor:.6g}"), ends=scale.ends)
        return replace(read, zero=read.zero_with(self.sign))

    def zero_with(self, sign: int) -> float:
        """What the column says where the model has 0, with a sign, where it is a share of the joint's range."""
        if self.ends is None or self.reach is None:
            return self.zero
        size = (self.reach[1] - self.reach[0]) / (self.ends[1] - self.ends[0])
        begin = self.reach[0] if sign > 0 else -self.reach[1]
        return float(f"{self.ends[0] - begin / size:.6g}")

    def turned_to(self, sign: int) -> Reading:
        """With a sign, and the other end of the joint's range first where it counts from an end."""
        own = self.zero == self.zero_with(self.sign)
        return replace(self, sign=sign, zero=self.zero_with(sign) if own else self.zero)

    def lines_of(self, scale: Scale) -> tuple[str, ...]:
        """Lines of TOML that stand in a configuration for another scale."""
        other = self.read_as(scale)
        unit = f'unit = "{scale.unit}"' + "  # and no factor, no zero" * bool(self.ends and not other.ends)
        factor = [f"factor = {other.factor!r}"] if other.factor != 1 else []
        return unit, *factor, *([f"zero = {other.zero!r}"] if other.ends or scale.zero else [])

    def row(self) -> Row:
        """Its table in the configuration."""
        match = self.match
        row: Row = {}
        if self.commanded:
            row["actuator"] = match.target.removeprefix("actuator:")
        else:
            row["target"] = match.target
        row |= {"column": match.column} if len(match.columns) == 1 else {"columns": list(match.columns)}
        if match.quaternion:
            return row | {"quaternion": match.quaternion}
        row["unit"] = self.unit
        row |= {"sign": self.sign} if self.sign != 1 else {}
        row |= {"factor": self.factor} if self.factor != 1 else {}
        row |= {"zero": self.zero} if self.zero else {}
        row |= {"wraps": True} if self.wraps else {}
        row |= {"supply": {"column": self.supply[0], "unit": self.supply[1]}} if self.supply else {}
        return row | ({} if self.fit else {"fit": False})


@dataclass(frozen=True)
class Unknown:
    """A parameter that is proposed.

    left_out says why it stands in a comment only. expected, SI: what the logs say of a size that may be anything, which
    then has a log scale and a wide prior.
    """

    name: str
    targets: tuple[str, ...]
    low: float
    high: float
    relative: bool
    note: str
    left_out: str = ""
    expected: float | None = None

    def row(self) -> Row:
        """Its table in the configuration."""
        target: Row = {"target": self.targets[0]} if len(self.targets) == 1 else {"targets": list(self.targets)}
        row: Row = {"name": self.name}
        row |= target | {"factor" if self.relative else "bounds": [self.low, self.high]}
        if self.expected is None:
            return row
        wide = {"mean": self.expected, "sd": float(f"{_WIDE * self.expected:.3g}")}
        return row | {"scale": "log", "prior": wide}


@dataclass(frozen=True)
class LogLine:
    """A log or a part of it; file relative to the configuration."""

    file: str
    use: Use = "train"
    name: str = ""
    span: tuple[float, float] | None = None
    episodes: tuple[int, ...] = ()

    def row(self) -> Row:
        """Its table in the configuration."""
        row: Row = {"file": self.file}
        row |= {"name": self.name} if self.name else {}
        row |= {"use": self.use} if self.use != "train" else {}
        row |= {"span": list(self.span)} if self.span else {}
        return row | ({"episodes": list(self.episodes)} if self.episodes else {})


@dataclass(frozen=True)
class Draft:
    """A configuration with its evidence.

    Args:
        model: the MJCF, relative to the configuration.
        clock: the log's clock.
        episode: the column that numbers episodes.
        commands: columns that drive actuators.
        measurements: columns that measure.
        logs: that train, and that are held out.
        window: s, or "log"; None for unknown states in place of windows.
        window_note: why.
        unknowns: parameters, those that are left out among them.
        doubts: what could not be decided, beside what readings say.
        notes: of the whole.
        unused: columns that are none of the model's.
        delay: of the commands, in samples.
        seconds: that a calibration may take; 0 where nothing says it.
        tied: columns of positions, each with that of the set-point that it follows.
        together: columns that may be flipped together, in groups.
        names: of columns without a header.
    """

    model: str
    clock: Clock
    episode: str | None
    commands: tuple[Reading, ...]
    measurements: tuple[Reading, ...]
    logs: tuple[LogLine, ...]
    window: float | str | None
    window_note: str = ""
    unknowns: tuple[Unknown, ...] = ()
    doubts: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    unused: tuple[str, ...] = ()
    delay: float = 0.0
    seconds: float = 0.0
    together: tuple[tuple[str, ...], ...] = ()
    tied: tuple[tuple[str, str], ...] = ()
    names: tuple[str, ...] = ()

    @property
    def readings(self) -> tuple[Reading, ...]:
        """Measurements, then commands."""
        return (*self.measurements, *self.commands)

    def with_readings(self, readings: Sequence[Reading]) -> Draft:
        """The draft with others in their places."""
        measured = len(self.measurements)
        return replace(self, measurements=tuple(readings[:measured]), commands=tuple(readings[measured:]))

    @property
    def proposed(self) -> tuple[Unknown, ...]:
        """The unknowns that are asked for."""
        return tuple(unknown for unknown in self.unknowns if not unknown.left_out)

    @property
    def likelihood(self) -> Row:
        """Its keys in the configuration."""
        return {"likelihood": "state_space"} if self.window is None else {"window": self.window}

    @property
    def open_doubts(self) -> list[str]:
        """Everything that could not be decided."""
        own = [self.clock.doubt] if self.clock.doubt else []
        return own + [f"{r.match.column!r}: {doubt}" for r in self.readings for doubt in r.doubts] + list(self.doubts)

    def config(self, folder: Path) -> Config:
        """The configuration that it stands for; paths are relative to the folder."""
        columns: Row = {"time": self.clock.row}
        columns |= {"episode": self.episode} if self.episode else {}
        columns |= {"names": list(self.names)} if self.names else {}
        data: Row = {
            "model": self.model,
            **self.likelihood,
            "columns": columns,
            "commands": [reading.row() for reading in self.commands],
            "measurements": [reading.row() for reading in self.measurements],
            "logs": [log.row() for log in self.logs],
            "parameters": [unknown.row() for unknown in self.proposed],
        }
        return Config.model_validate(data, context={"folder": folder})


Answer = Scale | int


@dataclass(frozen=True)
class Question:
    """What is open: the unit of some readings, or the sign of one.

    Args:
        readings: places in ``Draft.readings``.
        answers: scales or signs, the likeliest first: what names say, or a configuration that is checked.
    """

    readings: tuple[int, ...]
    answers: tuple[Answer, ...]

    @property
    def of_sign(self) -> bool:
        """Whether it is a sign."""
        return isinstance(self.answers[0], int)


def unit_words(reading: Reading, machine: Machine) -> tuple[str, ...]:
    """The units that a column without one in its name may have, the likeliest first."""
    target, kind = reading.match.target, reading.match.label.kind
    turns = bool(_IN_TURNS & {*pieces_of(reading.match.column)})
    if target.startswith("body:"):
        return ("m", "mm", "cm") if target.endswith(".position") else (reading.unit,)
    if target.startswith("sensor:"):
        return (reading.unit,)
    if target.startswith("joint:"):
        joint = next(j for j in machine.joints if target.startswith(f"joint:{j.name}."))
        if target.endswith(".position"):
            return ("rad", "deg", *["rev"] * turns) if joint.hinge else ("m", "mm", "cm")
        return ("rad/s", "deg/s", "rpm", *["rev/s"] * turns) if joint.hinge else ("m/s", "mm/s")
    actuator = next(a for a in machine.actuators if target == f"actuator:{a.name}")
    hinge = actuator.turns
    if actuator.drive == Drive.POSITION:
        return ("rad", "deg", *["rev"] * turns) if hinge else ("m", "mm", "cm")
    if actuator.drive == Drive.VELOCITY:
        return ("rad/s", "deg/s", "rpm", *["rev/s"] * turns) if hinge else ("m/s", "mm/s")
    if kind == Kind.CURRENT:
        return ("A", "mA")
    if kind == Kind.DUTY:
        return (reading.unit,)
    if kind == Kind.VOLTAGE or (actuator.drive == Drive.VOLTAGE and kind != Kind.TORQUE):
        return ("V", "mV")
    if kind == Kind.TORQUE or reading.unit != "1":
        return ("N m", "mN m") if hinge else ("N", "mN")
    return ("1", "%")


def questions(draft: Draft, machine: Machine) -> list[Question]:
    """What the names leave open: one unit for alike columns without one, a sign for each scalar that may have both."""
    groups: dict[tuple[str, tuple[Scale, ...]], list[int]] = {}
    signs, one_way = [], {f"actuator:{actuator.name}" for actuator in machine.actuators if actuator.one_way}
    for k, reading in enumerate(draft.readings):
        if not is_tried(draft, reading):
            continue
        scales = _scales(reading, machine)
        open_scales = reading.factor == 1 or reading.scales or reading.shares
        if not reading.match.label.unit and len(scales) > 1 and open_scales:
            own = "both" if reading.shares else "command" if reading.commanded else "measured"
            groups.setdefault((own, scales), []).append(k)
        if len(reading.match.columns) == 1 and reading.match.target not in one_way:
            signs.append(Question((k,), (reading.sign, turned(reading.sign))))
    return [*(Question(tuple(members), scales) for (_, scales), members in groups.items()), *signs]


def _scales(reading: Reading, machine: Machine) -> tuple[Scale, ...]:
    """What a column may be multiplied by, first what the draft has."""
    scales = reading.scales or tuple(Scale(word) for word in unit_words(reading, machine))
    if reading.ends or not reading.zero:  # a zero that simulations tell is no share's
        scales = (*scales, *reading.shares)
    return tuple(sorted(scales, key=lambda scale: scale != reading.scale))


def is_tried(draft: Draft, reading: Reading) -> bool:
    """Whether simulations say something of it: commands, positions, and velocities of joints without these."""
    target = reading.match.target
    if reading.match.quaternion or target.startswith("sensor:") or target.endswith(".force"):
        return False
    if target.endswith(".velocity"):
        place = target.removesuffix("velocity") + "position"
        return all(other.match.target != place for other in draft.measurements)
    return not target.endswith(("angular_velocity", "linear_velocity"))


def turned(sign: Answer) -> int:
    """The other sign."""
    return -1 if sign == 1 else 1


def answered(readings: Sequence[Reading], asked: Sequence[Question], answers: Sequence[Answer]) -> tuple[Reading, ...]:
    """The readings with the answers to all questions."""
    out = list(readings)
    for question, answer in zip(asked, answers, strict=True):
        for k in question.readings:
            out[k] = out[k].turned_to(answer) if isinstance(answer, int) else out[k].read_as(answer)
    return tuple(out)


def rounded_up(value: float) -> float:
    """Upwards to two digits."""
    digits = 10.0 ** (np.floor(np.log10(value)) - 1)
    return float(f"{np.ceil(value / digits) * digits:.2g}")
