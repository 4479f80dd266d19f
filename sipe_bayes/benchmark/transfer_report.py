"""What the transfer's records say: a table, the grouped bars of the paper's Figure 6, and learning curves.

Every return R in the target stands as a percentage of the oracle's O, the agent trained in the target itself, both as means over the seeds that
both have. The paper (B. Mehta, A. Handa, D. Fox, F. Ramos 2020, https://arxiv.org/abs/2011.08985, Section 3.4) takes 100 R / O, which
means something only where returns are positive. Deviation: here zero is a policy Z that acts at random in the target,

    100 (R - Z) / (O - Z),

and the paper's percentage stands beside it where every oracle earns more than 0. Intervals: 95 %, percentile bootstrap over seeds (B. Efron
1979, "Bootstrap Methods: Another Look at the Jackknife", https://doi.org/10.1214/aos/1176344552), a seed's agent and oracle drawn together. With
three seeds it has ten different resamples and ends at the best and the worst seed. There is none where an oracle fails: a resample's
denominator would be near zero.

What a randomisation is worth against another one is told by differences in that percentage, seed by seed, over all tasks and variants
that have both (``contrasts``).
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
from sipe_bayes.benchmark.tables import against, order_estimators, order_tasks
from sipe_bayes.benchmark.transfer import REFERENCES, SETTING, TRUTH, TransferRecord
from sipe_bayes.benchmark.transfer_run import load
from sipe_bayes.diagnostics.drawing import CHAINS, DEFAULT, MEASURED, PRIOR, _figure, _styled, png

FloatArray = NDArray[np.float64]

_RESAMPLES = 10_000
_LEVEL = 0.95
_LEAST_LEAD = 0.1
_WORDS = {"truth": "truth (oracle)", "prior": "prior (uniform)", "default": "default model"}
_COLOURS = {"truth": MEASURED, "prior": PRIOR, "default": DEFAULT}


Percent = tuple[float, tuple[float, float] | None] | None
"""Of the oracle, with its interval over seeds (None for one seed); None where an oracle is lacking or fails."""


@dataclass(frozen=True)
class Row:
    """A randomisation of one task and variant, over its seeds. returns: by seed; spread: mean sd in theta of what was drawn from;
    percent: of the oracle, random being zero; paper: the paper's percentage; by_seed: percent of each seed, of the mean oracle; success (K,) or
    None. solved: how many seeds solve the target. diverged, redrawn: in all trainings together. seconds: of a training, mean."""

    task: str
    variant: str
    name: str
    returns: dict[int, float]
    spread: float
    percent: Percent
    paper: Percent
    by_seed: dict[int, float]
    success: FloatArray | None
    solved: int
    redrawn: int
    diverged: int
    seconds: float

    @property
    def group(self) -> tuple[str, str]:
        return self.task, self.variant


def label(record: TransferRecord) -> str:
    """A randomisation with its variations."""
    return record.estimator + record.setting.removeprefix(SETTING).replace(",", ", ")


def relative(mine: FloatArray, oracle: FloatArray, zero: float) -> tuple[float, tuple[float, float] | None] | None:
    """100 (R - Z) / (O - Z) of returns (K,) of the same K seeds, and its interval over seeds, None for one seed. None altogether unless
    every oracle earns a tenth at least of what they earn on average above zero."""
    lead = oracle - zero
    if not len(mine) or lead.mean() <= 0 or lead.min() < _LEAST_LEAD * lead.mean():
        return None
    rows = np.random.default_rng(0).integers(0, len(mine), (_RESAMPLES, len(mine)))
    value = 100 * (mine.mean() - zero) / lead.mean()
    if len(mine) < 2:
        return float(value), None
    again = 100 * (mine[rows].mean(1) - zero) / lead[rows].mean(1)
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
    returns = {r.seed: float(r.evaluation["mean"]) for r in mine}
    both = [seed for seed in returns if seed in oracle]
    ours, theirs = np.array([returns[s] for s in both]), np.array([oracle[s] for s in both])
    percent = relative(ours, theirs, zero)
    lead = theirs.mean() - zero if percent is not None else np.nan
    rates = [r.evaluation["success_rate"] for r in mine]
    return Row(
        task=mine[0].task,
        variant=mine[0].variant,
        name=name,
        returns=returns,
        spread=float(np.mean([r.sd for r in mine])),
        percent=percent,
        paper=relative(ours, theirs, 0.0),
        by_seed={} if percent is None else {s: 100 * (returns[s] - zero) / lead for s in both},
        success=None if None in rates else np.array(rates, float),
        solved=sum(bool(r.solved_reference) for r in mine),
        redrawn=sum(r.redrawn for r in mine),
        diverged=sum(r.diverged for r in mine),
        seconds=float(np.mean([r.seconds or 0.0 for r in mine])),
    )


def contrasts(found: Sequence[Row]) -> list[tuple[str, str, list[float], int]]:
    """(randomisation, what it is held against, differences in percent of the oracle of each seed, over how many targets): every
    randomisation against the prior, and variations against what they vary. A seed's difference is the mean over the targets that have
    both with all their seeds."""
    by_name: dict[str, dict[tuple[str, str], dict[int, float]]] = {}
    for row in found:
        by_name.setdefault(row.name, {})[row.group] = row.by_seed
    pairs = [(name, "prior") for name in by_name if name not in ("prior", TRUTH)]
    pairs += [(name, name.split(",")[0]) for name in by_name if "," in name]
    said = []
    for name, other in pairs:
        if other not in by_name:
            continue
        groups = [g for g, mine in by_name[name].items() if mine and mine.keys() == by_name[other].get(g, {}).keys()]
        seeds = set.intersection(*(set(by_name[name][g]) for g in groups)) if groups else set()
        if seeds:
            gains = [
                float(np.mean([by_name[name][g][s] - by_name[other][g][s] for g in groups])) for s in sorted(seeds)
            ]
            said.append((name, other, gains, len(groups)))
    return said


_EXPLAINED = """Every agent trains with the same settings, steps and seed, and acts in the target as it is. ± is the standard error over seeds. The
percentage is 100 (R - Z) / (O - Z), R the return, O that of the oracle, Z of a policy that acts at random; the paper's is 100 R / O, left out
where returns may be negative. In brackets the 95 % bootstrap interval over seeds, which with three seeds ends at the best and the worst one.
Spread is the mean sd of what was drawn from, in theta (the prior's is 0.29); where it is 0.00 the posterior was as good as a point. Where the
same training serves two targets, as the prior's does, their rows are not independent."""


def table(found: Sequence[Row], records: Sequence[TransferRecord]) -> str:
    """Markdown."""
    said = ["# Sim2sim transfer", "", _EXPLAINED, ""]
    for group in dict.fromkeys(row.group for row in found):
        of = [r for r in records if r.done and (r.task, r.variant) == group]
        steps = sorted({r.training for r in of})
        said += [
            f"## {group[0]}, target: {group[1].replace('_', ' ')}",
            "",
            f"{', '.join(f'{n:,}' for n in steps)} control steps of training; {of[0].evaluation['episodes']} episodes in the target; "
            f"a random policy earns {np.mean([r.random['mean'] for r in of]):.1f} there.",
            "",
            "| trained under | spread | seeds | return in the target | % of the oracle (random = 0) | % of the oracle (paper) | success | solve it | redrawn | diverged | s a training |",
            "|---|---|---|---|---|---|---|---|---|---|---|",
        ]
        said += [_line(row) for row in found if row.group == group] + [""]
    compared = contrasts(found)
    if compared:
        said += [
            "## What a randomisation is worth",
            "",
            "Differences in % of the oracle, seed by seed, means over the targets that have both; outside noise by a t-test over seeds at 5 %.",
            "",
            "| trained under | against | targets | difference | outside noise |",
            "|---|---|---|---|---|",
        ]
        said += [_contrast(*row) for row in compared] + [""]
    return "\n".join(said)


def _contrast(name: str, other: str, gains: list[float], targets: int) -> str:
    verdict = {1: "better", -1: "worse", 0: "no"}[against(gains, 0.0)]
    words = [_WORDS.get(name, name), _WORDS.get(other, other), str(targets), _spread(gains), verdict]
    return f"| {' | '.join(words)} |"


def _spread(values: Sequence[float], digits: int = 1) -> str:
    """Mean and standard error."""
    error = f" ± {np.std(values, ddof=1) / len(values) ** 0.5:.{digits}f}" if len(values) > 1 else ""
    return f"{np.mean(values):.{digits}f}{error}"


def _line(row: Row) -> str:
    entries = [
        *(
            _WORDS.get(row.name, row.name),
            f"{row.spread:.2f}",
            str(len(row.returns)),
            _spread(list(row.returns.values())),
        ),
        *(_with(row.percent), _with(row.paper)),
        *("" if row.success is None else _spread(list(row.success), 2), str(row.solved)),
        *(str(row.redrawn), str(row.diverged), f"{row.seconds:.0f}"),
    ]
    return f"| {' | '.join(entries)} |"


def _with(percent: Percent) -> str:
    if percent is None:
        return ""
    value, interval = percent
    return f"{value:.0f}" + ("" if interval is None else f" ({interval[0]:.0f} to {interval[1]:.0f})")


@_styled
def bars(found: Sequence[Row]) -> Figure:
    """The paper's Figure 6: a group of bars for each task and variant, the oracle as the line at 100 %, the uniform prior as a dashed line
    in each group. A bar without a whisker has one seed."""
    groups = list(dict.fromkeys(row.group for row in found if row.percent is not None))
    names = [n for n in dict.fromkeys(row.name for row in found) if n != TRUTH]
    figure = _figure(3.6 + 0.15 * (len(names) // 4), max(4.8, 1.6 + 0.17 * (len(names) + 1) * len(groups)))
    axes = figure.add_subplot()
    width, drawn = 0.8 / max(1, len(names)), set[str]()
    for row in found:
        if row.percent is None or row.name == TRUTH:
            continue
        g, k, (height, interval) = groups.index(row.group), names.index(row.name), row.percent
        at, look = g + (k - (len(names) - 1) / 2) * width, _look(row.name, names)
        text = None if row.name in drawn else _WORDS.get(row.name, row.name)
        axes.bar(at, height, 0.9 * width, color=look.colour, hatch=look.hatch, edgecolor="white", lw=0, label=text)
        drawn.add(row.name)
        if interval is not None:
            axes.errorbar(at, height, np.abs(np.array(interval) - height)[:, None], color=MEASURED, lw=1, capsize=1.5)
        if row.name == "prior":
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
                _curve(axes, mine, _look(name, names), _WORDS.get(name, name))
        axes.set_title(f"{group[0]}, {group[1].replace('_', ' ')}")
        axes.set_xlabel("control steps")
        axes.set_ylabel("return in the target")
    lines = {line.get_label(): line for axes in figure.axes for line in axes.get_lines()}
    figure.legend(list(lines.values()), [str(x) for x in lines], loc="outside lower center", ncols=4, frameon=False)
    return figure


def _curve(axes: Any, mine: Sequence[Sequence[dict[str, Any]]], look: _Look, text: str) -> None:
    points = min(len(curve) for curve in mine)
    steps = [row["step"] for row in mine[0][:points]]
    earned = np.array([[row["target_return"] for row in curve[:points]] for curve in mine])
    axes.plot(steps, earned.mean(0), color=look.colour, lw=1.4, ls=look.line, label=text)
    axes.fill_between(steps, earned.min(0), earned.max(0), color=look.colour, alpha=0.08, lw=0)


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
    """A row for each record; percent: of the mean oracle of the same target, random being zero."""
    percent = {(*row.group, row.name, seed): value for row in rows(records) for seed, value in row.by_seed.items()}
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    head = [
        "id",
        "status",
        "training",
        "spread",
        "return",
        "return_sd",
        "percent_of_oracle",
        "success_rate",
        "random_return",
    ]
    writer.writerow([*head, "kept", "redrawn", "diverged", "seconds"])
    for r in records:
        earned = [r.evaluation.get(key, "") for key in ("mean", "sd")]
        of_oracle = percent.get((r.task, r.variant, label(r), r.seed), "")
        spread = float(np.mean(r.sd)) if r.sd else ""
        rates = [r.evaluation.get("success_rate", ""), r.random.get("mean", "")]
        writer.writerow(
            [r.id, r.status, r.training, spread, *earned, of_oracle, *rates, r.kept, r.redrawn, r.diverged, r.seconds]
        )
    return text.getvalue()
