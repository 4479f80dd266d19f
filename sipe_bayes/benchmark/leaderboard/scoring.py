"""What an entry is scored by, and whether it may be trusted at all.

Per log and known parameter, in theta: CRPS and its skill 1 - CRPS / CRPS of the prior, summed over logs before the
ratio is taken; whether the central 90 % interval holds the truth; the interval score of T. Gneiting, A. Raftery 2007,
"Strictly Proper Scoring Rules", https://doi.org/10.1198/016214506000001437, Section 6.2, smaller for intervals that are
narrow and right. Where logs are held out: the error on them of what the entry predicts with, its mean unless it says
otherwise, over that of the model as given, geometric mean over logs and channels. A log that failed has the prior's
CRPS and interval score, no coverage, and the model's own held-out error: as much as one knows without the method.

An estimate that is made of a log alone can not be nearer to the truth than the exact posterior allows: where that is
known, the mass of it within the estimate's distance of the truth is uniform on [0, 1]. An entry for which all these
masses together are too small with p < 1e-9, or whose estimates are the truths to rounding, has peeked.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import scipy.stats

from sipe_bayes.benchmark.leaderboard.entry import (
    Answer,
    Answers,
    Entry,
    EntryError,
    answered,
    answers_path,
    predicting,
    read_answers,
    theta_of,
)
from sipe_bayes.benchmark.leaderboard.registry import TASKS
from sipe_bayes.benchmark.leaderboard.task import Case, Kind, Problem, Task
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.core.validation import nearest_name
from sipe_bayes.diagnostics.evaluate import errors
from sipe_bayes.diagnostics.scores import crps
from sipe_bayes.posterior import Dirac, Particles, Posterior

LEVEL = 0.9
_PEEKED = 1e-9  # false alarms of an honest entry
_AT_TRUTH = 1e-5  # of a range: a mean so near to every truth is the truth, written with six digits


@dataclass(frozen=True)
class LogScore:
    """Of one log.

    Args:
        name: of the log.
        crps: summed over the known parameters.
        prior_crps: the same of the prior.
        covered: how many of them the 90 % interval holds.
        known: how many there are.
        interval: mean interval score; None where no truth is known.
        heldout: error on held-out logs over that of the model as given, None without any.
        rollouts: simulated.
        cpu_seconds: taken.
        failure: why it has no answer.
    """

    name: str
    crps: float
    prior_crps: float
    covered: int
    known: int
    interval: float | None
    heldout: float | None
    rollouts: int
    cpu_seconds: float
    failure: str = ""

    @property
    def skill(self) -> float | None:
        """None where no truth is known."""
        return 1 - self.crps / self.prior_crps if self.known else None


@dataclass(frozen=True)
class TaskScore:
    """Of an entry on a task.

    Args:
        task: its name.
        kind: its group.
        logs: each.
        points: whether the method gives no intervals.
    """

    task: str
    kind: Kind
    logs: tuple[LogScore, ...]
    points: bool

    @property
    def skill(self) -> float | None:
        """Over the prior; None where no truth is known."""
        known = [log for log in self.logs if log.known]
        return 1 - sum(log.crps for log in known) / sum(log.prior_crps for log in known) if known else None

    @property
    def coverage(self) -> float | None:
        """The share of intervals that hold the truth; None of points, and where no truth is known."""
        known = sum(log.known for log in self.logs)
        return sum(log.covered for log in self.logs) / known if known and not self.points else None

    @property
    def coverage_error(self) -> float | None:
        """Its standard error by logs, and at least that of a right method whose logs count once for each parameter."""
        if self.coverage is None:
            return None
        known = [log for log in self.logs if log.known]
        shares = [log.covered / log.known for log in known]
        least = np.sqrt(LEVEL * (1 - LEVEL) / sum(log.known for log in known))
        clustered = np.std(shares, ddof=1) / np.sqrt(len(shares)) if len(shares) > 1 else 0.0
        return float(max(clustered, least))

    @property
    def interval(self) -> float | None:
        """Mean interval score in theta; None of points, and where no truth is known."""
        scored = [log.interval for log in self.logs if log.interval is not None]
        return float(np.mean(scored)) if scored and not self.points else None

    @property
    def heldout(self) -> float | None:
        """Error on held-out logs over that of the model as given, geometric mean; None without any."""
        ratios = [log.heldout for log in self.logs if log.heldout is not None]
        return float(np.exp(np.mean(np.log(ratios)))) if ratios else None

    @property
    def rollouts(self) -> float:
        """Mean over logs."""
        return float(np.mean([log.rollouts for log in self.logs]))

    @property
    def cpu_seconds(self) -> float:
        """Mean over logs."""
        return float(np.mean([log.cpu_seconds for log in self.logs]))

    @property
    def failed(self) -> int:
        """Logs without an answer."""
        return sum(bool(log.failure) for log in self.logs)


@dataclass(frozen=True)
class Scored:
    """An entry with its scores by task.

    Args:
        entry: what made it.
        folder: where it is.
        tasks: name -> score, of those that it answered.
    """

    entry: Entry
    folder: Path
    tasks: dict[str, TaskScore]


@cache
def made(task: str) -> Problem:
    """A task's problem, made once."""
    return TASKS[task].load()


def scored(folder: Path) -> Scored:
    """An entry, checked and scored.

    Raises:
        EntryError: for one that is not to be trusted; see the module.
    """
    entry, tasks, answers = Entry.read(folder), dict[str, TaskScore](), list[tuple[Problem, Answers]]()
    names = answered(folder)
    if not names:
        raise EntryError(f"{folder}: answers no task; expected {answers_path(folder, next(iter(TASKS)))} or others")
    for name in sorted(names, key=_order):
        if name not in TASKS:
            hint = nearest_name(name, TASKS) or f"; known: {', '.join(TASKS)}"
            raise EntryError(f"{answers_path(folder, name)}: no task {name!r}{hint}")
        task, problem = TASKS[name], made(name)
        one = read_answers(folder, task, problem)
        assert one is not None
        answers.append((problem, one))
        tasks[name] = score_task(task, problem, one)
    _check_honest(folder, answers)
    return Scored(entry, folder, tasks)


def _order(name: str) -> int:
    return list(TASKS).index(name) if name in TASKS else -1


def score_task(task: Task, problem: Problem, answers: Answers) -> TaskScore:
    """Scores of checked answers; a log without one counts as failed."""
    missing, rows = Answer(failure="no answer"), [len(a.values) for a in answers.logs.values() if a.values]
    points = bool(rows) and max(rows) == 1
    logs = tuple(score_log(problem, case, answers.logs.get(case.name, missing)) for case in problem.cases)
    return TaskScore(task.name, task.kind, logs, points)


def score_log(problem: Problem, case: Case, answer: Answer) -> LogScore:
    """Scores of one checked answer."""
    known = np.flatnonzero(np.isfinite(case.truth))
    names, truth = [problem.space.names[j] for j in known], case.truth[known]
    before = problem.prior.marginal(names) if names else None
    after, ratio = before, 1.0
    if not answer.failure:
        theta = theta_of(answer, problem)
        after = _belief(theta[:, known], before) if before is not None else None
        ratio = heldout_ratio(problem, case.heldout, predicting(answer, problem))
    covered, interval, own, prior_crps = 0, None, 0.0, 0.0
    if before is not None and after is not None:
        own, prior_crps = float(crps(after, truth).sum()), float(crps(before, truth).sum())
        low, high = after.quantile([(1 - LEVEL) / 2, (1 + LEVEL) / 2]).numpy()
        missed = np.maximum(low - truth, 0) + np.maximum(truth - high, 0)
        interval = float((high - low + 2 / (1 - LEVEL) * missed).mean())
        covered = 0 if answer.failure else int((missed == 0).sum())
    heldout = None if case.heldout is None else ratio
    costs = answer.rollouts, answer.cpu_seconds, answer.failure
    return LogScore(case.name, own, prior_crps, covered, len(known), interval, heldout, *costs)


def _belief(theta: FloatArray, before: Posterior) -> Posterior:
    return Dirac(theta[0], before.space) if len(theta) == 1 else Particles(theta, before.space)


def heldout_ratio(problem: Problem, heldout: Trajectories | None, theta: FloatArray) -> float:
    """Error of theta (N,) on held-out logs over that of the model as given; that one's where theta's diverges."""
    if heldout is None:
        return 1.0
    both = np.stack([theta, np.clip(problem.space.default_theta, 0, 1)])
    own, given = errors(problem.windows(heldout), both)
    ratio = own / given
    usable = ratio[~np.isnan(ratio)]
    return float(np.exp(np.mean(np.log(usable)))) if len(usable) and np.isfinite(usable).all() else 1.0


# Whether an entry may be trusted


def _check_honest(folder: Path, answers: Sequence[tuple[Problem, Answers]]) -> None:
    """Raises EntryError where draws have no width anywhere, or estimates are nearer to the truths than may be."""
    given = [(p, p.case(n), theta_of(a, p)) for p, one in answers for n, a in one.logs.items() if a.values]
    drawn = [theta for _, _, theta in given if len(theta) > 1]
    if drawn and all(np.ptp(theta, axis=0).max() <= _AT_TRUTH for theta in drawn):
        raise EntryError(
            f"{folder}: its draws have no width in any log, which no log with noise allows; a method without intervals "
            "gives a point, one row for each log"
        )
    known = [(theta.mean(0), case.truth) for _, case, theta in given if np.isfinite(case.truth).any()]
    off = [float(np.nanmax(np.abs(mean - truth))) for mean, truth in known]
    if off and max(off) <= _AT_TRUTH:
        raise EntryError(
            f"{folder}: its estimates are the truths to {max(off):.0e} of the range in all {len(off)} logs, which "
            "noise does not allow; estimate from the logs alone"
        )
    masses = [_mass_nearer(case.reference, theta.mean(0), case.truth) for _, case, theta in given if _exact(case)]
    p = float(scipy.stats.gamma.sf(-np.log(masses).sum(), len(masses))) if masses else 1.0
    if p < _PEEKED:
        raise EntryError(
            f"{folder}: its estimates are nearer to the truths than the exact posteriors of {len(masses)} logs allow "
            f"(p = {p:.0e}); estimate from the logs alone"
        )


def _exact(case: Case) -> bool:
    return case.reference is not None


def _mass_nearer(reference: FloatArray | None, estimate: FloatArray, truth: FloatArray) -> float:
    """The exact posterior's mass that is nearer to an estimate (N,) than the truth is, never zero."""
    assert reference is not None
    distance = np.linalg.norm(reference - estimate, axis=1)
    return float((1 + (distance < np.linalg.norm(truth - estimate)).sum()) / (1 + len(reference)))
