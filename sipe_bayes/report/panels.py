"""Panels of one or two parameters, the same in every figure that shows draws of a posterior over its prior."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.report.colours import DEFAULT, MEASURED, POSTERIOR, PRIOR, STYLE
from sipe_bayes.report.drawing import laid_out, new_figure, panel_grid, ticks
from sipe_bayes.report.legends import PRIOR_HANDLE, legend_above, line_handle, shade_handle
from sipe_bayes.report.words import shortened, unit_text

if TYPE_CHECKING:
    from sipe_bayes.posterior import Posterior

Place = float | None
"""Of the model as given or the truth, in theta; None where there is none."""

_POINT = 1e-6  # spread of draws in theta below which rounding is all that is left of it: a point


def draws(posterior: Posterior, n: int = STYLE.points) -> FloatArray:
    """Draws of a posterior with a fixed seed.

    Returns:
        theta (n, N), within [0, 1].
    """
    import torch

    values = posterior.values(n, generator=torch.Generator().manual_seed(0))
    return np.clip(posterior.space.normalise(values), 0.0, 1.0)


def density(theta: FloatArray, grid: FloatArray) -> FloatArray:
    """Density of draws in [0, 1] by Gaussian kernels.

    They are reflected at both bounds, so that nothing leaks past them and an edge is not rounded off.

    Args:
        theta: draws (M,).
        grid: where the density is wanted (G,).

    Returns:
        The density (G,), 0 outside [0, 1].
    """
    q25, q75 = np.quantile(theta, (0.25, 0.75))
    sd = float(theta.std())
    width = 0.9 * (min(sd, (q75 - q25) / 1.349) or sd) * len(np.unique(theta)) ** -0.2
    low, high = theta[theta < 5 * width], theta[theta > 1 - 5 * width]
    points = np.concatenate([theta, -low, 2 - high])
    kernels = np.exp(-(((grid[:, None] - points) / width) ** 2) / 2)
    return kernels.sum(1) / (len(theta) * width * np.sqrt(2 * np.pi)) * ((grid >= 0) & (grid <= 1))


def correlation(theta: FloatArray) -> FloatArray:
    """Correlation matrix (N, N) of draws theta (M, N); 0 where one of the two does not vary."""
    deviation = theta - theta.mean(0)
    sd = deviation.std(0)
    scaled = np.divide(deviation, sd, out=np.zeros_like(deviation), where=sd > 1e-12)
    return np.asarray(scaled.T @ scaled / len(theta))


def view(theta: FloatArray, default: Place = None) -> tuple[float, float]:
    """The part of [0, 1] to show: where the draws are, and the default if it is not far.

    Args:
        theta: draws (M,).
        default: the model as given.
    """
    low, high = (float(q) for q in np.quantile(theta, (0.002, 0.998)))
    span = max(high - low, 1e-6)
    view_low, view_high = low - 0.3 * span, high + 0.3 * span
    if default is not None and low - 1.5 * span < default < high + 1.5 * span:
        view_low, view_high = min(view_low, default - 0.1 * span), max(view_high, default + 0.1 * span)
    if view_high - view_low > 0.6:
        return 0.0, 1.0
    return max(view_low, 0.0), min(view_high, 1.0)


def view_with(shown: tuple[float, float], truth: Place) -> tuple[float, float]:
    """``shown`` with the truth inside and a little room beside it."""
    if truth is None:
        return shown
    room = 0.05 * (max(shown[1], truth) - min(shown[0], truth))
    return min(shown[0], truth - room), max(shown[1], truth + room)


def scale(parameter: Parameter, shown: tuple[float, float]) -> str:
    """The scale of an axis: "log" where the parameter has one and several octaves are shown.

    Args:
        parameter: on the axis.
        shown: from where to where, in theta.
    """
    wide = parameter.scale == "log" and parameter.value(shown[1]) > 5 * parameter.value(shown[0])
    return "log" if wide else "linear"


def marginal(
    ax: Axes,
    parameter: Parameter,
    theta: FloatArray,
    prior: Posterior,
    interval: FloatArray,
    default: Place,
    truth: Place = None,
    plain: FloatArray | None = None,
) -> None:
    """One parameter in its unit: density and interval, the prior, the model as given, the truth; the range above.

    Densities are per unit of theta, in which a uniform prior is flat, on log scales too.

    Args:
        ax: the panel.
        parameter: what it shows.
        theta: draws of the posterior (M,).
        prior: its marginal is drawn too.
        interval: the two ends of the 90 % interval, in theta.
        default: the model as given.
        truth: if it is known; may lie outside [0, 1].
        plain: draws (M',) of the posterior that takes the model for right, where that is another.
    """
    point = bool(np.ptp(theta) < _POINT)
    low, high = view_with((0.0, 1.0) if point else view(theta, default), truth)
    ax.set_xscale(scale(parameter, (low, high)))
    grid = np.linspace(low, high, STYLE.grid)
    x = parameter.value(grid)
    inside = ((grid >= 0) & (grid <= 1)).astype(float)
    before = _prior_density(prior, parameter.name, np.clip(grid, 0, 1)) * inside
    ax.fill_between(x, before, color=PRIOR, alpha=STYLE.prior, lw=0)
    if point:
        ax.axvline(parameter.value(theta[0]), color=POSTERIOR, lw=STYLE.truth)
        ax.set_ylim(bottom=0)
    else:
        height = density(theta, grid)
        within = (grid >= interval[0]) & (grid <= interval[1])
        ax.fill_between(x, height, where=within.tolist(), color=POSTERIOR, alpha=STYLE.interval, lw=0)
        ax.plot(x, height, color=POSTERIOR, lw=STYLE.curve)
        ax.set_ylim(0, 1.08 * height.max())
        if plain is not None and np.ptp(plain) >= _POINT:
            narrow = density(plain, grid)
            ax.plot(x, narrow * height.max() / narrow.max(), color=POSTERIOR, lw=STYLE.reference, ls=":")
    if default is not None and low <= default <= high:
        ax.axvline(parameter.value(default), color=DEFAULT, ls="--", lw=STYLE.reference)
    if truth is not None:
        ax.axvline(parameter.value(truth), color=MEASURED, ls=":", lw=STYLE.truth)
    ax.set_xlim(x[0], x[-1])
    ticks(ax.xaxis, 5)
    ax.set_yticks([])
    ax.spines["left"].set_visible(False)
    ax.set_xlabel(unit_text(parameter.unit) or "no unit", labelpad=1)
    ax.set_title(shortened(parameter.name, 40), pad=15, fontweight="bold")
    _prior_strip(ax, interval, default, truth)


def reference_handles(known: Sequence[Place], default_mark: str = "", truth_mark: str = "") -> list[Artist]:
    """Legend of the prior, the model as given, and, where one of them is ``known``, the truth."""
    shown = [PRIOR_HANDLE, line_handle(DEFAULT, f"model as given{default_mark}", "--")]
    return [*shown, *[line_handle(MEASURED, f"truth{truth_mark}", ":")] * any(k is not None for k in known)]


def marginal_grid(
    parameters: Sequence[Parameter],
    theta: FloatArray,
    prior: Posterior,
    intervals: FloatArray,
    truth: Sequence[Place],
    plain: FloatArray | None = None,
) -> Figure:
    """A ``marginal`` of each of K parameters, with a legend.

    Args:
        parameters: K of them.
        theta: draws of the posterior (M, K).
        prior: of these and perhaps others.
        intervals: the ends of the 90 % intervals in theta (2, K).
        truth: in theta (K,).
        plain: draws of the posterior that takes the model for right (M', K), where that is another: dotted, as high.
    """
    figure, axes, _ = panel_grid(len(parameters), 1.85, 0.4)
    for j, (ax, parameter) in enumerate(zip(axes, parameters, strict=True)):
        default = None if parameter.default is None else float(parameter.normalise(parameter.default))
        narrow = None if plain is None else plain[:, j]
        marginal(ax, parameter, theta[:, j], prior, intervals[:, j], default, truth[j], narrow)
    shown = [line_handle(POSTERIOR, "posterior"), shade_handle(POSTERIOR, "90 % interval")]
    shown += [line_handle(POSTERIOR, "model-conditional", ":")] * (plain is not None)
    legend_above(figure, [*shown, *reference_handles(truth)], 5)
    return figure


def _prior_density(prior: Posterior, name: str, grid: FloatArray) -> FloatArray:
    one = prior.marginal([name])
    if one.has_density:
        return np.exp(one.log_prob(grid[:, None]).numpy())
    return density(draws(one)[:, 0], grid)


def _prior_strip(ax: Axes, interval: FloatArray, default: Place, truth: Place) -> None:
    """The whole prior range as a bar above the panel; ends are the bounds."""
    across, width = ax.transAxes, max(interval[1] - interval[0], 0.006)
    whole = Rectangle((0, 1.05), 1, 0.055, color=PRIOR, alpha=STYLE.prior, lw=0, transform=across, clip_on=False)
    start = (min(interval[0], 1 - width), 1.05)
    part = Rectangle(start, width, 0.055, color=POSTERIOR, lw=0, transform=across, clip_on=False)
    ax.add_patch(whole)
    ax.add_patch(part)
    for place, colour in ((default, DEFAULT), (truth, MEASURED)):
        if place is not None and (colour == DEFAULT or 0 <= place <= 1):
            ax.plot([place] * 2, [1.03, 1.125], color=colour, transform=across, clip_on=False, lw=STYLE.truth)


def pair_grid(
    parameters: Sequence[Parameter],
    theta: FloatArray,
    before: FloatArray,
    defaults: Sequence[Place],
    truth: Sequence[Place],
    handles: Sequence[Artist] = (),
) -> Figure:
    """Draws of every pair of parameters: close up below the diagonal, within the whole prior range above it.

    Above it stand the pairs' correlations, too.

    Args:
        parameters: K of them.
        theta: draws of the posterior (M, K).
        before: draws of the prior (M', K).
        defaults: of the model as given, in the parameters' units (K,).
        truth: in theta (K,).
        handles: of a legend, if there is to be one.
    """
    size = len(parameters)
    width, height = (min(STYLE.width, least + step * size) for least, step in ((1.6, 1.75), (1.3, 1.55)))
    figure = new_figure(0.96 * height + 0.5 * bool(handles), width)
    axes = figure.subplots(size, size, squeeze=False)
    strength = correlation(theta)
    for i in range(size):
        for j in range(size):
            ax, two, columns = axes[i, j], (parameters[j], parameters[i]), [j, i]
            known = (truth[j], truth[i])
            if i < j:
                _pair_in_prior(ax, theta[:, columns], before[:, columns], known, float(strength[i, j]))
            elif i == j:
                _diagonal(ax, two[0], theta[:, i], truth[i])
            else:
                _pair(ax, two, theta[:, columns], (defaults[j], defaults[i]), known)
            _pair_frame(ax, two, i, j, size)
    if handles:
        legend_above(figure, handles, 4)
    figure.align_xlabels(list(axes[-1]))  # of the outer panels alone: all take most of the drawing's time
    figure.align_ylabels(list(axes[:, 0]))
    laid_out(figure, list(axes[:-1, 1:].flat))
    return figure


def _axis_range(parameter: Parameter, theta: FloatArray, truth: Place) -> tuple[str, tuple[float, float]]:
    """Scale and limits of an axis that shows the draws and the truth."""
    close = view(theta)
    low, high = view_with(close, truth)
    return scale(parameter, close), (float(parameter.value(low)), float(parameter.value(high)))


def _pair(
    ax: Axes,
    two: tuple[Parameter, Parameter],
    theta: FloatArray,
    default: tuple[Place, Place],
    truth: tuple[Place, Place],
) -> None:
    """Draws of two parameters in their units. default: in units; truth: in theta."""
    x, y = (p.value(theta[:2000, k]) for k, p in enumerate(two))
    ax.scatter(x, y, s=3, color=POSTERIOR, alpha=0.2, lw=0)
    known = None not in truth
    (x_scale, x_limits), (y_scale, y_limits) = (
        _axis_range(p, theta[:, k], truth[k] if known else None) for k, p in enumerate(two)
    )
    ax.set(xscale=x_scale, yscale=y_scale, xlim=x_limits, ylim=y_limits)
    if default[0] is not None and default[1] is not None:
        ax.plot(default[0], default[1], "+", color=DEFAULT, ms=9, mew=1.8)
    if truth[0] is not None and truth[1] is not None:
        _cross(ax, two[0].value(truth[0]), two[1].value(truth[1]))


def _cross(ax: Axes, x: float, y: float) -> None:
    ax.plot(x, y, "x", color=MEASURED, ms=8, mew=1.8, ls="none")


def _diagonal(ax: Axes, parameter: Parameter, theta: FloatArray, truth: Place) -> None:
    if np.ptp(theta) < _POINT:
        ax.axvline(parameter.value(theta[0]), color=POSTERIOR)
    else:
        grid = np.linspace(*view(theta), STYLE.grid)
        height = density(theta, grid)
        ax.fill_between(parameter.value(grid), height, color=POSTERIOR, alpha=STYLE.interval, lw=0)
        ax.plot(parameter.value(grid), height, color=POSTERIOR, lw=STYLE.reference)
        ax.set_ylim(0, 1.08 * height.max())
    if truth is not None:
        ax.axvline(parameter.value(truth), color=MEASURED, ls=":", lw=STYLE.truth)
    how, limits = _axis_range(parameter, theta, truth)
    ax.set(xscale=how, xlim=limits)


def _pair_in_prior(
    ax: Axes, theta: FloatArray, before: FloatArray, truth: tuple[Place, Place], strength: float
) -> None:
    ax.scatter(before[:, 0], before[:, 1], s=4, color=PRIOR, alpha=STYLE.prior, lw=0)
    ax.scatter(theta[:1000, 0], theta[:1000, 1], s=3, color=POSTERIOR, alpha=STYLE.interval, lw=0)
    ax.set_xlim(0, 1)
    ax.set_ylim(0, 1)
    box = {"facecolor": "white", "alpha": 0.85, "edgecolor": "none", "pad": 1.5}
    weight = "bold" if abs(strength) >= 0.8 else "normal"
    number = f"{strength:+.2f}" if abs(strength) >= 0.005 else "0.00"
    ax.text(0.96, 0.95, number, transform=ax.transAxes, ha="right", va="top", bbox=box, fontweight=weight)
    if truth[0] is not None and truth[1] is not None:
        _cross(ax, float(np.clip(truth[0], 0, 1)), float(np.clip(truth[1], 0, 1)))


def _pair_frame(ax: Axes, two: tuple[Parameter, Parameter], i: int, j: int, size: int) -> None:
    """Labels on the outer panels only; frames in the upper half, whose axes are the prior's bounds."""
    if i < j:
        ax.set_xticks([])
        ax.set_yticks([])
        ax.spines[:].set_visible(True)
        ax.spines[:].set_color(PRIOR)
        return
    length, font = (26, 9.0) if size < 6 else (15, 8.0) if size < 8 else (14, 7.5)
    ticks(ax.xaxis, 3)
    if i > j:
        ticks(ax.yaxis, 3)
    else:
        ax.set_yticks([])
        ax.spines["left"].set_visible(False)
    ax.tick_params(axis="x", rotation=90 if size > 4 else 0, labelbottom=i == size - 1)
    ax.tick_params(axis="y", labelleft=j == 0 and i > j)
    if i == size - 1:
        ax.set_xlabel(_axis_name(two[0], length), fontsize=font)
    if j == 0 and i > 0:
        ax.set_ylabel(_axis_name(two[1], length), fontsize=font)


def _axis_name(parameter: Parameter, length: int) -> str:
    """Name, log of a nuisance parameter and unit, each on lines of its own."""
    name, bracket, log = parameter.name.partition("[")
    unit = unit_text(parameter.unit)
    bracketed = textwrap.wrap(f"[{unit}]", length) if unit else []
    parts = [_wrapped(name, length), _wrapped(bracket + log, length), *bracketed]
    return "\n".join(part for part in parts if part)


def _wrapped(name: str, length: int) -> str:
    """``name`` on at most two lines, broken after an underscore where one comes late enough."""
    if len(name) <= length:
        return name
    cut = name.rfind("_", length // 3, length) + 1 or length
    return f"{name[:cut]}\n{shortened(name[cut:], length)}"
