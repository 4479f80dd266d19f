"""Recorded logs: CSV, Parquet or npz tables, put on a control grid as a ``Trajectory``.

The grid starts at the log's (or span's) first sample and has the log's own rate unless ``resample.rate`` says
otherwise. What happens to the samples, in two cases:

* *Passed through.* When every sample lies within a tenth of a period of a grid time of its own, grid sample k
  is that log sample, untouched: interpolation would smooth the noise whose size is to be estimated. At the
  log's own rate dt is the mean period. Dropped rows and blank cells are NaN.
* *Resampled* otherwise. A measurement is interpolated linearly between its two neighbouring finite samples,
  but only at grid times that are the nearest one to some real sample, and where the two are within
  ``max_gap`` of each other. So no column has more grid samples than real ones: a slow column, or a grid
  faster than the log, leaves NaN in between.

Either way commands are held (zero-order hold): action k is the last finite command at or before grid time k,
also across gaps; and missing measurements are NaN: masked, never invented. ``LogReport`` says what was done.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sipe_bayes.calibration.config import Command, Config, LogEntry, Measurement, check_dimensions, nearest
from sipe_bayes.calibration.tables import Columns, LogError, read_table
from sipe_bayes.core.trajectory import Trajectory
from sipe_bayes.core.units import convert

FloatArray = NDArray[np.float64]

_SLOW = 0.25  # s from row to row: no robot is logged so slowly without its being meant
REGULAR = 0.1
"""A clock is regular when its samples are within this fraction of a period of the grid."""
GAP_PERIODS = 5.0
"""Default ``max_gap``, in a column's own median sample periods."""
CLIPPED_RUN = 5
"""Samples in a row at the extreme value that count as saturation."""
CLIPPED_SHARE = 0.01
"""Share of the samples above which that is worth a note: dry friction holds a turning joint for a few."""


@dataclass(frozen=True)
class LogReport:
    """What a log held and what was done to it.

    rate_hz: of the grid. duration_s: of the trajectory. samples: T+1. jitter_s: largest distance of a sample
    period from the median one (or, over dropped rows, from a multiple of it). gaps: (start, stop) in seconds
    from the trajectory's first sample, without a measurement for longer than ``max_gap``. missing: masked
    samples of each channel. clipped: samples of each channel and command (``actuator:NAME``) in runs at its
    extreme value. notes: the same in words, with what the user should know.
    """

    name: str
    file: str
    sha256: str
    rate_hz: float
    duration_s: float
    samples: int
    jitter_s: float
    resampled: bool
    gaps: tuple[tuple[float, float], ...] = ()
    missing: Mapping[str, int] = field(default_factory=dict)
    clipped: Mapping[str, int] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Plain data, for JSON."""
        return {**asdict(self), "gaps": [list(gap) for gap in self.gaps], "notes": list(self.notes)}


# From a table to a trajectory


@dataclass(frozen=True)
class _Raw:
    """A log in SI: time (n,) from zero, commands and measurements (n,) with NaN where there is no number."""

    time: FloatArray
    commands: list[FloatArray]
    measurements: list[FloatArray]


@dataclass(frozen=True)
class _Grid:
    """The control grid of ``samples`` times, ``dt`` seconds apart.

    rows (n,): where the log's rows stand, in periods; whole numbers when ``regular``, else time / dt.
    """

    dt: float
    samples: int
    rows: FloatArray
    regular: bool


def load_log(
    config: Config, log: LogEntry, dimensions: Mapping[str, str] | None = None
) -> tuple[Trajectory, LogReport]:
    """A log as a trajectory on its control grid, and the report of what was done to it.

    dimensions: kind of quantity of each target, see ``config.check_dimensions``; without it units are only
    converted. Observations are the measurements (T+1, O), actions the commands (T, A), in the config's order.
    Raises LogError, and ConfigError for a unit of the wrong kind.
    """
    check_dimensions(config, dimensions or {})
    raw = _read_log(config, log)
    grid = _grid(raw.time, config.resample.rate)
    _check_length(config, log, grid, raw.time)
    sampled = [_sampled(raw.time, y, grid, config.resample.max_gap) for y in raw.measurements]
    for measurement, before, after in zip(config.measurements, raw.measurements, sampled, strict=True):
        _check_any(log, measurement.column, before, after)
    held = [_held(y, grid) for y in raw.commands]
    actions = np.stack(held, -1) if held else np.zeros((grid.samples - 1, 0))
    trajectory = Trajectory(np.stack(sampled, -1), actions, grid.dt, name=log.name, channels=config.channels)
    return trajectory, _report(config, log, raw, grid, trajectory)


def _read_log(config: Config, log: LogEntry) -> _Raw:
    try:
        table = read_table(log.file)
    except LogError as error:
        raise LogError(f"log {log.name!r}: {error}") from None
    clock = config.columns.time
    time = _column(log, table, clock.column)
    _check_clock(log, clock.column, time)
    time = convert(time, clock.unit, "time")
    time = time - time[0]
    if "unit" not in clock.model_fields_set and np.median(np.diff(time)) >= _SLOW:
        raise LogError(
            f"log {log.name!r}: read in seconds, {clock.column!r} is {np.median(np.diff(time)):g} s from row to row; name its unit, such as "
            '`columns.time.unit = "ms"`, or "s" if that is right'
        )
    part = _span(log, time)

    def signal(entry: Command | Measurement) -> FloatArray:
        values = _fitted(log, entry.column, _column(log, table, entry.column), len(time))[part]
        return entry.sign * convert(np.where(np.isfinite(values), values, np.nan), entry.unit)

    commands = [signal(c) for c in config.commands]
    measurements = [signal(m) for m in config.measurements]
    time = time[part]
    for command, values in zip(config.commands, commands, strict=True):
        _check_first_command(log, command.column, time, values)
    return _Raw(time - time[0], commands, measurements)


def _column(log: LogEntry, table: Columns, name: str) -> FloatArray:
    """One column as numbers (n,)."""
    if name not in table:
        raise LogError(f"log {log.name!r}: no column {name!r} in {log.file.name}; {nearest(name, table)}")
    try:
        return np.asarray(table[name], dtype=np.float64)
    except (TypeError, ValueError):
        row, cell = next((i, value) for i, value in enumerate(table[name], 1) if not _is_cell(value))
        raise LogError(
            f"log {log.name!r}: column {name!r} holds {cell!r} in row {row}, expected numbers; "
            "correct it or leave it blank"
        ) from None


def _is_cell(value: Any) -> bool:
    try:
        float(value)
    except (TypeError, ValueError):
        return False
    return True


def _fitted(log: LogEntry, name: str, values: FloatArray, samples: int) -> FloatArray:
    """``values`` as long as the clock; T values beside T+1 times, as npz actions come, end with a NaN."""
    if len(values) == samples - 1:
        return np.append(values, np.nan)
    if len(values) != samples:
        raise LogError(
            f"log {log.name!r}: column {name!r} has {len(values)} samples, the time {samples}; "
            "they must be equal, or one fewer"
        )
    return values


def _check_clock(log: LogEntry, name: str, time: FloatArray) -> None:
    bad = np.flatnonzero(~np.isfinite(time))
    if bad.size:
        raise LogError(f"log {log.name!r}: {name!r} has no time in row {bad[0] + 1}; drop that row")
    if len(time) < 2:
        raise LogError(f"log {log.name!r}: expected at least 2 samples, got {len(time)}; record a longer log")
    back = np.flatnonzero(np.diff(time) <= 0)
    if back.size:
        i = back[0]
        remedy = "drop duplicate rows" if time[i + 1] == time[i] else "sort the rows"
        raise LogError(
            f"log {log.name!r}: {name!r} must increase strictly, got {time[i + 1]!s} in row {i + 2} "
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
        raise LogError(
            f"log {log.name!r}: span {list(log.span)} holds {stop - start} samples of the {time[-1]:g} s; "
            "choose a span inside it"
        )
    return slice(start, stop)


def _check_first_command(log: LogEntry, name: str, time: FloatArray, values: FloatArray) -> None:
    known = np.flatnonzero(np.isfinite(values))
    if not known.size:
        raise LogError(f"log {log.name!r}: command column {name!r} holds no number; choose another column")
    if known[0] > 0:
        raise LogError(
            f"log {log.name!r}: command column {name!r} holds no number before {time[known[0]]:g} s, "
            "so what drove the actuator is unknown; start `span` there"
        )


def _check_length(config: Config, log: LogEntry, grid: _Grid, time: FloatArray) -> None:
    duration = (grid.samples - 1) * grid.dt
    if grid.samples < 2:
        raise LogError(
            f"log {log.name!r}: lasts {time[-1]:g} s, shorter than one control step of {grid.dt:g} s; "
            "raise `resample.rate` or use a longer log"
        )
    if grid.samples > 1000 * len(time):
        raise LogError(
            f"log {log.name!r}: {len(time)} samples in {duration:g} s leave a {1 / grid.dt:g} Hz grid empty; "
            "choose a `span` without the pause, or correct the time unit"
        )
    window = config.window_of(log)
    if window is not None and duration < window - grid.dt / 2:
        raise LogError(
            f"log {log.name!r}: lasts {duration:g} s, shorter than a window of {window:g} s; "
            "lower `window` or use a longer log"
        )


def _check_any(log: LogEntry, name: str, before: FloatArray, after: FloatArray) -> None:
    if not np.isfinite(before).any():
        raise LogError(f"log {log.name!r}: measured column {name!r} holds no number; drop the measurement")
    if not np.isfinite(after).any():
        raise LogError(f"log {log.name!r}: no sample of measured column {name!r} survives; raise `resample.max_gap`")


# The grid


def _grid(time: FloatArray, rate: float | None) -> _Grid:
    """The control grid of a log whose times (n,) start at zero."""
    periods = np.diff(time)
    dt = float(np.median(periods)) if rate is None else 1.0 / rate
    if rate is None:
        rows = np.append(0.0, np.cumsum(np.maximum(1.0, np.round(periods / dt))))
        mean = float(time[-1] / rows[-1])
        if np.abs(time - rows * mean).max() <= REGULAR * mean:
            return _Grid(mean, int(rows[-1]) + 1, rows, True)
    rows = np.round(time / dt)
    if (np.diff(rows) > 0).all() and np.abs(time - rows * dt).max() <= REGULAR * dt:
        return _Grid(dt, int(rows[-1]) + 1, rows, True)
    return _Grid(dt, int(time[-1] / dt + 1e-6) + 1, time / dt, False)


def _held(values: FloatArray, grid: _Grid) -> FloatArray:
    """Actions (T,): the last finite value at or before each control step."""
    known = np.maximum.accumulate(np.where(np.isfinite(values), np.arange(len(values)), 0))
    row = np.searchsorted(grid.rows, np.arange(grid.samples - 1) + 1e-6, side="right") - 1
    return values[known][row]


def _sampled(time: FloatArray, values: FloatArray, grid: _Grid, max_gap: float | None) -> FloatArray:
    """Measurements (T+1,) on the grid, NaN where there is none."""
    out = np.full(grid.samples, np.nan)
    if grid.regular:
        out[grid.rows.astype(np.int64)] = values
        return out
    known = np.isfinite(values)
    if known.sum() < 2:
        return out
    return _interpolated(time[known], values[known], grid, max_gap)


def _interpolated(time: FloatArray, values: FloatArray, grid: _Grid, max_gap: float | None) -> FloatArray:
    """Linear interpolation at those grid times that are the nearest one to some sample.

    time, values (n,): finite samples, at least two.
    """
    limit = GAP_PERIODS * float(np.median(np.diff(time))) if max_gap is None else max_gap
    times = np.arange(grid.samples) * grid.dt
    right = np.clip(np.searchsorted(time, times), 1, len(time) - 1)
    inside = (time[right - 1] <= times) & (times <= time[right]) & (time[right] - time[right - 1] <= limit)
    near = np.where(time[right] - times < times - time[right - 1], right, right - 1)
    exact = np.abs(time[near] - times) <= 1e-6 * grid.dt
    owned = np.zeros(grid.samples, dtype=np.bool_)
    owned[np.minimum(np.round(time / grid.dt).astype(np.int64), grid.samples - 1)] = True
    between = np.where(owned & inside, np.interp(times, time, values), np.nan)
    return np.where(exact, values[near], between)


# The report


def _report(config: Config, log: LogEntry, raw: _Raw, grid: _Grid, trajectory: Trajectory) -> LogReport:
    finite = np.isfinite(trajectory.observations)
    names = [*config.channels, *(c.target for c in config.commands)]
    signals = [*raw.measurements, *raw.commands]
    missing = {name: int((~finite[:, j]).sum()) for j, name in enumerate(config.channels)}
    clipped = {name: count_clipped(values) for name, values in zip(names, signals, strict=True)}
    gaps = _gaps(np.any(finite, axis=-1), grid.dt, config.resample.max_gap)
    jitter = _jitter(raw.time)
    notes = [
        _clock_note(raw, grid, jitter),
        *(f"no measurement from {a:.3f} to {b:.3f} s; commands are held there" for a, b in gaps),
        *(f"{name}: {n} of {grid.samples} samples missing, masked" for name, n in missing.items() if n),
        *_blank_notes(config, raw),
        *(
            f"{name}: {n} samples stuck at an extreme value, perhaps saturated"
            for name, n in clipped.items()
            if n > CLIPPED_SHARE * len(raw.time)
        ),
    ]
    return LogReport(
        name=log.name,
        file=str(log.file),
        sha256=hashlib.sha256(log.file.read_bytes()).hexdigest(),
        rate_hz=1.0 / grid.dt,
        duration_s=(grid.samples - 1) * grid.dt,
        samples=grid.samples,
        jitter_s=jitter,
        resampled=not grid.regular,
        gaps=gaps,
        missing=missing,
        clipped=clipped,
        notes=tuple(notes),
    )


def _clock_note(raw: _Raw, grid: _Grid, jitter: float) -> str:
    rate = f"{1 / grid.dt:.4g} Hz"
    if grid.regular:
        return f"{len(raw.time)} samples passed through unchanged at {rate}; clock jitter {1e3 * jitter:.3g} ms"
    own = f"{1 / float(np.median(np.diff(raw.time))):.4g} Hz"
    return f"{len(raw.time)} samples at {own}, clock jitter {1e3 * jitter:.3g} ms, resampled to {rate}"


def _blank_notes(config: Config, raw: _Raw) -> list[str]:
    blank = [int((~np.isfinite(values[:-1])).sum()) for values in raw.commands]
    return [
        f"{command.target}: {n} blank commands, the one before is held"
        for command, n in zip(config.commands, blank, strict=True)
        if n
    ]


def _jitter(time: FloatArray) -> float:
    periods = np.diff(time)
    median = np.median(periods)
    return float(np.abs(periods - median * np.maximum(1.0, np.round(periods / median))).max())


def _gaps(measured: NDArray[np.bool_], dt: float, max_gap: float | None) -> tuple[tuple[float, float], ...]:
    """Stretches (start, stop) in s without a measurement; ``measured`` (T+1,) is True where there is one."""
    known = np.flatnonzero(measured)
    spacing = float(np.median(np.diff(known))) if len(known) > 1 else 1.0
    limit = GAP_PERIODS * spacing * dt if max_gap is None else max_gap
    edges = np.concatenate([[0], known, [len(measured) - 1]])
    wide = np.flatnonzero(np.diff(edges) * dt > limit * (1 + 1e-9))
    return tuple((float(edges[i] * dt), float(edges[i + 1] * dt)) for i in wide)


def count_clipped(values: FloatArray) -> int:
    """Samples of a signal (n,) stuck at its largest or smallest value, in runs of five or more.

    A quantised signal that rests or turns there also repeats itself; clipping cuts off a moving one. So a run
    counts only if two samples before or after it the signal is at least three quanta away, a quantum being
    its smallest step. Switched and constant signals have none.
    """
    values = values[np.isfinite(values)]
    if len(np.unique(values)) < 10:
        return 0
    low, high = float(values.min()), float(values.max())
    steps = np.abs(np.diff(values))
    far = 2.5 * float(steps[steps > 1e-6 * (high - low)].min())
    return sum(_stuck(values, extreme, far) for extreme in (low, high))


def _stuck(values: FloatArray, extreme: float, far: float) -> int:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], values == extreme, [False]]).astype(np.int8)))
    away = np.concatenate([[0.0, 0.0], np.abs(values - extreme), [0.0, 0.0]])
    return sum(
        int(stop - start)
        for start, stop in zip(edges[::2], edges[1::2], strict=True)
        if stop - start >= CLIPPED_RUN and max(away[start], away[stop + 3]) >= far
    )
