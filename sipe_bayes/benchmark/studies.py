"""The two studies: the benchmark's estimates, and the transfer's agents that are trained under them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from sipe_bayes.benchmark import cells, status
from sipe_bayes.benchmark.cells import Cell, Suite
from sipe_bayes.benchmark.measure import ESTIMATES
from sipe_bayes.benchmark.run import AnyMeasurement
from sipe_bayes.benchmark.transfer import status as transfer_status
from sipe_bayes.benchmark.transfer import study as transfer
from sipe_bayes.benchmark.transfer.measure import AGENTS


class StudySummary(Protocol):
    """How far a folder of results is."""

    def to_dict(self) -> dict[str, object]:
        """As JSON has it."""

    def lines(self) -> list[str]:
        """To be read."""


@dataclass(frozen=True)
class Study:
    """What the command line needs of a study.

    Args:
        name: of its commands.
        unit: what one result is.
        kind: how a cell is measured.
        suites: of cells.
        select: cells of a suite whose ids match patterns.
        describe: a cell in a line.
        summary: how far a folder is.
    """

    name: str
    unit: str
    kind: AnyMeasurement
    suites: Mapping[str, Suite]
    select: Callable[[str, Sequence[str]], list[Cell]]
    describe: Callable[[Cell], str]
    summary: Callable[[Path], StudySummary]


BENCHMARK = Study("benchmark", "cell", ESTIMATES, cells.SUITES, cells.select, lambda c: c.id, status.summary)
TRANSFER = Study(
    "transfer",
    "unit",
    AGENTS,
    transfer.SUITES,
    transfer.select,
    lambda c: f"{c.id} ({c.training:,} control steps)",
    transfer_status.summary,
)
