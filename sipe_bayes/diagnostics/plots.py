"""Figures of a calibration. Every function is pure: a ``Calibration`` in, Matplotlib figures out, no pyplot,
no state.

One colour means one thing everywhere (Okabe and Ito's palette, which colour-blind readers can tell apart):
measured black, posterior blue, prior grey, the model as given dashed orange, held-out logs green. Rows beyond
what one page can show continue in a further figure, so each function returns a list. ``png`` turns a figure
into a file's bytes.
"""

from __future__ import annotations

import functools
import io
import itertools
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from matplotlib.ticker import Formatter, LogLocator, MaxNLocator, NullFormatter
from numpy.typing import NDArray

from sipe_bayes.diagnostics.result import Calibration, ParameterSummary, Residual, Signal
from sipe_bayes.parameters import Parameter

if TYPE_CHECKING:
    from sipe_bayes.posterior import Posterior

FloatArray = NDArray[np.float64]
P = ParamSpec("P")
R = TypeVar("R")

MEASURED, POSTERIOR, PRIOR, DEFAULT, HOLDOUT = "#000000", "#0072B2", "#999999", "#D55E00", "#00805F"
CHAINS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00")
WIDTH = 9.6  # inches; a report shows it about 960 pixels wide
DPI = 130
DRAWS = 8000
MAX_PAIRS = 8
MAX_LAG = 200
_PANELS, _CHANNELS, _RESIDUALS, _TRACES = 21, 6, 8, 10  # per figure
_LONG_WINDOWS, _LONG_SAMPLES = 24, 4000  # beyond either, a signal also gets a close-up
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_STYLE: dict[str, Any] = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.labelsize": 9,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "legend.fontsize": 8.5,
    "legend.frameon": False,
    "figure.titlesize": 11,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#555555",
    "xtick.color": "#333333",
    "ytick.color": "#333333",
    "text.parse_math": False,
    "figure.constrained_layout.h_pad": 0.05,
    "figure.constrained_layout.w_pad": 0.06,
}


def _styled(draw: Callable[P, R]) -> Callable[P, R]:
    """Run ``draw`` under this file's style, whatever the user's own; the user's is back afterwards."""

    @functools.wraps(draw)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> R:
        with matplotlib.style.context(["default", _STYLE]):
            return draw(*args, **kwargs)

    return wrapper


@_styled
def png(figure: Figure) -> bytes:
    """The figure as a PNG file; the same bytes for the same figure."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI, metadata={"Software": None})
    return buffer.getvalue()


# Numbers behind the pictures


def draws(posterior: Posterior, n: int = DRAWS) -> FloatArray:
    """Fixed-seed draws theta (n, N)."""
    import torch

    values = posterior.values(n, generator=torch.Generator().manual_seed(0))
    return np.clip(posterior.space.normalise(values), 0.0, 1.0)


def density(theta: FloatArray, grid: FloatArray) -> FloatArray:
    """Density (G,) at ``grid`` (G,) of draws theta (M,) in [0, 1]: Gaussian kernels, reflected at both
    bounds, so that nothing leaks past them and an edge is not rounded off."""
    q25, q75 = np.quantile(theta, (0.25, 0.75))
    sd = float(theta.std())
    width = 0.9 * (min(sd, (q75 - q25) / 1.349) or sd) * len(np.unique(theta)) ** -0.2
    low, high = theta[theta < 5 * width], theta[theta > 1 - 5 * width]
    points = np.concatenate([theta, -low, 2 - high])
    kernels = np.exp(-(((grid[:, None] - points) / width) ** 2) / 2)
    return kernels.sum(1) / (len(theta) * width * np.sqrt(2 * np.pi)) * ((grid >= 0) & (grid <= 1))


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
    return sorted(parameters, key=lambda p: "nuisance" in p.flags)


def correlation(theta: FloatArray) -> FloatArray:
    """Correlation matrix (N, N) of draws theta (M, N); 0 where one of the two does not vary."""
    deviation = theta - theta.mean(0)
    sd = deviation.std(0)
    scaled = np.divide(deviation, sd, out=np.zeros_like(deviation), where=sd > 1e-12)
    return np.asarray(scaled.T @ scaled / len(theta))


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


def _view(theta: FloatArray, default: float | None = None) -> tuple[float, float]:
    """The part of [0, 1] to show: where the draws are, and the default if it is not far."""
    low, high = (float(q) for q in np.quantile(theta, (0.002, 0.998)))
    span = max(high - low, 1e-6)
    view_low, view_high = low - 0.3 * span, high + 0.3 * span
    if default is not None and low - 1.5 * span < default < high + 1.5 * span:
        view_low, view_high = min(view_low, default - 0.1 * span), max(view_high, default + 0.1 * span)
    if view_high - view_low > 0.6:
        return 0.0, 1.0
    return max(view_low, 0.0), min(view_high, 1.0)


def _scale(parameter: Parameter, view: tuple[float, float]) -> str:
    wide = parameter.scale == "log" and parameter.value(view[1]) > 5 * parameter.value(view[0])
    return "log" if wide else "linear"


def _prior_density(prior: Posterior, name: str, grid: FloatArray) -> FloatArray:
    marginal = prior.marginal([name])
    if marginal.has_density:
        return np.exp(marginal.log_prob(grid[:, None]).numpy())
    return density(draws(marginal)[:, 0], grid)


# Axes


class _Plain(Formatter):
    """Tick labels with as many decimals as the ticks need, "2.5e-5" outside 0.001 .. 100,000, never an
    offset."""

    def __call__(self, x: float, pos: int | None = None) -> str:
        return f"{x:g}"

    def format_ticks(self, values: Any) -> list[str]:
        values = np.asarray(values, dtype=float)
        if not len(values):
            return []
        largest = float(np.abs(values).max())
        step = float(np.diff(values).min()) if len(values) > 1 else largest
        step = step if step > 0 else 1.0
        exponent = int(np.floor(np.log10(largest))) if largest > 0 else 0
        if -3 <= exponent < 5:
            decimals = self._decimals(step)
            return [f"{v:.{decimals}f}" for v in values]
        decimals = self._decimals(step / 10.0**exponent)
        return ["0" if v == 0 else f"{v / 10.0**exponent:.{decimals}f}e{exponent}" for v in values]

    @staticmethod
    def _decimals(step: float) -> int:
        return next((d for d in range(12) if abs(round(step, d) / step - 1) < 1e-6), 12)


def _compact(x: float) -> str:
    """``x`` with few letters: 0.05, 2e-5."""
    mantissa, exponent = f"{x:.3e}".split("e")
    return f"{x:g}" if -3 <= int(exponent) < 5 else f"{float(mantissa):g}e{int(exponent)}"


def _ticks(axis: Axis, count: int) -> None:
    if axis.get_scale() == "log":
        low, high = np.log10(axis.get_view_interval())
        subs = (1.0,) if high - low > 1.5 else (1.0, 3.0) if high - low > 1 else (1.0, 2.0, 5.0)
        axis.set_major_locator(LogLocator(base=10, subs=subs, numticks=count))
        axis.set_major_formatter(lambda x, _: _compact(x))
        axis.set_minor_formatter(NullFormatter())
        return
    axis.set_major_locator(MaxNLocator(count, steps=[1, 2, 2.5, 5, 10], min_n_ticks=2))
    axis.set_major_formatter(_Plain())


def unit_text(unit: str) -> str:
    """``unit`` for the eye: "kg m^2" with a raised 2, nothing for the unit "1"."""
    return "" if unit == "1" else re.sub(r"\^(-?\d+)", lambda power: power[1].translate(_RAISED), unit)


def _label(name: str, unit: str) -> str:
    return f"{name} [{unit_text(unit)}]" if unit else name


def _short(text: str, length: int) -> str:
    """``text``, its middle left out when it is longer than ``length``."""
    if len(text) <= length:
        return text
    half = (length - 1) // 2
    return f"{text[:half]}…{text[-half:]}"


def _parts(rows: Sequence[Any], size: int) -> Iterator[Sequence[Any]]:
    """Rows in parts of nearly equal length, none longer than ``size``."""
    count = -(-len(rows) // size)
    edges = np.linspace(0, len(rows), count + 1).round().astype(int)
    return (rows[a:b] for a, b in itertools.pairwise(edges))


def _figure(height: float, width: float = WIDTH) -> Figure:
    return Figure(figsize=(width, height), layout="constrained", facecolor="white")


def _line(colour: str, label: str, **style: Any) -> Line2D:
    return Line2D([], [], color=colour, label=label, **style)


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


def _prior_strip(ax: Axes, interval: FloatArray, default: float | None) -> None:
    """The whole prior range as a bar above the panel; ends are the bounds."""
    bar: dict[str, Any] = {"transform": ax.transAxes, "clip_on": False, "lw": 0}
    ax.add_patch(Rectangle((0, 1.05), 1, 0.055, color=PRIOR, alpha=0.35, **bar))
    width = max(interval[1] - interval[0], 0.006)
    ax.add_patch(Rectangle((min(interval[0], 1 - width), 1.05), width, 0.055, color=POSTERIOR, **bar))
    if default is not None:
        ax.plot([default] * 2, [1.03, 1.125], color=DEFAULT, transform=ax.transAxes, clip_on=False, lw=1.6)


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


def _axis_range(parameter: Parameter, theta: FloatArray) -> tuple[str, tuple[float, float]]:
    """Scale and limits of an axis that shows the draws."""
    view = _view(theta)
    return _scale(parameter, view), (float(parameter.value(view[0])), float(parameter.value(view[1])))


def _pair(ax: Axes, parameters: tuple[Parameter, Parameter], theta: FloatArray, default: list[float | None]) -> None:
    x, y = (p.value(theta[:2000, k]) for k, p in enumerate(parameters))
    ax.scatter(x, y, s=3, color=POSTERIOR, alpha=0.2, lw=0)
    (x_scale, x_limits), (y_scale, y_limits) = (_axis_range(p, theta[:, k]) for k, p in enumerate(parameters))
    ax.set(xscale=x_scale, yscale=y_scale, xlim=x_limits, ylim=y_limits)
    if default[0] is not None and default[1] is not None:
        ax.plot(default[0], default[1], "+", color=DEFAULT, ms=9, mew=1.8)


def _diagonal(ax: Axes, parameter: Parameter, theta: FloatArray) -> None:
    grid = np.linspace(*_view(theta), 200)
    if np.ptp(theta) < 1e-9:
        ax.axvline(parameter.value(theta[0]), color=POSTERIOR)
    else:
        height = density(theta, grid)
        ax.fill_between(parameter.value(grid), height, color=POSTERIOR, alpha=0.3, lw=0)
        ax.plot(parameter.value(grid), height, color=POSTERIOR, lw=1.2)
        ax.set_ylim(0, 1.08 * height.max())
    scale, limits = _axis_range(parameter, theta)
    ax.set(xscale=scale, xlim=limits)


def _pair_in_prior(ax: Axes, theta: FloatArray, before: FloatArray, strength: float) -> None:
    ax.scatter(before[:, 0], before[:, 1], s=4, color=PRIOR, alpha=0.35, lw=0)
    ax.scatter(theta[:1000, 0], theta[:1000, 1], s=3, color=POSTERIOR, alpha=0.3, lw=0)
    ax.set_xlim(0, 1)
    ax.set_ylim(0, 1)
    box = {"facecolor": "white", "alpha": 0.85, "edgecolor": "none", "pad": 1.5}
    weight = "bold" if abs(strength) >= 0.8 else "normal"
    number = f"{strength:+.2f}" if abs(strength) >= 0.005 else "0.00"
    ax.text(0.96, 0.95, number, transform=ax.transAxes, ha="right", va="top", bbox=box, fontweight=weight)


def _pair_frame(ax: Axes, parameters: tuple[Parameter, Parameter], i: int, j: int, size: int) -> None:
    """Labels on the outer panels only; frames in the upper half, whose axes are the prior's bounds."""
    if i < j:
        ax.set_xticks([])
        ax.set_yticks([])
        ax.spines[:].set_visible(True)
        ax.spines[:].set_color(PRIOR)
        return
    length, font = (26, 9.0) if size < 6 else (15, 8.0) if size < 8 else (14, 7.5)
    _ticks(ax.xaxis, 3)
    if i > j:
        _ticks(ax.yaxis, 3)
    else:
        ax.set_yticks([])
        ax.spines["left"].set_visible(False)
    ax.tick_params(axis="x", rotation=90 if size > 4 else 0, labelbottom=i == size - 1)
    ax.tick_params(axis="y", labelleft=j == 0 and i > j)
    if i == size - 1:
        ax.set_xlabel(_axis_name(parameters[0], length), fontsize=font)
    if j == 0 and i > 0:
        ax.set_ylabel(_axis_name(parameters[1], length), fontsize=font)


def _axis_name(parameter: Parameter, length: int) -> str:
    """Name, log of a nuisance parameter and unit, each on lines of its own."""
    name, bracket, log = parameter.name.partition("[")
    unit = unit_text(parameter.unit)
    parts = [_wrapped(name, length), _wrapped(bracket + log, length), f"[{unit}]" if unit else ""]
    return "\n".join(part for part in parts if part)


def _wrapped(name: str, length: int) -> str:
    """``name`` on at most two lines, broken after an underscore where one comes late enough."""
    if len(name) <= length:
        return name
    cut = name.rfind("_", length // 3, length) + 1 or length
    return f"{name[:cut]}\n{_short(name[cut:], length)}"


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


def _restarted(signal: Signal, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Time and values with a gap before each window's first sample, so that no line joins two windows."""
    starts = np.unique(np.searchsorted(signal.time, signal.window_starts - 1e-9))
    starts = starts[(starts > 0) & (starts < len(signal.time))]
    return np.insert(signal.time, starts, signal.time[starts]), np.insert(values, starts, np.nan)


def _window_ticks(ax: Axes, signal: Signal, height: float) -> None:
    ax.vlines(signal.window_starts, 0, height, transform=ax.get_xaxis_transform(), color=PRIOR, lw=0.9, clip_on=True)


def _signal(ax: Axes, signal: Signal, span: tuple[float, float]) -> None:
    time, low = _restarted(signal, signal.low)
    ax.fill_between(time, low, _restarted(signal, signal.high)[1], color=POSTERIOR, alpha=0.3, lw=0)
    ax.plot(*_restarted(signal, signal.default), color=DEFAULT, ls="--", lw=1)
    if len(signal.time) > 400 or not np.isfinite(signal.measured).any():
        ax.plot(signal.time, signal.measured, color=MEASURED, lw=0.9)
    else:
        ax.plot(signal.time, signal.measured, ".", color=MEASURED, ms=3)
    ax.plot(*_restarted(signal, signal.mode), color=POSTERIOR, lw=1.3)
    _window_ticks(ax, signal, 0.05)
    _keep_in_view(ax, signal, span)
    _ticks(ax.yaxis, 4)


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


def _error(ax: Axes, signal: Signal, span: tuple[float, float]) -> None:
    time, low = _restarted(signal, signal.low - signal.mode)
    ax.fill_between(time, low, _restarted(signal, signal.high - signal.mode)[1], color=POSTERIOR, alpha=0.3, lw=0)
    ax.axhline(0, color="#555555", lw=0.7)
    error = signal.measured - signal.mode
    ax.plot(*_restarted(signal, error), color=MEASURED, lw=0.8)
    _window_ticks(ax, signal, 0.1)
    shown = np.abs(error[(signal.time >= span[0]) & (signal.time <= span[1]) & np.isfinite(error)])
    if len(shown) and shown.max() > 0:
        band = np.nanmax(np.abs([signal.low - signal.mode, signal.high - signal.mode]), initial=0.0)
        reach = 1.2 * max(shown.max(), min(band, 3 * shown.max()))
        ax.set_ylim(-reach, reach)
    _ticks(ax.yaxis, 2)


def _worst_stretch(rows: Sequence[Signal]) -> tuple[float, float]:
    """About a tenth of the log, four windows at least, where the squared error, relative to each channel's,
    is largest."""
    time = rows[0].time
    starts = rows[0].window_starts
    window = float(np.median(np.diff(starts))) if len(starts) > 1 else 0.0
    length = min(max(0.1 * (time[-1] - time[0]), 4 * window), time[-1] - time[0])
    total = np.zeros(len(time))
    for signal in rows:
        squared = np.nan_to_num((signal.measured - signal.mode) ** 2)
        total += squared / max(float(squared.mean()), 1e-300)
    width = max(round(length / max(float(np.median(np.diff(time))), 1e-12)), 1)
    running = np.convolve(total, np.ones(min(width, len(time))), "valid")
    start = float(time[running.argmax()])
    return start, start + float(length)


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


def scores_by_name(mixing: dict[str, Any] | None, key: str, names: Sequence[str]) -> dict[str, float]:
    """What ``mixing`` holds under ``key`` as numbers by parameter, from a mapping or a list in the order of
    ``names``; empty when it is neither, such as a single number for all."""
    found: Any = (mixing or {}).get(key)
    if isinstance(found, dict):
        return {str(name): float(value) for name, value in found.items()}
    if np.ndim(found) == 1 and len(np.asarray(found)) == len(names):
        return dict(zip(names, np.asarray(found, dtype=float).tolist(), strict=True))
    return {}


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
    scores = [scores_by_name(calibration.mixing, key, space.names) for key in ("rhat", "ess")]
    return [_chain_figure(part, values, step, calibration, scores) for part in _parts(names, _TRACES)]


def _chain_figure(
    names: Sequence[str],
    values: FloatArray,
    step: int,
    calibration: Calibration,
    scores: list[dict[str, float]],
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
