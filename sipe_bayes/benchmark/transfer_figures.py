"""The transfer in pictures: the grouped bars of the paper's Figure 6, and learning curves in the target.

Records or rows in, one Matplotlib figure out, no pyplot, no state.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from sipe_bayes.benchmark.tables import order_tasks
from sipe_bayes.benchmark.transfer import TRUTH, TransferRecord
from sipe_bayes.benchmark.transfer_rows import WORDS, Row, in_order, label, ordered
from sipe_bayes.diagnostics.drawing import CHAINS, DEFAULT, MEASURED, PRIOR, _figure, _styled

_COLOURS = {"truth": MEASURED, "prior": PRIOR, "default": DEFAULT}


@_styled
def bars(found: Sequence[Row]) -> Figure:
    """The paper's Figure 6: a group of bars for each task and variant, the oracle as the line at 100 % and its seeds
    as a shade, the uniform prior as a dashed line in each group. A bar without a whisker has one seed."""
    groups = list(dict.fromkeys(row.group for row in found if row.percent is not None))
    names = [n for n in in_order({row.name for row in found}) if n != TRUTH]
    figure = _figure(3.6 + 0.15 * (len(names) // 4), max(4.8, 1.6 + 0.17 * (len(names) + 1) * len(groups)))
    axes = figure.add_subplot()
    width, drawn = 0.8 / max(1, len(names)), dict[str, Any]()
    for row in found:
        if row.percent is None:
            continue
        if row.name == TRUTH:
            g, seeds = groups.index(row.group), list(row.by_seed.values())
            axes.fill_between([g - 0.45, g + 0.45], min(seeds), max(seeds), color=MEASURED, alpha=0.12, lw=0)
            continue
        mine = [n for n in names if any(r.group == row.group and r.name == n and r.percent is not None for r in found)]
        g, k, (height, interval) = groups.index(row.group), mine.index(row.name), row.percent
        at, look = g + (k - (len(mine) - 1) / 2) * width, _look(row.name, names)
        drawn[row.name] = axes.bar(
            at, height, 0.9 * width, color=look.colour, hatch=look.hatch, edgecolor="white", lw=0
        )
        if interval is not None:
            axes.errorbar(at, height, np.abs(np.array(interval) - height)[:, None], color=MEASURED, lw=1, capsize=1.5)
        if row.name == "prior":
            axes.hlines(height, g - 0.45, g + 0.45, color=PRIOR, ls=(0, (3, 2)), lw=1.2)
    drawn[TRUTH] = axes.axhline(100, color=MEASURED, lw=1.2)
    axes.axhline(0, color=MEASURED, lw=0.6)
    if not groups:
        axes.text(0.5, 50, "no target has an oracle to compare with", ha="center")
    axes.set_xticks(range(len(groups)), [f"{task}\n{variant.replace('_', ' ')}" for task, variant in groups])
    axes.set_ylabel("return in the target, % of the oracle\n(0: a random policy)")
    _legend(figure, drawn, [TRUTH, *names])
    return figure


@_styled
def curves(records: Sequence[TransferRecord]) -> Figure:
    """Return in the target along the training, the mean over seeds and their range; a panel for each task and variant."""
    done = [r for r in records if r.done]
    groups = [
        (t, v) for t in order_tasks({r.task for r in done}) for v in sorted({r.variant for r in done if r.task == t})
    ]
    names, drawn = [n for n in ordered(done) if n != TRUTH], dict[str, Any]()
    across = min(2, len(groups))
    figure = _figure(0.6 + 2.8 * -(-len(groups) // across), 4.8 * across)
    for k, group in enumerate(groups):
        axes = figure.add_subplot(-(-len(groups) // across), across, k + 1)
        for name in [TRUTH, *names]:
            mine = [r.curve for r in done if (r.task, r.variant) == group and label(r) == name]
            if mine:
                drawn[name] = _curve(axes, mine, _look(name, names))
        axes.set_title(f"{group[0]}, {group[1].replace('_', ' ')}")
        axes.set_xlabel("control steps")
        axes.set_ylabel("return in the target")
    _legend(figure, drawn, [TRUTH, *names])
    return figure


def _legend(figure: Figure, drawn: dict[str, Any], names: Sequence[str]) -> None:
    """What is drawn of the randomisations, in their order."""
    there = [n for n in names if n in drawn]
    words = [WORDS.get(n, n) for n in there]
    figure.legend([drawn[n] for n in there], words, loc="outside lower center", ncols=4, frameon=False)


def _curve(axes: Any, mine: Sequence[Sequence[dict[str, Any]]], look: _Look) -> Any:
    points = min(len(curve) for curve in mine)
    steps = [row["step"] for row in mine[0][:points]]
    earned = np.array([[row["target_return"] for row in curve[:points]] for curve in mine])
    axes.fill_between(steps, earned.min(0), earned.max(0), color=look.colour, alpha=0.08, lw=0)
    return axes.plot(steps, earned.mean(0), color=look.colour, lw=1.4, ls=look.line)[0]


@dataclass(frozen=True)
class _Look:
    """Of a randomisation in every figure."""

    colour: str
    line: Any
    hatch: str


def _look(name: str, names: Sequence[str]) -> _Look:
    """Colours go round once with full lines and once with dashes and hatches, so that no two randomisations look alike."""
    if name in _COLOURS:
        return _Look(_COLOURS[name], "-" if name == TRUTH else (0, (3, 2)), "")
    others, palette = [n for n in names if n not in _COLOURS], [c for c in CHAINS if c != DEFAULT]
    turn, k = divmod(others.index(name), len(palette))
    return _Look(
        palette[k],
        ("-", (0, (6, 1.5)), (0, (1, 1)), (0, (4, 1, 1, 1)))[turn % 4],
        ("", "////", "....", "xxxx")[turn % 4],
    )
