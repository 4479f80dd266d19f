"""A log's table: its clock, its episodes, and its columns as numbers on one clock."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from sipe_bayes.calibration.column_names import Kind, read_name
from sipe_bayes.calibration.config_fields import listed
from sipe_bayes.calibration.readers.base import Columns, LogError, is_text, read_numbers
from sipe_bayes.calibration.readers.many import clock_of, episode, episode_numbers, with_clock
from sipe_bayes.calibration.readers.numbered import gathered, numbered
from sipe_bayes.calibration.readers.tables import read_table
from sipe_bayes.calibration.signals import time_unit
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.units import find_unit

_EPISODES = ("demo", "episode", "ep_", "run", "trial", "toss", "traj", "rollout", "log", "exp", "test", "swing")
_MOST = 20_000  # rows that are looked at


@dataclass(frozen=True)
class Clock:
    """The column that holds the clock."""

    column: str  # as ``columns.time.column`` has it
    unit: str  # unit word
    period: float  # its usual step, in its own unit
    why: str  # what tells the unit
    doubt: str = ""  # what does not; "" for nothing
    rate: float | None = None  # Hz, of a log without a clock

    @property
    def row(self) -> dict[str, object]:
        """Its table in the configuration."""
        return {"column": self.column, "unit": self.unit} if self.rate is None else {"rate": self.rate}


@dataclass(frozen=True)
class Opened:
    """A log: its columns (n,) that change, on one clock."""

    clock: Clock
    episodes: str | None  # the column that numbers them
    columns: Mapping[str, FloatArray]
    seconds: float
    weights: Mapping[str, float]  # of columns in kg that do not change, as of a load
    names: tuple[str, ...] = ()  # of columns without a header
    lost: Mapping[str, int] = field(default_factory=dict)  # cells that are no numbers, by column


def open_table(path: Path, table: Columns, rate: float | None = None) -> Opened:
    """Read what a file holds, whose rows come at ``rate`` Hz; raises LogError where nothing tells the time."""
    table = with_clock(table, "time", rate)
    prefix = numbered(table, _EPISODES)
    table = table if prefix is None else gathered(table, prefix)
    read = {name: own for name, column in table.items() if (own := read_numbers(column))}
    numbers = {name: values for name, (values, lost) in read.items() if not is_text(lost, len(values))}
    lost = {name: lost for name, (_, lost) in read.items() if lost}
    episodes = _find_episodes(numbers) if prefix is None else prefix
    if episodes is not None:
        ids = episode_numbers(path, table, episodes)
        values, counts = np.unique(ids, return_counts=True)
        one = episode({**numbers}, ids, int(values[np.argmax(counts)]))
        numbers = {name: np.asarray(own, dtype=np.float64) for name, own in one.items()}
    clock = replace(_find_clock(path, numbers), rate=rate)
    longest = max((v for name, v in numbers.items() if clock.column in (name, leaf(name))), key=len)
    seconds = float(longest[-1] - longest[0]) * find_unit(clock.unit).factor
    weights = {
        name: float(values[0])
        for name, values in numbers.items()
        if len(values) and (values == values[0]).all() and read_name(leaf(name)).unit == "kg"
    }
    return Opened(clock, episodes, _put_together(numbers, clock, episodes), seconds, weights, (), lost)


def richest(
    files: Sequence[Path], rate: float | None = None, columns: tuple[str, ...] = ()
) -> tuple[Opened, list[Opened]]:
    """The log by whose columns quantities are looked for, and the others.

    That is the one in which most of the first one's columns change: a joint may stand still in one motion of several.
    """
    tables = [read_table(file, (), columns) for file in files]
    opened = [replace(open_table(f, t, rate), names=columns) for f, t in zip(files, tables, strict=True)]
    alike = [opened[0], *(one for one in opened[1:] if {*tables[0]}.issuperset(one.columns))]
    most = max(alike, key=lambda one: len(one.columns))
    return most, [one for one in opened if one is not most]


def ask_of_columns(opened: Sequence[Opened]) -> list[str]:
    """What is to be asked of columns that say in kg what a log carries, and of cells that are no numbers."""
    out = []
    for name in sorted({name for one in opened for name in one.weights}):
        values = [one.weights[name] for one in opened if name in one.weights]
        if any(values):
            span = " to ".join(f"{value:.4g}" for value in sorted({min(values), max(values)}))
            entry = '`added = {"body:NAME.mass" = ...}`'
            out.append(f"{name!r} is {span} kg by log: of a load that the model has not, each log can say it: {entry}")
    for name in sorted({name for one in opened for name in one.lost}):
        used = "are read as missing" if any(name in one.columns for one in opened) else "leave nothing of it to be used"
        count = sum(one.lost.get(name, 0) for one in opened)
        out.append(f"{name!r}: cells that are no numbers ({count}) {used}; correct the log, or leave such cells blank")
    return out


def leaf(name: str) -> str:
    """The last part of a column's name, behind topics, structs and folders: a clock is named by it."""
    return re.split(r"[./](?![^\[]*\])", name)[-1] or name


def _find_episodes(numbers: Mapping[str, FloatArray]) -> str | None:
    """The column that numbers episodes: whole numbers that stay for long, and are more than one."""
    for name, values in numbers.items():
        whole = read_name(leaf(name)).kind == Kind.EPISODE and bool((values == np.round(values)).all())
        if whole and 1 < len(np.unique(values)) <= len(values) // 4:
            return name
    return None


def _find_clock(path: Path, numbers: Mapping[str, FloatArray]) -> Clock:
    """The clock that most columns have, of those the one with the best name."""
    times = {name: values for name, values in numbers.items() if read_name(leaf(name)).kind == Kind.TIME}
    ranks = {name: _rank_name(leaf(name), values) for name, values in times.items() if _increases(values)}
    if ranks:
        word = leaf(max(ranks, key=ranks.__getitem__))
        return _make_clock(word, max((values for name, values in numbers.items() if leaf(name) == word), key=len))
    for name, values in times.items():
        steps = np.diff(values) if len(values) > 2 else np.zeros(0)
        repeats = np.flatnonzero(steps == 0)
        if (steps >= 0).all() and 0 < len(repeats) < len(values) / 10:
            raise LogError(
                f"{path}: {name!r} repeats a time stamp in {len(repeats)} rows, first in row {repeats[0] + 3}; "
                "leave these rows out"
            )
    for name, values in numbers.items():
        steps = np.diff(values)
        if _increases(values) and np.mean(np.abs(steps - np.median(steps)) > 0.5 * np.median(steps)) < 0.3:
            return _make_clock(leaf(name), values, f"the only kind of column that rises steadily: {name}")
    for name, values in times.items():
        if len(falls := np.flatnonzero(np.diff(values) < 0)):
            at = f"first in row {falls[0] + 3} from {values[falls[0]]:.10g} to {values[falls[0] + 1]:.10g}"
            remedy = "sort the rows, make each part a file of its own, or give their Hz: --rate 500"
            raise LogError(f"{path}: the clock {name!r} goes back {len(falls)} times, {at}; {remedy}")
    has = listed(list(map(repr, numbers)))
    raise LogError(f"{path}: no column is a clock that increases; it has {has}; give the rows' Hz: --rate 500")


def _rank_name(word: str, values: FloatArray) -> float:
    """How good a name of a clock is; one that counts samples is none."""
    label, counts = read_name(word), float(np.median(np.diff(values))) == 1.0 and word not in ("time", "t")
    rank = 3.0 * (word == "time") + 2.0 * (word in ("t", "timestamp")) + bool(label.unit) - 0.1 * len(label.words)
    return rank + 0.001 * float(np.log(len(values))) - 4.0 * (counts and not label.unit)


def _make_clock(word: str, values: FloatArray, why: str = "") -> Clock:
    """A clock with its unit, by its name or by its step; why: what else is to be doubted."""
    period, named = float(np.median(np.diff(values))), read_name(word).unit
    sized, named = time_unit(period), named if named in ("s", "ms", "us", "ns") else ""
    rate = 1 / (period * find_unit(named or sized).factor)
    if named and named != sized:
        text = f"its name says {named}, which makes {rate:.3g} Hz; its size speaks for {sized}"
        return Clock(word, named, period, text, text)
    reason = "as its name says: " * bool(named) + f"{period:.6g} from row to row, {rate:.4g} Hz"
    return Clock(word, named or sized, period, why or reason, f"{why} is taken for the clock" if why else "")


def _increases(values: FloatArray) -> bool:
    return len(values) > 2 and bool(np.isfinite(values).all() and (np.diff(values) > 0).all())


def _put_together(numbers: Mapping[str, FloatArray], clock: Clock, episodes: str | None) -> dict[str, FloatArray]:
    """The columns that change, on the clock with most samples: those of other clocks as they are held."""
    times = {name: clock_of(dict(numbers), name, clock.column) for name in numbers}
    usable = {
        name: numbers[own]
        for name, own in times.items()
        if own in numbers and 0 <= len(numbers[own]) - len(numbers[name]) <= 1 and _increases(numbers[own])
    }
    if not usable:
        return {}
    lead = max(usable.values(), key=len)[:_MOST]
    out: dict[str, FloatArray] = {}
    for name, time in usable.items():
        values = numbers[name]
        known = values[np.isfinite(values)]
        is_clock = name in (times[name], episodes) or leaf(name) == clock.column
        if not is_clock and known.size and np.ptp(known) > 0:
            rows = np.searchsorted(time, lead, side="right") - 1
            out[name] = values[np.clip(rows, 0, len(values) - 1)]
    return out
