"""Figures of posteriors and of how methods reach them.

Arrays and posteriors in, one Matplotlib figure out, no pyplot, no state.

Colours as in ``drawing``: posterior blue, prior grey, the model as given dashed orange, what was measured and the truth
black. Every figure shows the prior and the trivial baseline: the model as given, the prior mean, or the diagonal.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import Parameter, ParameterSpace
from sipe_bayes.posterior import Posterior
from sipe_bayes.posterior import prior as default_prior
from sipe_bayes.report.colours import DEFAULT, MEASURED, POSTERIOR, PRIOR, STYLE
from sipe_bayes.report.drawing import new_figure, outer_labels, panel_grid, styled, ticks
from sipe_bayes.report.legends import legend_above, line_handle, look, shade_handle
from sipe_bayes.report.panels import Place, draws, marginal_grid, pair_grid, reference_handles, scale, view_with
from sipe_bayes.report.words import shortened, with_unit

MAX_PAIRS = 8
_LEVELS = (0.05, 0.95)  # the two ends of a 90 % interval


@styled
def marginals(posterior: Posterior, prior: Posterior | None = None, truth: ArrayLike | None = None) -> Figure:
    """One panel per parameter in its unit: density with the 90 % interval, prior, model as given, and truth.

    The bar above a panel is the whole range of the prior.

    Args:
        posterior: over N parameters.
        prior: what was believed before; default what the parameters say.
        truth: theta (N,), if it is known.

    Raises:
        ValueError: for a truth of another shape.
    """
    before = default_prior(posterior.space) if prior is None else prior
    theta, known = draws(posterior), _known(posterior.space, truth)
    return marginal_grid(list(posterior.space), theta, before, np.quantile(theta, _LEVELS, axis=0), known)


@styled
def pairs(
    posterior: Posterior,
    prior: Posterior | None = None,
    truth: ArrayLike | None = None,
    names: Sequence[str] | None = None,
) -> Figure:
    """Draws of every pair of two to eight parameters: below the diagonal close up, above it within the prior's range.

    Args:
        posterior: over N parameters.
        prior: what was believed before; default what the parameters say.
        truth: theta (N,), if it is known.
        names: which parameters, default the first eight.

    Raises:
        ValueError: for fewer than two names, more than eight, or a truth of another shape.
    """
    space = posterior.space
    chosen = list(space.names[:MAX_PAIRS] if names is None else names)
    if not 2 <= len(chosen) <= MAX_PAIRS:
        raise ValueError(
            f"names: expected 2 to {MAX_PAIRS} parameters, got {len(chosen)}; choose among {list(space.names)}"
        )
    columns = [space.index(name) for name in chosen]
    before = draws(default_prior(space) if prior is None else prior, 500)[:, columns]
    known, parameters = [_known(space, truth)[j] for j in columns], [space[j] for j in columns]
    handles = [line_handle(POSTERIOR, "posterior"), *reference_handles(known, " (+)", " (×)")]
    return pair_grid(parameters, draws(posterior)[:, columns], before, [p.default for p in parameters], known, handles)


def _known(space: ParameterSpace, truth: ArrayLike | None) -> list[Place]:
    return [None] * len(space) if truth is None else [float(x) for x in space.check_shape(truth)]


# How a method gets there


@styled
def particle_paths(paths: ArrayLike, space: ParameterSpace, truth: ArrayLike | None = None, most: int = 60) -> Figure:
    """Particles along a search, one panel per parameter over the whole range.

    Each panel holds their mean, their 90 % interval and some of them; the prior's 90 % interval, the model as given,
    and the truth.

    Args:
        paths: theta (I, M, N) of M particles over I iterations.
        space: the N parameters.
        truth: theta (N,), if it is known.
        most: particles that are drawn.

    Raises:
        ValueError: for paths or a truth of another shape.
    """
    given = space.check_shape(paths)
    if given.ndim != 3:
        raise ValueError(f"paths: expected (iterations, particles, {len(space)}), got {given.shape}")
    known = _known(space, truth)
    before = default_prior(space).quantile(list(_LEVELS)).numpy()
    picked = np.linspace(0, given.shape[1] - 1, min(most, given.shape[1])).astype(int)
    figure, axes, columns = panel_grid(len(space), 2.1, 0.5)
    for j, (ax, parameter) in enumerate(zip(axes, space, strict=True)):
        _paths(ax, parameter, given[:, :, j], picked, before[:, j], known[j])
    outer_labels(axes, columns, "iteration")
    shown = [line_handle(POSTERIOR, "mean of the particles"), shade_handle(POSTERIOR, "90 % of them", 0.25)]
    legend_above(figure, [*shown, *reference_handles(known)], 5)
    return figure


def _paths(
    ax: Axes, parameter: Parameter, paths: FloatArray, picked: FloatArray, before: FloatArray, truth: Place
) -> None:
    iteration = np.arange(len(paths))
    ax.set_yscale(scale(parameter, (0.0, 1.0)))
    ax.axhspan(*(float(parameter.value(b)) for b in before), color=PRIOR, alpha=0.18, lw=0)
    ax.plot(iteration, parameter.value(paths[:, picked]), color=POSTERIOR, lw=0.4, alpha=0.3)
    low, high = np.quantile(paths, _LEVELS, axis=1)
    ax.fill_between(iteration, parameter.value(low), parameter.value(high), color=POSTERIOR, alpha=0.25, lw=0)
    ax.plot(iteration, parameter.value(paths.mean(1)), color=POSTERIOR, lw=1.8)
    if parameter.default is not None:
        ax.axhline(parameter.default, color=DEFAULT, ls="--", lw=STYLE.reference)
    if truth is not None:
        ax.axhline(parameter.value(truth), color=MEASURED, ls=":", lw=STYLE.truth)
    low, high = (float(parameter.value(v)) for v in view_with((0.0, 1.0), truth))
    ax.set(xlim=(0, max(1, iteration[-1])), ylim=(low, high))
    ticks(ax.yaxis, 5)
    ax.xaxis.set_major_locator(MaxNLocator(6, integer=True))
    ax.set_title(with_unit(shortened(parameter.name, 30), parameter.unit), fontweight="bold")


@styled
def learning_curve(
    curves: Mapping[str, tuple[ArrayLike, ArrayLike]],
    baselines: Mapping[str, float],
    score: str = "CRPS (mean over parameters)",
) -> Figure:
    """Score against rollouts, on a log scale where scores fall far below the baselines.

    Args:
        curves: method -> (rollouts (K,), scores (S, K) of S seeds), drawn as the median and, for three seeds or more,
            the range that holds half of them.
        baselines: such as "prior" and "prior mean" -> their score.
        score: what the scores are.

    Raises:
        ValueError: without a curve or a baseline, and for scores of another shape.
    """
    if not curves or not baselines:
        raise ValueError("curves and baselines: expected at least one of each, such as {'prior mean': 0.25}")
    figure = new_figure(3.6, 6.4)
    ax = figure.add_subplot()
    lowest: list[float] = []
    for k, (name, (rollouts, scores)) in enumerate(curves.items()):
        x, y = np.asarray(rollouts, float), np.atleast_2d(np.asarray(scores, float))
        if y.shape[1:] != x.shape:
            raise ValueError(f"curves[{name!r}]: expected scores (seeds, {len(x)}), got {y.shape}")
        one = look(k)
        ax.plot(x, np.median(y, axis=0), color=one.colour, marker=one.marker, ls=one.line, ms=4.5, lw=1.5, label=name)
        lowest.append(float(np.min(y)))
        if len(y) > 2:
            ax.fill_between(x, *np.quantile(y, (0.25, 0.75), axis=0), color=one.colour, alpha=0.18, lw=0)
    for (name, value), style in zip(baselines.items(), ("--", ":", "-.", "-"), strict=False):
        ax.axhline(value, color="#666666", ls=style, lw=1.3, label=name)
    decades = min(lowest) > 0 and max(baselines.values()) > 20 * min(lowest)
    ax.set(xscale="log", yscale="log" if decades else "linear", xlabel="rollouts", ylabel=score)
    ticks(ax.xaxis, 8)
    ticks(ax.yaxis, 8)
    if not decades:
        ax.set_ylim(bottom=min(0.0, ax.get_ylim()[0]))
    figure.legend(loc="outside right upper")
    return figure
