"""The transfer's report: a table in Markdown, a row a record in CSV, and the figures."""

from __future__ import annotations

import csv
import io
import itertools
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from sipe_bayes.benchmark.records import RecordError
from sipe_bayes.benchmark.tables import against
from sipe_bayes.benchmark.transfer.figures import bars, curves
from sipe_bayes.benchmark.transfer.rows import WORDS, Percent, Row, Target, by_quality, contrasts, label, rows
from sipe_bayes.benchmark.transfer.status import Sources
from sipe_bayes.benchmark.transfer.study import TRUTH, TransferRecord
from sipe_bayes.core.files import write_bytes, write_text
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.report.drawing import png

_EXPLAINED = """\
Every agent trains with the same settings, steps and seed, and acts in the target as it is: the model as published
(default), or one each of whose parameters is .1 to .4 of its range away from that (in distribution). ± is the standard
error over seeds. The percentage is 100 (R - Z) / (O - Z), R the return, O that of the oracle, Z of a policy that acts
at random; the paper's is 100 R / O, left out where an oracle earns hardly more than 0. The oracle is an agent like the
others, no upper bound: its own training has its luck, which every percentage shares. In brackets the 95 % bootstrap
interval over seeds, agent and oracle of a seed drawn together: with three seeds it ends at the least and the greatest
ratio of a seed's own two, and covers less than it says. The figure's dots, the CSV and the differences below divide by
the mean oracle. Spread is the mean sd of what was drawn from, in theta (the prior's is 0.29); where it is 0.00 the
posterior was as good as a point. CRPS is how far what was drawn from is from the truth, in theta, 0 the truth itself.
Solve it: seeds whose agent reaches what `sipe envs TASK` calls solved. Redrawn: theta that no model can have; diverged:
episodes. Where the same training serves two targets, as the prior's does, their rows are not independent."""
_COLUMNS = (
    *("trained under", "spread", "CRPS", "seeds", "return in the target", "% of the oracle (random = 0)"),
    *("% of the oracle (paper)", "success", "solve it", "redrawn", "diverged", "s a training"),
)
_POINT = 1e-9  # sd in theta: what rounding leaves of a point


def table(given: Sequence[Row], records: Sequence[TransferRecord], remarks: Sequence[str] = ()) -> str:
    """The report in Markdown.

    Args:
        given: rows of all targets.
        records: that they come from.
        remarks: what else a reader must know.
    """
    text = ["# Sim2sim transfer", "", _EXPLAINED, ""]
    for remark in [_took(records), *remarks, *_same_targets(records)]:
        text += [f"{remark[0].upper()}{remark[1:]}.", ""]
    for group in dict.fromkeys(row.group for row in given):
        of = [r for r in records if r.done and (r.task, r.variant) == group]
        mine = [r for r in given if r.group == group]
        steps = ", ".join(f"{n:,}" for n in sorted({r.training for r in of}))
        text += [
            f"## {_words(group)}",
            "",
            f"{steps} control steps of training; {of[0].earned.episodes} episodes in the target; a random policy earns "
            f"{np.mean([r.earned_at_random.mean for r in of]):.1f} there. {_no_percentage(mine)}".strip(),
            "",
            *_head(_COLUMNS),
            *(_line(row) for row in mine),
            "",
        ]
        oracle = next((row for row in mine if row.name == TRUTH and len(row.by_seed) > 1), None)
        if oracle is not None:
            seeds = ", ".join(f"{value:.0f}" for _, value in sorted(oracle.by_seed.items()))
            text += [f"The oracle's seeds earn {seeds} % of their mean.", ""]
    return "\n".join([*text, *_compared(given), *_correlated(by_quality(given))])


def _head(columns: Sequence[str]) -> list[str]:
    return [f"| {' | '.join(columns)} |", "|---" * len(columns) + "|"]


def _took(records: Sequence[TransferRecord]) -> str:
    done = [r for r in records if r.done]
    hours = sum(r.cpu_seconds or 0.0 for r in done) / 3600
    lost = sum(r.cpu_seconds is None for r in done)
    more = f", but for {lost} that were interrupted or share another's training" * bool(lost)
    return f"{len(done)} agents, {hours:.1f} h of CPU{more}"


def _words(target: Target) -> str:
    return f"{target[0]}, target: {target[1].replace('_', ' ')}"


def _no_percentage(mine: Sequence[Row]) -> str:
    """Why a target has no percentages, empty where it has."""
    if any(row.percent is not None for row in mine):
        return ""
    if not any(row.name == TRUTH for row in mine):
        return f"No percentages, for the oracle is lacking: run also `--select {mine[0].task}/{TRUTH}`."
    return "No percentages, for an oracle fails: it earns less than a tenth of what they earn on average above random."


def _same_targets(records: Sequence[TransferRecord]) -> list[str]:
    """Targets that are the same model, which their oracles' returns show."""
    oracles: dict[Target, list[tuple[int, float]]] = {}
    for r in sorted((r for r in records if r.done and r.estimator == TRUTH), key=lambda r: r.seed):
        oracles.setdefault((r.task, r.variant), []).append((r.seed, r.earned.mean))
    return [
        f"{_words(one)}, and {_words(other)}, are the same model, with the same oracles"
        for one, other in itertools.combinations(oracles, 2)
        if oracles[one] == oracles[other]
    ]


def _compared(given: Sequence[Row]) -> list[str]:
    compared = contrasts(given)
    if not compared:
        return []
    targets = [g for g in dict.fromkeys(row.group for row in given) if any(g in c.by_target for c in compared)]
    seeds = " or ".join(map(str, sorted({len(c.gains) for c in compared})))
    tests = sum(len(c.by_target) + (len(c.by_target) > 1) for c in compared if len(c.gains) > 1)
    by_chance = THRESHOLDS.method_comparison * tests
    uncorrected = (
        f" The {tests} tests are not corrected for their number: chance alone would call {by_chance:.1f} of them "
        "better or worse."
    )
    head = [*("trained under", "against", "mean of its targets"), *(_words(t).replace(" target:", "") for t in targets)]
    lines = [
        "## What a randomisation is worth",
        "",
        "Differences in % of the oracle, seed by seed; of the mean of its targets, that mean is taken seed by seed "
        f"first. ± is the standard error over seeds ({seeds} of them), which share the luck of what is held against. "
        "better, worse: outside noise by a t-test over seeds at 5 %; the other differences are not told apart from "
        "none, which with few seeds says little; one seed tells nothing." + uncorrected * (tests > 0),
        "",
        *_head(head),
    ]
    for c in compared:
        entries = [WORDS.get(c.name, c.name), WORDS.get(c.other, c.other), _verdict(c.gains)]
        entries += [_verdict(c.by_target[t]) if t in c.by_target else "" for t in targets]
        lines.append(f"| {' | '.join(entries)} |")
    return [*lines, ""]


def _verdict(gains: Sequence[float]) -> str:
    return _spread(gains) + {1: " better", -1: " worse", 0: ""}[against(gains, 0.0)]


def _correlated(quality: tuple[dict[Target, float], float] | None) -> list[str]:
    if quality is None:
        return []
    by_target, p = quality
    return [
        "## Does a better posterior train a better policy?",
        "",
        "Spearman's rank correlation of the percentage with minus the CRPS, over a target's rows but the oracle's and "
        "variations': 1 where the better posterior always earns more, 0 where it makes no difference. The p-value "
        "takes targets and randomisations as independent.",
        "",
        *_head(("target", "rank correlation")),
        *(f"| {_words(target).replace(' target:', '')} | {value:.2f} |" for target, value in by_target.items()),
        f"| mean (p = {p:.2g}, by permutations within the targets) | {np.mean(list(by_target.values())):.2f} |",
        "",
    ]


def _spread(values: Sequence[float], digits: int = 1) -> str:
    """Mean and standard error."""
    error = f" ± {np.std(values, ddof=1) / len(values) ** 0.5:.{digits}f}" if len(values) > 1 else ""
    return f"{np.mean(values):.{digits}f}{error}"


def _line(row: Row) -> str:
    point = " (a point: not widened)" * ("wider" in row.name and row.spread < _POINT)
    entries = [
        WORDS.get(row.name, row.name) + point,
        f"{row.spread:.2f}",
        "" if row.crps is None else f"{row.crps:.3f}",
        str(len(row.returns)),
        _spread(list(row.returns.values())),
        _with(row.percent),
        _with(row.paper),
        "" if row.success is None else _spread(list(row.success), 2),
        str(row.solved),
        str(row.redrawn),
        str(row.diverged),
        f"{row.seconds:.0f}",
    ]
    return f"| {' | '.join(entries)} |"


def _with(percent: Percent) -> str:
    if percent is None:
        return ""
    value, interval = percent
    return f"{value:.0f}" + ("" if interval is None else f" ({interval[0]:.0f} to {interval[1]:.0f})")


def write(folder: Path, into: Path | None = None) -> list[Path]:
    """Write transfer.md, transfer.csv (a row a record), bars.png and curves.png.

    Args:
        folder: of results.
        into: where to write; default its ``transfer/``.

    Returns:
        The paths.

    Raises:
        RecordError: where nothing is finished.
    """
    records, target = TransferRecord.all_in(folder), folder / TransferRecord.FOLDER if into is None else into
    if not any(r.done for r in records):
        raise RecordError(f"{folder}: every cell of the transfer failed; `sipe transfer status {folder}` shows why")
    sources = Sources.of(records, folder)
    crps = sources.crps(records)
    remarks = [f"{cell} is stale, {why}" for cell, why in sources.stale.items()]
    versions = Counter((r.checksums.get("source", ""), r.task) for r in records if r.done)
    if len({source for source, _ in versions}) > 1:
        which = ", ".join(f"{source} ({count} of {task})" for (source, task), count in sorted(versions.items()))
        remarks.append(f"these trainings were made with several versions of the code: {which}")
    given = rows(records, crps)
    text = {"transfer.md": table(given, records, remarks), "transfer.csv": _csv(records, crps)}
    drawn = {"bars.png": png(bars(given)), "curves.png": png(curves(records))}
    for name, content in text.items():
        write_text(target / name, content)
    for name, image in drawn.items():
        write_bytes(target / name, image)
    return [target / name for name in (*text, *drawn)]


def _csv(records: Sequence[TransferRecord], crps: Mapping[str, float]) -> str:
    """A row for each record; percent: of the mean oracle of the same target, random being zero."""
    percent = {(*row.group, row.name, seed): value for row in rows(records) for seed, value in row.by_seed.items()}
    table = [
        {
            "id": r.id,
            "status": r.status,
            "training": r.training,
            "spread": float(np.mean(r.sd)) if r.sd else "",
            "crps": crps.get(r.id, ""),
            "return": "" if r.evaluation is None else r.evaluation.mean,
            "return_sd": "" if r.evaluation is None else r.evaluation.sd,
            "percent_of_oracle": percent.get((r.task, r.variant, label(r), r.seed), ""),
            "success_rate": "" if r.evaluation is None else r.evaluation.success_rate,
            "random_return": "" if r.random is None else r.random.mean,
            "kept": r.kept,
            "redrawn": r.redrawn,
            "diverged": r.diverged,
            "seconds": r.seconds,
        }
        for r in records
    ]
    text = io.StringIO()
    writer = csv.DictWriter(text, list(table[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(table)
    return text.getvalue()
