"""An entry: a folder with ``entry.json``, what made it, and ``tasks/TASK.json``, what it says of each task's logs.

Anybody may write one, with any program: nothing of it is run. What it may hold is stated by the dataclasses here and
checked against the task before a number of it is used: physical values (M, N) in the order of the task's parameters,
finite, within the prior's bounds, M draws of a posterior or one point.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Self, TypeVar

import numpy as np
from pydantic import TypeAdapter

from sipe_bayes.benchmark.leaderboard.task import VERSION, Problem, Task
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.files import FileError, read_json, reading, to_json, write_text

ENTRY, FOLDER = "entry.json", "tasks"
FORMAT = "sipe_bayes.leaderboard/1"
MOST_DRAWS = 2000
_ROUNDING = 1e-5  # of a range: values are written with six digits, and clipped by so much


class EntryError(FileError):
    """An entry that is not scored; the message is one line with the file, what is wrong and the remedy."""


@dataclass(frozen=True)
class Entry:
    """What made an entry.

    Args:
        method: a name, which the page shows.
        command: that made it.
        seeds: of the method.
        packages: package -> version, of those that the numbers depend on.
        about: a sentence for people.
        version: of the tasks.
        format: of the files.
    """

    method: str
    command: str
    seeds: list[int]
    packages: dict[str, str]
    about: str = ""
    version: str = VERSION
    format: str = FORMAT

    def write(self, folder: Path) -> None:
        """Write ``entry.json``, whole or not at all."""
        write_text(folder / ENTRY, to_json(asdict(self), indent=1) + "\n")

    @classmethod
    def read(cls, folder: Path) -> Self:
        """That of a folder; raises EntryError for a folder that is no entry of these tasks."""
        path = folder / ENTRY
        if not path.is_file():
            raise EntryError(f"{path}: no such file; `sipe leaderboard run METHOD --out {folder}` writes an entry")
        entry = _read(path, cls)
        if entry.format != FORMAT:
            raise EntryError(f"{path}: format {entry.format!r}; expected {FORMAT!r}")
        if entry.version != VERSION:
            raise EntryError(
                f"{path}: made for version {entry.version!r} of the tasks, these are {VERSION!r}; run the method again"
            )
        if not entry.method.strip():
            raise EntryError(f"{path}: method is empty; give it a name")
        return entry


@dataclass(frozen=True)
class Answer:
    """What a method says of one log.

    Args:
        values: physical, (M, N): draws of a posterior, or one row for a point; none where it failed.
        rollouts: that it simulated for this log.
        cpu_seconds: that it took for this log; what is learned once for several counts where it was learned.
        failure: why there are no values.
        predicts: physical, (N,): what held-out logs are predicted with; default the mean of ``values``. Of a wrong
            model the values that predict best are not the machine's own.
    """

    values: list[list[float]] = field(default_factory=list)
    rollouts: int = 0
    cpu_seconds: float = 0.0
    failure: str = ""
    predicts: list[float] = field(default_factory=list)


@dataclass(frozen=True)
class Answers:
    """What a method says of a task.

    Args:
        task: its name.
        definition: of the task (``Task.definition``), which changes with its truths, bounds and budget.
        parameters: names, in the order of the values' columns.
        logs: log -> answer.
        version: of the tasks.
    """

    task: str
    definition: str
    parameters: list[str]
    logs: dict[str, Answer]
    version: str = VERSION

    def write(self, folder: Path) -> None:
        """Write ``tasks/TASK.json`` of an entry's folder, whole or not at all."""
        plain = {**vars(self), "logs": {name: _plain(answer) for name, answer in self.logs.items()}}
        write_text(answers_path(folder, self.task), to_json(plain) + "\n")


def answers_path(folder: Path, task: str) -> Path:
    """Of an entry's answers to a task."""
    return folder / FOLDER / f"{task}.json"


def answered(folder: Path) -> list[str]:
    """The names of an entry's task files."""
    return sorted(path.stem for path in (folder / FOLDER).glob("[!.]*.json"))


def read_answers(folder: Path, task: Task, problem: Problem) -> Answers | None:
    """An entry's answers to a task, checked against it; None where there are none.

    Raises:
        EntryError: for a file that is not what it should be, or is of another version of the task.
    """
    path = answers_path(folder, task.name)
    if not path.is_file():
        return None
    answers = _read(path, Answers)
    wanted = task.definition(problem)
    if (answers.task, answers.version) != (task.name, VERSION) or answers.definition != wanted:
        raise EntryError(
            f"{path}: made for {answers.task} of version {answers.version!r}, definition {answers.definition!r}; "
            f"expected {task.name}, {VERSION!r}, {wanted!r}: run the method on this version of the task"
        )
    if answers.parameters != list(problem.space.names):
        raise EntryError(f"{path}: parameters {answers.parameters}; expected {list(problem.space.names)}, in order")
    unknown = sorted(set(answers.logs) - {case.name for case in problem.cases})
    if unknown:
        raise EntryError(
            f"{path}: log {unknown[0]!r} is none of the task's; expected {', '.join(c.name for c in problem.cases)}"
        )
    for name, answer in answers.logs.items():
        check_answer(f"{path}: log {name!r}", answer, problem)
    return answers


def theta_of(answer: Answer, problem: Problem) -> FloatArray:
    """The answer's points (M, N) in theta; values that rounding put outside the bounds are on them."""
    return np.clip(problem.space.normalise(np.array(answer.values)), 0.0, 1.0)


def predicting(answer: Answer, problem: Problem) -> FloatArray:
    """The theta (N,) that held-out logs are predicted with."""
    if not answer.predicts:
        return np.asarray(theta_of(answer, problem).mean(0))
    return np.clip(problem.space.normalise(np.array(answer.predicts)), 0.0, 1.0)


def _plain(answer: Answer) -> dict[str, object]:
    return {name: value for name, value in vars(answer).items() if name != "predicts" or value}


def rounded(values: FloatArray) -> list[list[float]]:
    """Values (M, N) to six digits, as they are written."""
    return [[float(f"{x:.6g}") for x in row] for row in values]


def check_answer(where: str, answer: Answer, problem: Problem) -> None:
    """Raises EntryError, which begins with ``where``, for an answer that cannot be scored."""
    if answer.rollouts < 0 or not 0 <= answer.cpu_seconds < np.inf:
        raise EntryError(
            f"{where}: rollouts {answer.rollouts}, cpu_seconds {answer.cpu_seconds}; expected neither below zero"
        )
    if bool(answer.failure) == bool(answer.values):
        raise EntryError(f"{where}: expected values or a failure, got {'both' if answer.values else 'neither'}")
    if answer.failure:
        return
    _check_rows(f"{where}: values", answer.values, problem)
    if answer.predicts:
        _check_rows(f"{where}: predicts", [answer.predicts], problem)


def _check_rows(where: str, rows: list[list[float]], problem: Problem) -> None:
    """Raises EntryError for rows that are no physical values of the problem's parameters."""
    size, widths = len(problem.space), {len(row) for row in rows}
    if widths != {size} or len(rows) > MOST_DRAWS:
        shape = f"{len(rows)} rows of {', '.join(map(str, sorted(widths)))} numbers"
        raise EntryError(f"{where} of {shape}; expected at most {MOST_DRAWS} rows of {size}, a parameter each")
    theta = problem.space.normalise(np.array(rows))
    if not np.isfinite(theta).all():
        count = int((~np.isfinite(theta)).any(1).sum())
        raise EntryError(f"{where}: NaN, infinity or what has no logarithm in {count} rows; a failed log has `failure`")
    outside = ((theta < -_ROUNDING) | (theta > 1 + _ROUNDING)).any(0)
    if outside.any():
        parameter = problem.space[int(outside.argmax())]
        raise EntryError(
            f"{where} of {parameter.name} outside the prior's bounds {parameter.low:g} to {parameter.high:g}; "
            "leave such draws out, or clip them"
        )


T = TypeVar("T")


def _read(path: Path, kind: type[T]) -> T:
    what, remedy = f"an entry's {path.name}", "write it anew, as docs/leaderboard.md says"
    plain = read_json(path, what, remedy, EntryError)
    with reading(path, what, remedy, EntryError):
        unknown: Sequence[str] = sorted(set(plain) - {f.name for f in fields(kind)})  # type: ignore[arg-type]
        if unknown:
            raise ValueError(f"unknown key {unknown[0]!r}")
        return TypeAdapter(kind).validate_python(plain)
