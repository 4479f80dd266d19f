"""The SiPE plot: one spoke per environment, so that an estimator is read at a glance over the whole benchmark.

After B. Mehta, A. Handa, D. Fox, F. Ramos 2020, "A User's Guide to Calibrating Robotics Simulators"
(https://arxiv.org/abs/2011.08985, Figures 3, 4, 5, 7 and 9). The radius is the accuracy 1 - |E theta_j - theta*_j|: its mean, its
minimum or its maximum over an environment's parameters, each averaged over seeds. Beside it the same picture in CRPS skill,

    skill = 1 - CRPS / (CRPS of the prior),

with the mean CRPS, or that of the worst or the best parameter, over the prior's mean CRPS; a point and a distribution share that axis.

Deviations from the paper. The prior mean is drawn dashed: a truth near the centre of the range gives it a high accuracy for
nothing. CRPS skill is added. Curves differ in line and marker as well as in colour, and green, blue and orange are those of Okabe
and Ito's palette, so that every version is safe for colour-blind readers. Accuracies below 0 and skills below -1 sit at the centre.

Results in, one Matplotlib figure out, no pyplot, no state. ``Results`` are estimator -> environment -> scores of each seed, a score
being ``Scores`` or what its ``to_dict`` returns; "prior_mean", where present, is the baseline and no estimator. One of the estimators
may be the ``reference`` that the others are held against: it is dotted on every radar.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke
from matplotlib.projections.polar import PolarAxes
from numpy.typing import NDArray

from sipe_bayes.report.drawing import _figure, _styled

FloatArray = NDArray[np.float64]
Results = Mapping[str, Mapping[str, Sequence[Any]]]
Mode = Literal["mean", "min", "max"]

MODES: tuple[Mode, ...] = ("mean", "min", "max")
GREEN, BLUE, ORANGE = "#009E73", "#0072B2", "#E69F00"
BASELINE = "prior_mean"
BASELINES = (BASELINE, "prior")
COMPARED = 6  # estimators on one radar; more cannot be told apart

_SPREAD = {"mean": (GREEN, "-", "o"), "min": (BLUE, (0, (5, 1.2)), "v"), "max": (ORANGE, (0, (2, 1.2)), "^")}
_COLOURS = (
    GREEN,
    BLUE,
    ORANGE,
    "#CC79A7",
    "#000000",
    "#56B4E9",
)  # Okabe and Ito's, the yellow and the vermilion left out
_LINES: tuple[Any, ...] = ("-", (0, (5, 1.2)), (0, (2, 1.2)), (0, (7, 1.2, 1.5, 1.2)), "-", (0, (5, 1.2)))
_MARKERS = ("o", "v", "^", "s", "D", "P")
_MEASURES = ("accuracy", "CRPS skill")
_RANGES = {"accuracy": (0.0, 1.0), "CRPS skill": (-1.0, 1.0)}
_SIDE = 3.5  # inches, of one radar
_FEWEST, _STEP = 3, 0.14  # spokes of a closed line; rad between estimators where there are fewer


@dataclass(frozen=True, eq=False)
class Curve:
    """A closed line of a radar: values (E,), one per spoke, NaN where there is none."""

    label: str
    values: FloatArray
    colour: str
    line: Any
    marker: str = ""


def measured(scores: Any, measure: str, mode: Mode) -> float:
    """Accuracy or CRPS skill of one run: its mean, its minimum or its maximum over the parameters. NaN where the prior is
    exact and skill has no meaning."""
    plain = scores if isinstance(scores, Mapping) else scores.to_dict()
    if measure == "accuracy":
        return float(plain[f"{mode}_accuracy"])
    skill, mean = plain["skill_over_prior"], float(plain["mean_crps"])
    if skill is None:
        return float("nan")
    if mean == 0.0:
        return 1.0
    crps = {"mean": mean, "min": max(plain["crps"]), "max": min(plain["crps"])}[mode]
    return 1 - (1 - float(skill)) * crps / mean


def over_seeds(runs: Mapping[str, Sequence[Any]], spokes: Sequence[str], measure: str, mode: Mode) -> FloatArray:
    """Means over seeds (E,), one per environment of ``spokes``; NaN without a run."""
    values = [[measured(scores, measure, mode) for scores in runs.get(spoke, ())] for spoke in spokes]
    return np.array([np.mean(v) if v else np.nan for v in values])


def environments(results: Results) -> list[str]:
    """The environments of all estimators, in the benchmark's order, then by name."""
    from sipe_bayes.envs.registry import TASKS

    order = list(TASKS)
    found = {name for runs in results.values() for name, scores in runs.items() if len(scores)}
    return sorted(found, key=lambda name: (order.index(name) if name in order else len(order), name))


def estimators(results: Results, reference: str | None = None) -> list[str]:
    """What is drawn as a curve of its own: everything but the baselines and the reference."""
    return [name for name in results if name not in (*BASELINES, reference)]


@_styled
def sipe_plot(results: Results, mode: Mode | None = None, reference: str | None = None) -> Figure:
    """Left accuracy, right CRPS skill. Without a mode one row per estimator, with its mean (green), minimum (blue) and maximum
    (orange) over parameters; with one, all estimators in that mode on one pair of radars, at most six. The prior mean is
    dashed, the mean of the reference dotted. Raises ValueError for results without an estimator, another mode or more estimators."""
    spokes, names = _checked(results), estimators(results, reference)
    if mode is None:
        rows = [(name, {m: _spread(results[name], spokes, m) for m in _MEASURES}) for name in names]
    elif mode not in MODES:
        raise ValueError(f"mode: expected one of {', '.join(MODES)} or None, got {mode!r}")
    elif len(names) > COMPARED:
        raise ValueError(
            f"results: {len(names)} estimators on one radar, at most {COMPARED} can be told apart; choose some"
        )
    else:
        rows = [(f"{mode} over parameters", {m: _several(results, names, spokes, m, mode) for m in _MEASURES})]
    return _rows(rows, spokes, _baselines(results, spokes, mode or "mean", reference))


@_styled
def settings_plot(first: Results, second: Results, labels: tuple[str, str], reference: str | None = None) -> Figure:
    """One row per estimator that has both: its mean accuracy and skill in one setting (green) and in another (orange), such as
    demonstrations and the data of a policy, on the environments that both have; the reference is one of the first. Raises ValueError where nothing is in both."""
    both = [name for name in estimators(first) if any(first[name].values()) and any(second.get(name, {}).values())]
    spokes = [e for e in environments({n: first[n] for n in both}) if e in environments({n: second[n] for n in both})]
    if not spokes:
        raise ValueError(f"results: no estimator ran both with {labels[0]} and with {labels[1]}; run the cells of both")
    styles = ((GREEN, "-", "o"), (ORANGE, (0, (2, 1.2)), "^"))
    rows = []
    for name in both:
        pair = list(zip(labels, (first[name], second[name]), styles, strict=True))
        rows.append(
            (name, {m: [Curve(label, over_seeds(r, spokes, m, "mean"), *s) for label, r, s in pair] for m in _MEASURES})
        )
    return _rows(rows, spokes, _baselines(first, spokes, "mean", reference))


def _checked(results: Results) -> list[str]:
    if not any(any(len(s) for s in results[name].values()) for name in estimators(results)):
        raise ValueError(
            "results: expected estimator -> environment -> scores of each seed, got no scores; run some cells"
        )
    return environments(results)


def _spread(runs: Mapping[str, Sequence[Any]], spokes: Sequence[str], measure: str) -> list[Curve]:
    return [Curve(mode, over_seeds(runs, spokes, measure, mode), *_SPREAD[mode]) for mode in MODES]


def _several(results: Results, names: Sequence[str], spokes: Sequence[str], measure: str, mode: Mode) -> list[Curve]:
    styles = zip(_COLOURS, _LINES, _MARKERS, strict=True)
    return [
        Curve(name, over_seeds(results[name], spokes, measure, mode), *style)
        for name, style in zip(names, styles, strict=False)
    ]


def _baselines(results: Results, spokes: Sequence[str], mode: Mode, reference: str | None) -> dict[str, list[Curve]]:
    """The curves of the prior mean and of the reference in each measure."""
    styles: list[tuple[str, Mode, Any]] = [(BASELINE, mode, (0, (3, 2)))]
    styles += [(reference, "mean", (0, (1, 1.4)))] if reference is not None else []
    return {
        m: [
            Curve(name.replace("_", " "), over_seeds(results[name], spokes, m, which), "#444444", line)
            for name, which, line in styles
            if name in results
        ]
        for m in _MEASURES
    }


def _rows(
    rows: Sequence[tuple[str, Mapping[str, list[Curve]]]], spokes: Sequence[str], baselines: Mapping[str, list[Curve]]
) -> Figure:
    """A row per title, a column per measure, one legend."""
    figure = _figure(_SIDE * len(rows) + 0.45)
    layout: Any = figure.get_layout_engine()
    layout.set(h_pad=0.1)
    axes: Any = figure.subplots(len(rows), len(_MEASURES), squeeze=False, subplot_kw={"projection": "polar"})
    for line, (title, curves) in zip(axes, rows, strict=True):
        for ax, measure in zip(line, _MEASURES, strict=True):
            _radar(ax, [*curves[measure], *baselines[measure]], spokes, _RANGES[measure])
            ax.set_title(f"{title}: {measure}", fontweight="bold", pad=26)
    figure.legend(handles=_legend(rows, baselines), loc="outside upper center", ncols=7)
    return figure


def _legend(
    rows: Sequence[tuple[str, Mapping[str, list[Curve]]]], baselines: Mapping[str, list[Curve]]
) -> list[Line2D]:
    shown = [*rows[0][1][_MEASURES[0]], *baselines[_MEASURES[0]]]
    return [Line2D([], [], color=c.colour, ls=c.line, marker=c.marker, ms=4.5, label=c.label) for c in shown]


def _radar(ax: PolarAxes, curves: Sequence[Curve], spokes: Sequence[str], limits: tuple[float, float]) -> None:
    angle = np.linspace(0, 2 * np.pi, len(spokes), endpoint=False)
    ax.set_theta_zero_location("N")
    ax.set_theta_direction(-1)
    ax.set_ylim(*limits)
    ax.set_yticks(np.linspace(*limits, 5)[1:], [])
    for tick in np.linspace(*limits, 5)[1:]:  # between the first two spokes, above the curves
        text = "0, the prior" if limits[0] < 0 == tick else f"{tick:g}"
        label = ax.text(np.pi / max(len(spokes), 3), tick, text, color="#555555", fontsize=6.5, ha="center", zorder=4)
        label.set_path_effects([withStroke(linewidth=2, foreground="white")])
    ax.grid(color="#d5d8dc", lw=0.6)
    ax.spines["polar"].set_color("#b0b5bb")
    _spoke_labels(ax, angle, spokes)
    if limits[0] < 0:
        ax.plot(np.linspace(0, 2 * np.pi, 200), np.zeros(200), color="#888888", lw=0.9)  # the prior itself
    if len(spokes) < _FEWEST:
        _apart(ax, curves, angle, limits)
        return
    for curve in curves:
        closed = np.clip(np.append(curve.values, curve.values[:1]), *limits)
        ax.plot(
            np.append(angle, angle[:1]), closed, color=curve.colour, ls=curve.line, lw=1.5 if curve.marker else 1.2,
            marker=curve.marker or None, ms=4, clip_on=False, zorder=3 if curve.marker else 2.5,
        )  # fmt: skip


def _apart(ax: PolarAxes, curves: Sequence[Curve], angle: FloatArray, limits: tuple[float, float]) -> None:
    """Where there are too few spokes for a closed line: estimators side by side about each spoke, baselines as arcs across them."""
    own = [curve for curve in curves if curve.marker]
    places = _STEP * (np.arange(len(own)) - (len(own) - 1) / 2)
    arc = np.linspace(-0.5, 0.5, 50) * _STEP * (len(own) + 1)
    for curve in curves:
        for turn, value in zip(angle, np.clip(curve.values, *limits), strict=True):
            if curve.marker:
                place = turn + places[own.index(curve)]
                ax.plot([place], [value], color=curve.colour, marker=curve.marker, ms=5, ls="", clip_on=False, zorder=3)
            else:
                ax.plot(turn + arc, np.full(len(arc), value), color=curve.colour, ls=curve.line, lw=1.2, zorder=2.5)


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
