"""Running cells: what is not there yet is measured, each result is written once, and the same command goes on after any interruption.

First the simulations that several estimators share (``bank``), then the cells. Units of work return their files, and this process alone
writes them, each under a temporary name and renamed, a record after its posterior: a record that exists is whole.
"""

from __future__ import annotations

import fcntl
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

from sipe_bayes.benchmark import bank, measure, spent
from sipe_bayes.benchmark.bank import Bank
from sipe_bayes.benchmark.cells import BASELINES, Cell
from sipe_bayes.benchmark.executors.work import Done, Executor, Unit
from sipe_bayes.benchmark.records import Record, plan
from sipe_bayes.core.files import OutputError, write_bytes

_LOCK = ".lock"
Report = Callable[[str], None]


def run(
    cells: Sequence[Cell],
    folder: Path,
    start: Callable[[], Executor],
    command: str = "",
    retry_failed: bool = False,
    report: Report = print,
) -> int:
    """Measure the cells that have no record in ``folder`` yet; returns how many failed, now or before. start: makes the executor, once
    the folder is found fit. retry_failed: measure failed ones again. Raises OutputError for a folder with records of other versions,
    budgets, lengths or agents, or that another run is at work in, and OSError where it cannot be written."""
    with claimed(folder):
        left = lacking(cells, folder, retry_failed)
        plan(folder, [cell.id for cell in cells])
        before = failures(cells, left, folder)
        report(there_already(cells, left, before))
        if not left:
            return before
        return before + carried_out(units_of(left, folder, command), folder, start, command, report)


def failures(cells: Sequence[Cell], left: Sequence[Cell], folder: Path, kind: type[Record] = Record) -> int:
    """How many of the cells that are not measured now have failed before."""
    there = {cell.id for cell in cells} - {cell.id for cell in left}
    return sum(not record.done for record in kind.every(folder) if record.id in there)


def there_already(cells: Sequence[Cell], left: Sequence[Cell], failed: int) -> str:
    text = f"{len(cells)} cells, {len(cells) - len(left)} of them there already"
    return f"{text}, {failed} failed" if failed else text


def simulate(
    which: Bank, budget: int, folder: Path, start: Callable[[], Executor], command: str, report: Report
) -> int:
    """Fill the first ``budget`` rows of a bank; returns how many shards there were to make. Raises as ``run``."""
    with claimed(folder):
        units = bank.shards(which, budget, bank.place(which, folder))
        if units:
            carried_out(units, folder, start, command, report)
        return len(units)


def not_a_file(folder: Path) -> None:
    """Raises OutputError where the folder to write into is a file."""
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"--out {folder}: is a file, not a folder; choose another name")


@contextmanager
def claimed(folder: Path) -> Iterator[None]:
    """The folder, made if need be, for one run at a time."""
    not_a_file(folder)
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / _LOCK).open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise OutputError(
                f"--out {folder}: another run is at work in it; wait for it, or choose another folder"
            ) from None
        yield


def lacking(
    cells: Iterable[Cell], folder: Path, retry_failed: bool, blank: Callable[[Cell, str], Record] = measure.blank_record
) -> list[Cell]:
    """The cells that have no record in a folder of results, or with retry_failed a failed one. blank: makes their records. Raises
    OutputError for a record with other entries than its cell's, and for one of any cell that other versions made."""
    asked = [(cell, blank(cell, "")) for cell in cells]
    if not asked:
        return []
    kind = asked[0][1]
    there = {record.id: record for record in kind.every(folder)}
    for record in there.values():
        _alike(record, kind, ("versions",), folder)
    for _, mine in asked:
        if mine.id in there:
            _alike(there[mine.id], mine, mine.FIXED, folder)
    return [cell for cell, mine in asked if mine.id not in there or (retry_failed and not there[mine.id].done)]


def _alike(found: Record, mine: Record, names: Iterable[str], folder: Path) -> None:
    for name in names:
        there, here = getattr(found, name), getattr(mine, name)
        if there != here:
            raise OutputError(
                f"--out {folder}: holds {found.id} with {name} {_differing(there, here)} and not {_differing(here, there)}; "
                "choose another folder"
            )


def _differing(one: Any, other: Any) -> Any:
    """Of two dictionaries, what differs in the first."""
    if not isinstance(one, dict):
        return one
    return ", ".join(f"{k} {v}" for k, v in one.items() if other.get(k) != v) or "fewer entries"


def units_of(cells: Sequence[Cell], folder: Path, command: str) -> list[Unit]:
    """Shards of simulations first, and then the cells, which wait for theirs."""
    banks: dict[Bank, int] = {}
    for cell in cells:
        which = _bank(cell)
        if which is not None:
            banks[which] = max(banks.get(which, 0), cell.budget)
    made = {which: bank.shards(which, budget, bank.known_place(which, folder)) for which, budget in banks.items()}
    units = [shard for shards in made.values() for shard in shards]
    for cell in cells:
        which = _bank(cell)
        needs = [shard.name for shard in made[which]] if which is not None else []
        units.append(unit(measure, cell, folder, command, needs))
    return units


def unit(kind: ModuleType, cell: Cell, folder: Path, command: str, needs: Iterable[str] = ()) -> Unit:
    """Measuring a cell. kind: ``measure``, or another module with its ``run`` and ``died``."""
    arguments = {"cell": cell, "folder": folder.resolve(), "command": command}
    return Unit(cell.id, kind.run, arguments, kind.died, frozenset(needs))


def _bank(cell: Cell) -> Bank | None:
    """The simulations that a cell shares with others."""
    from sipe_bayes.inference.amortised.prior_sampling import PriorSampling
    from sipe_bayes.inference.registry import estimator_class

    alone = cell.estimator in BASELINES or cell.with_policy or cell.split != "reference"
    if alone or not issubclass(estimator_class(cell.estimator), PriorSampling):
        return None
    return Bank(cell.task, cell.variant, cell.seed, cell.horizon)


def carried_out(units: list[Unit], folder: Path, start: Callable[[], Executor], command: str, report: Report) -> int:
    """Submit what needs nothing more, write what comes back, until nothing is left; returns the number of failures."""
    waiting, written, failed = {unit.name: unit for unit in units}, set[str](), 0
    with start() as executor:
        log = _Log(folder, command, executor.workers, sum(unit.name.startswith("simulations/") for unit in units))
        flying = 0
        while waiting or flying:
            for unit in [u for u in waiting.values() if not (u.needs - written)]:
                executor.submit(waiting.pop(unit.name))
                flying += 1
            unit, done = executor.next()
            flying -= 1
            _write(done, folder)
            written.add(unit.name)
            failed += done.failed
            log.add(unit, done)
            mark = "failed: " if done.failed else ""
            report(f"{len(written)}/{len(units)} {unit.name} {mark}{done.line}")
    return failed


def _write(done: Done, folder: Path) -> None:
    for name, data in done.files:
        write_bytes(folder / name, data)
    if done.spent:
        shutil.rmtree(folder / done.spent, ignore_errors=True)


class _Log:
    """``runs.json``: what each run took, kept up to date: seconds and CPU seconds, also of its simulations alone."""

    def __init__(self, folder: Path, command: str, workers: int, shards: int) -> None:
        self._folder, self._began, self._shards = folder, time.perf_counter(), shards
        self._before = spent.runs(folder)
        self._row: dict[str, Any] = {
            "command": command,
            "started": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
            "workers": workers,
            "units": 0,
            "seconds": 0.0,
            "cpu_seconds": 0.0,
            "simulating": {"seconds": 0.0, "cpu_seconds": 0.0},
        }

    def add(self, unit: Unit, done: Done) -> None:
        now = time.perf_counter() - self._began
        self._row = {**self._row, "units": self._row["units"] + 1, "seconds": now}
        self._row["cpu_seconds"] += done.cpu_seconds
        if self._shards and unit.name.startswith("simulations/"):
            self._shards -= 1
            cpu = self._row["simulating"]["cpu_seconds"] + done.cpu_seconds
            self._row["simulating"] = {"seconds": now, "cpu_seconds": cpu}
        spent.keep(self._folder, [*self._before, self._row])


def changed(cells: Sequence[Cell], **changes: Any) -> list[Cell]:
    """Cells with another budget, length or training, where one is given."""
    given = {name: value for name, value in changes.items() if value is not None}
    return [replace(cell, **given) for cell in cells] if given else list(cells)
