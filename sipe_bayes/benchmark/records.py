"""Records: what a cell of the benchmark came to.

A folder of results holds ``records/ID.json`` for each finished cell, with ``/`` of its id as ``__``; beside it ``records/ID.nc``, the
posterior (ArviZ, physical units); and ``plan.json``, every cell that was ever asked for, so that what is missing can be said.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, ClassVar, Literal, Self

from sipe_bayes.core.files import OutputError, to_json, write_text

RECORDS = "records"
PLAN = "plan.json"


class RecordError(OutputError):
    """A record that cannot be read."""


@dataclass(frozen=True)
class Record:
    """Of one cell, N parameters; all parameters in theta, [0, 1] being the range.

    id: ``TASK/ESTIMATOR/SETTING/VARIANT/seedK``; setting: direct, learned_reward, policy, policy_learned_reward, gradient_steps,
    rollouts or sweep; values: what the cell sets of the estimator ({"gradient_steps": 3}). steps: control steps of the trajectory.
    status: a failed cell has a traceback and neither mean nor scores. seconds and cpu_seconds: of the method, without the shared
    simulations of the prior, whose CPU time is simulation_cpu_seconds; None for a run that went on after an interruption. rollouts:
    counted by the estimator. scores: ``diagnostics.scores.Scores.to_dict``. determined: which parameters the log determines (the
    rule: ``benchmark.log``); None out of distribution. history: rows of rollouts, mean_accuracy, mean_crps (None with a policy)
    along the way, the last one the result. log: who acted, "expert" or "excitation", or "policy". converged: of a cell with a
    policy, whether the last one solves simulators drawn from the estimate; solved_reference: whether it solves the reference; training:
    its control steps; agent: settings that are not DDPG's defaults.
    """

    FOLDER: ClassVar[str] = ""  # of records and plan, in a folder of results
    NONE: ClassVar[str] = "no records; make some with `sipe benchmark run --suite quick"
    NEVER: ClassVar[str] = "no run was started in it; start one with `sipe benchmark run --suite quick"
    # alike in all runs of a cell in one folder:
    FIXED: ClassVar[tuple[str, ...]] = ("budget", "steps", "training", "agent", "versions")

    id: str
    task: str
    estimator: str
    setting: str
    variant: str
    seed: int
    budget: int
    steps: int
    status: Literal["done", "failed"]
    values: dict[str, Any] = field(default_factory=dict)
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
    scores: dict[str, Any] = field(default_factory=dict)
    determined: list[bool] | None = None
    history: list[dict[str, Any]] = field(default_factory=list)
    log: str = ""
    converged: bool | None = None
    solved_reference: bool | None = None
    training: int = 0
    agent: dict[str, Any] = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=dict)
    checksums: dict[str, str] = field(default_factory=dict)
    command: str = ""

    @property
    def done(self) -> bool:
        return self.status == "done"

    @property
    def failure(self) -> str:
        """The last line of a failed cell's traceback."""
        return (self.traceback or "?").strip().splitlines()[-1]

    @property
    def file(self) -> tuple[str, bytes]:
        """Path in a folder of results, and content."""
        return str(record_path(Path(self.FOLDER), self.id)), self.to_json().encode()

    def to_json(self) -> str:
        return to_json(asdict(self), indent=1) + "\n"

    def write(self, folder: Path) -> Path:
        """Write ``records/ID.json`` in a folder of results, atomically."""
        path = record_path(folder, self.id)
        write_text(path, self.to_json())
        return path

    @classmethod
    def read(cls, path: Path) -> Self:
        """Raises RecordError for a file that is no record."""
        try:
            found = json.loads(path.read_text(encoding="utf-8"))
            known = {f.name for f in fields(cls)}
            unknown = sorted(set(found) - known)
            if unknown:
                raise TypeError(f"unknown entry {unknown[0]!r}")
            record = cls(**found)
        except (OSError, ValueError, TypeError) as error:
            raise RecordError(
                f"{path}: cannot be read as a record ({error}); delete it, and the cell runs again"
            ) from None
        return record

    @classmethod
    def all_in(cls, folder: Path) -> list[Self]:
        """All of this kind in a folder of results, by id; raises RecordError where there is none, or one cannot be read."""
        found = cls.every(folder)
        if not found:
            raise RecordError(f"{folder}: holds {cls.NONE} --out {folder}`")
        return found

    @classmethod
    def progress(cls, folder: Path) -> tuple[list[Self], dict[str, Any]]:
        """Those in a folder of results, perhaps none, and how far it is, as plain data; raises RecordError for a folder in which no run
        was started."""
        asked = planned(folder / cls.FOLDER)
        if not asked:
            raise RecordError(f"{folder}: {cls.NEVER} --out {folder}`")
        records = cls.every(folder)
        known = {record.id for record in records}
        return records, {
            "folder": str(folder),
            "cells": len(asked),
            "done": sum(record.done for record in records),
            "failed": {record.id: record.failure for record in records if not record.done},
            "missing": [cell for cell in asked if cell not in known],
        }

    @classmethod
    def every(cls, folder: Path) -> list[Self]:
        """All of this kind in a folder of results, perhaps none; raises RecordError where one cannot be read."""
        return [cls.read(path) for path in sorted((folder / cls.FOLDER / RECORDS).glob("[!.]*.json"))]


def file_name(cell_id: str) -> str:
    """Of a cell's files, without the ending."""
    return cell_id.replace("/", "__")


def record_path(folder: Path, cell_id: str) -> Path:
    return folder / RECORDS / f"{file_name(cell_id)}.json"


def posterior_path(folder: Path, cell_id: str) -> Path:
    return folder / RECORDS / f"{file_name(cell_id)}.nc"


def load_all(folder: Path) -> list[Record]:
    """All records of a folder of results, by id; raises RecordError where there is none, or one cannot be read."""
    return Record.all_in(folder)


def mixed(records: Sequence[Record]) -> list[str]:
    """Tasks, variants and seeds whose cells were given different logs, as an agent was installed or trained anew meanwhile: they do
    not compare."""
    logs: dict[str, set[str]] = {}
    for record in records:
        if record.done and record.log != "policy":
            group = f"{record.task}/{record.variant}/seed{record.seed}" + (
                "/sweep" if record.setting == "sweep" else ""
            )
            logs.setdefault(group, set()).add(record.checksums["log"])
    return [group for group, found in logs.items() if len(found) > 1]


def planned(folder: Path) -> list[str]:
    """The ids of all cells that were ever asked for in this folder, in order."""
    path = folder / PLAN
    if not path.is_file():
        return []
    try:
        return [str(cell) for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise RecordError(f"{path}: cannot be read ({error}); delete it and run the suite again") from None


def plan(folder: Path, cells: list[str]) -> None:
    """Add cells to those that were asked for."""
    every = list(dict.fromkeys([*planned(folder), *cells]))
    write_text(folder / PLAN, to_json({"cells": every}, indent=0) + "\n")
