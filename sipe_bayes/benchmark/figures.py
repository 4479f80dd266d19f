"""The benchmark's in-depth figures: what the SiPE plot sums up, by parameter, rollout and gradient step.

Records in, one Matplotlib figure out, no pyplot, no state. Colours as in ``report.drawing``: estimates blue, the prior
grey, the prior mean dashed, the truth black. Every dot is one seed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from matplotlib.typing import LineStyleType

from sipe_bayes.benchmark.cells import BASELINES, REFERENCE
from sipe_bayes.benchmark.records import Record
from sipe_bayes.benchmark.tables import order_estimators, order_tasks
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.report.colours import DASHED, DOTTED, MEASURED, POSTERIOR, PRIOR, STYLE
from sipe_bayes.report.drawing import new_figure, outer_labels, panel_grid, styled, ticks
from sipe_bayes.report.legends import legend_above, line_handle, look, shade_handle
from sipe_bayes.report.words import shortened

Points = Mapping[float, Sequence[float]]
"""x -> a score of each seed."""
_ACROSS = "#444444"  # what estimates are held against


@styled
def error_per_parameter(records: Sequence[Record]) -> Figure:
    """One row per estimator, one column per parameter of the task: |mean - truth| of each seed, their mean as a bar.

    The prior mean's error is drawn as dashed steps; parameters that no log determines stand on grey.

    Raises:
        ValueError: for others.
    """
    rows, truth = _by_estimator(records)
    highest = max(0.5, *(float(np.abs(_means(mine) - truth).max()) for mine in rows.values()))

    def draw(ax: Axes, mine: Sequence[Record]) -> None:
        error = np.abs(_means(mine) - truth)
        at, edges = np.arange(len(truth)), np.arange(len(truth) + 1) - 0.5
        ax.bar(at, error.mean(0), width=0.62, color=POSTERIOR, alpha=STYLE.prior, lw=0)
        for k, one in enumerate(error):
            ax.plot(at + _offset(k, len(error)), one, ".", color=POSTERIOR, ms=3.5)
        ax.stairs(np.abs(0.5 - truth), edges, baseline=None, color=_ACROSS, ls=DASHED, lw=STYLE.reference)
        ax.set_ylim(0, 1.05 * highest)

    handles = [
        shade_handle(POSTERIOR, "|mean − truth|, mean over seeds", STYLE.prior),
        line_handle(POSTERIOR, "one seed", "none", marker=".", ms=5),
        line_handle(_ACROSS, "prior mean", DASHED),
    ]
    return _parameter_rows(rows, draw, handles)


@styled
def posterior_against_truth(records: Sequence[Record]) -> Figure:
    """One row per estimator, one column per parameter of the task: mean and sd of each seed's posterior, and the truth.

    All in theta; the band is the prior's.

    Raises:
        ValueError: for others.
    """
    rows, truth = _by_estimator(records)
    low, high = min(-0.06, float(truth.min()) - 0.06), max(1.06, float(truth.max()) + 0.06)
    prior_sd = 12**-0.5

    def draw(ax: Axes, mine: Sequence[Record]) -> None:
        at = np.arange(len(truth))
        ax.axhspan(0.5 - prior_sd, 0.5 + prior_sd, color=PRIOR, alpha=0.16, lw=0)
        ax.axhline(0.5, color=_ACROSS, ls=DASHED, lw=STYLE.reference)
        for k, record in enumerate(mine):
            ax.errorbar(at + _offset(k, len(mine)), record.mean, record.sd, fmt="o", color=POSTERIOR, ms=2.2, lw=0.9)
        ax.hlines(truth, at - 0.42, at + 0.42, color=MEASURED, lw=STYLE.truth, zorder=3)
        ax.set_ylim(low, high)

    handles = [
        line_handle(MEASURED, "truth", lw=STYLE.truth),
        line_handle(POSTERIOR, "mean ± sd of the posterior, one seed", marker="o", ms=3),
        shade_handle(PRIOR, "prior ± sd", 0.25),
        line_handle(_ACROSS, "prior mean", DASHED),
    ]
    return _parameter_rows(rows, draw, handles)


def _by_estimator(records: Sequence[Record]) -> tuple[dict[str, list[Record]], FloatArray]:
    """Finished runs of each estimator, baselines left out, and the truth (N,)."""
    done = [r for r in records if r.done and r.estimator not in BASELINES]
    if not done or len({(r.task, r.setting, r.variant) for r in done}) != 1:
        groups = sorted({f"{r.task}/{r.setting}/{r.variant}" for r in done})
        raise ValueError(f"records: expected those of one task, setting and variant, got {groups}; choose one")
    names = order_estimators({r.estimator for r in done})
    mine = {n: sorted((r for r in done if r.estimator == n), key=lambda r: r.seed) for n in names}
    return mine, np.array(done[0].truth)


def _means(records: Sequence[Record]) -> FloatArray:
    """(S, N)."""
    return np.array([r.mean for r in records])


def _offset(k: int, count: int) -> float:
    """Of a seed beside the others, within one parameter's column."""
    return 0.6 * ((k + 0.5) / count - 0.5)


def _parameter_rows(
    rows: Mapping[str, Sequence[Record]],
    draw: Callable[[Axes, Sequence[Record]], None],
    handles: Sequence[Artist],
    row: float = 0.82,
) -> Figure:
    """A panel per estimator, ``row`` inches high; few parameters leave room for several side by side."""
    names = [shortened(name, 26) for name in next(iter(rows.values()))[0].names]
    known = [r.determined for mine in rows.values() for r in mine if r.determined is not None]
    undetermined = np.flatnonzero(~np.any(known, axis=0)).tolist() if known else []  # by no seed's log
    many = len(names) > 8
    columns = 1 if many else 2 if len(names) > 3 else 3
    lines = -(-len(rows) // columns)
    figure = new_figure(row * lines + (1.9 if many or columns == 2 else 0.9))
    axes = figure.subplots(lines, columns, sharex=True, sharey=True, squeeze=False)
    for ax, (name, mine) in zip(axes.flat, rows.items(), strict=False):
        for j in undetermined:
            ax.axvspan(j - 0.5, j + 0.5, color="#eceef0", lw=0, zorder=0)
        draw(ax, mine)
        ax.set_title(name, loc="left", fontweight="bold", fontsize=8, pad=2.5)
        ax.yaxis.set_major_locator(MaxNLocator(2, steps=[1, 2, 5, 10]))
        ax.tick_params(axis="x", length=0)
    axes[0, 0].set_xlim(-0.6, len(names) - 0.4)
    axes[0, 0].set_xticks(range(len(names)), names)
    for k, ax in enumerate(axes.flat):
        ax.tick_params(axis="x", rotation=90 if columns < 3 else 0, labelsize=6.5 if many else 8)
        ax.tick_params(axis="x", labelbottom=k + columns >= len(rows))
        ax.set_visible(k < len(rows))
    grey = Patch(color="#e2e5e8", lw=0, label="not determined by the log")
    legend_above(figure, [*handles, grey] if undetermined else handles, 5)
    return figure


# Scores along something


@styled
def accuracy_against_rollouts(records: Sequence[Record]) -> Figure:
    """One panel per task: mean accuracy against rollouts, over seeds with their range; the prior mean is dashed.

    Where cells with other budgets were run, a point is a whole run with that budget, else what the estimator knew on
    the way, or at its end alone.

    Raises:
        ValueError: without a finished run.
    """
    curves: dict[str, dict[str, Points]] = {}
    for task in order_tasks({r.task for r in records}):
        mine = [r for r in records if r.done and r.task == task and r.estimator not in BASELINES]
        for name in order_estimators({r.estimator for r in mine}):
            points = _budgets([r for r in mine if r.estimator == name])
            if points:
                curves.setdefault(task, {})[name] = points
    return _panels(curves, _levels(records, curves), "rollouts", logarithmic=True)


@styled
def gradient_step_ablation(records: Sequence[Record]) -> Figure:
    """One panel per task: mean accuracy against the gradient steps at test time, the mean over seeds with their range.

    Args:
        records: those of the setting gradient_steps, the prior mean's, which is dashed, and ``laplace``'s of the direct
            setting, which is dotted.

    Raises:
        ValueError: without a finished run.
    """
    points: dict[str, dict[str, dict[float, list[float]]]] = {}
    for r in records:
        if r.done and "gradient_steps" in r.values:
            of_task = points.setdefault(r.task, {}).setdefault(r.estimator, {})
            of_task.setdefault(float(r.values["gradient_steps"]), []).append(r.scored.mean_accuracy)
    ordered: dict[str, dict[str, Points]] = {task: {**points[task]} for task in order_tasks(set(points))}
    return _panels(ordered, _levels(records, ordered), "gradient steps at test time", logarithmic=False)


def _budgets(records: Sequence[Record]) -> Points:
    """Accuracy of each seed by rollouts."""
    points: dict[float, list[float]] = {}
    for record in (r for r in records if r.setting == "rollouts"):
        points.setdefault(float(record.budget), []).append(record.scored.mean_accuracy)
    if points:
        return points
    traces = [_trace(r) for r in records]
    for x in sorted({float(x) for rollouts, _ in traces for x in rollouts}):
        known = [score[np.searchsorted(rollouts, x, "right") - 1] for rollouts, score in traces if rollouts[0] <= x]
        points[x] = [float(value) for value in known]
    return points


def _trace(record: Record) -> tuple[FloatArray, FloatArray]:
    """Rollouts (K,) and mean accuracy (K,) along a run; its result alone where nothing else was scored."""
    rows = [(h.rollouts, h.mean_accuracy) for h in record.history if h.mean_accuracy is not None and h.rollouts > 0]
    rollouts, score = np.array(rows or [(max(record.rollouts, 1), record.scored.mean_accuracy)], dtype=float).T
    return rollouts, score


@dataclass(frozen=True)
class _Level:
    """What is drawn across the panels: its line, and mean accuracy by task."""

    line: LineStyleType
    accuracy: Mapping[str, float]


def _levels(records: Sequence[Record], curves: Mapping[str, Mapping[str, Points]]) -> dict[str, _Level]:
    """By label: the prior mean, and the reference where it has no curve."""
    lines: dict[str, LineStyleType] = {"prior_mean": DASHED}
    if not any(REFERENCE in of_task for of_task in curves.values()):
        lines[REFERENCE] = DOTTED
    levels = {}
    for name, line in lines.items():
        mine = [r for r in records if r.done and (r.estimator, r.setting) == (name, "direct") and r.task in curves]
        by_task = {t: [r.scored.mean_accuracy for r in mine if r.task == t] for t in {r.task for r in mine}}
        if by_task:
            levels[name.replace("_", " ")] = _Level(line, {t: float(np.mean(v)) for t, v in by_task.items()})
    return levels


def _panels(
    curves: Mapping[str, Mapping[str, Points]], levels: Mapping[str, _Level], xlabel: str, logarithmic: bool
) -> Figure:
    if not curves:
        raise ValueError("records: no finished run to draw; run some cells")
    names = order_estimators({name for of_task in curves.values() for name in of_task})
    figure, axes, columns = panel_grid(len(curves), 2.3, 0.3 + 0.2 * -(-len(names) // 6))
    for ax, (task, of_task) in zip(axes, curves.items(), strict=True):
        for name, points in of_task.items():
            _curve(ax, points, names.index(name))
        for level in levels.values():
            if task in level.accuracy:
                ax.axhline(level.accuracy[task], color=_ACROSS, ls=level.line, lw=STYLE.reference)
        if logarithmic:
            ax.set_xscale("log")
            ticks(ax.xaxis, 5)
        else:
            ax.xaxis.set_major_locator(MaxNLocator(6, integer=True))
        ticks(ax.yaxis, 5)
        ax.set_title(task, fontweight="bold")
    outer_labels(axes, columns, xlabel, "mean accuracy")
    across = [line_handle(_ACROSS, name, level.line) for name, level in levels.items()]
    legend_above(figure, [*(look(k).handle(n, STYLE.curve) for k, n in enumerate(names)), *across], 6)
    return figure


def _curve(ax: Axes, points: Points, index: int) -> None:
    x = np.array(sorted(points))
    mean, one = [np.mean(points[at]) for at in x], look(index)
    every = max(1, len(x) // 6)
    ax.plot(x, mean, ms=4, lw=STYLE.curve, color=one.colour, ls=one.line, marker=one.marker, markevery=every)
    if any(len(points[at]) > 1 for at in x):
        low, high = (np.array([f(points[at]) for at in x]) for f in (min, max))
        if len(x) > 1:
            ax.fill_between(x, low, high, color=one.colour, alpha=0.12, lw=0)
        else:
            ax.vlines(x, low, high, color=one.colour, lw=1)
