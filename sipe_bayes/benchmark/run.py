"""Running cells: what is missing is measured, each result is written once, and the same command goes on after a stop.

First the simulations that several estimators share (``bank``), then the estimates, then the agents that need them.
Units of work return their files, and this process alone writes them, each under a temporary name and renamed, a record
after its posterior: a record that exists is whole.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from sipe_bayes.benchmark import bank
from sipe_bayes.benchmark.bank import Bank
from sipe_bayes.benchmark.cells import BASELINES, Cell
from sipe_bayes.benchmark.executors.work import Done, Executor, Unit
from sipe_bayes.benchmark.measure import ESTIMATES
from sipe_bayes.benchmark.measurement import Measurement
from sipe_bayes.benchmark.records import Record, plan, posterior_path, record_path
from sipe_bayes.benchmark.run_log import Run, read_runs, write_runs
from sipe_bayes.benchmark.transfer.study import TransferRecord
from sipe_bayes.core.files import OutputError, exclusive, write_bytes

Report = Callable[[str], None]
AnyMeasurement = Measurement[Record] | Measurement[TransferRecord]


@dataclass(frozen=True)
class Order:
    """How cells are to be measured.

    Args:
        folder: of results.
        start: makes the executor, once the folder is found fit.
        command: that asks for them.
        retry_failed: measure failed ones again.
        report: is told each result.
    """

    folder: Path
    start: Callable[[], Executor]
    command: str = ""
    retry_failed: bool = False
    report: Report = print


def run(cells: Sequence[Cell], order: Order, kind: AnyMeasurement | None = None) -> int:
    """Measure the cells that have no record yet, after the estimates that they need.

    Args:
        cells: which.
        order: how.
        kind: what is measured of a cell; default estimates.

    Returns:
        How many failed, now or before.

    Raises:
        OutputError: for a folder with records of other versions, budgets, lengths or agents, or that another run is at
            work in.
        OSError: where it cannot be written, or a cell finds the disk full.
    """
    if kind is None:
        return run(cells, order, ESTIMATES)
    folder = order.folder
    with exclusive(folder):
        left = without_record(cells, order, kind)
        estimates = {e.id: e for cell in left if (e := kind.needs(cell)) is not None}
        first = without_record(list(estimates.values()), order, ESTIMATES)
        first += [cell for cell in estimates.values() if cell not in first and _lost_draws(cell, folder)]
        plan(folder / kind.record_type.FOLDER, [cell.id for cell in cells])
        before = _failures(cells, left, folder, kind.record_type)
        text = f"{len(cells)} cells, {len(cells) - len(left)} of them there already" + f", {before} failed" * bool(
            before
        )
        order.report(text if kind is ESTIMATES else f"{text}; {len(first)} estimates to make first")
        if not left:
            return before
        if first:
            plan(folder, [cell.id for cell in first])
        units = _estimate_units(left if kind is ESTIMATES else first, order)
        units += [] if kind is ESTIMATES else _units(left, first, order, kind)
        return before + _carried_out(units, order)


def _lost_draws(cell: Cell, folder: Path) -> bool:
    """Whether a folder has an estimate's record, and not the posterior that it came to."""
    return Record.read(record_path(folder, cell.id)).done and not posterior_path(folder, cell.id).is_file()


def simulate(which: Bank, budget: int, order: Order) -> int:
    """Fill the first rows of a bank of simulations.

    Args:
        which: bank.
        budget: rows.
        order: how.

    Returns:
        How many shards there were to make.

    Raises:
        OutputError: as ``run``.
    """
    with exclusive(order.folder):
        units = bank.shards(which, budget, bank.place(which, order.folder))
        if units:
            _carried_out(units, order)
        return len(units)


def without_record(cells: Sequence[Cell], order: Order, kind: AnyMeasurement) -> list[Cell]:
    """The cells that have no record in a folder of results, or a failed one that is to be measured again.

    Args:
        cells: which.
        order: how; of it the folder and ``retry_failed``.
        kind: of the records.

    Raises:
        OutputError: for a record with other entries than its cell's, and for one of any cell that other versions made.
    """
    blanks = [kind.blank(cell) for cell in cells]
    if not blanks:
        return []
    records = {record.id: record for record in kind.record_type.every(order.folder)}
    for record in records.values():
        _check_alike(record, blanks[0], ("versions",), order.folder)
    for blank in blanks:
        if blank.id in records:
            _check_alike(records[blank.id], blank, blank.FIXED, order.folder)
    missing = {b.id for b in blanks if b.id not in records or (order.retry_failed and not records[b.id].done)}
    return [cell for cell in cells if cell.id in missing]


def _check_alike(record: Record, blank: Record, names: Iterable[str], folder: Path) -> None:
    for name in names:
        kept, asked = getattr(record, name), getattr(blank, name)
        if kept != asked:
            raise OutputError(
                f"--out {folder}: holds {record.id} with {name} {_difference(kept, asked)} and not "
                f"{_difference(asked, kept)}; choose another folder"
            )


def _difference(one: object, other: object) -> object:
    """Of two dictionaries, what differs in the first."""
    if not isinstance(one, dict) or not isinstance(other, dict):
        return one
    return ", ".join(f"{k} {v}" for k, v in one.items() if other.get(k) != v) or "fewer entries"


def _failures(cells: Sequence[Cell], left: Sequence[Cell], folder: Path, kind: type[Record]) -> int:
    """How many of the cells that are not measured now have failed before."""
    kept = {cell.id for cell in cells} - {cell.id for cell in left}
    return sum(not record.done for record in kind.every(folder) if record.id in kept)


# Units of work


def _estimate_units(cells: Sequence[Cell], order: Order) -> list[Unit]:
    """Shards of simulations first, and then the estimates, which wait for theirs."""
    banks: dict[Bank, int] = {}
    for cell in cells:
        which = bank_of(cell)
        if which is not None:
            banks[which] = max(banks.get(which, 0), cell.budget)
    shards = {which: bank.shards(which, size, bank.known_place(which, order.folder)) for which, size in banks.items()}
    units = [shard for made in shards.values() for shard in made]
    for cell in cells:
        which = bank_of(cell)
        needs = [] if which is None else [shard.name for shard in shards[which]]
        units.append(_unit(ESTIMATES, cell, order, needs))
    return units


def _units(cells: Sequence[Cell], first: Sequence[Cell], order: Order, kind: AnyMeasurement) -> list[Unit]:
    """Cells which wait for their estimate, and for the cell that shares their training."""
    now, estimates = {cell.id for cell in cells}, {cell.id for cell in first}
    units = []
    for cell in cells:
        estimate, trained = kind.needs(cell), kind.alike(cell)
        needs = [estimate.id] if estimate is not None and estimate.id in estimates else []
        needs += [trained.id] if trained != cell and trained.id in now else []
        units.append(_unit(kind, cell, order, needs))
    return units


def _unit(kind: AnyMeasurement, cell: Cell, order: Order, needs: Iterable[str]) -> Unit:
    arguments = {"cell": cell, "folder": order.folder.resolve(), "command": order.command}
    return Unit(cell.id, kind.run, arguments, kind.died, frozenset(needs))


def bank_of(cell: Cell) -> Bank | None:
    """The simulations that a cell shares with others, if any."""
    from sipe_bayes.inference.amortised.prior_sampling import PriorSampling
    from sipe_bayes.inference.registry import estimator_class

    alone = cell.estimator in BASELINES or cell.with_policy or cell.split != "reference"
    if alone or not issubclass(estimator_class(cell.estimator), PriorSampling):
        return None
    return Bank(cell.task, cell.variant, cell.seed, cell.horizon, cell.device)


def _carried_out(units: Sequence[Unit], order: Order) -> int:
    """Submit what needs nothing more, write what comes back, until nothing is left; returns the number of failures."""
    waiting, written, failed = {unit.name: unit for unit in units}, set[str](), 0
    with order.start() as executor:
        log, running = _Log(order, executor.workers), 0
        while waiting or running:
            # hand over every unit whose needs are met
            for unit in [u for u in waiting.values() if not (u.needs - written)]:
                executor.submit(waiting.pop(unit.name))
                running += 1
            # write the next one that ends
            unit, done = executor.next()
            running -= 1
            if done.stopped is not None:
                raise done.stopped
            _write(done, order.folder)
            written.add(unit.name)
            failed += done.failed
            log.add(unit, done)
            mark = "failed: " if done.failed else ""
            order.report(f"{len(written)}/{len(units)} {unit.name} {mark}{done.line}")
    return failed


def _write(done: Done, folder: Path) -> None:
    for name, data in done.files:
        write_bytes(folder / name, data)
    if done.spent:
        shutil.rmtree(folder / done.spent, ignore_errors=True)


class _Log:
    """``runs.json``: what each run took, kept up to date."""

    def __init__(self, order: Order, workers: int) -> None:
        self._folder, self._began = order.folder, time.perf_counter()
        self._before = read_runs(order.folder)
        self._run = Run(order.command, time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()), workers)

    def add(self, unit: Unit, done: Done) -> None:
        """Count a unit in."""
        now, simulation = time.perf_counter() - self._began, unit.name.startswith(bank.UNITS)
        self._run = self._run.and_unit(now, done.cpu_seconds, simulation)
        write_runs(self._folder, [*self._before, self._run])
