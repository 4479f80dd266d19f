"""The checks of a calibration, one after the other: what each is called, what it may take, what is kept of it."""

from __future__ import annotations

import enum
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import TypeVar

import numpy as np

from sipe_bayes.calibration.problem import Problem
from sipe_bayes.core.checkpoint import Kept
from sipe_bayes.diagnostics.agreement import LOG_BUDGET
from sipe_bayes.diagnostics.evaluate import band_cost, starts_cost
from sipe_bayes.diagnostics.identifiability import GRID
from sipe_bayes.diagnostics.prior_predictive import PREDICTIVE
from sipe_bayes.inference.base import Estimator
from sipe_bayes.inference.laplace.estimator import Laplace, LaplaceState
from sipe_bayes.inference.laplace.forecast import usual_rest, usual_rollouts
from sipe_bayes.inference.laplace.windows.followed import followed_cost
from sipe_bayes.inference.laplace.windows.growing_windows import grows
from sipe_bayes.inference.laplace.windows.state import WindowState
from sipe_bayes.inference.progress_bar import ProgressBar
from sipe_bayes.inference.recorded import Progress, Tell
from sipe_bayes.likelihood.binding import bind
from sipe_bayes.likelihood.settings import StateSpace
from sipe_bayes.structure.probes import probes_cost

S = TypeVar("S")


class Check(enum.Enum):
    """What is asked of a fit, in this order; the words are those of the progress."""

    STARTS = "where the windows start"
    LOGS = "what each log says by itself"
    LACKING = "what the model lacks"
    PREDICTIONS = "predictions of the logs"
    COMPARISON = "errors beside those of the model as given"
    PRIOR = "simulations of the prior"
    BANDS = "the posterior's band"
    RANGES = "where parameters change nothing"


@dataclass(frozen=True)
class Plan:
    """Rollouts of the checks.

    Args:
        most: those that each takes at most.
        logs: those that what each log says by itself takes as a rule, where it takes any.
    """

    most: Mapping[Check, int] = field(default_factory=dict)
    logs: int = 0

    @property
    def total(self) -> int:
        """At most."""
        return sum(self.most.values())

    @property
    def usual(self) -> int:
        """As a rule."""
        return self.total - self.most.get(Check.LOGS, 0) + self.logs


class Checks:
    """The checks of one fit: what is kept of them is not made again.

    Args:
        kept: keeps their results.
        progress: called along the way.
        spent: rollouts of the fit.
        plan: rollouts of the checks.
        simulated: counts the rollouts that were simulated until it is called.
    """

    def __init__(
        self, kept: Kept, progress: Progress | None, spent: int, plan: Plan, simulated: Callable[[], float]
    ) -> None:
        self._kept, self._progress, self._plan = kept, progress, plan
        self._done, self._usual, self._total = spent, spent + plan.usual, spent + plan.total
        self._simulated, self._before = simulated, simulated()

    def of(self, check: Check, kind: type[S], make: Callable[[Tell, Kept], S]) -> S:
        """The result of a check.

        Args:
            check: which.
            kind: of the result, as ``Kept.of`` has it.
            make: called with what is told of its parts, and what keeps them.
        """
        tell, began = partial(self._tell, check), False

        def work(kept: Kept) -> S:
            nonlocal began
            began, self._before = True, self._simulated()
            tell()
            return make(tell, kept)

        result, most = self._kept.of(check.name.lower(), kind, work), self._plan.most.get(check, 0)
        usual, taken = most, most if began else 0
        if check is Check.LOGS:  # which takes all or next to nothing
            usual, taken = self._plan.logs, self._taken(check) if began else 0
        self._done += taken
        self._usual += taken - usual
        self._total += taken - most
        return result

    def _taken(self, check: Check) -> int:
        """Rollouts of a check until now; about, where windows differ in length."""
        return min(int(self._simulated() - self._before), self._plan.most.get(check, 0))

    def _tell(self, check: Check, part: str = "") -> None:
        if self._progress is not None:
            what = f"check {list(Check).index(check) + 1} of {len(Check)}, {check.value}" + f": {part}" * bool(part)
            _show(self._progress, what, self._done + self._taken(check), self._total, self._usual)


def rollouts_of(problem: Problem) -> Callable[[], float]:
    """A function that counts what the problem's simulator has simulated, in rollouts of a training log."""
    steps = float(problem.train.length.mean())
    return lambda: problem.simulator.control_steps / steps


def plan_of(problem: Problem, method: Estimator) -> Plan:
    """Rollouts of the checks after a fit.

    About, of what the model lacks: extensions are placed at the model as given. Linear algebra on what was simulated,
    as draws of noise alone take it, is in none.
    """
    windows = bind(problem.segments, problem.simulator, problem.train)
    logs, n = len(problem.train), windows.num_theta
    held = 0 if problem.holdout is None else len(problem.holdout)
    chain = isinstance(problem.likelihood, StateSpace)
    known = chain or isinstance(method, Laplace)
    lin = (1 + n + windows.num_start) * logs
    search, chosen = starts_cost(windows), grows(windows) and not known  # which windows are followed
    try:
        lacking = 0 if chain else probes_cost(windows, np.clip(problem.environment.space.default_theta, 0, 1))
    except ValueError:  # the model as given diverges, which the check will say
        lacking = 0
    most = {
        Check.STARTS: 0 if known else 2 * search,
        Check.LOGS: (0 if chain else lin) + LOG_BUDGET * logs if logs > 1 and not grows(windows) else 0,
        Check.LACKING: lacking if chain else lacking + (followed_cost(windows) if chosen else lin + logs),
        Check.PREDICTIONS: 2 * (logs + held),
        Check.COMPARISON: 2 * search * (logs + held) // logs,
        Check.PRIOR: PREDICTIVE.simulations * logs,
        Check.BANDS: band_cost(windows) * (logs + held) // logs,
        Check.RANGES: 2 * len(GRID) * n * logs,
    }
    alone = int(usual_rollouts(n + windows.num_start, logs))
    return Plan(most, min(alone, most[Check.LOGS]))


def with_checks(progress: Progress, plan: Plan, method: Estimator, logs: int) -> Progress:
    """The progress of a fit to so many logs that the checks come after."""

    def of_fit(what: str, done: int, total: int) -> None:
        rest = _usual_rest(method, logs)
        usual = None if rest is None else min(int(done + rest), total) + plan.usual
        _show(progress, f"{what} (then checks)", done, total + plan.total, usual)

    return of_fit


def _usual_rest(method: Estimator, logs: int) -> float | None:
    """Rollouts that a fit will still need as a rule; None where nothing is known of that."""
    state = method.state
    if not isinstance(method, Laplace) or not isinstance(state, LaplaceState):
        return None
    if not isinstance(state.search, WindowState):
        return None
    drawn = 0 if state.draws is None else len(state.draws.values)
    return usual_rest(state.search, drawn, state.search.points.shape[1] + method.num_start, logs)


def _show(progress: Progress, what: str, done: int, total: int, usual: int | None) -> None:
    """Tell what is usual to a bar, which takes it, beside what may be needed."""
    if isinstance(progress, ProgressBar):
        progress(what, done, total, usual)
    else:
        progress(what, done, total)
