"""The control grid of a log, and signals on it: passed through or interpolated; commands are held."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sipe_bayes.core.arrays import BoolArray, FloatArray

_REGULAR = 0.1  # of a period: a clock whose samples are as near to the grid as this is regular
_JITTER = 0.45  # of a period: so far a time stamp may be off while it is certain which sample is meant
_SMOOTHER = 0.8  # of what a cubic misses: so much better, and the stamps are right that the samples jitter
_USUAL = 0.9  # of the samples: the others may be steps and glitches
_GAP_PERIODS = 5.0  # default max_gap, in a column's own median sample periods


@dataclass(frozen=True)
class Series:
    """One column in SI.

    Args:
        time: (n,) s from the recording's zero; the recording's own time, unless the column has a clock of its own.
        values: (n,) with NaN where there is no number.
    """

    time: FloatArray
    values: FloatArray


@dataclass(frozen=True)
class Recording:
    """A log in SI.

    Args:
        time: (n,) s from zero, of the clock that gives the grid.
        commands: of each control.
        measurements: of each channel.
        supplies: voltages by which commands are multiplied, by their number.
        late: s that were left out before the first command of a clock of its own.
        wild: of each measurement, samples that were masked because no smooth motion explains them.
    """

    time: FloatArray
    commands: list[Series]
    measurements: list[Series]
    supplies: dict[int, Series]
    late: float
    wild: list[int]


@dataclass(frozen=True)
class Grid:
    """The control grid.

    Args:
        dt: s from one time to the next.
        samples: how many times.
        rows: (n,) where the log's rows stand, in periods; whole numbers when regular, else time / dt.
        regular: whether the rows lie on the grid.
    """

    dt: float
    samples: int
    rows: FloatArray
    regular: bool

    def on_clock(self, time: FloatArray) -> Grid:
        """The same grid, with the rows of another clock; time (n,) in s from the grid's start."""
        rows = np.round(time / self.dt)
        inside = bool(len(rows)) and rows[0] >= 0 and rows[-1] < self.samples
        near = inside and np.abs(time - rows * self.dt).max() <= _REGULAR * self.dt and (np.diff(rows) > 0).all()
        return replace(self, rows=rows if near else time / self.dt, regular=bool(near))


def control_grid(time: FloatArray, rate: float | None, measured: Sequence[FloatArray] = ()) -> Grid:
    """The control grid of a log.

    Args:
        time: (n,) s from zero.
        rate: Hz; default the log's own.
        measured: (n,) each: signals that say whether the samples jitter or only their time stamps do.
    """
    periods = np.diff(time)
    dt = float(np.median(periods)) if rate is None else 1.0 / rate
    if rate is None:
        rows = _counted(time, dt)
        mean = float(time[-1] / rows[-1])
        if np.abs(time - rows * mean).max() <= _REGULAR * mean:
            return Grid(mean, int(rows[-1]) + 1, rows, True)
        slope, start = np.polyfit(rows, time, 1)
        if np.abs(time - start - rows * slope).max() <= _JITTER * slope:
            dt = float(slope)
            if _as_smooth(rows * dt, time, measured):
                return Grid(dt, int(rows[-1]) + 1, rows, True)
    rows = np.round(time / dt)
    if (np.diff(rows) > 0).all() and np.abs(time - rows * dt).max() <= _REGULAR * dt:
        return Grid(dt, int(rows[-1]) + 1, rows, True)
    return Grid(dt, int(time[-1] / dt + 1e-6) + 1, time / dt, False)


def _counted(time: FloatArray, dt: float) -> FloatArray:
    """Numbers (n,) of the samples with those that were dropped; dt: about the period, in s."""
    rows = np.append(0.0, np.cumsum(np.maximum(1.0, np.round(np.diff(time) / dt))))
    for _ in range(3):  # a first guess that is a little off loses count in a long log
        slope, start = np.polyfit(rows, time, 1)
        again = np.round((time - start) / slope)
        if (np.diff(again) <= 0).any() or np.array_equal(again - again[0], rows):
            break
        rows = again - again[0]
    return rows


def _as_smooth(regular: FloatArray, stamped: FloatArray, measured: Sequence[FloatArray]) -> bool:
    """Whether signals (n,) pass about as smoothly through regular times as through their stamps.

    Each sample is held against the cubic through its four neighbours; the mean of most, since the median of a coarse
    encoder's readings jumps by its ticks.
    """
    sizes = [[_usual(_off_cubic(times, y)) for times in (regular, stamped)] for y in measured]
    return bool(sizes) and all(not by_stamp < _SMOOTHER * plain for plain, by_stamp in sizes)


def _usual(off: FloatArray) -> float:
    """Mean size of what is off, of all but the largest."""
    size = np.sort(np.abs(off))
    return float(size[: max(1, round(_USUAL * len(size)))].mean())


def _off_cubic(time: FloatArray, values: FloatArray) -> FloatArray:
    """How far finite samples (n,) are from the cubics through their four neighbours."""
    known = np.isfinite(values)
    t, x = time[known], values[known]
    if len(t) < 5:
        return np.full(1, np.nan)
    places, middle = [0, 1, 3, 4], slice(2, -2)
    near = np.stack([t[k : len(t) - 4 + k] for k in places])
    foretold = np.zeros(len(t) - 4)
    for k, place in enumerate(places):
        others = np.delete(near, k, axis=0)
        weight = np.prod((t[middle] - others) / (near[k] - others), axis=0)
        foretold += weight * x[place : len(t) - 4 + place]
    return np.asarray(x[middle] - foretold)


def held(values: FloatArray, grid: Grid) -> FloatArray:
    """Actions (T,): the last finite value (n,) at or before each control step."""
    known = np.maximum.accumulate(np.where(np.isfinite(values), np.arange(len(values)), 0))
    row = np.searchsorted(grid.rows, np.arange(grid.samples - 1) + 1e-6, side="right") - 1
    return values[known][row]


def sampled(time: FloatArray, values: FloatArray, grid: Grid, max_gap: float | None) -> FloatArray:
    """Measurements (T+1,) on the grid, NaN where there is none.

    Args:
        time: (n,) s.
        values: (n,) with NaN where there is none.
        grid: the control grid.
        max_gap: s between two samples, beyond which nothing is interpolated; default five of their periods.
    """
    out = np.full(grid.samples, np.nan)
    if grid.regular:
        out[grid.rows.astype(np.int64)] = values
        return out
    known = np.isfinite(values)
    if known.sum() < 2:
        return out
    return _interpolated(time[known], values[known], grid, max_gap)


def _interpolated(time: FloatArray, values: FloatArray, grid: Grid, max_gap: float | None) -> FloatArray:
    """Linear interpolation at those grid times that are the nearest one to some sample.

    time, values (n,): finite samples, at least two.
    """
    limit = _GAP_PERIODS * float(np.median(np.diff(time))) if max_gap is None else max_gap
    times = np.arange(grid.samples) * grid.dt
    right = np.clip(np.searchsorted(time, times), 1, len(time) - 1)
    inside = (time[right - 1] <= times) & (times <= time[right]) & (time[right] - time[right - 1] <= limit)
    near = np.where(time[right] - times < times - time[right - 1], right, right - 1)
    exact = np.abs(time[near] - times) <= 1e-6 * grid.dt
    owned = np.zeros(grid.samples, dtype=np.bool_)
    owned[np.minimum(np.round(time / grid.dt).astype(np.int64), grid.samples - 1)] = True
    between = np.where(owned & inside, np.interp(times, time, values), np.nan)
    return np.where(exact, values[near], between)


def gaps(measured: BoolArray, dt: float, max_gap: float | None) -> tuple[tuple[float, float], ...]:
    """Stretches (start, stop) in s without a measurement.

    Args:
        measured: (T+1,) where there is one.
        dt: s from one to the next.
        max_gap: s that are no gap yet; default five median periods of the measurements.
    """
    known = np.flatnonzero(measured)
    spacing = float(np.median(np.diff(known))) if len(known) > 1 else 1.0
    limit = _GAP_PERIODS * spacing * dt if max_gap is None else max_gap
    edges = np.concatenate([[0], known, [len(measured) - 1]])
    wide = np.flatnonzero(np.diff(edges) * dt > limit * (1 + 1e-9))
    return tuple((float(edges[i] * dt), float(edges[i + 1] * dt)) for i in wide)
