"""What a log held and what was done to it: the clock, gaps, masked samples, held commands, saturation."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from sipe_bayes.calibration.config import Config
from sipe_bayes.calibration.config_tables import LogEntry, Measurement
from sipe_bayes.calibration.grid import Grid, Recording, Series, gaps
from sipe_bayes.core.arrays import BoolArray, FloatArray
from sipe_bayes.core.findings import Code, Finding, finding
from sipe_bayes.core.options import Options, option
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.core.trajectory import Trajectory
from sipe_bayes.diagnostics.records import LogReport
from sipe_bayes.likelihood.wild_samples import jumps


@dataclass(frozen=True)
class Saturation(Options):
    """When samples at an extreme value count as cut off."""

    run: int = option(5, "in a row at the extreme value", "samples", least=2)
    share: float = option(0.01, "worth a note: dry friction holds a turning joint for a few", "of the samples", above=0)
    levels: int = option(10, "different values: a signal with fewer is switched, not clipped", least=2)
    quanta: float = option(2.5, "from as far it was cut off, from nearer it turned round", "smallest steps", above=0)


_SATURATION = Saturation()
_EVEN, _FEWEST = 0.95, 10  # share of a slower sensor's samples that are as far apart as usual; and how many it has
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
    signals = {name: y.values for name, (m, _), y in measured if not m.quaternion}
    signals |= {c.target: y.values for c, y in zip(config.drives, raw.commands, strict=True)}
    every = {name: _every(finite[:, j]) for j, name in enumerate(config.channels)}
    expected = {name: len(finite) // n for name, n in every.items()}
    missing = {name: max(expected[name] - int(finite[:, j].sum()), 0) for j, name in enumerate(config.channels)}
    driven = {command.target for command in config.drives}
    clipped = {name: count_clipped(values, name in driven) for name, values in signals.items()}
    saturated = {name: n for name, n in clipped.items() if n > _SATURATION.share * len(raw.time)}
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
                Code.LOG_CLOCK if grid.regular else Code.LOG_RESAMPLED,
                samples=len(raw.time),
                rate=f"{1 / grid.dt:.4g} Hz",
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
    return float(np.abs(periods - median * np.maximum(1.0, np.round(periods / median))).max())


def count_clipped(values: FloatArray, command: bool = False) -> int:
    """Samples of a signal (n,) stuck at its largest or smallest value, in runs of five or more.

    A quantised signal that rests or turns there also repeats itself; clipping cuts off a moving one. So a run
    counts only if two samples before or after it the signal is at least three quanta away, a quantum being
    its smallest step. Switched and constant signals have none, and a command that is 0 there rests: an idle rotor.
    """
    values = values[np.isfinite(values)]
    if len(np.unique(values)) < _SATURATION.levels:
        return 0
    low, high = float(values.min()), float(values.max())
    steps = np.abs(np.diff(values))
    far = _SATURATION.quanta * float(steps[steps > 1e-6 * (high - low)].min())
    return sum(_stuck(values, extreme, far) for extreme in (low, high) if extreme or not command)


def _stuck(values: FloatArray, extreme: float, far: float) -> int:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], values == extreme, [False]]).astype(np.int8)))
    away = np.concatenate([[0.0, 0.0], np.abs(values - extreme), [0.0, 0.0]])
    return sum(
        int(stop - start)
        for start, stop in zip(edges[::2], edges[1::2], strict=True)
        if stop - start >= _SATURATION.run and max(away[start], away[stop + 3]) >= far
    )
