"""The transfer in pictures: the grouped bars of the paper's Figure 6, and learning curves in the target.

Records or rows in, one Matplotlib figure out, no pyplot, no state.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.typing import LineStyleType

from sipe_bayes.benchmark.tables import order_tasks
from sipe_bayes.benchmark.transfer.rows import WORDS, Row, Target, label, ordered
from sipe_bayes.benchmark.transfer.study import PRIOR as PRIOR_NAME
from sipe_bayes.benchmark.transfer.study import TRUTH, Point, TransferRecord
from sipe_bayes.report.colours import CHAINS, DASHED, DEFAULT, MEASURED, PRIOR, STYLE
from sipe_bayes.report.drawing import new_figure, styled
from sipe_bayes.report.legends import Look

_COLOURS = {"truth": MEASURED, "prior": PRIOR, "default": DEFAULT}


@styled
def bars(given: Sequence[Row]) -> Figure:
    """The paper's Figure 6: a group of bars for each task and variant, means over seeds in percent of the mean oracle.

    The seeds are dots; the oracle is the line at 100 % with its seeds as a shade, the uniform prior a dashed line.
    """
    groups = list(dict.fromkeys(row.group for row in given if row.percent is not None))
    most = max((len(_shown(given, group)) for group in groups), default=1)
    across = min(3, max(1, len(groups)))
    down = -(-max(1, len(groups)) // across)
    figure = new_figure(down * (0.9 + 0.22 * most) + 0.3, max(4.8, 3.7 * across))
    for k, group in enumerate(groups):
        axes = figure.add_subplot(down, across, k + 1)
        _group(axes, _shown(given, group), next((r for r in given if r.group == group and r.name == TRUTH), None))
        axes.set_title(f"{group[0]}, {group[1].replace('_', ' ')}")
    if groups:
        figure.supxlabel(
            "return in the target, % of the oracle (black; shade: its seeds), 0: a random policy", fontsize="medium"
        )
    else:
        figure.text(0.5, 0.5, "no target has an oracle to compare with", ha="center")
    return figure


def _shown(given: Sequence[Row], group: Target) -> list[Row]:
    return [row for row in given if row.group == group and row.percent is not None and row.name != TRUTH]


def _group(axes: Axes, rows: Sequence[Row], oracle: Row | None) -> None:
    if oracle is not None and oracle.by_seed:
        axes.axvspan(min(oracle.by_seed.values()), max(oracle.by_seed.values()), color=MEASURED, alpha=0.1, lw=0)
    for place, row in enumerate(rows):
        assert row.percent is not None
        colour, alpha = _COLOURS.get(row.name, CHAINS[0]), 0.45 if "," in row.name else 0.85
        axes.barh(place, row.percent[0], 0.75, color=colour, alpha=alpha, lw=0)
        seeds = list(row.by_seed.values())
        axes.plot(seeds, np.full(len(seeds), place), "o", color=MEASURED, ms=2.6, zorder=3)
        if row.name == PRIOR_NAME:
            axes.axvline(row.percent[0], color=PRIOR, ls=DASHED, lw=STYLE.reference)
    axes.axvline(100, color=MEASURED, lw=STYLE.reference)
    axes.set_yticks(range(len(rows)), [WORDS.get(row.name, row.name) for row in rows])
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.tick_params(axis="y", length=0)


@styled
def curves(records: Sequence[TransferRecord]) -> Figure:
    """Return in the target along the training, the mean over seeds, and their range as a shade.

    Args:
        records: of the agents; there is a panel for each task and variant.
    """
    done = [r for r in records if r.done]
    groups = [
        (t, v) for t in order_tasks({r.task for r in done}) for v in sorted({r.variant for r in done if r.task == t})
    ]
    names, drawn = [n for n in ordered(done) if n != TRUTH], dict[str, Line2D]()
    across = min(2, len(groups))
    figure = new_figure(0.6 + 2.8 * -(-len(groups) // across), 4.8 * across)
    for k, group in enumerate(groups):
        axes = figure.add_subplot(-(-len(groups) // across), across, k + 1)
        for name in [TRUTH, *names]:
            mine = [r.curve for r in done if (r.task, r.variant) == group and label(r) == name]
            if mine:
                drawn[name] = _curve(axes, mine, look_of(name, names))
        axes.set_title(f"{group[0]}, {group[1].replace('_', ' ')}")
        axes.set_xlabel("control steps")
        axes.set_ylabel("return in the target")
    _legend(figure, drawn, [TRUTH, *names])
    return figure


def _legend(figure: Figure, drawn: Mapping[str, Line2D], names: Sequence[str]) -> None:
    """What is drawn of the randomisations, in their order."""
    shown = [n for n in names if n in drawn]
    words = [WORDS.get(n, n) for n in shown]
    width = 0.55 + 0.075 * max((len(word) for word in words), default=0)  # inches of a column, at most
    columns = max(1, min(4, int(figure.get_figwidth() / width)))
    figure.legend(
        [drawn[n] for n in shown],
        words,
        loc="outside lower center",
        ncols=columns,
        frameon=False,
        title="mean over seeds; shade: their range",
    )


def _curve(axes: Axes, mine: Sequence[Sequence[Point]], look: Look) -> Line2D:
    points = min(len(curve) for curve in mine)
    steps = [point.step for point in mine[0][:points]]
    earned = np.array([[point.target_return for point in curve[:points]] for curve in mine])
    axes.fill_between(steps, earned.min(0), earned.max(0), color=look.colour, alpha=0.08, lw=0)
    return axes.plot(steps, earned.mean(0), color=look.colour, lw=STYLE.curve, ls=look.line)[0]


def look_of(name: str, names: Sequence[str]) -> Look:
    """Of a randomisation: colours go round once with full lines, then with dashes, so that no two look alike."""
    if name in _COLOURS:
        return Look(_COLOURS[name], "-" if name == TRUTH else DASHED)
    others, palette = [n for n in names if n not in _COLOURS], [c for c in CHAINS if c != DEFAULT]
    turn, k = divmod(others.index(name), len(palette))
    dashes: tuple[LineStyleType, ...] = ("-", (0, (6, 1.5)), (0, (1, 1)), (0, (4, 1, 1, 1)))
    return Look(palette[k], dashes[turn % 4])
