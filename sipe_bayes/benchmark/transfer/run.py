"""Running transfer cells, and how far a folder is: the benchmark's executors, its locking, resuming and writing.

A folder of results holds the transfer's records and plan in ``transfer/`` beside the benchmark's own; estimates that are lacking are
cells of the benchmark like any other, measured first and there for both.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sipe_bayes.benchmark import run as runs
from sipe_bayes.benchmark.cells import Cell
from sipe_bayes.benchmark.executors.work import Executor, Unit
from sipe_bayes.benchmark.records import plan, posterior_path, record_path
from sipe_bayes.benchmark.status import headline
from sipe_bayes.benchmark.transfer import measure as transfer_measure
from sipe_bayes.benchmark.transfer.study import TransferRecord, cell_of, estimate_of, trained_as
from sipe_bayes.diagnostics.scores import crps
from sipe_bayes.posterior import Posterior

_ROUNDING = 1e-9  # in theta


def run(
    cells: Sequence[Cell],
    folder: Path,
    start: Callable[[], Executor],
    command: str = "",
    retry_failed: bool = False,
    report: runs.Report = print,
) -> int:
    """Measure the cells that have no record in ``folder`` yet, after the estimates that they need; returns how many failed, now or before. Arguments
    and errors as of ``benchmark.run.run``."""
    with runs.claimed(folder):
        left = runs.lacking(cells, folder, retry_failed, transfer_measure.blank_record)
        estimates = {e.id: e for cell in left if (e := estimate_of(cell)) is not None}
        lacking = runs.lacking(estimates.values(), folder, retry_failed)
        plan(folder / TransferRecord.FOLDER, [cell.id for cell in cells])
        before = runs.failures(cells, left, folder, TransferRecord)
        report(f"{runs.there_already(cells, left, before)}; {len(lacking)} estimates to make first")
        if not left:
            return before
        plan(folder, [cell.id for cell in lacking])
        mine = {cell.id for cell in left}
        units = [
            *runs.units_of(lacking, folder, command),
            *(_unit(cell, lacking, mine, folder, command) for cell in left),
        ]
        return before + runs.carried_out(units, folder, start, command, report)


def _unit(cell: Cell, lacking: Sequence[Cell], mine: set[str], folder: Path, command: str) -> Unit:
    """An agent, which waits for its estimate, and for the cell that shares its training."""
    estimate, twin = estimate_of(cell), trained_as(cell)
    needs = [estimate.id] if estimate is not None and estimate in lacking else []
    needs += [twin.id] if twin != cell and twin.id in mine else []
    return runs.unit(transfer_measure, cell, folder, command, needs)


def load(folder: Path) -> list[TransferRecord]:
    """All records of the transfer in a folder of results, by id; raises RecordError where there is none."""
    return TransferRecord.all_in(folder)


def believed(records: Sequence[TransferRecord], folder: Path) -> dict[str, Posterior | str]:
    """What each finished agent's episodes drew from, by record, as far as its estimate is there; or why that is another one now."""
    found: dict[str, Posterior | str] = {}
    for record in (r for r in records if r.done):
        cell = cell_of(record)
        estimate = estimate_of(cell)
        paths = [] if estimate is None else [record_path(folder, estimate.id), posterior_path(folder, estimate.id)]
        if not all(path.is_file() for path in paths):
            continue
        try:
            posterior = transfer_measure.randomization(cell, folder).posterior
        except ValueError as error:
            found[record.id] = str(error)
            continue
        now, then = [posterior.mean.numpy(), posterior.stddev.numpy()], [record.mean, record.sd]
        found[record.id] = (
            posterior if np.allclose(now, then, rtol=0, atol=_ROUNDING) else "its estimate was measured anew"
        )
    return found


def stale(found: dict[str, Posterior | str]) -> dict[str, str]:
    """Agents that were trained under another posterior than their estimate's record has now, and why."""
    return {cell: why for cell, why in found.items() if isinstance(why, str)}


def qualities(records: Sequence[TransferRecord], found: dict[str, Posterior | str]) -> dict[str, float]:
    """Mean CRPS, in theta, of what each agent's episodes drew from, by record."""
    there = ((r, found.get(r.id)) for r in records)
    return {r.id: float(crps(drawn, np.array(r.truth)).mean()) for r, drawn in there if isinstance(drawn, Posterior)}


def summary(folder: Path) -> dict[str, Any]:
    """How far a folder is, as plain data; raises RecordError for one without a transfer."""
    records, found = TransferRecord.progress(folder)
    done = [r for r in records if r.done]
    seconds = {trained_as(cell_of(r)).id: r.seconds or 0.0 for r in done}  # of a shared training once
    returns = {r.id: r.evaluation["mean"] for r in done}
    return {
        **found,
        "stale": stale(believed(records, folder)),
        "returns": returns,
        "training_seconds": sum(seconds.values()),
    }


def lines(found: dict[str, Any]) -> list[str]:
    """``summary`` to be read."""
    said = [f"{headline(found)}; {found['training_seconds']:.0f} s of training"]
    said += [f"{cell}: return {earned:.1f}" for cell, earned in found["returns"].items()]
    said += [f"stale: {cell}: {why}; delete its record, and run again" for cell, why in found["stale"].items()]
    said += [f"failed: {cell}: {why}" for cell, why in found["failed"].items()]
    return said + [f"missing: {cell}" for cell in found["missing"]]
