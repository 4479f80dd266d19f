"""The SiPE plot: one spoke per environment, so that an estimator is read at a glance over the whole benchmark.

After B. Mehta, A. Handa, D. Fox, F. Ramos 2020, "A User's Guide to Calibrating Robotics Simulators"
(https://arxiv.org/abs/2011.08985, Figures 3, 4, 5, 7 and 9). The radius is the accuracy 1 - |E theta_j - theta*_j|: its
mean, its minimum or its maximum over an environment's parameters, each averaged over seeds. Beside it the same picture
in CRPS skill,

    skill = 1 - CRPS / (CRPS of the prior),

with the mean CRPS, or that of the worst or the best parameter, over the prior's mean CRPS; a point and a distribution
share that axis.

Deviations from the paper:

- The prior mean is drawn dashed: a truth near the centre of the range gives it a high accuracy for nothing.
- CRPS skill is added.
- Curves differ in line and marker as well as in colour, and green, blue and orange are those of Okabe and Ito's
  palette, so that every version is safe for colour-blind readers.
- Accuracies below 0 and skills below -1 sit at the centre.

Results in, one Matplotlib figure out, no pyplot, no state. ``Results`` are estimator -> environment -> scores of each
seed; "prior_mean", where present, is the baseline and no estimator. One of the estimators may be the ``reference`` that
the others are held against: it is dotted on every radar.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patheffects import withStroke
from matplotlib.projections.polar import PolarAxes
from matplotlib.typing import LineStyleType

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.diagnostics.scores import Scores
from sipe_bayes.report.colours import DASHED, DOTTED, STYLE
from sipe_bayes.report.drawing import new_figure, styled
from sipe_bayes.report.legends import Look, legend_above

Results = Mapping[str, Mapping[str, Sequence[Scores]]]
Mode = Literal["mean", "min", "max"]
Measure = Literal["accuracy", "CRPS skill"]

MODES: tuple[Mode, ...] = ("mean", "min", "max")
BASELINE = "prior_mean"
BASELINES = (BASELINE, "prior")

_MEASURES: tuple[Measure, ...] = ("accuracy", "CRPS skill")
_RANGES = {"accuracy": (0.0, 1.0), "CRPS skill": (-1.0, 1.0)}


GREEN = Look("#009E73", "-", "o")
BLUE = Look("#0072B2", (0, (5, 1.2)), "v")
ORANGE = Look("#E69F00", (0, (2, 1.2)), "^")
LOOKS = (
    GREEN,
    BLUE,
    ORANGE,
    Look("#CC79A7", (0, (7, 1.2, 1.5, 1.2)), "s"),
    Look("#000000", "-", "D"),
    Look("#56B4E9", (0, (5, 1.2)), "P"),
)
"""Of estimators on one radar: Okabe and Ito's, the yellow and the vermilion left out. More cannot be told apart."""


@dataclass(frozen=True)
class Radar:
    """Sizes of the radars.

    Args:
        side: of one radar, inches.
        spokes: from which on a line is closed.
        apart: rad between estimators where there are fewer.
    """

    side: float = 3.5
    spokes: int = 3
    apart: float = 0.14


RADAR = Radar()


@dataclass(frozen=True, eq=False)
class Curve:
    """A closed line of a radar: values (E,), one per spoke, NaN where there is none."""

    label: str
    values: FloatArray
    look: Look


def measured(scores: Scores, measure: Measure, mode: Mode) -> float:
    """Accuracy or CRPS skill of one run.

    Args:
        scores: of the run.
        measure: which of the two.
        mode: its mean, its minimum or its maximum over the parameters.

    Returns:
        The number; NaN where the prior is exact and skill has no meaning.
    """
    if measure == "accuracy":
        return {"mean": scores.mean_accuracy, "min": min(scores.accuracy), "max": max(scores.accuracy)}[mode]
    if scores.skill_over_prior is None:
        return float("nan")
    if scores.mean_crps == 0.0:
        return 1.0
    crps = {"mean": scores.mean_crps, "min": max(scores.crps), "max": min(scores.crps)}[mode]
    return 1 - (1 - scores.skill_over_prior) * crps / scores.mean_crps


def over_seeds(runs: Mapping[str, Sequence[Scores]], spokes: Sequence[str], measure: Measure, mode: Mode) -> FloatArray:
    """Means over seeds (E,), one per environment; NaN without a run.

    Args:
        runs: environment -> scores of each seed.
        spokes: the E environments.
        measure: accuracy or CRPS skill.
        mode: over the parameters.
    """
    values = [[measured(scores, measure, mode) for scores in runs.get(spoke, ())] for spoke in spokes]
    return np.array([np.mean(v) if v else np.nan for v in values])


def environments(results: Results) -> list[str]:
    """The environments of all estimators, in the benchmark's order, then by name."""
    from sipe_bayes.envs.registry import TASKS

    order = list(TASKS)
    names = {name for runs in results.values() for name, scores in runs.items() if len(scores)}
    return sorted(names, key=lambda name: (order.index(name) if name in order else len(order), name))


def estimators(results: Results, reference: str | None = None) -> list[str]:
    """What is drawn as a curve of its own: everything but the baselines and the reference."""
    return [name for name in results if name not in (*BASELINES, reference)]


@styled
def sipe_plot(results: Results, mode: Mode | None = None, reference: str | None = None) -> Figure:
    """Left accuracy, right CRPS skill.

    Without a mode one row per estimator, with its mean (green), minimum (blue) and maximum (orange) over parameters;
    with one, all estimators in that mode on one pair of radars. The prior mean is dashed, the mean of the reference
    dotted.

    Args:
        results: of the estimators.
        mode: over the parameters.
        reference: the estimator that the others are held against.

    Raises:
        ValueError: for results without an estimator, another mode, or more estimators than can be told apart.
    """
    spokes, names = _checked(results), estimators(results, reference)
    if mode is None:
        rows = [(name, {m: _spread(results[name], spokes, m) for m in _MEASURES}) for name in names]
    elif mode not in MODES:
        raise ValueError(f"mode: expected one of {', '.join(MODES)} or None, got {mode!r}")
    elif len(names) > len(LOOKS):
        raise ValueError(
            f"results: {len(names)} estimators on one radar, at most {len(LOOKS)} can be told apart; choose some"
        )
    else:
        rows = [(f"{mode} over parameters", {m: _several(results, names, spokes, m, mode) for m in _MEASURES})]
    return _rows(rows, spokes, _baselines(results, spokes, mode or "mean", reference))


@styled
def settings_plot(first: Results, second: Results, labels: tuple[str, str], reference: str | None = None) -> Figure:
    """One row per estimator that has both settings, on the environments that both have: its mean accuracy and skill.

    Args:
        first: of one setting, such as demonstrations; green.
        second: of the other, such as the data of a policy; orange.
        labels: their names.
        reference: one of the first that the others are held against.

    Raises:
        ValueError: where nothing is in both.
    """
    both = [name for name in estimators(first) if any(first[name].values()) and any(second.get(name, {}).values())]
    spokes = [e for e in environments({n: first[n] for n in both}) if e in environments({n: second[n] for n in both})]
    if not spokes:
        raise ValueError(f"results: no estimator ran both with {labels[0]} and with {labels[1]}; run the cells of both")
    rows = []
    for name in both:
        pair = list(zip(labels, (first[name], second[name]), (GREEN, ORANGE), strict=True))
        curves = {m: [Curve(x, over_seeds(runs, spokes, m, "mean"), look) for x, runs, look in pair] for m in _MEASURES}
        rows.append((name, curves))
    return _rows(rows, spokes, _baselines(first, spokes, "mean", reference))


def _checked(results: Results) -> list[str]:
    if not any(any(len(s) for s in results[name].values()) for name in estimators(results)):
        raise ValueError(
            "results: expected estimator -> environment -> scores of each seed, got no scores; run some cells"
        )
    return environments(results)


def _spread(runs: Mapping[str, Sequence[Scores]], spokes: Sequence[str], measure: Measure) -> list[Curve]:
    modes = zip(MODES, LOOKS, strict=False)
    return [Curve(mode, over_seeds(runs, spokes, measure, mode), look) for mode, look in modes]


def _several(
    results: Results, names: Sequence[str], spokes: Sequence[str], measure: Measure, mode: Mode
) -> list[Curve]:
    looks = zip(names, LOOKS, strict=False)
    return [Curve(name, over_seeds(results[name], spokes, measure, mode), look) for name, look in looks]


def _baselines(
    results: Results, spokes: Sequence[str], mode: Mode, reference: str | None
) -> dict[Measure, list[Curve]]:
    """The curves of the prior mean and of the reference in each measure."""
    shown: list[tuple[str, Mode, LineStyleType]] = [(BASELINE, mode, DASHED)]
    shown += [(reference, "mean", DOTTED)] if reference is not None else []
    return {
        m: [
            Curve(name.replace("_", " "), over_seeds(results[name], spokes, m, which), Look("#444444", line))
            for name, which, line in shown
            if name in results
        ]
        for m in _MEASURES
    }


def _rows(
    rows: Sequence[tuple[str, Mapping[Measure, list[Curve]]]],
    spokes: Sequence[str],
    baselines: Mapping[Measure, list[Curve]],
) -> Figure:
    """A row per title, a column per measure, one legend."""
    figure = new_figure(RADAR.side * len(rows) + 0.45)
    layout = figure.get_layout_engine()
    if isinstance(layout, ConstrainedLayoutEngine):
        layout.set(h_pad=0.1)
    axes = figure.subplots(len(rows), len(_MEASURES), squeeze=False, subplot_kw={"projection": "polar"})
    for line, (title, curves) in zip(axes, rows, strict=True):
        for ax, measure in zip(line, _MEASURES, strict=True):
            _radar(ax, [*curves[measure], *baselines[measure]], spokes, _RANGES[measure])
            ax.set_title(f"{title}: {measure}", fontweight="bold", pad=26)
    shown = [*rows[0][1][_MEASURES[0]], *baselines[_MEASURES[0]]]
    legend_above(figure, [curve.look.handle(curve.label, ms=4.5) for curve in shown], 7)
    return figure


def _radar(ax: PolarAxes, curves: Sequence[Curve], spokes: Sequence[str], limits: tuple[float, float]) -> None:
    angle = np.linspace(0, 2 * np.pi, len(spokes), endpoint=False)
    _rings(ax, len(spokes), limits)
    _spoke_labels(ax, angle, spokes)
    if limits[0] < 0:
        ax.plot(np.linspace(0, 2 * np.pi, 200), np.zeros(200), color="#888888", lw=0.9)  # the prior itself
    if len(spokes) < RADAR.spokes:
        _apart(ax, curves, angle, limits)
        return
    for curve in curves:
        look, closed = curve.look, np.clip(np.append(curve.values, curve.values[:1]), *limits)
        width, order = (1.5, 3.0) if look.marker else (STYLE.reference, 2.5)
        turn, marker = np.append(angle, angle[:1]), look.marker or None
        ax.plot(
            turn, closed, color=look.colour, ls=look.line, lw=width, marker=marker, ms=4, clip_on=False, zorder=order
        )


def _rings(ax: PolarAxes, spokes: int, limits: tuple[float, float]) -> None:
    """The grid, with its labels between the first two spokes, above the curves."""
    ax.set_theta_zero_location("N")
    ax.set_theta_direction(-1)
    ax.set_ylim(*limits)
    levels = np.linspace(*limits, 5)[1:]
    ax.set_yticks(levels, [])
    for tick in levels:
        text = "0, the prior" if limits[0] < 0 == tick else f"{tick:g}"
        label = ax.text(np.pi / max(spokes, 3), tick, text, color="#555555", fontsize=6.5, ha="center", zorder=4)
        label.set_path_effects([withStroke(linewidth=2, foreground="white")])
    ax.grid(color="#d5d8dc", lw=0.6)
    ax.spines["polar"].set_color("#b0b5bb")


def _apart(ax: PolarAxes, curves: Sequence[Curve], angle: FloatArray, limits: tuple[float, float]) -> None:
    """With too few spokes for a closed line: estimators side by side about each, baselines as arcs across them."""
    own = [curve for curve in curves if curve.look.marker]
    places = RADAR.apart * (np.arange(len(own)) - (len(own) - 1) / 2)
    arc = np.linspace(-0.5, 0.5, 50) * RADAR.apart * (len(own) + 1)
    for curve in curves:
        look = curve.look
        for turn, value in zip(angle, np.clip(curve.values, *limits), strict=True):
            if look.marker:
                place = turn + places[own.index(curve)]
                ax.plot([place], [value], color=look.colour, marker=look.marker, ms=5, ls="", clip_on=False, zorder=3)
            else:
                at = np.full(len(arc), value)
                ax.plot(turn + arc, at, color=look.colour, ls=look.line, lw=STYLE.reference, zorder=2.5)


def _spoke_labels(ax: PolarAxes, angle: FloatArray, spokes: Sequence[str]) -> None:
    ax.set_xticks(angle)
    ax.set_xticklabels([two_lines(name) for name in spokes], fontsize=7.5, linespacing=1.05)
    ax.tick_params(axis="x", pad=1)
    for label, turn in zip(ax.get_xticklabels(), angle, strict=True):
        side = np.sin(turn)
        label.set_horizontalalignment("center" if abs(side) < 0.1 else "left" if side > 0 else "right")
        label.set_verticalalignment("center" if abs(np.cos(turn)) < 0.9 else "bottom" if np.cos(turn) > 0 else "top")


def two_lines(name: str) -> str:
    """A long name broken between two of its words, as near its middle as can be."""
    breaks = [m.start() for m in re.finditer(r"(?<=[a-z0-9])[A-Z]", name)]
    if len(name) <= 9 or not breaks:
        return name
    at = min(breaks, key=lambda b: abs(b - len(name) / 2))
    return f"{name[:at]}\n{name[at:]}"
