"""Recorded logs: tables of any format, put on a control grid as a ``Trajectory``.

The grid starts at the log's (or span's) first sample and has the log's own rate unless ``resample.rate`` says
otherwise. What happens to the samples, in two cases:

* *Passed through.* When every sample lies within a tenth of a period of a grid time of its own, grid sample k
  is that log sample, untouched: interpolation would smooth the noise whose size is to be estimated. At the
  log's own rate dt is the mean period. Dropped rows and blank cells are NaN. The same holds up to .45 periods where
  the signals run about as smoothly through regular times as through their stamps: then the stamps jitter, not the
  samples.
* *Resampled* otherwise. A measurement is interpolated linearly between its two neighbouring finite samples,
  but only at grid times that are the nearest one to some real sample, and where the two are within
  ``max_gap`` of each other. So no column has more grid samples than real ones: a slow column, or a grid
  faster than the log, leaves NaN in between.

Either way commands are held (zero-order hold): action k is the last finite command at or before grid time k,
also across gaps; and missing measurements are NaN: masked, never invented. ``LogReport`` says what was done.

Where columns have clocks of their own, as topics of a bag do, the fitted measurement with the most samples gives the
grid; the others come onto it by the same two cases, and what lies before the first command is left out.
"""

from __future__ import annotations

import reprlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

import numpy as np

from sipe_bayes.calibration.config import Config, check_dimensions
from sipe_bayes.calibration.config_fields import nearest
from sipe_bayes.calibration.config_tables import Columns as Named
from sipe_bayes.calibration.config_tables import Command, LogEntry, Measurement
from sipe_bayes.calibration.grid import Grid, Recording, Series, control_grid, held, sampled
from sipe_bayes.calibration.log_report import report_of
from sipe_bayes.calibration.readers.base import Columns, LogError, is_text, read_numbers
from sipe_bayes.calibration.readers.many import clock_of, combined, digest, episode, episode_numbers, with_clock
from sipe_bayes.calibration.readers.tables import read_table
from sipe_bayes.core.arrays import FloatArray, IntArray
from sipe_bayes.core.rotations import aligned, continued, rotation_vectors
from sipe_bayes.core.trajectory import Trajectory
from sipe_bayes.core.units import convert
from sipe_bayes.core.wild_samples import wild_positions
from sipe_bayes.diagnostics.records import LogReport
from sipe_bayes.simulation.engine import HUGE

_SLOW = 0.25  # s from row to row: no robot is logged so slowly without its being meant
_SHORTEST, _LONGEST = 1e-9, 1e9  # s, of a step and of a log: beyond, a clock holds no times
_UNIT_LENGTH = 0.05  # by which a quaternion's length may differ from one
_EMPTY = 1000  # grid samples for each of the log: a pause, or a wrong unit of time


def load_logs(
    config: Config, logs: Sequence[LogEntry], dimensions: Mapping[str, str] | None = None
) -> list[tuple[Trajectory, LogReport]]:
    """Logs as trajectories on their control grids, and the reports of what was done to them.

    A file of which several of them are parts, one after the other, is read once.

    Args:
        config: the configuration.
        logs: which of its logs.
        dimensions: kind of quantity of each target, see ``config.check_dimensions``; without it units are only
            converted.

    Returns:
        Of each, observations are the measurements (T+1, O), actions the commands (T, A), in the config's order.

    Raises:
        LogError: for a log that cannot be used.
        ConfigError: for a unit of the wrong kind.
    """
    check_dimensions(config, dimensions or {})
    wanted = [column for _, column in config.sources] + [c.column for c in config.drives]
    wanted += [c.supply.column for c in config.commands if c.supply is not None]
    wanted += [config.columns.episode] if config.columns.episode else []
    loaded = []
    for file, parts in groupby(logs, key=lambda log: log.file):
        opened = None
        for log in parts:
            try:
                opened = opened or _Opened.of(file, wanted, config.columns)
                loaded.append(_loaded(config, log, opened))
            except LogError as error:
                raise LogError(f"log {log.name!r}: {error}") from None
    return loaded


def load_log(
    config: Config, log: LogEntry, dimensions: Mapping[str, str] | None = None
) -> tuple[Trajectory, LogReport]:
    """One log, as ``load_logs`` gives it."""
    return load_logs(config, [log], dimensions)[0]


@dataclass(frozen=True)
class _Opened:
    """A file's columns and SHA-256, and where it holds episodes, of which one each row (n,) is."""

    table: Columns
    sha256: str
    episodes: IntArray | None

    @classmethod
    def of(cls, file: Path, wanted: Sequence[str], named: Named) -> _Opened:
        episode = named.episode
        table = with_clock(read_table(file, wanted, named.names), named.time.column, named.time.rate)
        return cls(table, digest(file), None if episode is None else episode_numbers(file, table, episode))


def _loaded(config: Config, log: LogEntry, opened: _Opened) -> tuple[Trajectory, LogReport]:
    table, sha256 = opened.table, opened.sha256
    if opened.episodes is not None:
        if log.episodes is None or len(log.episodes) != 1:
            raise LogError(f"expected one number in `episodes`, got {log.episodes}; use load_config, which names them")
        table = episode(table, opened.episodes, log.episodes[0])
        sha256 = combined([sha256, str(log.episodes[0])])
    raw = _read_log(config, log, table)
    leading = [y.values for y in raw.measurements if y.time is raw.time]
    grid = control_grid(raw.time, config.resample.rate, leading)
    _check_length(config, log, grid, raw.time)
    observed = [sampled(y.time, y.values, _placed(grid, raw, y), config.resample.max_gap) for y in raw.measurements]
    for (_, column), before, after in zip(config.sources, raw.measurements, observed, strict=True):
        _check_any(column, before.values, after)
    commands = [held(y.values, _placed(grid, raw, y)) for y in raw.commands]
    for k, y in raw.supplies.items():
        commands[k] = commands[k] * held(y.values, _placed(grid, raw, y))
    actions = np.stack(commands, -1) if commands else np.zeros((grid.samples - 1, 0))
    trajectory = Trajectory(_observations(config, observed), actions, grid.dt, name=log.name, channels=config.channels)
    return trajectory, report_of(config, log, sha256, raw, grid, trajectory)


def _placed(grid: Grid, raw: Recording, series: Series) -> Grid:
    return grid if series.time is raw.time else grid.on_clock(series.time)


def _read_log(config: Config, log: LogEntry, table: Columns) -> Recording:
    times: dict[str, FloatArray] = {}

    def time_of(column: str) -> FloatArray:
        """The clock of a column (n,) in s; equal clocks are one array."""
        name = clock_of(table, column, config.columns.time.column)
        if name not in times:
            time = _seconds(config, log, table, name)
            times[name] = next((other for other in times.values() if np.array_equal(other, time)), time)
        return times[name]

    def signal(entry: Command | Measurement, name: str) -> Series:
        column = _column(config, log, table, name)
        time = time_of(name)
        values = _fitted(name, column, len(time))
        values = convert(np.where(np.isfinite(values), values, np.nan) - entry.zero, entry.unit)
        if isinstance(entry, Measurement) and entry.wraps:
            known = np.isfinite(values)
            values[known] = np.unwrap(entry.factor * values[known]) / entry.factor
        values *= entry.sign * entry.factor
        huge = np.abs(values) > HUGE
        if huge.any() and isinstance(entry, Command):
            worst = f"{values[huge][0]:.3g} in SI in row {int(np.argmax(huge)) + 1}"
            raise LogError(
                f"command column {name!r} holds {worst}, the most is {HUGE:g}; correct its unit or that cell"
            )
        return Series(time, np.where(huge, np.nan, values))  # no measurement, as infinity is none

    measurements = [y for m in config.measurements for y in _aligned(m, [signal(m, column) for column in m.sources])]
    commands = [signal(c, c.column) for c in config.drives]
    scaled = {k: c.fed for k, c in enumerate(config.commands) if c.fed is not None and c.rate is None}
    supplies = [signal(fed, fed.column) for fed in scaled.values()]
    driving, driven = (*config.drives, *scaled.values()), [*commands, *supplies]
    lead = max((y.time for y, (m, _) in zip(measurements, config.sources, strict=True) if m.fit), key=len)
    span = _span(log, lead - lead[0])
    part = _after_commands(driving, lead, span, driven)
    time = (lead - lead[0])[part]
    late, time = float(time[0] - (lead[span.start] - lead[0])), time - time[0]

    def cut(series: Series, before: bool) -> Series:
        """Within the part; of another clock, with the last sample before it where that is asked for."""
        if series.time is lead:
            return Series(time, series.values[part])
        own = series.time - lead[part.start]
        first = int(np.searchsorted(own, 0.0, side="right")) - 1 if before else int(np.searchsorted(own, 0.0))
        rows = slice(max(first, 0), int(np.searchsorted(own, time[-1], side="right")))
        return Series(own[rows], series.values[rows])

    for command, series in zip(driving, driven, strict=True):
        if series.time is lead:
            _check_first_command(command.column, time, series.values[part])
    for (_, column), series in zip(config.sources, measurements, strict=True):
        if not cut(series, False).time.size:
            raise _apart(column, series.time, lead[part])
    tame, wild = _tame(config, [cut(y, False) for y in measurements])
    feeding = {k: cut(y, True) for k, y in zip(scaled, supplies, strict=True)}
    return Recording(time, [cut(y, True) for y in commands], tame, feeding, late, wild)


def _tame(config: Config, columns: list[Series]) -> tuple[list[Series], list[int]]:
    """The measured columns without samples of positions that no smooth motion explains, and how many of each had."""
    rest, tame, counts = iter(columns), [], []
    for entry in config.measurements:
        own = [next(rest) for _ in entry.sources]
        wild = np.zeros(len(own[0].time), bool)
        if (entry.quaternion or entry.target.endswith(".position")) and len({id(y.time) for y in own}) == 1:
            wild = wild_positions(np.stack([y.values for y in own], axis=-1))
        if wild.any():
            rows = np.where(wild[:, None], np.nan, np.stack([y.values for y in own], axis=-1))
            rows = aligned(rows) if entry.quaternion else rows
            own = [Series(y.time, values) for y, values in zip(own, rows.T, strict=True)]
        tame += own
        counts.append(int(wild.sum()))
    return tame, counts


def _aligned(entry: Measurement, columns: list[Series]) -> list[Series]:
    """The columns of a measurement; a quaternion's w-x-y-z with aligned signs, NaN where a number is missing."""
    if entry.quaternion is None:
        return columns
    if len({id(y.time) for y in columns}) > 1:
        raise LogError(f"columns {list(entry.columns)} have clocks of their own; give a quaternion of one clock")
    rows = np.stack([y.values for y in columns], axis=-1)
    rows = rows if entry.quaternion == "wxyz" else rows[:, [3, 0, 1, 2]]
    size = np.linalg.norm(rows, axis=1)
    usual = float(np.nanmedian(size)) if np.isfinite(size).any() else 1.0
    if abs(usual - 1) > _UNIT_LENGTH:
        raise LogError(
            f"columns {list(entry.columns)} are no quaternion: its length is {usual:.3g}, expected 1; name its four"
        )
    rows = aligned(np.where((np.abs(size - 1) < _UNIT_LENGTH)[:, None], rows, np.nan))
    return [Series(y.time, values) for y, values in zip(columns, rows.T, strict=True)]


def _observations(config: Config, columns: list[FloatArray]) -> FloatArray:
    """Channels (T+1, O) of the columns on the grid: quaternions become rotation vectors, written without jumps."""
    rest, channels = iter(columns), []
    for entry in config.measurements:
        own = np.stack([next(rest) for _ in entry.sources], axis=-1)
        channels.append(own if entry.quaternion is None else continued(rotation_vectors(own)))
    return np.concatenate(channels, axis=-1)


def _seconds(config: Config, log: LogEntry, table: Columns, name: str) -> FloatArray:
    """A clock of the log (n,) in s, which increases."""
    clock = config.columns.time
    remedy = "; a log without a clock needs its Hz, `columns.time.rate`" if name == clock.column else ""
    time = _column(config, log, table, name, remedy)
    _check_clock(name, time)
    time = convert(time, clock.unit, "time")
    period, duration = float(np.median(np.diff(time))), float(time[-1]) - float(time[0])
    if not (period >= _SHORTEST and duration <= _LONGEST):
        raise LogError(f"{name!r} goes on for {duration:g} s in steps of {period:g} s; correct the clock or its unit")
    if "unit" not in clock.model_fields_set and period >= _SLOW:
        raise LogError(
            f"read in seconds, {name!r} is {period:g} s from row to row; "
            'name its unit, such as `columns.time.unit = "ms"`, or "s" if that is right'
        )
    return time


def _after_commands(driving: Sequence[Command], lead: FloatArray, span: slice, commands: list[Series]) -> slice:
    """The rows of the span from where all commands of other clocks have begun."""
    first = span.start
    for command, series in zip(driving, commands, strict=True):
        known = series.time[np.isfinite(series.values)]
        if not known.size:
            raise LogError(f"command column {command.column!r} holds no number; choose another column")
        if series.time is lead:
            continue
        first = max(first, int(np.searchsorted(lead, known[0])))
        if span.stop - first < 2 or known[-1] < lead[0]:
            raise _apart(command.column, known, lead)
    return slice(first, span.stop)


def _apart(column: str, time: FloatArray, lead: FloatArray) -> LogError:
    """What to say of a column whose clock (m,) has nothing in common with that of the grid (n,)."""
    return LogError(
        f"the clock of {column!r} goes from {time[0]:g} to {time[-1]:g} s, that of the grid from {lead[0]:g} to "
        f"{lead[-1]:g} s; name one in `columns.time.column` that they share"
    )


def _key_of(config: Config, column: str) -> str:
    """Where the configuration names a column."""
    for i, m in enumerate(config.measurements):
        if column in m.sources:
            return f"measurements[{i}].{'columns' if m.columns else 'column'}"
    for i, c in enumerate(config.commands):
        if column == c.column:
            return f"commands[{i}].column"
        if c.supply is not None and column == c.supply.column:
            return f"commands[{i}].supply.column"
    return "columns.time.column"


def _column(config: Config, log: LogEntry, table: Columns, name: str, remedy: str = "") -> FloatArray:
    """One column as numbers (n,)."""
    if name not in table:
        where = f"key `{_key_of(config, name)}`: no column {name!r} in {log.file.name}"
        raise LogError(f"{where}; {nearest(name, table)}{remedy}")
    numbers = read_numbers(table[name])
    if numbers and not is_text(numbers[1], len(numbers[0])):
        return numbers[0]
    cells = (row for row in enumerate(table[name], 1) if read_numbers(np.array([row[1]], dtype=object)) is None)
    row, cell = next(cells, (1, table[name][:1]))
    where = f"column {name!r} holds {reprlib.repr(cell)} in row {row}"
    raise LogError(f"{where}, expected numbers; correct it or leave it blank")


def _fitted(name: str, values: FloatArray, samples: int) -> FloatArray:
    """``values`` as long as the clock; T values beside T+1 times, as npz actions come, end with a NaN."""
    if len(values) == samples - 1:
        return np.append(values, np.nan)
    if len(values) != samples:
        lengths = f"column {name!r} has {len(values)} samples, the time {samples}"
        raise LogError(f"{lengths}; they must be equal, or one fewer: rows are samples")
    return values


def _check_clock(name: str, time: FloatArray) -> None:
    bad = np.flatnonzero(~np.isfinite(time))
    if bad.size:
        raise LogError(f"{name!r} has no time in row {bad[0] + 1}; drop that row")
    if len(time) < 2:
        raise LogError(f"expected at least 2 samples, got {len(time)}; record a longer log")
    back = np.flatnonzero(np.diff(time) <= 0)
    if back.size:
        i = back[0]
        remedy = "drop duplicate rows" if time[i + 1] == time[i] else "sort the rows"
        remedy = "use the recorder's clock, `time`" if name.endswith(".stamp") else remedy
        raise LogError(
            f"{name!r} must increase strictly, got {time[i + 1]!s} in row {i + 2} "
            f"after {time[i]!s} in row {i + 1}; {remedy}"
        )


def _span(log: LogEntry, time: FloatArray) -> slice:
    """The rows of the log's span."""
    if log.span is None:
        return slice(0, len(time))
    slack = 1e-9 * max(1.0, time[-1])
    start = int(np.searchsorted(time, log.span[0] - slack))
    stop = int(np.searchsorted(time, log.span[1] + slack))
    if stop - start < 2:
        held = f"{stop - start} samples of the {time[-1]:g} s"
        raise LogError(f"span {list(log.span)} holds {held}; choose a span inside it")
    return slice(start, stop)


def _check_first_command(name: str, time: FloatArray, values: FloatArray) -> None:
    known = np.flatnonzero(np.isfinite(values))
    if not known.size or known[0] > 0:
        raise LogError(
            f"command column {name!r} holds no number before {time[known[0]] if known.size else time[-1]:g} s, "
            "so what drove the actuator is unknown; start `span` there"
        )


def _check_length(config: Config, log: LogEntry, grid: Grid, time: FloatArray) -> None:
    duration = (grid.samples - 1) * grid.dt
    if grid.samples < 2:
        step = f"lasts {time[-1]:g} s, shorter than one control step of {grid.dt:g} s"
        raise LogError(f"{step}; raise `resample.rate` or use a longer log")
    if grid.samples > _EMPTY * len(time):
        raise LogError(
            f"{len(time)} samples in {duration:g} s leave a {1 / grid.dt:g} Hz grid empty; "
            "choose a `span` without the pause, or correct the time unit"
        )
    window = config.window_of(log)
    if window is not None and duration < window - grid.dt / 2:
        short = f"lasts {duration:g} s, shorter than a window of {window:g} s"
        raise LogError(f"{short}; lower `window` or use a longer log")


def _check_any(name: str, before: FloatArray, after: FloatArray) -> None:
    if not np.isfinite(before).any():
        raise LogError(f"measured column {name!r} holds no number; drop the measurement")
    if not np.isfinite(after).any():
        raise LogError(f"no sample of measured column {name!r} survives; raise `resample.max_gap`")
