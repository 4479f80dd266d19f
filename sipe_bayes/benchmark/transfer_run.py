"""Running transfer cells, and how far a folder is: the benchmark's executors, its locking, resuming and writing.

A folder of results holds the transfer's records and plan in ``transfer/`` beside the benchmark's own; estimates that are lacking are
cells of the benchmark like any other, measured first and there for both.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from sipe_bayes.benchmark import run as runs
from sipe_bayes.benchmark import transfer_measure
from sipe_bayes.benchmark.cells import Cell
from sipe_bayes.benchmark.records import plan
from sipe_bayes.benchmark.status import headline
from sipe_bayes.benchmark.transfer import TransferRecord, estimate_of
from sipe_bayes.benchmark.work import Executor, Unit


def run(
    cells: Sequence[Cell],
    folder: Path,
    start: Callable[[], Executor],
    command: str = "",
    retry_failed: bool = False,
    report: runs.Report = print,
) -> int:
    """Measure the cells that have no record in ``folder`` yet, after the estimates that they need; returns how many failed. Arguments
    and errors as of ``benchmark.run.run``."""
    with runs.claimed(folder):
        left = runs.lacking(cells, folder, retry_failed, transfer_measure.blank_record)
        estimates = {e.id: e for cell in left if (e := estimate_of(cell)) is not None}
        lacking = runs.lacking(estimates.values(), folder, retry_failed)
        plan(folder / TransferRecord.FOLDER, [cell.id for cell in cells])
        report(
            f"{len(cells)} cells, {len(cells) - len(left)} of them there already; {len(lacking)} estimates to make first"
        )
        if not left:
            return 0
        plan(folder, [cell.id for cell in lacking])
        units = [*runs.units_of(lacking, folder, command), *(_unit(cell, lacking, folder, command) for cell in left)]
        return runs.carried_out(units, folder, start, command, report)


def _unit(cell: Cell, lacking: Sequence[Cell], folder: Path, command: str) -> Unit:
    estimate = estimate_of(cell)
    needs = [estimate.id] if estimate is not None and estimate in lacking else []
    return runs.unit(transfer_measure, cell, folder, command, needs)


def load(folder: Path) -> list[TransferRecord]:
    """All records of the transfer in a folder of results, by id; raises RecordError where there is none."""
    return TransferRecord.all_in(folder)


def summary(folder: Path) -> dict[str, Any]:
    """How far a folder is, as plain data; raises RecordError for one without a transfer."""
    records, found = TransferRecord.progress(folder)
    done = [r for r in records if r.done]
    returns = {r.id: r.evaluation["mean"] for r in done}
    return {**found, "returns": returns, "training_seconds": sum(r.seconds or 0.0 for r in done)}


def lines(found: dict[str, Any]) -> list[str]:
    """``summary`` to be read."""
    said = [f"{headline(found)}; {found['training_seconds']:.0f} s of training"]
    said += [f"{cell}: return {earned:.1f}" for cell, earned in found["returns"].items()]
    said += [f"failed: {cell}: {why}" for cell, why in found["failed"].items()]
    return said + [f"missing: {cell}" for cell in found["missing"]]
