"""What a log held and what was done to it: the clock, gaps, masked samples, held commands, saturation."""

from __future__ import annotations

import functools

import numpy as np

from sipe_bayes.calibration.checks.clipping import SATURATION, Signal, clipped_of
from sipe_bayes.calibration.config import Config
from sipe_bayes.calibration.config_tables import LogEntry, Measurement
from sipe_bayes.calibration.grid import Grid, Recording, Series, gaps
from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray
from sipe_bayes.core.findings import Code, Finding, finding
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.core.trajectory import Trajectory
from sipe_bayes.core.wild_samples import AFTER, jumps
from sipe_bayes.diagnostics.records import LogReport

_EVEN, _FEWEST = 0.95, 10  # share of a slower sensor's samples that are as far apart as usual; and how many it has
_ROUNDED = 1e-6  # of a period: less is how times near zero are rounded
_SILENT = 10.0  # periods of a command after its last one: a stream that has stopped, and no late message


def report_of(
    config: Config, log: LogEntry, sha256: str, raw: Recording, grid: Grid, trajectory: Trajectory
) -> LogReport:
    """What a log held, as it was read, and what was done to it on the grid.

    Args:
        config: the configuration.
        log: which of its logs.
        sha256: of its file.
        raw: as it was read.
        grid: of the control steps.
        trajectory: what came out.
    """
    finite = np.isfinite(trajectory.observations)
    measured = zip(_column_names(config), config.sources, raw.measurements, strict=True)
    # a quaternion has length one: where a body rests or lies squarely, a component is at its largest
    signals = [Signal(name, y.time, y.values, False, not m.quaternion) for name, (m, _), y in measured]
    signals += [Signal(c.target, y.time, y.values, True) for c, y in zip(config.drives, raw.commands, strict=True)]
    every = {name: _every(finite[:, j]) for j, name in enumerate(config.channels)}
    expected = {name: len(finite) // n for name, n in every.items()}
    missing = {name: max(expected[name] - int(finite[:, j].sum()), 0) for j, name in enumerate(config.channels)}
    clipped = clipped_of(signals)
    saturated = {name: n for name, n in clipped.items() if n > SATURATION.share * len(raw.time)}
    commands = zip(config.drives, raw.commands, strict=True)
    blank = {c.target: int((~np.isfinite(y.values[:-1])).sum()) for c, y in commands}
    holes = gaps(np.any(finite, axis=-1), grid.dt, config.resample.max_gap)
    jitter = _jitter(raw.time)
    note = functools.partial(finding, log=log.name)
    wild = {m.name: n for m, n in zip(config.measurements, raw.wild, strict=True) if n}
    own = [y for y in raw.measurements if y.time is not raw.time]
    return LogReport(
        name=log.name,
        file=str(log.file),
        sha256=sha256,
        rate_hz=1.0 / grid.dt,
        duration_s=(grid.samples - 1) * grid.dt,
        samples=grid.samples,
        jitter_s=jitter,
        resampled=not all(grid.on_clock(y.time).regular for y in own) or not grid.regular,
        gaps=holes,
        missing=missing,
        wild=wild,
        clipped=clipped,
        findings=(
            note(
                Code.LOG_CLOCK,
                samples=len(raw.time),
                done="passed through unchanged" if grid.regular else f"resampled to {1 / grid.dt:.4g} Hz",
                own_rate=f"{1 / float(np.median(np.diff(raw.time))):.4g} Hz",
                jitter_ms=1e3 * jitter,
            ),
            *_of_clocks(config, log, raw),
            *(note(Code.LOG_WILD, channel=c, count=n) for c, n in wild.items()),
            *(note(Code.LOG_GAP, start=start, stop=stop) for start, stop in holes),
            *(
                note(Code.LOG_RATE, channel=c, rate=f"{1 / (n * grid.dt):.4g} Hz", every=n)
                for c, n in every.items()
                if n > 1
            ),
            *(note(Code.LOG_MISSING, channel=c, missing=n, samples=grid.samples) for c, n in missing.items() if n),
            *(note(Code.LOG_BLANK_COMMANDS, channel=c, blank=n) for c, n in blank.items() if n),
            *(note(Code.LOG_CLIPPED, channel=c, clipped=n) for c, n in saturated.items()),
        ),
    )


def _of_clocks(config: Config, log: LogEntry, raw: Recording) -> list[Finding]:
    """Of clocks beside the grid's, commands that end early, positions that jump, joints and bodies logged slowly."""
    noticed = []
    series = [*raw.measurements, *raw.commands]
    apart = sum(y.time is not raw.time for y in series)
    if apart:
        noticed.append(finding(Code.LOG_CLOCKS, log=log.name, count=apart, of=len(series), late=raw.late))
    for command, y in zip(config.drives, raw.commands, strict=True):
        silent = float(raw.time[-1] - y.time[-1])
        if len(y.time) > 1 and silent > _SILENT * float(np.median(np.diff(y.time))):
            noticed.append(finding(Code.LOG_COMMAND_ENDS, log=log.name, channel=command.target, silent=silent))
    for (m, _), y in zip(config.sources, raw.measurements, strict=True):
        known = np.flatnonzero(np.isfinite(y.values))
        places = jumps(y.values[known]) if _of_joint(m) and m.target.endswith(".position") else known[:0]
        places = places[~_commanded(raw, y.time[known], places)]
        if len(places):
            when = float(y.time[known[places[0] + 1]] - raw.time[0])
            noticed.append(finding(Code.LOG_JUMPS, log=log.name, channel=m.name, count=len(places), when=when))
    moving = [(m, y) for (m, _), y in zip(config.sources, raw.measurements, strict=True) if _of_joint(m) or _of_body(m)]
    rates = {m.name: _rate(y) for m, y in moving}
    slow = {name: rate for name, rate in rates.items() if rate < THRESHOLDS.slow_log}
    if slow:
        rate = f"{min(slow.values()):.3g} Hz"
        noticed.append(finding(Code.LOG_SLOW, log=log.name, channels=", ".join(slow), rate=rate))
    return noticed


def _commanded(raw: Recording, times: FloatArray, places: IntArray) -> BoolArray:
    """Which of the steps from samples ``places`` (k,) on, at times (n,), come right after a jump of a command."""
    if not len(places):
        return np.zeros(0, bool)
    jumped = [y.time[1 + jumps(y.values)] for y in raw.commands if np.isfinite(y.values).all()]
    ago = times[places + 1, None] - np.concatenate([*jumped, np.full(1, np.inf)])
    return np.asarray(((ago >= 0) & (ago <= AFTER * float(np.median(np.diff(times))))).any(axis=1))


def _every(known: BoolArray) -> int:
    """By how many samples those that are there (n,) are apart, where they are many and nearly all as far; else 1."""
    apart = np.diff(np.flatnonzero(known))
    if len(apart) < _FEWEST:
        return 1
    usual = int(np.median(apart))
    return usual if np.mean(apart == usual) > _EVEN else 1


def _of_joint(measurement: Measurement) -> bool:
    return measurement.fit and measurement.target.startswith("joint:")


def _of_body(measurement: Measurement) -> bool:
    return measurement.fit and measurement.target.startswith("body:")


def _rate(series: Series) -> float:
    """Hz of the samples that are there."""
    time = series.time[np.isfinite(series.values)]
    return 1.0 / float(np.median(np.diff(time))) if len(time) > 1 else np.inf


def _column_names(config: Config) -> list[str]:
    """What the measured columns are called: as their channels, those of a vector as themselves."""
    return [f"{m.name} ({column})" if m.columns else m.name for m, column in config.sources]


def _jitter(time: FloatArray) -> float:
    periods = np.diff(time)
    median = np.median(periods)
    jitter = float(np.abs(periods - median * np.maximum(1.0, np.round(periods / median))).max())
    return jitter if jitter > _ROUNDED * float(median) else 0.0
