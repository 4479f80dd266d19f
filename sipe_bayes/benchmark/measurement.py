"""Measuring a cell, whatever its kind: a blank record, what came of the measurement as files and a line, what failed.

The benchmark's estimates and the transfer's agents are the two kinds; each is a ``Measurement``.
"""

from __future__ import annotations

import hashlib
import time
import traceback
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import ClassVar, Generic, TypeVar

from sipe_bayes.benchmark.cells import Cell
from sipe_bayes.benchmark.executors.work import Done
from sipe_bayes.benchmark.records import Record
from sipe_bayes.core.files import installed_version, no_room, scratch

R = TypeVar("R", bound=Record)
T = TypeVar("T")
Files = tuple[tuple[str, bytes], ...]
"""Path in the folder of results, and content."""

POLICIES, CHECKPOINTS = "policies", "checkpoint"  # a checkpoint holds a replay buffer, which nothing needs at the end
_PACKAGES = ("sipe-bayes", "mujoco", "numpy", "scipy", "torch", "sbi", "botorch")


class Measurement(ABC, Generic[R]):
    """One kind of cell and how it is measured.

    A kind says which ``record_type`` it makes, fills it in ``measured``, and names the estimates that its cells need.
    """

    record_type: ClassVar[type[Record]]

    @abstractmethod
    def blank(self, cell: Cell, command: str = "") -> R:
        """A cell's record before it is measured."""

    @abstractmethod
    def measured(self, cell: Cell, record: R, folder: Path) -> tuple[R, Files, str]:
        """Measure a cell.

        Args:
            cell: which.
            record: its blank record.
            folder: of the results, to read from; a training's checkpoints are kept in it.

        Returns:
            The full record, files to be written before it, and a few words.
        """

    def trained_in(self, cell: Cell) -> str:
        """The folder of a cell's training, in that of the results; empty where nothing is trained."""
        return ""

    def needs(self, cell: Cell) -> Cell | None:
        """The estimate that has to be there before a cell is measured, if any."""
        return None

    def alike(self, cell: Cell) -> Cell:
        """The cell whose training a cell shares; itself where it shares none."""
        return cell

    def run(self, cell: Cell, folder: Path, command: str) -> Done:
        """What a cell comes to, whatever happens.

        Args:
            cell: which.
            folder: of the results. Where it is not there, as this is another machine, the cell makes what it needs.
            command: that asked for it.
        """
        began, record = time.process_time(), self.blank(cell, command)
        try:
            with _at_hand(folder) as here, warnings.catch_warnings():
                warnings.simplefilter("ignore")
                full, files, line = self.measured(cell, record, here)
        except Exception as error:  # a failed cell must not stop the others
            if no_room(error) is not None:  # of which no cell is at fault
                raise
            return _failed(record, traceback.format_exc(), time.process_time() - began)
        trained = self.trained_in(cell)
        spent = f"{trained}/{CHECKPOINTS}" if trained else ""
        return Done((*files, full.file), line, time.process_time() - began, spent=spent)

    def died(self, cell: Cell, folder: Path, command: str, why: str) -> Done:
        """What a cell comes to whose process does not live to tell.

        Args:
            cell: which.
            folder: of the results.
            command: that asked for it.
            why: it did not.
        """
        return _failed(self.blank(cell, command), why)


def entries(cell: Cell, command: str) -> dict[str, object]:
    """What every record says of its cell."""
    return {
        "id": cell.id,
        "task": cell.task,
        "estimator": cell.estimator,
        "setting": cell.setting,
        "variant": cell.variant,
        "seed": cell.seed,
        "budget": cell.budget,
        "steps": cell.horizon,
        "status": "done",
        "values": dict(cell.values),
        "versions": versions(),
        "checksums": {"source": source()},
        "command": command,
        "device": cell.device,
    }


def _failed(record: Record, why: str, cpu_seconds: float = 0.0) -> Done:
    """What a cell comes to that was not measured. why: a traceback, or its last line."""
    record = replace(record, status="failed", traceback=why)
    return Done((record.file,), record.failure, cpu_seconds, True)


@contextmanager
def _at_hand(folder: Path) -> Iterator[Path]:
    """The folder, or where it is not there an empty one for the time being."""
    if folder.is_dir():
        yield folder
    else:
        with scratch() as instead:
            yield instead


class Clock:
    """Seconds and CPU seconds spent in what is timed."""

    def __init__(self) -> None:
        self.seconds = self.cpu_seconds = 0.0

    def time(self, call: Callable[[], T]) -> T:
        """Call, and count what it took."""
        began, cpu = time.perf_counter(), time.process_time()
        try:
            return call()
        finally:
            self.seconds += time.perf_counter() - began
            self.cpu_seconds += time.process_time() - cpu


def versions(packages: Sequence[str] = _PACKAGES) -> dict[str, str]:
    """Of this package and those that numbers depend on, "" for one that is not installed."""
    return {package: installed_version(package) for package in packages}


@cache
def source() -> str:
    """A digest of this package's code: two records of one version may stem from different states of it."""
    root, digest = Path(__file__).parents[1], hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        digest.update(str(path.relative_to(root)).encode() + path.read_bytes())
    return digest.hexdigest()[:12]
