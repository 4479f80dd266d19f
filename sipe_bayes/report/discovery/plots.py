"""Figures of a search over structures: a ``Discovery`` in, Matplotlib figures out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sipe_bayes.diagnostics.discovery import Discovery, ModelErrors
from sipe_bayes.diagnostics.records import Residual
from sipe_bayes.diagnostics.result import ParameterSummary
from sipe_bayes.report.calibration_plots import SIZES, autocorrelation, log_figure
from sipe_bayes.report.colours import DEFAULT, MEASURED, POSTERIOR, PRIOR
from sipe_bayes.report.drawing import equal_parts, new_figure, panel_grid, styled, ticks
from sipe_bayes.report.legends import legend_above, line_handle
from sipe_bayes.report.signal_panels import two_errors_panel
from sipe_bayes.report.words import error_text, shortened, unit_text, with_unit

BEFORE, AFTER = "calibrated as it was", "with what was found"

# Signals


@styled
def before_and_after(discovery: Discovery, log: str) -> list[Figure]:
    """Measured against simulated signals of one log before and after, and both errors below.

    Simulations start anew at every tick on the time axis; a long log also gets a close-up of the largest error.
    """
    rows = [s for s in discovery.signals if s.log == log]
    titles = {row.channel: _errors_text(row) for row in discovery.errors if row.log == log}
    mark = line_handle(PRIOR, "a window starts", "none", marker="|", ms=8, mew=1.2)
    lines = [line_handle(MEASURED, "measured", lw=1), line_handle(DEFAULT, BEFORE, "--", lw=1)]
    handles = [*lines, line_handle(POSTERIOR, AFTER, lw=1.5), mark]
    parts = equal_parts(rows, SIZES.channels)
    return [log_figure(part, two_errors_panel, titles, handles, heights=(1.6, 1.0)) for part in parts]


def _errors_text(row: ModelErrors) -> str:
    sizes = f"RMSE {error_text(row.before)} {unit_text(row.unit)} before, {error_text(row.after)} after"
    return f"{sizes}; model as given {error_text(row.given)}"


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
    legend_above(figure, [line_handle(DEFAULT, BEFORE), line_handle(POSTERIOR, AFTER)], 2)
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
    """The user's parameters, those of single logs aside: 90 % intervals before, and stacked over structures.

    Where there are discrepancy-aware ones, these are thin lines that hold the others.
    """
    plain = {p.name: p for p in discovery.plain_parameters}
    pairs = [(plain[p.name], p) for p in discovery.parameters if not p.nuisance]
    return [_value_figure(part) for part in equal_parts(pairs, SIZES.parameters)]


def _value_figure(rows: Sequence[tuple[ParameterSummary, ParameterSummary]]) -> Figure:
    figure, axes, _ = panel_grid(len(rows), 1.0, 0.5)
    for ax, pair in zip(axes, rows, strict=True):
        for height, (p, colour) in enumerate(zip(pair, (DEFAULT, POSTERIOR), strict=True)):
            ax.plot([p.q05, p.q95], [1 - height] * 2, color=colour, lw=2.5, solid_capstyle="butt")
            ax.plot(p.q50, 1 - height, "o", color=colour, ms=5)
            if p.further is not None:
                ax.plot(p.further, [1 - height] * 2, color=colour, lw=1)
        ax.set_ylim(-0.7, 1.7)
        ax.set_yticks([])
        ax.spines["left"].set_visible(False)
        ax.set_title(with_unit(shortened(pair[0].name, 30), pair[0].unit), loc="left")
        ticks(ax.xaxis, 4)
    handles = [line_handle(DEFAULT, BEFORE, lw=2.5), line_handle(POSTERIOR, "stacked over structures", lw=2.5)]
    if any(p.further is not None for _, p in rows):
        handles.append(line_handle(POSTERIOR, "with what the model lacks", lw=1))
    legend_above(figure, handles, 3)
    return figure
