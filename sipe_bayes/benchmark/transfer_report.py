"""The transfer's report: a table in Markdown, a row a record in CSV, and the figures."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sipe_bayes.atomic import write_bytes, write_text
from sipe_bayes.benchmark.tables import against
from sipe_bayes.benchmark.transfer import TransferRecord
from sipe_bayes.benchmark.transfer_figures import bars, curves
from sipe_bayes.benchmark.transfer_rows import WORDS, Percent, Row, contrasts, label, rows
from sipe_bayes.benchmark.transfer_run import load
from sipe_bayes.diagnostics.drawing import png

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
    words = [WORDS.get(name, name), WORDS.get(other, other), str(targets), _spread(gains), verdict]
    return f"| {' | '.join(words)} |"


def _spread(values: Sequence[float], digits: int = 1) -> str:
    """Mean and standard error."""
    error = f" ± {np.std(values, ddof=1) / len(values) ** 0.5:.{digits}f}" if len(values) > 1 else ""
    return f"{np.mean(values):.{digits}f}{error}"


def _line(row: Row) -> str:
    entries = [
        *(
            WORDS.get(row.name, row.name),
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
