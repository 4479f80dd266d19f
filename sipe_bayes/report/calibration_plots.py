"""Figures of a calibration: a ``Calibration`` in, Matplotlib figures out, no pyplot, no state.

Rows beyond what one page can show continue in a further figure, so each function returns a list. ``drawing.png`` turns
a figure into a file's bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.diagnostics.records import Residual, Signal
from sipe_bayes.diagnostics.result import Calibration, ParameterSummary
from sipe_bayes.posterior import Particles, Posterior
from sipe_bayes.report.colours import CHAINS, DEFAULT, HOLDOUT, MEASURED, POSTERIOR, PRIOR, STYLE
from sipe_bayes.report.drawing import column_of_panels, equal_parts, fixed_grid, label_y, new_figure, styled, ticks
from sipe_bayes.report.legends import line_handle, shade_handle
from sipe_bayes.report.panels import correlation, draws, marginal_grid, pair_grid, scale, view
from sipe_bayes.report.posterior_plots import MAX_PAIRS
from sipe_bayes.report.signal_panels import error_panel, signal_panel, within, worst_stretch
from sipe_bayes.report.words import shortened, unit_text, with_unit


@dataclass(frozen=True)
class Sizes:
    """How much a figure holds before the next one begins, and how much of it is drawn.

    Args:
        parameters: panels of marginals.
        channels: of a log.
        residuals: rows.
        chains: rows of traces.
        long_windows: a signal of more windows also gets a close-up,
        long_samples: or of more samples.
        lags: of an autocorrelation.
        trace: draws of a chain.
    """

    parameters: int = 21
    channels: int = 6
    residuals: int = 8
    chains: int = 10
    long_windows: int = 24
    long_samples: int = 4000
    lags: int = 200
    trace: int = 400


SIZES = Sizes()

# Numbers behind the pictures


def autocorrelation(series: FloatArray, lags: int) -> FloatArray:
    """Autocorrelation of a series about its mean; NaN samples count nowhere.

    Args:
        series: (T,).
        lags: the longest one.

    Returns:
        (lags + 1,), NaN for a series that does not vary.
    """
    known = np.isfinite(series)
    z = np.where(known, series - series[known].mean(), 0.0)
    size = 2 ** int(np.ceil(np.log2(2 * len(z))))
    products, pairs = (np.fft.irfft(np.abs(np.fft.rfft(a, size)) ** 2, size)[: lags + 1] for a in (z, known * 1.0))
    covariance = products / np.maximum(np.round(pairs), 1)
    return covariance / covariance[0] if covariance[0] > 0 else np.full(lags + 1, np.nan)


def ordered(parameters: Iterable[ParameterSummary]) -> list[ParameterSummary]:
    """The parameters with the nuisance ones, which hold for one log alone, at the end."""
    return sorted(parameters, key=lambda p: p.nuisance)


def pair_names(calibration: Calibration, theta: FloatArray) -> list[str]:
    """Names of at most eight parameters worth a look in pairs.

    They are those on ridges, then the most correlated and the least determined.

    Args:
        calibration: whose parameters.
        theta: draws of its posterior (M, N).
    """
    space = calibration.posterior.space
    parameters = [p for p in ordered(calibration.parameters) if p.name in space.names]
    if len(parameters) <= MAX_PAIRS:
        return [p.name for p in parameters]
    strength = np.abs(correlation(theta) - np.eye(len(space))).max(0)
    on_ridge = {name for ridge in calibration.ridges for name in ridge.parameters}

    def priority(p: ParameterSummary) -> tuple[bool, float]:
        return p.name in on_ridge, max(strength[space.index(p.name)], 1 - p.contraction)

    chosen = {p.name for p in sorted(parameters, key=priority, reverse=True)[:MAX_PAIRS]}
    return [p.name for p in parameters if p.name in chosen]


# Marginals and pairs


def printed_posterior(calibration: Calibration) -> Posterior:
    """That whose intervals are printed first: with what the model lacks or may lack, where that was asked."""
    return calibration.posterior if calibration.further is None else calibration.further


@styled
def marginals(calibration: Calibration) -> list[Figure]:
    """One panel per parameter, nuisance ones last: posterior, prior, 90 % interval, default; the prior range above.

    The posterior is that with what the model lacks or may lack; the one that takes it for right is dotted.
    """
    theta, space, figures = draws(printed_posterior(calibration)), calibration.posterior.space, []
    plain = None if calibration.further is None else draws(calibration.posterior)
    for part in equal_parts(ordered(calibration.parameters), SIZES.parameters):
        columns = [space.index(summary.name) for summary in part]
        chosen = [space[j] for j in columns]
        ends = [p.normalise(np.array(s.further or (s.q05, s.q95))) for p, s in zip(chosen, part, strict=True)]
        shown = (chosen, theta[:, columns], calibration.prior, np.stack(ends, axis=1), [None] * len(part))
        figures.append(marginal_grid(*shown, None if plain is None else plain[:, columns]))
    return figures


@styled
def pairs(calibration: Calibration, names: Sequence[str] | None = None) -> list[Figure]:
    """Draws of every pair of at most eight parameters, over draws of the prior, with their correlation.

    Returns:
        One figure; none for fewer than two parameters.
    """
    theta, space = draws(printed_posterior(calibration)), calibration.posterior.space
    names = pair_names(calibration, theta) if names is None else list(names)[:MAX_PAIRS]
    if len(names) < 2:
        return []
    columns = [space.index(name) for name in names]
    default = {p.name: p.default for p in calibration.parameters}
    defaults = [default.get(name) for name in names]
    before = draws(calibration.prior, 500)[:, columns]
    return [pair_grid([space[j] for j in columns], theta[:, columns], before, defaults, [None] * len(names))]


# Signals


@styled
def signals(calibration: Calibration, log: str) -> list[Figure]:
    """Measured against simulated signals of one log, and the error of each channel below it.

    The simulation starts anew at every tick on the time axis. A long log also gets a close-up of the stretch where the
    posterior mode errs most.

    Raises:
        ValueError: for a log without signals.
    """
    rows = [s for s in calibration.signals if s.log == log]
    if not rows:
        known = sorted({s.log for s in calibration.signals})
        raise ValueError(f"log: expected one of {known}, got {log!r}")
    scores = [score for score in (*calibration.train, *calibration.holdout) if score.log == log]
    titles = {
        s.channel: f"RMSE {s.rmse:.3g} {unit_text(s.unit)}, with the model as given {s.rmse_default:.3g}"
        for s in scores
    }
    parts = equal_parts(rows, SIZES.channels)
    return [log_figure(part, error_panel, titles, _signal_handles()) for part in parts]


def log_figure(
    rows: Sequence[Signal],
    errors: Callable[[Axes, Signal, tuple[float, float]], None],
    titles: Mapping[str, str],
    handles: Sequence[Artist],
    heights: tuple[float, float] = (3.0, 1.25),
) -> Figure:
    """Channels of one log: signals above, errors below; a long log also gets a close-up of the largest error.

    Args:
        rows: the channels.
        errors: draws the panel below.
        titles: of channels, above their panels.
        handles: of the legend.
        heights: of both panels, to each other.
    """
    first = rows[0]
    long = len(first.window_starts) > SIZES.long_windows or len(first.time) > SIZES.long_samples
    figure = new_figure(2.45 * len(rows) + 0.75)
    grid = fixed_grid(figure, [*heights] * len(rows), [2.2, 1] if long else [1])
    spans = [(float(first.time[0]), float(first.time[-1])), *([worst_stretch(rows)] if long else [])]
    for column, span in enumerate(spans):
        for i, signal in enumerate([within(row, span) for row in rows] if column else rows):
            above = figure.add_subplot(grid[2 * i, column])
            below = figure.add_subplot(grid[2 * i + 1, column], sharex=above)
            signal_panel(above, signal, span)
            errors(below, signal, span)
            above.set_xlim(*span)
            above.tick_params(labelbottom=False)
            below.tick_params(labelbottom=i == len(rows) - 1)
            if column:
                above.set_title("where the error is largest", loc="left")
                continue
            label_y(above, with_unit(shortened(signal.channel, 22), signal.unit))
            label_y(below, "error")
            above.set_title(titles.get(signal.channel, ""), loc="right", color="#444444", fontsize=8.5)
        below.set_xlabel("time [s]")
    held_out = first.use == "holdout"
    kind = "held-out log, not used in the fit" if held_out else "training log"
    colour = HOLDOUT if held_out else "#222222"
    figure.suptitle(
        f"{shortened(first.log, 60)}: {kind}", color=colour, fontweight="bold", y=1 - 0.1 / figure.get_figheight()
    )
    figure.legend(handles=handles, loc="lower center", ncols=len(handles))
    return figure


def _signal_handles() -> list[Artist]:
    return [
        line_handle(MEASURED, "measured", lw=1),
        line_handle(POSTERIOR, "posterior mode", lw=1.5),
        shade_handle(POSTERIOR, "90 % band of what is read"),
        line_handle(DEFAULT, "model as given", "--", lw=1),
        line_handle(PRIOR, "a window starts", "none", marker="|", ms=8, mew=1.2),
    ]


# Residuals


@styled
def residuals(calibration: Calibration) -> list[Figure]:
    """Residuals over time, one row per training log and fitted channel, with their autocorrelation.

    That of the whitened residual stays in the band when the noise model holds.
    """
    return [_residual_figure(part) for part in equal_parts(calibration.residuals, SIZES.residuals)]


def _residual_figure(rows: Sequence[Residual]) -> Figure:
    figure = new_figure(1.75 * len(rows) + 0.5)
    axes = fixed_grid(figure, [1.0] * len(rows), [2.0, 1.0], 0.45).subplots(squeeze=False)
    for (left, right), row in zip(axes, rows, strict=True):
        left.plot(row.time, row.residual, color=MEASURED, lw=0.7)
        left.axhline(0, color=PRIOR, lw=0.7)
        left.set_xlim(row.time[0], row.time[-1])
        label_y(left, with_unit("residual", row.unit))
        left.set_title(f"{shortened(row.log, 36)}: {shortened(row.channel, 24)}", loc="left")
        ticks(left.yaxis, 4)
        _autocorrelation(right, row)
    axes[-1, 0].set_xlabel("time [s]")
    axes[-1, 1].set_xlabel("lag [samples]")
    return figure


def _autocorrelation(ax: Axes, row: Residual) -> None:
    known = np.isfinite(row.whitened)
    n = int(known.sum())
    lags = min(SIZES.lags, n // 4)
    ax.axhline(0, color=PRIOR, lw=0.7)
    if lags < 1:
        ax.set_title("too few samples", loc="left")
        return
    band = 1.96 / np.sqrt(n)
    values = autocorrelation(row.whitened, lags)
    ax.axhspan(-band, band, color=PRIOR, alpha=STYLE.prior, lw=0)
    ax.vlines(np.arange(1, lags + 1), 0, values[1:], color=POSTERIOR, lw=min(1.6, 160 / lags))
    outside = float(np.mean(np.abs(values[1:]) > band))
    ax.set_title(f"{100 * outside:.0f} % of lags outside the band (5 % if white)", loc="left", fontsize=8.5)
    ax.set_xlim(0, lags + 0.5)
    reach = max(2.5 * band, 1.15 * float(np.nanmax(np.abs(values[1:]), initial=0.0)))
    ax.set_ylim(-reach, reach)
    ax.xaxis.set_major_locator(MaxNLocator(5, integer=True))
    ticks(ax.yaxis, 4)


# Chains


@styled
def chains(calibration: Calibration) -> list[Figure]:
    """Traces of the Markov chains, one row per parameter.

    Returns:
        None when the posterior did not come as several chains.
    """
    posterior, space = calibration.posterior, calibration.posterior.space
    if not isinstance(posterior, Particles) or not posterior.chains:
        return []
    traces = np.asarray(posterior.theta).reshape(posterior.chains, -1, len(space))
    step = -(-traces.shape[1] // SIZES.trace)
    values = space.values(traces[:, ::step])
    names = [p.name for p in ordered(calibration.parameters)]
    return [_chain_figure(part, values, step, calibration) for part in equal_parts(names, SIZES.chains)]


def _chain_figure(names: Sequence[str], values: FloatArray, step: int, calibration: Calibration) -> Figure:
    figure, axes = column_of_panels(len(names), 1.1, 0.5)
    space = calibration.posterior.space
    draw = np.arange(values.shape[1]) * step
    for ax, name in zip(axes, names, strict=True):
        j = space.index(name)
        for chain, colour in zip(values[:, :, j], np.resize(CHAINS, len(values)), strict=True):
            ax.plot(draw, chain, color=str(colour), lw=0.6, alpha=0.6)
        ax.set_title(shortened(name, 50), loc="left")
        ax.set_yscale(scale(space[j], view(space[j].normalise(values[:, :, j]).ravel())))
        ax.set_ylabel(unit_text(space[j].unit) or "no unit")
        ax.set_xlim(0, max(draw[-1], 1))
        ticks(ax.yaxis, 3)
    axes[-1].set_xlabel(f"draw of each of {len(values)} chains")
    figure.align_ylabels()
    return figure
