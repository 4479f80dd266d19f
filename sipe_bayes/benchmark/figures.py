"""The benchmark's in-depth figures: what the SiPE plot sums up, parameter by parameter, rollout by rollout and step by step.

Records in, one Matplotlib figure out, no pyplot, no state. Colours as everywhere (Okabe and Ito's palette): estimates blue, the
prior grey, the prior mean dashed, the truth black. Every dot is one seed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from sipe_bayes.benchmark.cells import BASELINES, REFERENCE
from sipe_bayes.benchmark.records import Record
from sipe_bayes.benchmark.tables import order_estimators, order_tasks
from sipe_bayes.report.drawing import CHAINS, MEASURED, POSTERIOR, PRIOR, _figure, _line, _short, _styled, _ticks
from sipe_bayes.report.posterior_plots import MARKERS

FloatArray = NDArray[np.float64]
Points = Mapping[float, Sequence[float]]  # x -> a score of each seed

_BASELINE: dict[str, Any] = {"color": "#444444", "ls": (0, (3, 2)), "lw": 1.2}
_REFERENCE: dict[str, Any] = {**_BASELINE, "ls": (0, (1, 1.4))}
_PRIOR_SD = 12**-0.5
_ROW = 0.82  # inches


@_styled
def error_per_parameter(records: Sequence[Record]) -> Figure:
    """One row per estimator, one column per parameter of the task: |mean - truth| of each seed, their mean as a bar, the prior mean's
    error as dashed steps; parameters that no log determines on grey. records: of one task, setting and variant."""
    rows, truth = _by_estimator(records)
    highest = max(0.5, *(float(np.abs(_means(mine) - truth).max()) for mine in rows.values()))

    def draw(ax: Axes, mine: Sequence[Record]) -> None:
        error = np.abs(_means(mine) - truth)
        at = np.arange(len(truth))
        ax.bar(at, error.mean(0), width=0.62, color=POSTERIOR, alpha=0.35, lw=0)
        for k, one in enumerate(error):
            ax.plot(at + _offset(k, len(error)), one, ".", color=POSTERIOR, ms=3.5)
        ax.stairs(np.abs(0.5 - truth), np.arange(len(truth) + 1) - 0.5, baseline=None, **_BASELINE)
        ax.set_ylim(0, 1.05 * highest)

    handles = [
        Patch(color=POSTERIOR, alpha=0.35, lw=0, label="|mean − truth|, mean over seeds"),
        _line(POSTERIOR, "one seed", ls="none", marker=".", ms=5),
        _line(_BASELINE["color"], "prior mean", ls=_BASELINE["ls"]),
    ]
    return _parameter_rows(rows, draw, handles)


@_styled
def posterior_against_truth(records: Sequence[Record]) -> Figure:
    """One row per estimator, one column per parameter of the task: mean and sd of each seed's posterior, in theta, against the truth;
    the band is the prior's. records: of one task, setting and variant."""
    rows, truth = _by_estimator(records)
    low, high = min(-0.06, float(truth.min()) - 0.06), max(1.06, float(truth.max()) + 0.06)

    def draw(ax: Axes, mine: Sequence[Record]) -> None:
        at = np.arange(len(truth))
        ax.axhspan(0.5 - _PRIOR_SD, 0.5 + _PRIOR_SD, color=PRIOR, alpha=0.16, lw=0)
        ax.axhline(0.5, **_BASELINE)
        for k, record in enumerate(mine):
            ax.errorbar(at + _offset(k, len(mine)), record.mean, record.sd, fmt="o", color=POSTERIOR, ms=2.2, lw=0.9)
        ax.hlines(truth, at - 0.42, at + 0.42, color=MEASURED, lw=1.6, zorder=3)
        ax.set_ylim(low, high)

    handles = [
        _line(MEASURED, "truth", lw=1.6),
        _line(POSTERIOR, "mean ± sd of the posterior, one seed", marker="o", ms=3),
        Patch(color=PRIOR, alpha=0.25, lw=0, label="prior ± sd"),
        _line(_BASELINE["color"], "prior mean", ls=_BASELINE["ls"]),
    ]
    return _parameter_rows(rows, draw, handles)


def _by_estimator(records: Sequence[Record]) -> tuple[dict[str, list[Record]], FloatArray]:
    """Finished runs of each estimator, baselines left out, and the truth (N,)."""
    done = [r for r in records if r.done and r.estimator not in BASELINES]
    if not done or len({(r.task, r.setting, r.variant) for r in done}) != 1:
        found = sorted({f"{r.task}/{r.setting}/{r.variant}" for r in done})
        raise ValueError(f"records: expected those of one task, setting and variant, got {found}; choose one")
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
    rows: Mapping[str, Sequence[Record]], draw: Callable[[Axes, Sequence[Record]], None], handles: list[Any]
) -> Figure:
    """A panel per estimator; few parameters leave room for several side by side."""
    names = [_short(name, 26) for name in next(iter(rows.values()))[0].names]
    undetermined = _undetermined(rows)
    many = len(names) > 8
    columns = 1 if many else 2 if len(names) > 3 else 3
    lines = -(-len(rows) // columns)
    figure = _figure(_ROW * lines + (1.9 if many or columns == 2 else 0.9))
    axes: Any = figure.subplots(lines, columns, sharex=True, sharey=True, squeeze=False)
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
    shown = [*handles, Patch(color="#e2e5e8", lw=0, label="not determined by the log")] if undetermined else handles
    figure.legend(handles=shown, loc="outside upper center", ncols=5)
    return figure


def _undetermined(rows: Mapping[str, Sequence[Record]]) -> list[int]:
    """Parameters that no seed's log determines."""
    known = [r.determined for mine in rows.values() for r in mine if r.determined is not None]
    return [int(j) for j in np.flatnonzero(~np.any(known, axis=0))] if known else []


# Scores along something


@_styled
def accuracy_against_rollouts(records: Sequence[Record]) -> Figure:
    """One panel per task: mean accuracy against rollouts, the mean over seeds with their range. Where cells with other budgets were
    run, a point is a whole run with that budget, else what the estimator knew on the way, or at its end alone. The prior mean is dashed."""
    curves: dict[str, dict[str, Points]] = {}
    for task in order_tasks({r.task for r in records}):
        mine = [r for r in records if r.done and r.task == task and r.estimator not in BASELINES]
        for name in order_estimators({r.estimator for r in mine}):
            points = _budgets([r for r in mine if r.estimator == name])
            if points:
                curves.setdefault(task, {})[name] = points
    return _panels(curves, _levels(records, curves), "rollouts", logarithmic=True)


@_styled
def gradient_step_ablation(records: Sequence[Record]) -> Figure:
    """One panel per task: mean accuracy against the gradient steps at test time, the mean over seeds with their range. records: those of
    the setting gradient_steps, the prior mean's, which is dashed, and ``laplace``'s of the direct setting, which is dotted."""
    curves: dict[str, dict[str, Points]] = {}
    for record in records:
        if record.done and "gradient_steps" in record.values:
            points: Any = curves.setdefault(record.task, {}).setdefault(record.estimator, {})
            points.setdefault(float(record.values["gradient_steps"]), []).append(record.scores["mean_accuracy"])
    ordered = {task: curves[task] for task in order_tasks(set(curves))}
    return _panels(ordered, _levels(records, ordered), "gradient steps at test time", logarithmic=False)


def _budgets(records: Sequence[Record]) -> Points:
    """Accuracy of each seed by rollouts."""
    points: dict[float, list[float]] = {}
    whole = [r for r in records if r.setting == "rollouts"]
    for record in whole:
        points.setdefault(float(record.budget), []).append(record.scores["mean_accuracy"])
    if points:
        return points
    traces = [_trace(r) for r in records]
    for x in sorted({float(x) for rollouts, _ in traces for x in rollouts}):
        known = [score[np.searchsorted(rollouts, x, "right") - 1] for rollouts, score in traces if rollouts[0] <= x]
        points[x] = [float(value) for value in known]
    return points


def _trace(record: Record) -> tuple[FloatArray, FloatArray]:
    """Rollouts (K,) and mean accuracy (K,) along a run; its result alone where nothing else was scored."""
    known = [h for h in record.history if h.get("mean_accuracy") is not None and h["rollouts"] > 0]
    rows = [(h["rollouts"], h["mean_accuracy"]) for h in known] or [
        (max(record.rollouts, 1), record.scores["mean_accuracy"])
    ]
    rollouts, score = np.array(rows, dtype=float).T
    return rollouts, score


Levels = Mapping[str, tuple[dict[str, Any], Mapping[str, float]]]  # label -> style, task -> mean accuracy


def _levels(records: Sequence[Record], curves: Mapping[str, Mapping[str, Points]]) -> Levels:
    """What is drawn across: the prior mean, and the reference where it has no curve."""
    styles = {"prior_mean": _BASELINE}
    if not any(REFERENCE in of_task for of_task in curves.values()):
        styles[REFERENCE] = _REFERENCE
    found = {}
    for name, style in styles.items():
        mine = [r for r in records if r.done and (r.estimator, r.setting) == (name, "direct") and r.task in curves]
        levels = {
            t: float(np.mean([r.scores["mean_accuracy"] for r in mine if r.task == t])) for t in {r.task for r in mine}
        }
        if levels:
            found[name.replace("_", " ")] = (style, levels)
    return found


def _panels(curves: Mapping[str, Mapping[str, Points]], levels: Levels, xlabel: str, logarithmic: bool) -> Figure:
    if not curves:
        raise ValueError("records: no finished run to draw; run some cells")
    names = order_estimators({name for of_task in curves.values() for name in of_task})
    columns = min(3, max(2, len(curves)))
    rows = -(-len(curves) // columns)
    figure = _figure(2.3 * rows + 0.3 + 0.2 * -(-len(names) // 6))
    grid = figure.add_gridspec(rows, columns)
    for k, (task, of_task) in enumerate(curves.items()):
        ax = figure.add_subplot(grid[k // columns, k % columns])
        for name, points in of_task.items():
            _curve(ax, points, names.index(name))
        for style, level in levels.values():
            if task in level:
                ax.axhline(level[task], **style)
        if logarithmic:
            ax.set_xscale("log")
            _ticks(ax.xaxis, 5)
        else:
            ax.xaxis.set_major_locator(MaxNLocator(6, integer=True))
        _ticks(ax.yaxis, 5)
        ax.set_title(task, fontweight="bold")
        if k % columns == 0:
            ax.set_ylabel("mean accuracy")
        if k + columns >= len(curves):
            ax.set_xlabel(xlabel)
    handles = [_line(label=n, ms=4, lw=1.4, **_style(k)) for k, n in enumerate(names)]
    across = [_line(style["color"], name, ls=style["ls"]) for name, (style, _) in levels.items()]
    figure.legend(handles=[*handles, *across], loc="outside upper center", ncols=6)
    return figure


def _curve(ax: Axes, points: Points, index: int) -> None:
    x = np.array(sorted(points))
    mean = [np.mean(points[at]) for at in x]
    style = _style(index)
    ax.plot(
        x,
        mean,
        ms=4,
        lw=1.4,
        color=style["colour"],
        ls=style["ls"],
        marker=style["marker"],
        markevery=max(1, len(x) // 6),
    )
    if any(len(points[at]) > 1 for at in x):
        low, high = (np.array([f(points[at]) for at in x]) for f in (min, max))
        if len(x) > 1:
            ax.fill_between(x, low, high, color=style["colour"], alpha=0.12, lw=0)
        else:
            ax.vlines(x, low, high, color=style["colour"], lw=1)


def _style(index: int) -> dict[str, Any]:
    line = ("-", (0, (4, 1.5)))[index // len(CHAINS) % 2]
    return {"colour": CHAINS[index % len(CHAINS)], "ls": line, "marker": MARKERS[index % len(MARKERS)]}
