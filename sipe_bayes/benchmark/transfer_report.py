"""What the transfer's records say: a table, the grouped bars of the paper's Figure 6, and learning curves.

Every return R in the target stands as a percentage of the oracle's O, the agent trained in the target itself, both as means over the seeds that
both have. The paper (B. Mehta, A. Handa, D. Fox, F. Ramos 2020, https://arxiv.org/abs/2011.08985, Section 3.4) takes 100 R / O, which
means something only where returns are positive. Deviation: here zero is a policy Z that acts at random in the target,

    100 (R - Z) / (O - Z),

and the paper's percentage stands beside it where O and Z are positive. Intervals: 95 %, percentile bootstrap over seeds (B. Efron 1979, "Bootstrap Methods:
Another Look at the Jackknife", https://doi.org/10.1214/aos/1176344552), a seed's agent and oracle drawn together. With three seeds it has ten
different resamples and covers less than it says: it is a lower bound on the doubt.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from sipe_bayes.atomic import write_bytes, write_text
from sipe_bayes.benchmark.tables import order_estimators, order_tasks
from sipe_bayes.benchmark.transfer import REFERENCES, SETTING, TRUTH, TransferRecord
from sipe_bayes.benchmark.transfer_run import load
from sipe_bayes.diagnostics.drawing import CHAINS, DEFAULT, MEASURED, PRIOR, _figure, _styled, png

FloatArray = NDArray[np.float64]

_RESAMPLES = 10_000
_LEVEL = 0.95
_WORDS = {"truth": "truth (oracle)", "prior": "prior (uniform)", "default": "default model"}
_COLOURS = {"truth": MEASURED, "prior": PRIOR, "default": DEFAULT}


@dataclass(frozen=True)
class Row:
    """A randomisation of one task and variant, over its seeds. returns (K,), of K seeds; percent: of the oracle, random being zero, with
    interval; paper: the paper's percentage, with interval; both None without an oracle of the same seeds, an interval None with one
    seed. success (K,) or None. solved: how many seeds solve the target. diverged, redrawn: in all trainings together. seconds: of a training, mean."""

    task: str
    variant: str
    name: str
    returns: FloatArray
    percent: float | None
    interval: tuple[float, float] | None
    paper: float | None
    paper_interval: tuple[float, float] | None
    success: FloatArray | None
    solved: int
    redrawn: int
    diverged: int
    seconds: float


def label(record: TransferRecord) -> str:
    """A randomisation with its variations."""
    return record.estimator + record.setting.removeprefix(SETTING).replace(",", ", ")


def relative(mine: FloatArray, oracle: FloatArray, zero: float) -> tuple[float, tuple[float, float] | None]:
    """100 (R - Z) / (O - Z) of returns (K,) of the same K seeds, and its interval over seeds, None for one seed."""
    rows = np.random.default_rng(0).integers(0, len(mine), (_RESAMPLES, len(mine)))
    value = 100 * (mine.mean() - zero) / (oracle.mean() - zero)
    if len(mine) < 2:
        return float(value), None
    again = 100 * (mine[rows].mean(1) - zero) / (oracle[rows].mean(1) - zero)
    low, high = np.quantile(again, [(1 - _LEVEL) / 2, (1 + _LEVEL) / 2])
    return float(value), (float(low), float(high))


def rows(records: Sequence[TransferRecord]) -> list[Row]:
    """Of all finished records, by task, variant and randomisation, the references first."""
    done = [r for r in records if r.done]
    found = []
    for task in order_tasks({r.task for r in done}):
        for variant in sorted({r.variant for r in done if r.task == task}):
            of = [r for r in done if (r.task, r.variant) == (task, variant)]
            oracle = {r.seed: r.evaluation["mean"] for r in of if r.estimator == TRUTH}
            zero = float(np.mean([r.random["mean"] for r in of]))
            found += [_row([r for r in of if label(r) == name], name, oracle, zero) for name in _ordered(of)]
    return found


def _ordered(records: Sequence[TransferRecord]) -> list[str]:
    order = [*REFERENCES, *order_estimators({r.estimator for r in records} - set(REFERENCES))]
    return sorted({label(r) for r in records}, key=lambda name: (order.index(name.split(",")[0]), name))


def _row(mine: Sequence[TransferRecord], name: str, oracle: dict[int, float], zero: float) -> Row:
    mine = sorted(mine, key=lambda r: r.seed)
    both = [r for r in mine if r.seed in oracle]
    ours, theirs = np.array([r.evaluation["mean"] for r in both]), np.array([oracle[r.seed] for r in both])
    percent, interval = relative(ours, theirs, zero) if both and theirs.mean() > zero else (None, None)
    positive = bool(both) and theirs.mean() > 0 and zero > 0
    paper, paper_interval = relative(ours, theirs, 0.0) if positive else (None, None)
    rates = [r.evaluation["success_rate"] for r in mine]
    return Row(
        task=mine[0].task,
        variant=mine[0].variant,
        name=name,
        returns=np.array([r.evaluation["mean"] for r in mine]),
        percent=percent,
        interval=interval,
        paper=paper,
        paper_interval=paper_interval,
        success=None if None in rates else np.array(rates, float),
        solved=sum(bool(r.solved_reference) for r in mine),
        redrawn=sum(r.redrawn for r in mine),
        diverged=sum(r.diverged for r in mine),
        seconds=float(np.mean([r.seconds or 0.0 for r in mine])),
    )


def table(found: Sequence[Row], records: Sequence[TransferRecord]) -> str:
    """Markdown."""
    said = ["# Sim2sim transfer", ""]
    for task, variant in dict.fromkeys((row.task, row.variant) for row in found):
        of = [r for r in records if r.done and (r.task, r.variant) == (task, variant)]
        steps = sorted({r.training for r in of})
        said += [
            f"## {task}, target: {variant.replace('_', ' ')}",
            "",
            f"{', '.join(f'{n:,}' for n in steps)} control steps of training; {of[0].evaluation['episodes']} episodes in the target; "
            f"a random policy earns {np.mean([r.random['mean'] for r in of]):.1f} there.",
            "",
            "| trained under | seeds | return in the target | % of the oracle (random = 0) | % of the oracle (paper) | success | solve it | redrawn | diverged | s a training |",
            "|---|---|---|---|---|---|---|---|---|---|",
        ]
        said += [_line(row) for row in found if (row.task, row.variant) == (task, variant)] + [""]
    return "\n".join(said)


def _line(row: Row) -> str:
    spread = f" ± {row.returns.std(ddof=1) / len(row.returns) ** 0.5:.1f}" if len(row.returns) > 1 else ""
    entries = [
        *(_WORDS.get(row.name, row.name), str(len(row.returns)), f"{row.returns.mean():.1f}{spread}"),
        *(_with(row.percent, row.interval), _with(row.paper, row.paper_interval)),
        *("" if row.success is None else f"{row.success.mean():.2f}", str(row.solved)),
        *(str(row.redrawn), str(row.diverged), f"{row.seconds:.0f}"),
    ]
    return f"| {' | '.join(entries)} |"


def _with(value: float | None, interval: tuple[float, float] | None) -> str:
    if value is None:
        return ""
    return f"{value:.0f}" + ("" if interval is None else f" ({interval[0]:.0f} to {interval[1]:.0f})")


@_styled
def bars(found: Sequence[Row]) -> Figure:
    """The paper's Figure 6: a group of bars for each task and variant, the oracle as the line at 100 %, the uniform prior as a dashed line
    in each group. A bar without a whisker has one seed."""
    groups = list(dict.fromkeys((row.task, row.variant) for row in found if row.percent is not None))
    names = [n for n in dict.fromkeys(row.name for row in found) if n != TRUTH]
    figure = _figure(3.6, max(4.8, 1.6 + 0.24 * (len(names) + 1) * len(groups)))
    axes = figure.add_subplot()
    width = 0.8 / max(1, len(names))
    for k, name in enumerate(names):
        for g, group in enumerate(groups):
            mine = [r for r in found if (r.task, r.variant) == group and r.name == name and r.percent is not None]
            for row in mine:
                at, height = g + (k - (len(names) - 1) / 2) * width, float(row.percent or 0.0)
                axes.bar(
                    at, height, 0.9 * width, color=_colour(name, names), label=None if g else _WORDS.get(name, name)
                )
                if row.interval is not None:
                    reach = np.abs(np.array(row.interval) - height)[:, None]
                    axes.errorbar(at, height, reach, color=MEASURED, lw=1, capsize=2)
                if name == "prior":
                    axes.hlines(height, g - 0.45, g + 0.45, color=PRIOR, ls=(0, (3, 2)), lw=1.2)
    axes.axhline(100, color=MEASURED, lw=1.2, label=_WORDS[TRUTH])
    axes.axhline(0, color=MEASURED, lw=0.6)
    axes.set_xticks(range(len(groups)), [f"{task}\n{variant.replace('_', ' ')}" for task, variant in groups])
    axes.set_ylabel("return in the target, % of the oracle\n(0: a random policy)")
    figure.legend(loc="outside lower center", ncols=4, frameon=False)
    return figure


@_styled
def curves(records: Sequence[TransferRecord]) -> Figure:
    """Return in the target along the training, the mean over seeds and their range; a panel for each task and variant."""
    done = [r for r in records if r.done]
    groups = [
        (t, v) for t in order_tasks({r.task for r in done}) for v in sorted({r.variant for r in done if r.task == t})
    ]
    names = [n for n in _ordered(done) if n != TRUTH]
    across = min(2, len(groups))
    figure = _figure(0.6 + 2.8 * -(-len(groups) // across), 4.8 * across)
    for k, group in enumerate(groups):
        axes = figure.add_subplot(-(-len(groups) // across), across, k + 1)
        for name in [TRUTH, *names]:
            mine = [r.curve for r in done if (r.task, r.variant) == group and label(r) == name]
            if mine:
                _curve(axes, mine, _colour(name, names), _WORDS.get(name, name))
        axes.set_title(f"{group[0]}, {group[1].replace('_', ' ')}")
        axes.set_xlabel("control steps")
        axes.set_ylabel("return in the target")
    lines = {line.get_label(): line for axes in figure.axes for line in axes.get_lines()}
    figure.legend(list(lines.values()), [str(x) for x in lines], loc="outside lower center", ncols=4, frameon=False)
    return figure


def _curve(axes: Any, mine: Sequence[Sequence[dict[str, Any]]], colour: str, text: str) -> None:
    points = min(len(curve) for curve in mine)
    steps = [row["step"] for row in mine[0][:points]]
    earned = np.array([[row["target_return"] for row in curve[:points]] for curve in mine])
    dashed = colour in (PRIOR, DEFAULT)
    axes.plot(steps, earned.mean(0), color=colour, lw=1.4, ls=(0, (3, 2)) if dashed else "-", label=text)
    axes.fill_between(steps, earned.min(0), earned.max(0), color=colour, alpha=0.12, lw=0)


def _colour(name: str, names: Sequence[str]) -> str:
    others = [n for n in names if n not in _COLOURS]
    palette = [c for c in CHAINS if c != DEFAULT]
    return _COLOURS[name] if name in _COLOURS else palette[others.index(name) % len(palette)]


def write(folder: Path, into: Path | None = None) -> list[Path]:
    """Write transfer.md, transfer.csv (a row a record), bars.png and curves.png of a folder of results, default into its ``transfer/``;
    returns the paths. Raises RecordError where nothing is finished."""
    from sipe_bayes.benchmark.records import RecordError

    records, target = load(folder), folder / TransferRecord.FOLDER if into is None else into
    if not any(r.done for r in records):
        raise RecordError(f"{folder}: every cell of the transfer failed; `sipe transfer status {folder}` shows why")
    found = rows(records)
    text = {"transfer.md": table(found, records), "transfer.csv": _csv(records)}
    drawn = {"bars.png": png(bars(found)), "curves.png": png(curves(records))}
    for name, content in text.items():
        write_text(target / name, content)
    for name, image in drawn.items():
        write_bytes(target / name, image)
    return [target / name for name in (*text, *drawn)]


def _csv(records: Sequence[TransferRecord]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(
        [
            "id",
            "status",
            "training",
            "return",
            "return_sd",
            "success_rate",
            "random_return",
            "kept",
            "redrawn",
            "diverged",
            "seconds",
        ]
    )
    for r in records:
        measured = [r.evaluation.get(key, "") for key in ("mean", "sd", "success_rate")]
        writer.writerow(
            [r.id, r.status, r.training, *measured, r.random.get("mean", ""), r.kept, r.redrawn, r.diverged, r.seconds]
        )
    return text.getvalue()
