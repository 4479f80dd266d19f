"""Figures of posteriors and of how methods reach them. Arrays and posteriors in, one Matplotlib figure out, no pyplot, no state.

Colours as in ``plots`` (Okabe and Ito's palette): posterior blue, prior grey, the model as given dashed orange, what was
measured and the truth black. Every figure shows the prior and the trivial baseline: the model as given, the prior mean, or
the diagonal.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from sipe_bayes.core.parameters import Parameter, ParameterSpace
from sipe_bayes.posterior import Posterior
from sipe_bayes.posterior import prior as default_prior
from sipe_bayes.report.drawing import (
    CHAINS,
    DEFAULT,
    MEASURED,
    POSTERIOR,
    PRIOR,
    _figure,
    _line,
    _short,
    _styled,
    _ticks,
    unit_text,
)
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

FloatArray = NDArray[np.float64]

MARKERS = ("o", "s", "^", "D", "v", "P")
_MOST_PAIRS = 8
_PATHS = 60  # particles drawn
_POINT = 1e-6  # a narrower posterior is drawn as a point, within the whole range


# Marginals and pairs


@_styled
def marginals(posterior: Posterior, prior: Posterior | None = None, truth: Any = None) -> Figure:
    """One panel per parameter in its unit: density with the 90 % interval, the prior, the model as given, and the truth (N,)
    in theta if it is known. The bar above a panel is the whole range of the prior."""
    before = default_prior(posterior.space) if prior is None else prior
    theta, known = draws(posterior), _known(posterior.space, truth)
    columns = min(3, max(2, len(posterior.space)))
    rows = -(-len(posterior.space) // columns)
    figure = _figure(1.85 * rows + 0.4)
    grid = figure.add_gridspec(rows, columns)
    for j, parameter in enumerate(posterior.space):
        ax = figure.add_subplot(grid[j // columns, j % columns])
        _marginal(ax, parameter, theta[:, j], before, known[j])
    handles = [
        _line(POSTERIOR, "posterior"),
        Patch(color=POSTERIOR, alpha=0.3, lw=0, label="90 % interval"),
        *_reference(known),
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=5)
    return figure


def _marginal(ax: Axes, parameter: Parameter, theta: FloatArray, prior: Posterior, truth: float | None) -> None:
    default = None if parameter.default is None else float(parameter.normalise(parameter.default))
    point = np.ptp(theta) < _POINT
    view = _wider((0.0, 1.0) if point else _view(theta, default), truth)
    ax.set_xscale(_scale(parameter, view))
    grid = np.linspace(*view, 400)
    x = parameter.value(grid)
    ax.fill_between(
        x, _prior_density(prior, parameter.name, np.clip(grid, 0, 1)) * _inside(grid), color=PRIOR, alpha=0.35, lw=0
    )
    low, high = np.quantile(theta, (0.05, 0.95))
    if point:
        ax.axvline(parameter.value(theta[0]), color=POSTERIOR, lw=1.8)
        ax.set_ylim(bottom=0)
    else:
        height = density(theta, grid)
        within = (grid >= low) & (grid <= high)
        ax.fill_between(x, height, where=within.tolist(), color=POSTERIOR, alpha=0.3, lw=0)
        ax.plot(x, height, color=POSTERIOR, lw=1.4)
        ax.set_ylim(0, 1.08 * height.max())
    if default is not None and view[0] <= default <= view[1]:
        ax.axvline(parameter.value(default), color=DEFAULT, ls="--", lw=1.2)
    if truth is not None:
        ax.axvline(parameter.value(truth), color=MEASURED, ls=":", lw=1.6)
    ax.set_xlim(x[0], x[-1])
    _ticks(ax.xaxis, 5)
    ax.set_yticks([])
    ax.spines["left"].set_visible(False)
    ax.set_xlabel(unit_text(parameter.unit) or "no unit", labelpad=1)
    ax.set_title(_short(parameter.name, 40), pad=15, fontweight="bold")
    _prior_strip(ax, np.array([low, high]), default)
    if truth is not None and 0 <= truth <= 1:
        ax.plot([truth] * 2, [1.03, 1.125], color=MEASURED, transform=ax.transAxes, clip_on=False, lw=1.6)


@_styled
def pairs(
    posterior: Posterior, prior: Posterior | None = None, truth: Any = None, names: Sequence[str] | None = None
) -> Figure:
    """Draws of every pair of two to eight parameters: below the diagonal close up, above it within the range of the prior,
    over draws of the prior, with their correlation. names: which ones, default the first eight. Raises ValueError for
    fewer than two."""
    space = posterior.space
    chosen = list(space.names[:_MOST_PAIRS] if names is None else names)
    if not 2 <= len(chosen) <= _MOST_PAIRS:
        raise ValueError(
            f"names: expected 2 to {_MOST_PAIRS} parameters, got {len(chosen)}; choose among {list(space.names)}"
        )
    columns = [space.index(name) for name in chosen]
    before = draws(default_prior(space) if prior is None else prior, 500)[:, columns]
    theta, known = draws(posterior)[:, columns], [_known(space, truth)[j] for j in columns]
    size = len(chosen)
    figure = _figure(0.5 + min(9.6, 1.3 + 1.55 * size) * 0.96, min(9.6, 1.6 + 1.75 * size))
    axes: Any = figure.subplots(size, size, squeeze=False)
    strength = correlation(theta)
    for i in range(size):
        for j in range(size):
            two = (space[columns[j]], space[columns[i]])
            _pair_panel(
                axes[i, j], two, theta[:, [j, i]], before[:, [j, i]], (known[j], known[i]), (i, j), strength[i, j]
            )
            _pair_frame(axes[i, j], two, i, j, size)
    figure.legend(
        handles=[_line(POSTERIOR, "posterior"), *_reference(known, " (+)", " (×)")], loc="outside upper center", ncols=4
    )
    figure.align_labels()
    return figure


def _pair_panel(
    ax: Axes,
    two: tuple[Parameter, Parameter],
    theta: FloatArray,
    before: FloatArray,
    truth: tuple[float | None, float | None],
    place: tuple[int, int],
    strength: float,
) -> None:
    style: dict[str, Any] = {"color": MEASURED, "ms": 8, "mew": 1.8, "ls": "none"}
    x, y = truth
    if place[0] == place[1]:
        _diagonal(ax, two[0], theta[:, 0])
        if x is not None:
            ax.axvline(two[0].value(x), color=MEASURED, ls=":", lw=1.6)
            _widen(ax, two[0], theta[:, 0], x)
        return
    if place[0] < place[1]:
        _pair_in_prior(ax, theta, before, float(strength))
        if x is not None and y is not None:
            ax.plot(np.clip(x, 0, 1), np.clip(y, 0, 1), "x", **style)
        return
    _pair(ax, two, theta, [p.default for p in two])
    if x is not None and y is not None:
        ax.plot(two[0].value(x), two[1].value(y), "x", **style)
        _widen(ax, two[0], theta[:, 0], x)
        view = _wider(_view(theta[:, 1]), y)
        ax.set_ylim(float(two[1].value(view[0])), float(two[1].value(view[1])))


def _widen(ax: Axes, parameter: Parameter, theta: FloatArray, truth: float) -> None:
    view = _wider(_view(theta), truth)
    ax.set_xlim(float(parameter.value(view[0])), float(parameter.value(view[1])))


def _wider(view: tuple[float, float], truth: float | None) -> tuple[float, float]:
    """``view`` with the truth inside and a little room beside it."""
    if truth is None:
        return view
    room = 0.05 * (max(view[1], truth) - min(view[0], truth))
    return min(view[0], truth - room), max(view[1], truth + room)


def _inside(grid: FloatArray) -> FloatArray:
    return ((grid >= 0) & (grid <= 1)).astype(float)


def _known(space: ParameterSpace, truth: Any) -> list[float | None]:
    return [None] * len(space) if truth is None else [float(x) for x in space.check_shape(truth)]


def _reference(known: Sequence[float | None], default_mark: str = "", truth_mark: str = "") -> list[Any]:
    """Legend of the prior, the model as given, and the truth."""
    shown = [
        Patch(facecolor=PRIOR, alpha=0.35, edgecolor=PRIOR, label="prior"),
        _line(DEFAULT, f"model as given{default_mark}", ls="--"),
    ]
    return [*shown, _line(MEASURED, f"truth{truth_mark}", ls=":")] if any(k is not None for k in known) else shown


# How a method gets there


@_styled
def particle_paths(paths: Any, space: ParameterSpace, truth: Any = None) -> Figure:
    """Particles (I, M, N) in theta over I iterations, one panel per parameter over the whole range: their mean, their 90 %
    interval and up to 60 of them; the prior's 90 % interval at the left edge, the model as given, and the truth."""
    given = space.check_shape(paths)
    if given.ndim != 3:
        raise ValueError(f"paths: expected (iterations, particles, {len(space)}), got {given.shape}")
    known = _known(space, truth)
    before = default_prior(space).quantile([0.05, 0.95]).numpy()
    columns = min(3, max(2, len(space)))
    rows = -(-len(space) // columns)
    figure = _figure(2.1 * rows + 0.5)
    grid = figure.add_gridspec(rows, columns)
    for j, parameter in enumerate(space):
        ax = figure.add_subplot(grid[j // columns, j % columns])
        _paths(ax, parameter, given[:, :, j], before[:, j], known[j])
        if j + columns >= len(space):
            ax.set_xlabel("iteration")
    shown = [_line(POSTERIOR, "mean of the particles"), Patch(color=POSTERIOR, alpha=0.25, lw=0, label="90 % of them")]
    figure.legend(handles=[*shown, *_reference(known)], loc="outside upper center", ncols=5)
    return figure


def _paths(ax: Axes, parameter: Parameter, paths: FloatArray, before: FloatArray, truth: float | None) -> None:
    iteration = np.arange(len(paths))
    picked = np.linspace(0, paths.shape[1] - 1, min(_PATHS, paths.shape[1])).astype(int)
    ax.set_yscale(_scale(parameter, (0.0, 1.0)))
    ax.axhspan(*(float(parameter.value(b)) for b in before), color=PRIOR, alpha=0.18, lw=0)
    ax.plot(iteration, parameter.value(paths[:, picked]), color=POSTERIOR, lw=0.4, alpha=0.3)
    low, high = np.quantile(paths, (0.05, 0.95), axis=1)
    ax.fill_between(iteration, parameter.value(low), parameter.value(high), color=POSTERIOR, alpha=0.25, lw=0)
    ax.plot(iteration, parameter.value(paths.mean(1)), color=POSTERIOR, lw=1.8)
    if parameter.default is not None:
        ax.axhline(parameter.default, color=DEFAULT, ls="--", lw=1.2)
    if truth is not None:
        ax.axhline(parameter.value(truth), color=MEASURED, ls=":", lw=1.6)
    view = _wider((0.0, 1.0), truth)
    ax.set(xlim=(0, max(1, iteration[-1])), ylim=tuple(float(parameter.value(v)) for v in view))
    _ticks(ax.yaxis, 5)
    ax.xaxis.set_major_locator(MaxNLocator(6, integer=True))
    unit = unit_text(parameter.unit)
    ax.set_title(_short(parameter.name, 30) + (f" [{unit}]" if unit else ""), fontweight="bold")


@_styled
def learning_curve(
    curves: Mapping[str, tuple[Any, Any]],
    baselines: Mapping[str, float],
    score: str = "CRPS (mean over parameters)",
) -> Figure:
    """Score against rollouts. curves: method -> (rollouts (K,), scores (S, K) of S seeds), drawn as the median and, for three
    seeds or more, the range that holds half of them; on a log scale where scores fall far below the baselines. baselines: such as "prior" and "prior mean" -> their score."""
    if not curves or not baselines:
        raise ValueError("curves and baselines: expected at least one of each, such as {'prior mean': 0.25}")
    figure = _figure(3.6, 6.4)
    ax: Axes = figure.add_subplot()
    lowest: list[float] = []
    for k, (name, (rollouts, scores)) in enumerate(curves.items()):
        x, y = np.asarray(rollouts, float), np.atleast_2d(np.asarray(scores, float))
        if y.shape[1:] != x.shape:
            raise ValueError(f"curves[{name!r}]: expected scores (seeds, {len(x)}), got {y.shape}")
        colour, marker = CHAINS[k % len(CHAINS)], MARKERS[k % len(MARKERS)]
        line = "-" if k < len(CHAINS) else (0, (4, 1.5))
        ax.plot(x, np.median(y, axis=0), color=colour, marker=marker, ls=line, ms=4.5, lw=1.5, label=name)
        lowest.append(float(np.min(y)))
        if len(y) > 2:
            ax.fill_between(x, *np.quantile(y, (0.25, 0.75), axis=0), color=colour, alpha=0.18, lw=0)
    for (name, value), style in zip(baselines.items(), ("--", ":", "-.", "-"), strict=False):
        ax.axhline(value, color="#666666", ls=style, lw=1.3, label=name)
    decades = min(lowest) > 0 and max(baselines.values()) > 20 * min(lowest)
    ax.set(xscale="log", yscale="log" if decades else "linear", xlabel="rollouts", ylabel=score)
    _ticks(ax.xaxis, 8)
    _ticks(ax.yaxis, 8)
    if not decades:
        ax.set_ylim(bottom=min(0.0, ax.get_ylim()[0]))
    figure.legend(loc="outside right upper")
    return figure
