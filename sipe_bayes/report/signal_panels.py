"""Panels of one channel of one log: measured against simulated, and the error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from matplotlib.axes import Axes

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.diagnostics.records import Signal
from sipe_bayes.report.colours import DEFAULT, MEASURED, POSTERIOR, PRIOR, STYLE
from sipe_bayes.report.drawing import ticks

_DRAWN = (
    20_000  # samples of a line, many to a pixel: beyond, a line is drawn by its lowest and highest in short stretches
)
_MARKS = 2_000  # of windows' starts: beyond, some of them


def within(signal: Signal, span: tuple[float, float]) -> Signal:
    """The part of a signal from one time to another, s; lines go on to the panel's edge."""
    first, last = np.searchsorted(signal.time, span)
    part = slice(max(int(first) - 1, 0), int(last) + 2)
    lines = ("time", "measured", "mode", "low", "high", "default")
    inside = (signal.window_starts >= signal.time[part][0]) & (signal.window_starts <= signal.time[part][-1])
    cut = {line: getattr(signal, line)[part] for line in lines}
    return replace(signal, window_starts=signal.window_starts[inside], **cut)


def _restarted(signal: Signal, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Time and values with a gap before each window's first sample, so that no line joins two windows."""
    starts = np.unique(np.searchsorted(signal.time, signal.window_starts - 1e-9))
    starts = starts[(starts > 0) & (starts < len(signal.time))]
    return np.insert(signal.time, starts, signal.time[starts]), np.insert(values, starts, np.nan)


def _line(signal: Signal, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """What is drawn of a line: all of it, broken between windows, or of a long one what a pixel shows of it."""
    if len(values) <= _DRAWN:
        return _restarted(signal, values)
    time, low, high = _ends(signal.time, values, values)
    return np.repeat(time, 2), np.stack([low, high], axis=1).reshape(-1)


def _ends(time: FloatArray, low: FloatArray, high: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Of short stretches of many samples their first time, lowest and highest value."""
    starts = np.arange(0, len(time), -(-2 * len(time) // _DRAWN))
    return time[starts], np.fmin.reduceat(low, starts), np.fmax.reduceat(high, starts)


def _band(ax: Axes, signal: Signal, low: FloatArray, high: FloatArray) -> None:
    """The posterior's band."""
    time, above = _restarted(signal, high)
    ends = (time, _restarted(signal, low)[1], above) if len(low) <= _DRAWN else _ends(signal.time, low, high)
    ax.fill_between(*ends, color=POSTERIOR, alpha=STYLE.interval, lw=0)


def _window_marks(ax: Axes, signal: Signal, height: float) -> None:
    starts = signal.window_starts[:: -(-len(signal.window_starts) // _MARKS) or 1]
    ax.vlines(starts, 0, height, transform=ax.get_xaxis_transform(), color=PRIOR, lw=0.9, clip_on=True)


def signal_panel(ax: Axes, signal: Signal, span: tuple[float, float]) -> None:
    """Measured against simulated, with the posterior's band and the model as given.

    Args:
        ax: the panel.
        signal: one channel of one log.
        span: from when to when its limits are taken, s.
    """
    _band(ax, signal, signal.low, signal.high)
    ax.plot(*_line(signal, signal.default), color=DEFAULT, ls="--", lw=1)
    if len(signal.time) > 400 or not np.isfinite(signal.measured).any():
        unbroken = replace(signal, window_starts=signal.window_starts[:0])
        ax.plot(*_line(unbroken, signal.measured), color=MEASURED, lw=0.9)
    else:
        ax.plot(signal.time, signal.measured, ".", color=MEASURED, ms=3)
    ax.plot(*_line(signal, signal.mode), color=POSTERIOR, lw=STYLE.curve)
    _window_marks(ax, signal, 0.05)
    _keep_in_view(ax, signal, span)
    ticks(ax.yaxis, 4)


def _keep_in_view(ax: Axes, signal: Signal, span: tuple[float, float]) -> None:
    """Limits from what was measured and the posterior; a default that runs away leaves the panel."""
    shown = (signal.time >= span[0]) & (signal.time <= span[1])
    ours = np.concatenate([a[shown] for a in (signal.measured, signal.mode, signal.low, signal.high)])
    ours = ours[np.isfinite(ours)]
    if not len(ours):
        return
    low, high = float(ours.min()), float(ours.max())
    margin = 0.5 * max(high - low, 1e-9)
    default = signal.default[shown & np.isfinite(signal.default)]
    if len(default):
        low = min(low, max(float(default.min()), low - margin))
        high = max(high, min(float(default.max()), high + margin))
    pad = 0.08 * max(high - low, 1e-9)
    ax.set_ylim(low - 1.3 * pad, high + pad)


def error_panel(ax: Axes, signal: Signal, span: tuple[float, float]) -> None:
    """What is measured less the posterior's mode, within the posterior's band.

    Args:
        ax: the panel.
        signal: one channel of one log.
        span: from when to when its limits are taken, s.
    """
    _band(ax, signal, signal.low - signal.mode, signal.high - signal.mode)
    ax.axhline(0, color="#555555", lw=0.7)
    error = signal.measured - signal.mode
    ax.plot(*_line(signal, error), color=MEASURED, lw=0.8)
    _window_marks(ax, signal, 0.1)
    shown = np.abs(error[(signal.time >= span[0]) & (signal.time <= span[1]) & np.isfinite(error)])
    if len(shown) and shown.max() > 0:
        band = np.nanmax(np.abs([signal.low - signal.mode, signal.high - signal.mode]), initial=0.0)
        reach = 1.2 * max(shown.max(), min(band, 3 * shown.max()))
        ax.set_ylim(-reach, reach)
    ticks(ax.yaxis, 2)


def two_errors_panel(ax: Axes, signal: Signal, span: tuple[float, float]) -> None:
    """What is measured less either simulation, ``default`` in orange and ``mode`` in blue.

    Args:
        ax: the panel.
        signal: one channel of one log.
        span: from when to when its limits are taken, s.
    """
    ax.axhline(0, color="#555555", lw=0.7)
    inside, reach = (signal.time >= span[0]) & (signal.time <= span[1]), 0.0
    for values, colour, width in ((signal.default, DEFAULT, 1.0), (signal.mode, POSTERIOR, STYLE.curve)):
        error = signal.measured - values
        ax.plot(*_line(signal, error), color=colour, lw=width)
        reach = max(reach, float(np.nanmax(np.abs(error[inside]), initial=0.0)))
    _window_marks(ax, signal, 0.1)
    if reach > 0:
        ax.set_ylim(-1.1 * reach, 1.1 * reach)
    ticks(ax.yaxis, 4)


def worst_stretch(rows: Sequence[Signal]) -> tuple[float, float]:
    """The part of a log with the largest squared error, relative to each channel's.

    Returns:
        Its two ends, s: about a tenth of the log, four windows at least.
    """
    time = rows[0].time
    starts = rows[0].window_starts
    window = float(np.median(np.diff(starts))) if len(starts) > 1 else 0.0
    length = min(max(0.1 * (time[-1] - time[0]), 4 * window), time[-1] - time[0])
    total = np.zeros(len(time))
    for signal in rows:
        squared = np.nan_to_num((signal.measured - signal.mode) ** 2)
        total += squared / max(float(squared.mean()), 1e-300)
    width = max(round(length / max(float(np.median(np.diff(time))), 1e-12)), 1)
    summed = np.insert(np.cumsum(total), 0, 0.0)
    width = min(width, len(time))
    running = summed[width:] - summed[:-width]
    start = float(time[running.argmax()])
    return start, start + float(length)
