"""What is proposed, as data: how columns are read, with evidence and doubts, logs, parameters; and its configuration.

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
from sipe_bayes.calibration.machine import Actuator, Drive, Machine

Row = dict[str, object]
_IN_TURNS = {"estimate", "input", "odrive", "turns"}  # words of columns that drives log in turns


class Scale(NamedTuple):
    """What a column may be read in: a unit word and a factor beside it, or a share of its joint's range."""

    unit: str
    factor: float = 1.0
    ends: tuple[float, float] | None = None  # what a share says at the ends of the range
    zero: float = 0.0  # what a column of counts says in the middle of its turn, where it is at 0 there

    def __str__(self) -> str:
        if self.ends:
            return f"{self.ends[0]:g} to {self.ends[1]:g} of the joint's range"
        middle = f" with 0 at {self.zero:g}" if self.zero else ""
        return self.unit if self.factor == 1 else f"{1 / self.factor:g} counts a {self.unit}{middle}"


@dataclass(frozen=True)
class Reading:
    """How columns are read: the model's value is sign * factor * (number - zero) of the unit."""

    match: Match  # the columns and what they are
    unit: str
    sign: int = 1
    factor: float = 1.0
    zero: float = 0.0
    unsure: float = 0.0  # SI, by how much the zero may be wrong where simulations alone tell it
    wraps: bool = False  # whether jumps by a turn are taken out
    fit: bool = True  # False for what only starts segments
    scales: tuple[Scale, ...] = ()  # what it may be in place of units of its kind: counts
    shares: tuple[Scale, ...] = ()  # what it may be besides: shares of its joint's range
    reach: tuple[float, float] | None = None  # that range, rad or m
    ends: tuple[float, float] | None = None  # what the column says at the ends of it, where it is read so
    supply: tuple[str, str] | None = None  # column of the voltage that a duty is a share of, and its unit
    notes: tuple[str, ...] = ()  # the evidence, each a comment
    doubts: tuple[str, ...] = ()  # what could not be decided, each a comment and told
    instead: tuple[str, ...] = ()  # lines of TOML that are the alternative where something could not be decided

    @property
    def joint(self) -> str:
        """The name of its joint; none where it is of something else."""
        kind, _, name = self.match.target.rpartition(".")[0].partition(":")
        return name if kind == "joint" else ""

    def add_evidence(self, note: str = "", doubt: str = "", *instead: str) -> Reading:
        """With what speaks for it or is open, where there is any, and lines of TOML that may stand there instead."""
        notes, doubts = (*self.notes, *[note] * bool(note)), (*self.doubts, *[doubt] * bool(doubt))
        return replace(self, notes=notes, doubts=doubts, instead=(*self.instead, *instead))

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
        name = match.target.removeprefix("actuator:")
        row: Row = {"actuator": name} if self.commanded else {"target": name}
        row |= {"column": match.column} if len(match.columns) == 1 else {"columns": list(match.columns)}
        if match.quaternion:
            return row | {"quaternion": match.quaternion}
        supply = None if self.supply is None else {"column": self.supply[0], "unit": self.supply[1]}
        usual: Row = {"sign": 1, "factor": 1.0, "zero": 0.0, "wraps": False, "supply": None, "fit": True}
        own: Row = {key: getattr(self, key) for key in usual} | {"supply": supply}
        return row | {"unit": self.unit} | {key: value for key, value in own.items() if value != usual[key]}


@dataclass(frozen=True)
class Proposal:
    """A parameter that may be free."""

    name: str
    targets: tuple[str, ...]
    low: float
    high: float
    relative: bool  # whether bounds are factors of the nominal value
    note: str
    left_out: str = ""  # why it stands in a comment only
    expected: float | None = None  # SI, what the logs say of a size that may be anything: log scale and wide prior

    def row(self) -> Row:
        """Its table in the configuration."""
        target: Row = {"target": self.targets[0]} if len(self.targets) == 1 else {"targets": list(self.targets)}
        row = {"name": self.name} | target | {"factor" if self.relative else "bounds": [self.low, self.high]}
        if self.expected is None:
            return row
        wide = {"mean": self.expected, "sd": float(f"{1.5 * self.expected:.3g}")}  # sd of the logarithm: 1.5
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
        use, span = self.use if self.use != "train" else "", list(self.span or ())
        row = {"file": self.file, "name": self.name, "use": use, "span": span, "episodes": list(self.episodes)}
        return {key: value for key, value in row.items() if value}


@dataclass(frozen=True)
class Draft:
    """A configuration with its evidence."""

    model: str  # the MJCF, relative to the configuration
    clock: Clock
    episode: str | None  # the column that numbers episodes
    commands: tuple[Reading, ...]
    measurements: tuple[Reading, ...]
    logs: tuple[LogLine, ...]
    window: float | str | None  # s, or "log"; None for states that are free in place of segments
    window_note: str = ""
    parameters: tuple[Proposal, ...] = ()  # those that are left out among them
    doubts: tuple[str, ...] = ()  # what could not be decided, beside what readings say
    notes: tuple[str, ...] = ()  # of the whole
    unused: tuple[str, ...] = ()  # columns that are none of the model's
    delay: float = 0.0  # of the commands, in samples
    seconds: float = 0.0  # that a calibration may take
    together: tuple[tuple[str, ...], ...] = ()  # columns that may be flipped together, in groups
    tied: tuple[tuple[str, str], ...] = ()  # columns of positions, each with that of the set-point that it follows
    names: tuple[str, ...] = ()  # of columns without a header

    @property
    def readings(self) -> tuple[Reading, ...]:
        """Measurements, then commands."""
        return (*self.measurements, *self.commands)

    def with_readings(self, readings: Sequence[Reading]) -> Draft:
        """The draft with others in their places."""
        measured = len(self.measurements)
        return replace(self, measurements=tuple(readings[:measured]), commands=tuple(readings[measured:]))

    @property
    def free(self) -> tuple[Proposal, ...]:
        """The parameters that are free."""
        return tuple(one for one in self.parameters if not one.left_out)

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
        columns: Row = {"time": self.clock.row, "episode": self.episode, "names": list(self.names)}
        data: Row = {
            "model": self.model,
            **self.likelihood,
            "columns": {key: value for key, value in columns.items() if value},
            "commands": [reading.row() for reading in self.commands],
            "measurements": [reading.row() for reading in self.measurements],
            "logs": [log.row() for log in self.logs],
            "parameters": [one.row() for one in self.free],
        }
        return Config.model_validate(data, context={"folder": folder})


Answer = Scale | int


@dataclass(frozen=True)
class Question:
    """What is open: the unit of some readings, or the sign of one."""

    readings: tuple[int, ...]  # places in ``Draft.readings``
    answers: tuple[Answer, ...]  # scales or signs, first what names or a configuration say

    @property
    def of_sign(self) -> bool:
        """Whether it is a sign."""
        return isinstance(self.answers[0], int)


def actuator_of(machine: Machine, target: str) -> Actuator | None:
    """The actuator of a reading's target."""
    return next((actuator for actuator in machine.actuators if target == f"actuator:{actuator.name}"), None)


def unit_words(reading: Reading, machine: Machine) -> tuple[str, ...]:
    """The units that a column without one in its name may have, the likeliest first."""
    target, kind = reading.match.target, reading.match.label.kind
    joint = next((j for j in machine.joints if target.startswith(f"joint:{j.name}.")), None)
    actuator = actuator_of(machine, target)
    hinge = joint.hinge if joint is not None else actuator is not None and actuator.turns
    drive = None if actuator is None else actuator.drive
    in_turns = bool(_IN_TURNS & {*pieces_of(reading.match.column)})
    if ((joint or target.startswith("body:")) and target.endswith(".position")) or drive == Drive.POSITION:
        return ("rad", "deg", *["rev"] * in_turns) if hinge else ("m", "mm", "cm")
    if joint is not None or drive == Drive.VELOCITY:
        return ("rad/s", "deg/s", "rpm", *["rev/s"] * in_turns) if hinge else ("m/s", "mm/s")
    if actuator is None or kind == Kind.DUTY:
        return (reading.unit,)
    if kind == Kind.CURRENT:
        return ("A", "mA")
    if kind == Kind.VOLTAGE or (drive == Drive.VOLTAGE and kind != Kind.TORQUE):
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


def apply_answers(
    readings: Sequence[Reading], asked: Sequence[Question], answers: Sequence[Answer]
) -> tuple[Reading, ...]:
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
