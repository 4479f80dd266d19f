"""Records: what a cell of the benchmark came to.

A folder of results holds ``records/ID.json`` for each finished cell, with ``/`` of its id as ``__``; beside it
``records/ID.nc``, the posterior (ArviZ, physical units); and ``plan.json``, every cell that was ever asked for, so that
what is missing can be said.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields
from functools import cache
from pathlib import Path
from typing import ClassVar, Literal, Self, TypeVar

from pydantic import TypeAdapter

from sipe_bayes.benchmark.cells import Value
from sipe_bayes.core.files import OutputError, read_json, reading, to_json, write_text
from sipe_bayes.diagnostics.scores import Scores

RECORDS = "records"
PLAN = "plan.json"


class RecordError(OutputError):
    """A record that cannot be read."""


@dataclass(frozen=True)
class Look:
    """At an estimate on its way: rollouts so far, and means over parameters; None for what was not scored."""

    rollouts: int
    mean_accuracy: float | None = None
    mean_crps: float | None = None


@dataclass(frozen=True)
class Record:
    """Of one cell, N parameters; all parameters in theta, [0, 1] being the range.

    Args:
        id: ``TASK/ESTIMATOR/SETTING/VARIANT/seedK``.
        task: of ``sipe envs``.
        estimator: its name, or that of a baseline.
        setting: direct, learned_reward, policy, policy_learned_reward, gradient_steps, rollouts or sweep.
        variant: of the environment.
        seed: of the estimator and the trajectory.
        budget: rollouts that the estimator might use.
        steps: control steps of the trajectory.
        status: a failed cell has a traceback and neither mean nor scores.
        values: what the cell sets of the estimator ({"gradient_steps": 3}).
        traceback: of a failed cell.
        seconds: of the method, without the shared simulations of the prior; None for a run that went on after an
            interruption.
        cpu_seconds: the same in CPU time.
        simulation_cpu_seconds: CPU time of the shared simulations.
        rollouts: counted by the estimator.
        warnings: its own.
        names: of the parameters (N,).
        truth: (N,).
        mean: of the estimate (N,).
        sd: of the estimate (N,).
        scores: of the estimate; None of a failed cell.
        determined: which parameters the log determines (the rule: ``benchmark.log``); None out of distribution.
        history: looks along the way, the last one the result.
        log: who acted, "expert" or "excitation", or "policy".
        converged: of a cell with a policy, whether the last one solves simulators drawn from the estimate.
        solved_reference: whether it solves the reference.
        training: control steps of the agent's training.
        agent: its settings that are not DDPG's defaults.
        versions: of the packages that numbers depend on.
        checksums: of model, log and this package's source.
        command: that made the record.
        device: that simulated.
    """

    FOLDER: ClassVar[str] = ""  # of records and plan, in a folder of results
    NONE: ClassVar[str] = "no records; make some with `sipe benchmark run --suite quick"
    NEVER: ClassVar[str] = "no run was started in it; start one with `sipe benchmark run --suite quick"
    # alike in all runs of a cell in one folder:
    FIXED: ClassVar[tuple[str, ...]] = ("budget", "steps", "training", "agent", "device", "versions")

    id: str
    task: str
    estimator: str
    setting: str
    variant: str
    seed: int
    budget: int
    steps: int
    status: Literal["done", "failed"]
    values: dict[str, Value] = field(default_factory=dict)
    traceback: str | None = None
    seconds: float | None = None
    cpu_seconds: float | None = None
    simulation_cpu_seconds: float = 0.0
    rollouts: int = 0
    warnings: list[str] = field(default_factory=list)
    names: list[str] = field(default_factory=list)
    truth: list[float] = field(default_factory=list)
    mean: list[float] = field(default_factory=list)
    sd: list[float] = field(default_factory=list)
    scores: Scores | None = None
    determined: list[bool] | None = None
    history: list[Look] = field(default_factory=list)
    log: str = ""
    converged: bool | None = None
    solved_reference: bool | None = None
    training: int = 0
    agent: dict[str, object] = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=dict)
    checksums: dict[str, str] = field(default_factory=dict)
    command: str = ""
    device: str = "cpu"

    @property
    def done(self) -> bool:
        """Whether the cell was measured."""
        return self.status == "done"

    @property
    def failure(self) -> str:
        """The last line of a failed cell's traceback."""
        return (self.traceback or "?").strip().splitlines()[-1]

    @property
    def scored(self) -> Scores:
        """The scores of a finished cell; raises RecordError where there are none."""
        if self.scores is None:
            raise RecordError(f"{self.id}: has no scores, as it was not measured; run it again with --retry-failed")
        return self.scores

    @property
    def file(self) -> tuple[str, bytes]:
        """Path in a folder of results, and content."""
        return str(record_path(Path(self.FOLDER), self.id)), self.to_json().encode()

    def to_json(self) -> str:
        """The file's text."""
        plain = asdict(self)
        if self.scores is not None:
            plain["scores"] = self.scores.to_dict()
        return to_json(plain, indent=1) + "\n"

    def write(self, folder: Path) -> Path:
        """Write ``records/ID.json`` in a folder of results, atomically."""
        path = record_path(folder, self.id)
        write_text(path, self.to_json())
        return path

    @classmethod
    def read(cls, path: Path) -> Self:
        """A record of this kind.

        Raises:
            RecordError: for a file that is no such record.
        """
        what, remedy = "a record", "delete it, and the cell runs again"
        plain = read_json(path, what, remedy, RecordError)
        with reading(path, what, remedy, RecordError):
            unknown = sorted(set(plain) - {f.name for f in fields(cls)})
            if unknown:
                raise ValueError(f"unknown entry {unknown[0]!r}")
            # what is missing of a failed cell is an empty mapping in earlier files
            given = {k: v for k, v in plain.items() if v != {} or k in _MAPPINGS}
            return _reader(cls).validate_python(given)  # type: ignore[arg-type]

    @classmethod
    def all_in(cls, folder: Path) -> list[Self]:
        """All of this kind in a folder of results, by id.

        Raises:
            RecordError: where there is none, or one cannot be read.
        """
        records = cls.every(folder)
        if not records:
            raise RecordError(f"{folder}: holds {cls.NONE} --out {folder}`")
        return records

    @classmethod
    def every(cls, folder: Path) -> list[Self]:
        """All of this kind in a folder of results, perhaps none; raises RecordError where one cannot be read."""
        return [cls.read(path) for path in sorted((folder / cls.FOLDER / RECORDS).glob("[!.]*.json"))]


_MAPPINGS = ("values", "agent", "versions", "checksums")


R = TypeVar("R", bound=Record)


@cache
def _reader(kind: type[R]) -> TypeAdapter[R]:
    return TypeAdapter(kind)


@dataclass(frozen=True)
class Progress:
    """How far a folder of results is.

    Args:
        folder: its path.
        cells: how many were ever asked for.
        done: how many of them are measured.
        failed: id -> the last line of the traceback.
        missing: ids without a record.
    """

    folder: str
    cells: int
    done: int
    failed: dict[str, str]
    missing: list[str]

    @classmethod
    def of(cls, kind: type[Record], records: Sequence[Record], folder: Path) -> Progress:
        """Of the records of a kind in a folder.

        Args:
            kind: of the records.
            records: those there are.
            folder: of results.

        Raises:
            RecordError: for a folder in which no run was started.
        """
        asked = planned(folder / kind.FOLDER)
        if not asked:
            raise RecordError(f"{folder}: {kind.NEVER} --out {folder}`")
        known = {record.id for record in records}
        failed = {record.id: record.failure for record in records if not record.done}
        missing = [cell for cell in asked if cell not in known]
        return Progress(str(folder), len(asked), sum(record.done for record in records), failed, missing)

    @property
    def headline(self) -> str:
        """The counts in words."""
        counts = f"{self.done} done, {len(self.failed)} failed, {len(self.missing)} missing"
        return f"{self.folder}: {self.cells} cells, {counts}"


def file_name(cell_id: str) -> str:
    """Of a cell's files, without the ending."""
    return cell_id.replace("/", "__")


def record_path(folder: Path, cell_id: str) -> Path:
    """Of a cell's record.

    Args:
        folder: of results.
        cell_id: the cell's.
    """
    return folder / RECORDS / f"{file_name(cell_id)}.json"


def posterior_path(folder: Path, cell_id: str) -> Path:
    """Of a cell's posterior.

    Args:
        folder: of results.
        cell_id: the cell's.
    """
    return folder / RECORDS / f"{file_name(cell_id)}.nc"


def mixed(records: Sequence[Record]) -> list[str]:
    """Tasks, variants and seeds whose cells were given different logs: they do not compare.

    It happens where an agent was installed or trained anew meanwhile.
    """
    logs: dict[str, set[str]] = {}
    for record in records:
        if record.done and record.log != "policy":
            sweep = "/sweep" * (record.setting == "sweep")
            logs.setdefault(f"{record.task}/{record.variant}/seed{record.seed}{sweep}", set()).add(
                record.checksums.get("log", "")
            )
    return [group for group, checksums in logs.items() if len(checksums) > 1]


def planned(folder: Path) -> list[str]:
    """The ids of all cells that were ever asked for in this folder, in order; raises RecordError for a broken file."""
    path = folder / PLAN
    if not path.is_file():
        return []
    what, remedy = "a plan", "delete it and run the suite again"
    plain = read_json(path, what, remedy, RecordError)
    with reading(path, what, remedy, RecordError):
        return TypeAdapter(list[str]).validate_python(plain["cells"])


def plan(folder: Path, cells: Sequence[str]) -> None:
    """Add cells to those that were asked for."""
    every = list(dict.fromkeys([*planned(folder), *cells]))
    write_text(folder / PLAN, to_json({"cells": every}, indent=0) + "\n")
