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

from collections.abc import Mapping

import numpy as np

from sipe_bayes.calibration.config import Config, check_dimensions
from sipe_bayes.calibration.config_fields import nearest
from sipe_bayes.calibration.config_tables import Command, LogEntry, Measurement
from sipe_bayes.calibration.grid import Grid, Recording, control_grid, held, sampled
from sipe_bayes.calibration.log_report import report_of
from sipe_bayes.calibration.readers.base import Columns, LogError
from sipe_bayes.calibration.tables import read_table
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.trajectory import Trajectory
from sipe_bayes.core.units import convert
from sipe_bayes.diagnostics.records import LogReport

_SLOW = 0.25  # s from row to row: no robot is logged so slowly without its being meant
_EMPTY = 1000  # grid samples for each of the log: a pause, or a wrong unit of time


def load_log(
    config: Config, log: LogEntry, dimensions: Mapping[str, str] | None = None
) -> tuple[Trajectory, LogReport]:
    """A log as a trajectory on its control grid, and the report of what was done to it.

    Args:
        config: the configuration.
        log: which of its logs.
        dimensions: kind of quantity of each target, see ``config.check_dimensions``; without it units are only
            converted.

    Returns:
        Observations are the measurements (T+1, O), actions the commands (T, A), in the config's order.

    Raises:
        LogError: for a log that cannot be used.
        ConfigError: for a unit of the wrong kind.
    """
    check_dimensions(config, dimensions or {})
    try:
        return _loaded(config, log)
    except LogError as error:
        raise LogError(f"log {log.name!r}: {error}") from None


def _loaded(config: Config, log: LogEntry) -> tuple[Trajectory, LogReport]:
    raw = _read_log(config, log)
    grid = control_grid(raw.time, config.resample.rate)
    _check_length(config, log, grid, raw.time)
    observed = [sampled(raw.time, y, grid, config.resample.max_gap) for y in raw.measurements]
    for measurement, before, after in zip(config.measurements, raw.measurements, observed, strict=True):
        _check_any(measurement.column, before, after)
    commands = [held(y, grid) for y in raw.commands]
    actions = np.stack(commands, -1) if commands else np.zeros((grid.samples - 1, 0))
    trajectory = Trajectory(np.stack(observed, -1), actions, grid.dt, name=log.name, channels=config.channels)
    return trajectory, report_of(config, log, raw, grid, trajectory)


def _read_log(config: Config, log: LogEntry) -> Recording:
    table, clock = read_table(log.file), config.columns.time
    time = _column(log, table, clock.column)
    _check_clock(clock.column, time)
    time = convert(time, clock.unit, "time")
    time = time - time[0]
    if "unit" not in clock.model_fields_set and np.median(np.diff(time)) >= _SLOW:
        raise LogError(
            f"read in seconds, {clock.column!r} is {np.median(np.diff(time)):g} s from row to row; "
            'name its unit, such as `columns.time.unit = "ms"`, or "s" if that is right'
        )
    part = _span(log, time)

    def signal(entry: Command | Measurement) -> FloatArray:
        values = _fitted(entry.column, _column(log, table, entry.column), len(time))[part]
        return entry.sign * entry.factor * convert(np.where(np.isfinite(values), values, np.nan), entry.unit)

    commands = [signal(c) for c in config.commands]
    measurements = [signal(m) for m in config.measurements]
    time = time[part]
    for command, values in zip(config.commands, commands, strict=True):
        _check_first_command(command.column, time, values)
    return Recording(time - time[0], commands, measurements)


def _column(log: LogEntry, table: Columns, name: str) -> FloatArray:
    """One column as numbers (n,)."""
    if name not in table:
        raise LogError(f"no column {name!r} in {log.file.name}; {nearest(name, table)}")
    try:
        return np.asarray(table[name], dtype=np.float64)
    except (TypeError, ValueError):
        row, cell = next((i, value) for i, value in enumerate(table[name], 1) if not _is_cell(value))
        where = f"column {name!r} holds {cell!r} in row {row}"
        raise LogError(f"{where}, expected numbers; correct it or leave it blank") from None


def _is_cell(value: object) -> bool:
    try:
        float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        return False
    return True


def _fitted(name: str, values: FloatArray, samples: int) -> FloatArray:
    """``values`` as long as the clock; T values beside T+1 times, as npz actions come, end with a NaN."""
    if len(values) == samples - 1:
        return np.append(values, np.nan)
    if len(values) != samples:
        lengths = f"column {name!r} has {len(values)} samples, the time {samples}"
        raise LogError(f"{lengths}; they must be equal, or one fewer")
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
    if not known.size:
        raise LogError(f"command column {name!r} holds no number; choose another column")
    if known[0] > 0:
        raise LogError(
            f"command column {name!r} holds no number before {time[known[0]]:g} s, "
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
