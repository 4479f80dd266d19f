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
from sipe_bayes.benchmark.measure import versions
from sipe_bayes.benchmark.records import RECORDS, RecordError, plan, planned, record_path
from sipe_bayes.benchmark.transfer import TransferRecord, estimate_of
from sipe_bayes.benchmark.transfer_measure import FOLDER
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
        left = [cell for cell in cells if not _finished(cell, folder, retry_failed)]
        estimates = {e.id: e for cell in left if (e := estimate_of(cell)) is not None}
        lacking = [e for e in estimates.values() if not runs.finished(e, folder, retry_failed)]
        plan(folder / FOLDER, [cell.id for cell in cells])
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
    needs = frozenset({estimate.id} if estimate in lacking and estimate is not None else ())
    arguments = {"cell": cell, "folder": folder.resolve(), "command": command}
    return Unit(cell.id, transfer_measure.run, arguments, transfer_measure.died, needs)


def _finished(cell: Cell, folder: Path, retry_failed: bool) -> bool:
    path = record_path(folder / FOLDER, cell.id)
    if not path.is_file():
        return False
    mine: dict[str, Any] = {
        "training": cell.training,
        "budget": cell.budget,
        "steps": cell.horizon,
        "versions": versions(),
    }
    found = TransferRecord.read(path)
    runs.check_alike(cell, folder, found, mine)
    return found.done or not retry_failed


def load(folder: Path) -> list[TransferRecord]:
    """All records of the transfer in a folder of results, by id; raises RecordError where there is none."""
    found = sorted(path for path in (folder / FOLDER / RECORDS).glob("*.json") if not path.name.startswith("."))
    if not found:
        raise RecordError(f"{folder}: holds no transfer; make one with `sipe transfer run --out {folder}`")
    return [TransferRecord.read(path) for path in found]


def summary(folder: Path) -> dict[str, Any]:
    """How far a folder is, as plain data; raises RecordError for one without a transfer."""
    asked = planned(folder / FOLDER)
    if not asked:
        raise RecordError(f"{folder}: no transfer was started in it; start one with `sipe transfer run --out {folder}`")
    records = {r.id: r for r in load(folder)} if any((folder / FOLDER).glob(f"{RECORDS}/[!.]*.json")) else {}
    done = [r for r in records.values() if r.done]
    return {
        "folder": str(folder),
        "cells": len(asked),
        "done": len(done),
        "failed": {r.id: (r.traceback or "?").strip().splitlines()[-1] for r in records.values() if not r.done},
        "missing": [cell for cell in asked if cell not in records],
        "returns": {r.id: r.evaluation["mean"] for r in done},
        "training_seconds": sum(r.seconds or 0.0 for r in done),
    }


def lines(found: dict[str, Any]) -> list[str]:
    """``summary`` to be read."""
    failed, missing = found["failed"], found["missing"]
    said = [
        f"{found['folder']}: {found['cells']} cells, {found['done']} done, {len(failed)} failed, {len(missing)} missing; "
        f"{found['training_seconds']:.0f} s of training"
    ]
    said += [f"{cell}: return {earned:.1f}" for cell, earned in found["returns"].items()]
    said += [f"failed: {cell}: {why}" for cell, why in failed.items()]
    return said + [f"missing: {cell}" for cell in missing]
