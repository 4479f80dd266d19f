"""The transfer's report: a table in Markdown, a row a record in CSV, and the figures."""

from __future__ import annotations

import csv
import io
import itertools
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from sipe_bayes.benchmark.tables import LEVEL, against
from sipe_bayes.benchmark.transfer.figures import bars, curves
from sipe_bayes.benchmark.transfer.rows import WORDS, Percent, Row, Target, by_quality, contrasts, label, rows
from sipe_bayes.benchmark.transfer.run import believed, load, qualities, stale
from sipe_bayes.benchmark.transfer.study import TRUTH, TransferRecord
from sipe_bayes.core.files import write_bytes, write_text
from sipe_bayes.report.drawing import png

_EXPLAINED = """Every agent trains with the same settings, steps and seed, and acts in the target as it is: the model as published (default), or one each of whose
parameters is .1 to .4 of its range away from that (in distribution). ± is the standard error over seeds. The percentage is 100 (R - Z) / (O - Z),
R the return, O that of the oracle, Z of a policy that acts at random; the paper's is 100 R / O, left out where an oracle earns hardly more
than 0. The oracle is an agent like the others, no upper bound: its own training has its luck, which every percentage shares.
In brackets the 95 % bootstrap interval over seeds, agent and oracle of a seed drawn together: with three seeds it ends at the least and the
greatest ratio of a seed's own two, and covers less than it says. The figure's dots, the CSV and the differences below divide by the mean oracle.
Spread is the mean sd of what was drawn from, in theta (the prior's is 0.29); where it is 0.00 the posterior was as good as a point. CRPS is how far
what was drawn from is from the truth, in theta, 0 the truth itself. Solve it: seeds whose agent reaches what `sipe envs TASK` calls solved. Redrawn:
theta that no model can have; diverged: episodes. Where the same training serves two targets, as the prior's does, their rows are not
independent."""


_POINT = 1e-9  # in theta


def table(found: Sequence[Row], records: Sequence[TransferRecord], remarks: Sequence[str] = ()) -> str:
    """Markdown. remarks: what else a reader must know."""
    said = ["# Sim2sim transfer", "", _EXPLAINED, ""]
    for remark in [_took(records), *remarks, *_same_targets(records)]:
        said += [f"{remark[0].upper()}{remark[1:]}.", ""]
    for group in dict.fromkeys(row.group for row in found):
        of = [r for r in records if r.done and (r.task, r.variant) == group]
        mine = [r for r in found if r.group == group]
        steps = sorted({r.training for r in of})
        said += [
            f"## {_words(group)}",
            "",
            f"{', '.join(f'{n:,}' for n in steps)} control steps of training; {of[0].evaluation['episodes']} episodes in the target; "
            f"a random policy earns {np.mean([r.random['mean'] for r in of]):.1f} there. {_no_percentage(mine)}".strip(),
            "",
            "| trained under | spread | CRPS | seeds | return in the target | % of the oracle (random = 0) | % of the oracle (paper) | success | solve it | redrawn | diverged | s a training |",
            "|---|---|---|---|---|---|---|---|---|---|---|---|",
        ]
        said += [_line(row) for row in mine] + [""]
        oracle = next((row for row in mine if row.name == TRUTH and len(row.by_seed) > 1), None)
        if oracle is not None:
            seeds = ", ".join(f"{value:.0f}" for _, value in sorted(oracle.by_seed.items()))
            said += [f"The oracle's seeds earn {seeds} % of their mean.", ""]
    return "\n".join([*said, *_compared(found), *_correlated(by_quality(found))])


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
        oracles.setdefault((r.task, r.variant), []).append((r.seed, r.evaluation["mean"]))
    return [
        f"{_words(one)}, and {_words(other)}, are the same model, with the same oracles"
        for one, other in itertools.combinations(oracles, 2)
        if oracles[one] == oracles[other]
    ]


def _compared(found: Sequence[Row]) -> list[str]:
    compared = contrasts(found)
    if not compared:
        return []
    targets = [g for g in dict.fromkeys(row.group for row in found) if any(g in c.by_target for c in compared)]
    seeds = sorted({len(c.gains) for c in compared})
    tests = sum(len(c.by_target) + (len(c.by_target) > 1) for c in compared if len(c.gains) > 1)
    head = [*("trained under", "against", "mean of its targets"), *(_words(t).replace(" target:", "") for t in targets)]
    lines = [
        "## What a randomisation is worth",
        "",
        "Differences in % of the oracle, seed by seed; of the mean of its targets, that mean is taken seed by seed first. ± is the standard error over "
        f"seeds ({' or '.join(map(str, seeds))} of them), which share the luck of what is held against. better, worse: outside noise by a t-test over seeds at "
        "5 %; the other differences are not told apart from none, which with few seeds says little; one seed tells nothing."
        + f" The {tests} tests are not corrected for their number: chance alone would call {LEVEL * tests:.1f} of them better or worse."
        * (tests > 0),
        "",
        f"| {' | '.join(head)} |",
        "|---" * len(head) + "|",
    ]
    for c in compared:
        entries = [WORDS.get(c.name, c.name), WORDS.get(c.other, c.other), _told(c.gains)]
        entries += [_told(c.by_target[t]) if t in c.by_target else "" for t in targets]
        lines.append(f"| {' | '.join(entries)} |")
    return [*lines, ""]


def _told(gains: list[float]) -> str:
    return _spread(gains) + {1: " better", -1: " worse", 0: ""}[against(gains, 0.0)]


def _correlated(found: tuple[dict[Target, float], float] | None) -> list[str]:
    if found is None:
        return []
    by_target, p = found
    return [
        "## Does a better posterior train a better policy?",
        "",
        "Spearman's rank correlation of the percentage with minus the CRPS, over a target's rows but the oracle's and variations': 1 where the better "
        "posterior always earns more, 0 where it makes no difference. The p-value takes targets and randomisations as independent.",
        "",
        *("| target | rank correlation |", "|---|---|"),
        *(f"| {_words(target).replace(' target:', '')} | {value:.2f} |" for target, value in by_target.items()),
        f"| mean (p = {p:.2g}, by permutations within the targets) | {np.mean(list(by_target.values())):.2f} |",
        "",
    ]


def _spread(values: Sequence[float], digits: int = 1) -> str:
    """Mean and standard error."""
    error = f" ± {np.std(values, ddof=1) / len(values) ** 0.5:.{digits}f}" if len(values) > 1 else ""
    return f"{np.mean(values):.{digits}f}{error}"


def _line(row: Row) -> str:
    entries = [
        *(
            WORDS.get(row.name, row.name) + " (a point: not widened)" * ("wider" in row.name and row.spread < _POINT),
            f"{row.spread:.2f}",
            "" if row.crps is None else f"{row.crps:.3f}",
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


def write(folder: Path, into: Path | None = None) -> list[Path]:
    """Write transfer.md, transfer.csv (a row a record), bars.png and curves.png of a folder of results, default into its ``transfer/``;
    returns the paths. Raises RecordError where nothing is finished."""
    from sipe_bayes.benchmark.records import RecordError

    records, target = load(folder), folder / TransferRecord.FOLDER if into is None else into
    if not any(r.done for r in records):
        raise RecordError(f"{folder}: every cell of the transfer failed; `sipe transfer status {folder}` shows why")
    drawn_from = believed(records, folder)
    crps = qualities(records, drawn_from)
    remarks = [f"{cell} is stale, {why}" for cell, why in stale(drawn_from).items()]
    versions = Counter((r.checksums.get("source", ""), r.task) for r in records if r.done)
    if len({source for source, _ in versions}) > 1:
        which = ", ".join(f"{source} ({count} of {task})" for (source, task), count in sorted(versions.items()))
        remarks.append(f"these trainings were made with several versions of the code: {which}")
    found = rows(records, crps)
    text = {"transfer.md": table(found, records, remarks), "transfer.csv": _csv(records, crps)}
    drawn = {"bars.png": png(bars(found)), "curves.png": png(curves(records))}
    for name, content in text.items():
        write_text(target / name, content)
    for name, image in drawn.items():
        write_bytes(target / name, image)
    return [target / name for name in (*text, *drawn)]


def _csv(records: Sequence[TransferRecord], crps: Mapping[str, float]) -> str:
    """A row for each record; percent: of the mean oracle of the same target, random being zero."""
    percent = {(*row.group, row.name, seed): value for row in rows(records) for seed, value in row.by_seed.items()}
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    head = [
        "id",
        "status",
        "training",
        "spread",
        "crps",
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
            [
                r.id,
                r.status,
                r.training,
                spread,
                crps.get(r.id, ""),
                *earned,
                of_oracle,
                *rates,
                r.kept,
                r.redrawn,
                r.diverged,
                r.seconds,
            ]
        )
    return text.getvalue()
