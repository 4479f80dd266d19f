"""A log's table: its clock, its episodes, and its columns as numbers on one clock."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sipe_bayes.calibration.column_names import Kind, read_name
from sipe_bayes.calibration.config_fields import listed
from sipe_bayes.calibration.readers.base import Columns, LogError
from sipe_bayes.calibration.readers.many import clock_of, episode, episode_numbers, with_clock
from sipe_bayes.calibration.readers.numbered import gathered, numbered
from sipe_bayes.calibration.readers.tables import read_table
from sipe_bayes.calibration.signals import time_unit
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.units import find_unit

_EPISODES = ("demo", "episode", "ep_", "run", "trial", "toss", "traj", "rollout", "log", "exp", "test", "swing")
_MADE = "time"  # what a clock is called that a rate makes
_MOST = 20_000  # rows that are looked at
_UNLIKE = 0.3  # share of steps that are far from the usual one, beyond which a column is no clock


@dataclass(frozen=True)
class Clock:
    """The column that holds the clock.

    Args:
        column: as ``columns.time.column`` has it.
        unit: its unit word.
        period: its usual step, in its own unit.
        why: what tells the unit.
        doubt: what does not; "" for nothing.
        rate: Hz, of a log without a clock.
    """

    column: str
    unit: str
    period: float
    why: str
    doubt: str = ""
    rate: float | None = None

    @property
    def row(self) -> dict[str, object]:
        """Its table in the configuration."""
        return {"column": self.column, "unit": self.unit} if self.rate is None else {"rate": self.rate}


@dataclass(frozen=True)
class Opened:
    """A log: its clock, what numbers its episodes, its columns (n,) on one clock, and how long it is in s.

    Columns that do not change are none of these; of those in kg, as of a load, ``weights`` has the value. What columns
    without a header are called is given in ``names``.
    """

    clock: Clock
    episodes: str | None
    columns: Mapping[str, FloatArray]
    seconds: float
    weights: Mapping[str, float]
    names: tuple[str, ...] = ()


def open_table(path: Path, table: Columns, rate: float | None = None) -> Opened:
    """Read what a file holds, whose rows come at ``rate`` Hz; raises LogError where nothing tells the time."""
    table = with_clock(table, _MADE, rate)
    prefix = numbered(table, _EPISODES)
    table = table if prefix is None else gathered(table, prefix)
    numbers = {name: values for name, column in table.items() if (values := _numbers(column)) is not None}
    episodes = _episodes(numbers) if prefix is None else prefix
    if episodes is not None:
        ids = episode_numbers(path, table, episodes)
        values, counts = np.unique(ids, return_counts=True)
        one = episode(table, ids, int(values[np.argmax(counts)]))
        numbers = {name: values for name, column in one.items() if (values := _numbers(column)) is not None}
    clock = replace(_clock(path, numbers), rate=rate)
    times = [values for name, values in numbers.items() if leaf(name) == clock.column or name == clock.column]
    longest = max(times, key=len)
    seconds = float(longest[-1] - longest[0]) * find_unit(clock.unit).factor
    rests = {name: float(values[0]) for name, values in numbers.items() if len(values) and (values == values[0]).all()}
    weights = {name: value for name, value in rests.items() if read_name(leaf(name)).unit == "kg"}
    return Opened(clock, episodes, _together(numbers, clock, episodes), seconds, weights)


def richest(
    files: Sequence[Path], rate: float | None = None, columns: tuple[str, ...] = ()
) -> tuple[Opened, list[Opened]]:
    """The log by whose columns quantities are looked for, and the others.

    That is the one in which most of the first one's columns change: a joint may stand still in one motion of several.
    """
    names = {*read_table(files[0], (), columns)}
    opened = [replace(open_table(file, read_table(file, (), columns), rate), names=columns) for file in files]
    alike = [opened[0], *(one for one in opened[1:] if names.issuperset(one.columns))]
    most = max(alike, key=lambda one: len(one.columns))
    return most, [one for one in opened if one is not most]


def loads(opened: Sequence[Opened]) -> list[str]:
    """What is to be asked of columns that say in kg what a log carries, so that it can be given as a fact."""
    out = []
    for name in sorted({name for one in opened for name in one.weights}):
        values = [one.weights[name] for one in opened if name in one.weights]
        if any(values):
            span = " to ".join(f"{value:.4g}" for value in sorted({min(values), max(values)}))
            entry = '`added = {"body:NAME.mass" = ...}`'
            out.append(f"{name!r} is {span} kg by log: of a load that the model has not, each log can say it: {entry}")
    return out


def _numbers(column: np.ndarray) -> FloatArray | None:
    """A column as numbers; None for text."""
    if column.dtype.kind in "biuf":
        return column.astype(np.float64)
    try:
        return np.asarray(column, dtype=np.float64) if column.dtype.kind == "O" else None
    except (TypeError, ValueError):
        return None


def _episodes(numbers: Mapping[str, FloatArray]) -> str | None:
    """The column that numbers episodes: whole numbers that stay for long, and are more than one."""
    for name, values in numbers.items():
        if read_name(leaf(name)).kind != Kind.EPISODE or len(values) < 2 or not np.isfinite(values).all():
            continue
        distinct = np.unique(values)
        if (values == np.round(values)).all() and 1 < len(distinct) <= len(values) // 4:
            return name
    return None


def leaf(name: str) -> str:
    """The last part of a column's name, behind topics, structs and folders: a clock is named by it."""
    depth, start = 0, 0
    for i, letter in enumerate(name):
        depth += (letter == "[") - (letter == "]")
        if letter in "./" and depth == 0:
            start = i + 1
    return name[start:] or name


def _clock(path: Path, numbers: Mapping[str, FloatArray]) -> Clock:
    """The clock that most columns have, of those the one with the best name."""
    ranked: dict[str, float] = {}
    for name, values in numbers.items():
        word = leaf(name)
        label = read_name(word)
        if label.kind != Kind.TIME or not _increases(values):
            continue
        rank = 3.0 * (word == "time") + 2.0 * (word in ("t", "timestamp")) + bool(label.unit) - 0.1 * len(label.words)
        rank += 0.001 * np.log(len(values))
        step = float(np.median(np.diff(values)))
        rank -= 4.0 * (step == 1.0 and not label.unit and word not in ("time", "t"))  # a counter of samples
        ranked[word] = max(ranked.get(word, -np.inf), rank)
    if not ranked:
        for name, values in numbers.items():
            repeats = np.flatnonzero(np.diff(values) == 0) if len(values) > 2 else np.zeros(0)
            rises = read_name(leaf(name)).kind == Kind.TIME and bool((np.diff(values) >= 0).all())
            if rises and 0 < len(repeats) < len(values) / 10:
                raise LogError(
                    f"{path}: {name!r} repeats a time stamp in {len(repeats)} rows, first in row {repeats[0] + 3}; "
                    "leave these rows out"
                )
        steady = [name for name, values in numbers.items() if _increases(values) and _is_steady(values)]
        if not steady:
            has = listed(list(map(repr, numbers)))
            raise LogError(f"{path}: no column is a clock that increases; it has {has}; give the rows' Hz: --rate 500")
        name = steady[0]
        return _timed(leaf(name), numbers[name], f"the only kind of column that rises steadily: {name}", True)
    word = max(ranked, key=lambda w: ranked[w])
    longest = max((values for name, values in numbers.items() if leaf(name) == word), key=len)
    return _timed(word, longest, "", False)


def _timed(word: str, values: FloatArray, why: str, doubt: bool) -> Clock:
    period = float(np.median(np.diff(values)))
    named, sized = read_name(word).unit, time_unit(period)
    named = named if named in ("s", "ms", "us", "ns") else ""
    rate = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}[named or sized] / period
    evidence = f"{period:.6g} from row to row, {rate:.4g} Hz"
    if named and named != sized and period > 0:
        text = f"its name says {named}, which makes {rate:.3g} Hz; its size speaks for {sized}"
        return Clock(word, named, period, text, text)
    reason = "as its name says" if named else evidence
    text = f"{why} is taken for the clock" if doubt else ""
    return Clock(word, named or sized, period, why or f"{reason}: {evidence}" if named else why or reason, text)


def _increases(values: FloatArray) -> bool:
    return len(values) > 2 and bool(np.isfinite(values).all() and (np.diff(values) > 0).all())


def _is_steady(values: FloatArray) -> bool:
    steps = np.diff(values)
    usual = float(np.median(steps))
    return bool(usual > 0 and np.mean(np.abs(steps - usual) > 0.5 * usual) < _UNLIKE)


def _together(numbers: Mapping[str, FloatArray], clock: Clock, episodes: str | None) -> dict[str, FloatArray]:
    """The columns that change, on the clock with most samples: those of other clocks as they are held."""
    clocks = {name: clock_of(dict(numbers), name, clock.column) for name in numbers}
    clocks = {name: own for name, own in clocks.items() if own in numbers}
    usable = {name: numbers[own] for name, own in clocks.items() if 0 <= len(numbers[own]) - len(numbers[name]) <= 1}
    usable = {name: time for name, time in usable.items() if _increases(time)}
    if not usable:
        return {}
    lead = max(usable.values(), key=len)
    lead = lead[np.unique(np.round(np.linspace(0, min(len(lead), _MOST) - 1, min(len(lead), _MOST))).astype(int))]
    out: dict[str, FloatArray] = {}
    for name, time in usable.items():
        values = numbers[name]
        if name in (clocks[name], episodes) or leaf(name) == clock.column or not np.isfinite(values).any():
            continue
        values = np.append(values, values[-1:]) if len(values) < len(time) else values
        rows = np.clip(np.searchsorted(time, lead, side="right") - 1, 0, len(time) - 1)
        if np.ptp(values[np.isfinite(values)]) > 0:
            out[name] = values[rows]
    return out
