"""Figures of a search over structures: a ``Discovery`` in, Matplotlib figures out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sipe_bayes.diagnostics.discovery import Discovery, ModelErrors
from sipe_bayes.diagnostics.records import Residual, Signal
from sipe_bayes.diagnostics.result import ParameterSummary
from sipe_bayes.report.calibration_plots import SIZES, autocorrelation
from sipe_bayes.report.colours import DEFAULT, HOLDOUT, MEASURED, POSTERIOR, PRIOR
from sipe_bayes.report.drawing import equal_parts, new_figure, panel_grid, styled, ticks
from sipe_bayes.report.legends import legend_above, line_handle
from sipe_bayes.report.signal_panels import signal_panel, two_errors_panel, worst_stretch
from sipe_bayes.report.words import error_text, shortened, unit_text, with_unit

_BEFORE, _AFTER = "calibrated as it was", "with what was found"

# Signals


@styled
def before_and_after(discovery: Discovery, log: str) -> list[Figure]:
    """Measured against simulated signals of one log before and after, and both errors below.

    Simulations start anew at every tick on the time axis; a long log also gets a close-up of the largest error.
    """
    rows = [s for s in discovery.signals if s.log == log]
    rmse = {(row.log, row.channel): row for row in discovery.errors}
    return [_signal_figure(part, rmse) for part in equal_parts(rows, SIZES.channels)]


def _signal_figure(rows: Sequence[Signal], rmse: Mapping[tuple[str, str], ModelErrors]) -> Figure:
    first = rows[0]
    long = len(first.window_starts) > SIZES.long_windows or len(first.time) > SIZES.long_samples
    figure = new_figure(2.6 * len(rows) + 0.75)
    ratios = [2.2, 1] if long else None
    grid = figure.add_gridspec(2 * len(rows), 1 + long, height_ratios=[1.6, 1] * len(rows), width_ratios=ratios)
    spans = [(float(first.time[0]), float(first.time[-1])), *([worst_stretch(rows)] if long else [])]
    for column, span in enumerate(spans):
        for i, signal in enumerate(rows):
            above = figure.add_subplot(grid[2 * i, column])
            below = figure.add_subplot(grid[2 * i + 1, column], sharex=above)
            signal_panel(above, signal, span)
            two_errors_panel(below, signal, span)
            above.set_xlim(*span)
            above.tick_params(labelbottom=False)
            below.tick_params(labelbottom=i == len(rows) - 1)
            if column == 0:
                _labels(above, below, signal, rmse.get((signal.log, signal.channel)))
            else:
                above.set_title("where the error is largest", loc="left")
        below.set_xlabel("time [s]")
    held_out = first.use == "holdout"
    kind = "held-out log, not used in the fits" if held_out else "training log"
    title = f"{shortened(first.log, 60)}: {kind}"
    figure.suptitle(title, color=HOLDOUT if held_out else "#222222", fontweight="bold")
    shown = [line_handle(MEASURED, "measured", lw=1), line_handle(DEFAULT, _BEFORE, "--", lw=1)]
    mark = line_handle(PRIOR, "a window starts", "none", marker="|", ms=8, mew=1.2)
    shown += [line_handle(POSTERIOR, _AFTER, lw=1.5), mark]
    figure.legend(handles=shown, loc="outside lower center", ncols=4)
    figure.align_ylabels()
    return figure


def _labels(above: Axes, below: Axes, signal: Signal, row: ModelErrors | None) -> None:
    above.set_ylabel(with_unit(shortened(signal.channel, 22), signal.unit))
    below.set_ylabel("error")
    if row is not None:
        sizes = f"RMSE {error_text(row.before)} {unit_text(row.unit)} before, {error_text(row.after)} after"
        above.set_title(f"{sizes}; model as given {error_text(row.given)}", loc="right", color="#444444", fontsize=8.5)


# Residuals


@styled
def residuals(discovery: Discovery) -> list[Figure]:
    """Residuals of the training logs before and after, with their autocorrelation: rows as logs and channels."""
    pairs = list(zip(discovery.before.residuals, discovery.after.residuals, strict=True))
    return [_residual_figure(part) for part in equal_parts(pairs, SIZES.residuals)]


def _residual_figure(rows: Sequence[tuple[Residual, Residual]]) -> Figure:
    figure = new_figure(1.9 * len(rows) + 0.7)
    axes = figure.subplots(len(rows), 2, squeeze=False, width_ratios=[2, 1])
    for (left, right), pair in zip(axes, rows, strict=True):
        for row, colour, width in zip(pair, (DEFAULT, POSTERIOR), (0.8, 0.9), strict=True):
            left.plot(row.time, row.residual, color=colour, lw=width)
            _correlation(right, row, colour)
        first = pair[0]
        left.axhline(0, color=PRIOR, lw=0.7)
        left.set_xlim(first.time[0], first.time[-1])
        left.set_ylabel(with_unit("residual", first.unit))
        left.set_title(f"{shortened(first.log, 36)}: {shortened(first.channel, 24)}, training log", loc="left")
        right.axhline(0, color=PRIOR, lw=0.7)
        right.set_title("autocorrelation", loc="left")
        ticks(left.yaxis, 4)
    axes[-1, 0].set_xlabel("time [s]")
    axes[-1, 1].set_xlabel("lag [s]")
    legend_above(figure, [line_handle(DEFAULT, _BEFORE), line_handle(POSTERIOR, _AFTER)], 2)
    figure.align_ylabels()
    return figure


def _correlation(ax: Axes, row: Residual, colour: str) -> None:
    lags = min(SIZES.lags, int(np.isfinite(row.residual).sum()) // 4)
    if lags < 1:
        return
    step = float(np.median(np.diff(row.time)))
    ax.plot(np.arange(lags + 1) * step, autocorrelation(row.residual, lags), color=colour, lw=1.2)
    ax.set_xlim(0, lags * step)
    ticks(ax.yaxis, 4)


# Values


@styled
def values(discovery: Discovery) -> list[Figure]:
    """The user's parameters, those of single logs aside: 90 % intervals before, and averaged over structures."""
    plain = {p.name: p for p in discovery.plain_parameters}
    pairs = [(plain[p.name], p) for p in discovery.parameters if not p.nuisance]
    return [_value_figure(part) for part in equal_parts(pairs, SIZES.parameters)]


def _value_figure(rows: Sequence[tuple[ParameterSummary, ParameterSummary]]) -> Figure:
    figure, axes, _ = panel_grid(len(rows), 1.0, 0.5)
    for ax, pair in zip(axes, rows, strict=True):
        for height, (p, colour) in enumerate(zip(pair, (DEFAULT, POSTERIOR), strict=True)):
            ax.plot([p.q05, p.q95], [1 - height] * 2, color=colour, lw=2.5, solid_capstyle="butt")
            ax.plot(p.q50, 1 - height, "o", color=colour, ms=5)
        ax.set_ylim(-0.7, 1.7)
        ax.set_yticks([])
        ax.spines["left"].set_visible(False)
        ax.set_title(with_unit(shortened(pair[0].name, 30), pair[0].unit), loc="left")
        ticks(ax.xaxis, 4)
    legend_above(
        figure, [line_handle(DEFAULT, _BEFORE, lw=2.5), line_handle(POSTERIOR, "averaged over structures", lw=2.5)], 2
    )
    return figure
