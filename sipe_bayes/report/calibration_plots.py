"""Figures of a calibration. Every function is pure: a ``Calibration`` in, Matplotlib figures out, no pyplot,
no state.

Rows beyond what one page can show continue in a further figure, so each function returns a list. ``drawing.png`` turns a figure
into a file's bytes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.diagnostics.records import Residual, Signal
from sipe_bayes.diagnostics.result import Calibration, ParameterSummary
from sipe_bayes.report.drawing import (
    CHAINS,
    DEFAULT,
    HOLDOUT,
    MEASURED,
    POSTERIOR,
    PRIOR,
    WIDTH,
    _figure,
    _label,
    _line,
    _parts,
    _short,
    _styled,
    _ticks,
)
from sipe_bayes.report.drawing import png as png
from sipe_bayes.report.drawing import unit_text as unit_text
from sipe_bayes.report.panels import (
    _diagonal,
    _pair,
    _pair_frame,
    _pair_in_prior,
    _prior_density,
    _prior_strip,
    _scale,
    _view,
    correlation,
    density,
    draws,
)
from sipe_bayes.report.signal_panels import _error, _signal, _worst_stretch

if TYPE_CHECKING:
    from sipe_bayes.posterior import Posterior

FloatArray = NDArray[np.float64]

MAX_PAIRS = 8
MAX_LAG = 200
_PANELS, _CHANNELS, _RESIDUALS, _TRACES = 21, 6, 8, 10  # per figure
_LONG_WINDOWS, _LONG_SAMPLES = 24, 4000  # beyond either, a signal also gets a close-up

# Numbers behind the pictures


def autocorrelation(series: FloatArray, lags: int) -> FloatArray:
    """Autocorrelation (lags + 1,) of a series (T,) about its mean; NaN samples count nowhere."""
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
    """Names of at most eight parameters worth a look in pairs: those on ridges, then the most correlated and
    the least determined."""
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


# Marginals


@_styled
def marginals(calibration: Calibration) -> list[Figure]:
    """One panel per parameter, nuisance ones last: density of the posterior, the prior, the 90 % interval,
    the default.

    Densities are per unit of theta, in which a uniform prior is flat, on log scales too. The bar above a
    panel is the whole prior range, with the interval and the default marked in it.
    """
    theta = draws(calibration.posterior)
    return [_marginal_figure(calibration, part, theta) for part in _parts(ordered(calibration.parameters), _PANELS)]


def _marginal_figure(calibration: Calibration, part: Sequence[ParameterSummary], theta: FloatArray) -> Figure:
    columns = min(3, max(2, len(part)))
    rows = -(-len(part) // columns)
    figure = _figure(1.85 * rows + 0.4)
    grid = figure.add_gridspec(rows, columns)
    space = calibration.posterior.space
    for i, summary in enumerate(part):
        ax = figure.add_subplot(grid[i // columns, i % columns])
        column = theta[:, space.index(summary.name)]
        _marginal(ax, summary, space[space.index(summary.name)], column, calibration.prior)
    handles = [
        _line(POSTERIOR, "posterior"),
        Patch(color=POSTERIOR, alpha=0.3, lw=0, label="90 % interval"),
        Patch(facecolor=PRIOR, alpha=0.35, edgecolor=PRIOR, label="prior"),
        _line(DEFAULT, "model as given", ls="--"),
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=4)
    return figure


def _marginal(ax: Axes, summary: ParameterSummary, parameter: Parameter, theta: FloatArray, prior: Posterior) -> None:
    default = None if summary.default is None else float(parameter.normalise(summary.default))
    low, high = _view(theta, default)
    ax.set_xscale(_scale(parameter, (low, high)))
    grid = np.linspace(low, high, 300)
    x = parameter.value(grid)
    ax.fill_between(x, _prior_density(prior, summary.name, grid), color=PRIOR, alpha=0.35, lw=0.8)
    interval = parameter.normalise(np.array([summary.q05, summary.q95]))
    if np.ptp(theta) < 1e-9:
        ax.axvline(parameter.value(theta[0]), color=POSTERIOR)
    else:
        height = density(theta, grid)
        inside = (grid >= interval[0]) & (grid <= interval[1])
        ax.fill_between(x, height, where=inside.tolist(), color=POSTERIOR, alpha=0.3, lw=0)
        ax.plot(x, height, color=POSTERIOR, lw=1.4)
        ax.set_ylim(0, 1.08 * height.max())
    if summary.default is not None and default is not None and low <= default <= high:
        ax.axvline(summary.default, color=DEFAULT, ls="--", lw=1.2)
    ax.set_xlim(x[0], x[-1])
    _ticks(ax.xaxis, 5)
    ax.set_yticks([])
    ax.spines["left"].set_visible(False)
    ax.set_xlabel(unit_text(parameter.unit) or "no unit", labelpad=1)
    ax.set_title(_short(summary.name, 40), pad=15, fontweight="bold")
    _prior_strip(ax, interval, default)


# Pairs


@_styled
def pairs(calibration: Calibration, names: Sequence[str] | None = None) -> list[Figure]:
    """Draws of every pair of at most eight parameters: below the diagonal close up, above it the same draws
    within the whole prior range, over draws of the prior, with their correlation. No figure for fewer than
    two parameters.

    names: which ones; left out, those of ``pair_names``.
    """
    theta, space = draws(calibration.posterior), calibration.posterior.space
    names = pair_names(calibration, theta) if names is None else list(names)[:MAX_PAIRS]
    if len(names) < 2:
        return []
    columns = [space.index(name) for name in names]
    theta, before = theta[:, columns], draws(calibration.prior, 500)[:, columns]
    size = len(names)
    figure = _figure(min(WIDTH, 1.3 + 1.55 * size) * 0.96, min(WIDTH, 1.6 + 1.75 * size))
    axes: Any = figure.subplots(size, size, squeeze=False)
    correlations = correlation(theta)
    parameters = [space[j] for j in columns]
    default = {p.name: p.default for p in calibration.parameters}
    for i in range(size):
        for j in range(size):
            ax: Axes = axes[i, j]
            if i < j:
                _pair_in_prior(ax, theta[:, [j, i]], before[:, [j, i]], float(correlations[i, j]))
            elif i == j:
                _diagonal(ax, parameters[i], theta[:, i])
            else:
                known = [default.get(parameters[k].name) for k in (j, i)]
                _pair(ax, (parameters[j], parameters[i]), theta[:, [j, i]], known)
            _pair_frame(ax, (parameters[j], parameters[i]), i, j, size)
    figure.align_labels()
    return [figure]


# Signals


@_styled
def signals(calibration: Calibration, log: str) -> list[Figure]:
    """Measured against simulated signals of one log, and the error of each channel below it; six channels to
    a figure.

    The simulation starts anew at every tick on the time axis. A long log also gets a close-up of the stretch
    where the posterior mode errs most. Raises ValueError for a log without signals.
    """
    rows = [s for s in calibration.signals if s.log == log]
    if not rows:
        known = sorted({s.log for s in calibration.signals})
        raise ValueError(f"log: expected one of {known}, got {log!r}")
    rmse = {(s.log, s.channel): (s.rmse, s.rmse_default) for s in (*calibration.train, *calibration.holdout)}
    return [_signal_figure(part, rmse) for part in _parts(rows, _CHANNELS)]


def _signal_figure(rows: Sequence[Signal], rmse: dict[tuple[str, str], tuple[float, float]]) -> Figure:
    first = rows[0]
    long = len(first.window_starts) > _LONG_WINDOWS or len(first.time) > _LONG_SAMPLES
    figure = _figure(2.35 * len(rows) + 0.75)
    grid = figure.add_gridspec(
        2 * len(rows), 1 + long, height_ratios=[3, 1.25] * len(rows), width_ratios=[2.2, 1] if long else None
    )
    spans = [(float(first.time[0]), float(first.time[-1])), *([_worst_stretch(rows)] if long else [])]
    for column, span in enumerate(spans):
        for i, signal in enumerate(rows):
            above = figure.add_subplot(grid[2 * i, column])
            below = figure.add_subplot(grid[2 * i + 1, column], sharex=above)
            _signal(above, signal, span)
            _error(below, signal, span)
            above.set_xlim(*span)
            above.tick_params(labelbottom=False)
            _channel_labels(above, below, signal, rmse, i == len(rows) - 1, column == 0)
    held_out = first.use == "holdout"
    kind = "held-out log, not used in the fit" if held_out else "training log"
    colour = HOLDOUT if held_out else "#222222"
    figure.suptitle(f"{_short(first.log, 60)}: {kind}", color=colour, fontweight="bold")
    figure.legend(handles=_signal_handles(), loc="outside lower center", ncols=5)
    figure.align_ylabels()
    return figure


def _signal_handles() -> list[Any]:
    return [
        _line(MEASURED, "measured", lw=1),
        _line(POSTERIOR, "posterior mode", lw=1.5),
        Patch(color=POSTERIOR, alpha=0.3, lw=0, label="90 % band of the posterior"),
        _line(DEFAULT, "model as given", ls="--", lw=1),
        _line(PRIOR, "a window starts", ls="none", marker="|", ms=8, mew=1.2),
    ]


def _channel_labels(
    above: Axes,
    below: Axes,
    signal: Signal,
    rmse: dict[tuple[str, str], tuple[float, float]],
    last: bool,
    left: bool,
) -> None:
    if last:
        below.set_xlabel("time [s]")
    else:
        below.tick_params(labelbottom=False)
    if not left:
        above.set_title("where the error is largest", loc="left")
        return
    above.set_ylabel(_label(_short(signal.channel, 22), signal.unit))
    below.set_ylabel("error")
    scores = rmse.get((signal.log, signal.channel))
    if scores is not None:
        text = f"RMSE {scores[0]:.3g} {unit_text(signal.unit)}, with the model as given {scores[1]:.3g}"
        above.set_title(text, loc="right", color="#444444", fontsize=8.5)


# Residuals


@_styled
def residuals(calibration: Calibration) -> list[Figure]:
    """Residual over time, and the autocorrelation of the whitened one, which stays in the band when the noise
    model holds. One row per training log and fitted channel."""
    return [_residual_figure(part) for part in _parts(calibration.residuals, _RESIDUALS)]


def _residual_figure(rows: Sequence[Residual]) -> Figure:
    figure = _figure(1.75 * len(rows) + 0.5)
    axes: Any = figure.subplots(len(rows), 2, squeeze=False, width_ratios=[2, 1])
    for (left, right), row in zip(axes, rows, strict=True):
        left.plot(row.time, row.residual, color=MEASURED, lw=0.7)
        left.axhline(0, color=PRIOR, lw=0.7)
        left.set_xlim(row.time[0], row.time[-1])
        left.set_ylabel(_label("residual", row.unit))
        left.set_title(f"{_short(row.log, 36)}: {_short(row.channel, 24)}", loc="left")
        _ticks(left.yaxis, 4)
        _autocorrelation(right, row)
    axes[-1, 0].set_xlabel("time [s]")
    axes[-1, 1].set_xlabel("lag [samples]")
    figure.align_ylabels()
    return figure


def _autocorrelation(ax: Axes, row: Residual) -> None:
    known = np.isfinite(row.whitened)
    n = int(known.sum())
    lags = min(MAX_LAG, n // 4)
    ax.axhline(0, color=PRIOR, lw=0.7)
    if lags < 1:
        ax.set_title("too few samples", loc="left")
        return
    band = 1.96 / np.sqrt(n)
    values = autocorrelation(row.whitened, lags)
    ax.axhspan(-band, band, color=PRIOR, alpha=0.35, lw=0)
    ax.vlines(np.arange(1, lags + 1), 0, values[1:], color=POSTERIOR, lw=min(1.6, 160 / lags))
    outside = float(np.mean(np.abs(values[1:]) > band))
    ax.set_title(f"{100 * outside:.0f} % of lags outside the band (5 % if white)", loc="left", fontsize=8.5)
    ax.set_xlim(0, lags + 0.5)
    reach = max(2.5 * band, 1.15 * float(np.nanmax(np.abs(values[1:]), initial=0.0)))
    ax.set_ylim(-reach, reach)
    ax.xaxis.set_major_locator(MaxNLocator(5, integer=True))
    _ticks(ax.yaxis, 4)


# Chains


@_styled
def chains(calibration: Calibration) -> list[Figure]:
    """Traces of the Markov chains, one row per parameter; none when the posterior did not come as several
    chains."""
    posterior: Any = calibration.posterior
    count = getattr(posterior, "chains", None)
    if not count:
        return []
    space = calibration.posterior.space
    traces = np.asarray(posterior.theta).reshape(count, -1, len(space))
    step = -(-traces.shape[1] // 400)
    values = space.values(traces[:, ::step])
    names = [p.name for p in ordered(calibration.parameters)]
    each = calibration.mixing.by_parameter if calibration.mixing else {}
    scores = [each.get(key, {}) for key in ("rhat", "ess")]
    return [_chain_figure(part, values, step, calibration, scores) for part in _parts(names, _TRACES)]


def _chain_figure(
    names: Sequence[str],
    values: FloatArray,
    step: int,
    calibration: Calibration,
    scores: Sequence[Mapping[str, float]],
) -> Figure:
    figure = _figure(1.1 * len(names) + 0.5)
    axes: Any = figure.subplots(len(names), 1, squeeze=False, sharex=True)
    space = calibration.posterior.space
    draw = np.arange(values.shape[1]) * step
    for ax, name in zip(axes[:, 0], names, strict=True):
        j = space.index(name)
        for chain, colour in zip(values[:, :, j], np.resize(CHAINS, len(values)), strict=True):
            ax.plot(draw, chain, color=str(colour), lw=0.6, alpha=0.6)
        texts = [
            f"{word} {found[name]:{style}}"
            for found, word, style in zip(scores, ("R-hat", "effective draws"), (".3f", ".0f"), strict=True)
            if name in found
        ]
        ax.set_title(", ".join([_short(name, 50), *texts]), loc="left")
        ax.set_yscale(_scale(space[j], _view(space[j].normalise(values[:, :, j]).ravel())))
        ax.set_ylabel(unit_text(space[j].unit) or "no unit")
        ax.set_xlim(0, max(draw[-1], 1))
        _ticks(ax.yaxis, 3)
    axes[-1, 0].set_xlabel(f"draw of each of {len(values)} chains")
    figure.align_ylabels()
    return figure
