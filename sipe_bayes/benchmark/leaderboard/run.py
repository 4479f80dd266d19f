"""Making an entry: a method on every log of every task, each log written when it is done.

``run_entry`` serves the library's own estimators (``own_method``) and every other method that is a Python function; a
method of another language writes the same files.
"""

from __future__ import annotations

import argparse
import shlex
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import torch

from sipe_bayes.benchmark.leaderboard.entry import (
    ENTRY,
    Answer,
    Answers,
    Entry,
    EntryError,
    check_answer,
    read_answers,
    rounded,
)
from sipe_bayes.benchmark.leaderboard.registry import chosen
from sipe_bayes.benchmark.leaderboard.scoring import made
from sipe_bayes.benchmark.leaderboard.task import Case, Problem, Task
from sipe_bayes.benchmark.measurement import Clock, versions
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.files import not_a_file
from sipe_bayes.inference.base import Estimator
from sipe_bayes.inference.registry import arguments, estimator_class, get_estimator
from sipe_bayes.posterior import Dirac
from sipe_bayes.simulation.callable_simulator import CallableSimulator

DRAWS = 200
"""Of each log's posterior: the ends of a 90 % interval are known to a tenth of an sd."""
_EACH = 1000  # seeds of draws between those of two seeds of a method: a log has its own
_WRITTEN = 1.0  # s, after which what is done is written again: a kill loses no more
PRIOR = "prior"
"""The method that knows nothing: the zero of CRPS skill."""


@dataclass(frozen=True)
class Estimate:
    """What a method gives for one log.

    Args:
        values: physical (M, N), draws or a point.
        rollouts: that it took.
        predicts: physical (N,), what held-out logs are predicted with; default the mean of ``values``.
    """

    values: FloatArray
    rollouts: int
    predicts: FloatArray | None = None


class Method(Protocol):
    """A method: what it makes of one log. It may keep what it learned of a problem for the next log."""

    def __call__(self, task: Task, problem: Problem, case: Case) -> Estimate:
        """Draws or a point; whatever it raises is a failure of this log.

        Args:
            task: with the budget.
            problem: with simulator, prior, ``observed`` and ``simulate``.
            case: the log; its truth, held-out logs and reference are for the scores alone.
        """
        ...


@dataclass(frozen=True)
class Ran:
    """What a run did, by task: logs measured now, logs that failed, CPU seconds."""

    task: str
    measured: int
    failed: int
    cpu_seconds: float


def run_entry(
    entry: Entry, folder: Path, tasks: Sequence[Task], method: Method, report: Callable[[str], None] = print
) -> list[Ran]:
    """Run a method on tasks; what an earlier run of the same entry finished is not run again.

    Args:
        entry: what is run.
        folder: of the entry.
        tasks: which.
        method: of one log.
        report: is given a line for each task.

    Returns:
        What was done, by task.

    Raises:
        EntryError: for a folder of another entry.
        OutputError: where the folder is a file.
    """
    not_a_file(folder)
    if (folder / ENTRY).exists():
        before = Entry.read(folder)
        if (before.method, before.seeds) != (entry.method, entry.seeds):
            raise EntryError(
                f"--out {folder}: holds the entry of {before.method}, seeds {before.seeds}; this is {entry.method}, "
                f"seeds {entry.seeds}: choose another folder"
            )
    else:
        entry.write(folder)
    return [_run_task(folder, task, method, report) for task in tasks]


def _run_task(folder: Path, task: Task, method: Method, report: Callable[[str], None]) -> Ran:
    problem = made(task.name)
    answers = read_answers(folder, task, problem)
    if answers is None:
        answers = Answers(task.name, task.definition(problem), list(problem.space.names), {})
    left, written = [case for case in problem.cases if case.name not in answers.logs], time.monotonic()
    try:
        for case in left:
            answers = replace(answers, logs={**answers.logs, case.name: _answer(method, task, problem, case)})
            if time.monotonic() - written > _WRITTEN:
                answers.write(folder)
                written = time.monotonic()
    finally:
        if left:
            answers.write(folder)
    failures = [answer.failure for answer in answers.logs.values() if answer.failure]
    seconds = sum(answer.cpu_seconds for answer in answers.logs.values())
    line = f"{task.name}: {len(answers.logs)} logs ({len(left)} now), {seconds:.1f} CPU s"
    report(line + (f", {len(failures)} failed: {failures[0]}" if failures else ""))
    return Ran(task.name, len(left), len(failures), seconds)


def _answer(method: Method, task: Task, problem: Problem, case: Case) -> Answer:
    clock = Clock()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            estimate = clock.time(lambda: method(task, problem, case))
        predicts = [] if estimate.predicts is None else rounded(estimate.predicts[None])[0]
        seconds = round(clock.cpu_seconds, 3)
        answer = Answer(rounded(estimate.values), estimate.rollouts, seconds, predicts=predicts)
        check_answer("estimate", answer, problem)
    except Exception:  # a failure is an answer, and counts as one
        why = " ".join(traceback.format_exc().strip().splitlines()[-1].split())[:300]
        return Answer(cpu_seconds=round(clock.cpu_seconds, 3), failure=why)
    return answer


def run_from_command_line(method: str, about: str, packages: Sequence[str], make: Callable[[int], Method]) -> None:
    """What a script of another library's method does: ``python SCRIPT --out DIR [--tasks TASK ...] [--seed N]``.

    Args:
        method: its name on the page.
        about: a sentence.
        packages: whose versions are kept beside those of this library's.
        make: the method of a seed.
    """
    parser = argparse.ArgumentParser(description=about)
    parser.add_argument("--out", type=Path, required=True, help="folder of the entry")
    parser.add_argument("--tasks", nargs="*", default=[], help="only these")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    used = versions(["sipe-bayes", "mujoco", "numpy", *packages])
    entry = Entry(method, shlex.join(["python", *sys.argv]), [given.seed], used, about)
    run_entry(entry, given.out, chosen(given.tasks), make(given.seed))


def draws_of(seed: int, problem: Problem, case: Case) -> torch.Generator:
    """The generator of a log's draws."""
    return torch.Generator().manual_seed(_EACH * seed + problem.cases.index(case))


class OwnMethod:
    """One of the library's estimators with its defaults, and the task's budget, prior and likelihood.

    Args:
        name: of ``sipe_bayes.inference.registry``, or "prior".
        seed: of the estimator and the draws.
    """

    def __init__(self, name: str, seed: int) -> None:
        self.name, self.seed = name, seed
        if name != PRIOR:
            estimator_class(name)  # raises for an unknown one
        self._trained: tuple[str, Estimator] | None = None

    def __call__(self, task: Task, problem: Problem, case: Case) -> Estimate:
        """See ``Method``."""
        generator = draws_of(self.seed, problem, case)
        if self.name == PRIOR:
            return Estimate(problem.prior.values(DRAWS, generator), 0)
        estimator = self._estimator(task, problem)
        posterior = estimator.fit(case.trajectories)
        if isinstance(posterior, Dirac):
            return Estimate(problem.space.values(posterior.theta.numpy())[None], estimator.rollouts)
        return Estimate(posterior.values(DRAWS, generator), estimator.rollouts)

    def _estimator(self, task: Task, problem: Problem) -> Estimator:
        """An amortised one is kept for the logs of its task, of which it may have learned already."""
        if self._trained is not None and self._trained[0] == task.name:
            return self._trained[1]
        method = estimator_class(self.name)
        settings = {name: value for name, value in problem.settings.items() if name in arguments(self.name)}
        estimator = get_estimator(
            problem.simulator,
            self.name,
            prior=problem.prior,
            likelihood=problem.likelihood,
            budget=task.budget,
            seed=self.seed,
            **(settings if method.searches else {}),
        )
        if method.amortised and isinstance(problem.simulator, CallableSimulator):
            self._trained = task.name, estimator
        return estimator
