"""The checks of a calibration, one after the other: what each is called, what it may take, what is kept of it."""

from __future__ import annotations

import enum
from collections.abc import Callable, Mapping
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
from sipe_bayes.inference.laplace.estimator import Laplace
from sipe_bayes.inference.laplace.windows.growing_windows import grows
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


class Checks:
    """The checks of one fit: what is kept of them is not made again.

    Args:
        kept: keeps their results.
        progress: called along the way.
        spent: rollouts of the fit.
        expected: those that each check takes at most.
    """

    def __init__(self, kept: Kept, progress: Progress | None, spent: int, expected: Mapping[Check, int]) -> None:
        self._kept, self._progress = kept, progress
        self._expected, self._done = expected, spent
        self._total = spent + sum(expected.values())

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
            began = True
            tell()
            return make(tell, kept)

        result, expected = self._kept.of(check.name.lower(), kind, work), self._expected.get(check, 0)
        if began and check is not Check.LOGS:  # which takes all or next to nothing
            self._done += expected
        else:
            self._total -= expected
        return result

    def _tell(self, check: Check, part: str = "") -> None:
        if self._progress is not None:
            what = f"check {list(Check).index(check) + 1} of {len(Check)}, {check.value}" + f": {part}" * bool(part)
            self._progress(what, self._done, self._total)


def expected_rollouts(problem: Problem, method: Estimator) -> dict[Check, int]:
    """Rollouts that each check takes at most, told before the fit.

    About, of what the model lacks: extensions are placed at the model as given. Linear algebra on what was simulated,
    as draws of noise alone take it, is in none.
    """
    windows = bind(problem.segments, problem.simulator, problem.train)
    logs, n = len(problem.train), windows.num_theta
    held = 0 if problem.holdout is None else len(problem.holdout)
    chain = isinstance(problem.likelihood, StateSpace)
    known = chain or isinstance(method, Laplace)
    lin = (1 + n + windows.num_start) * logs
    search = starts_cost(windows)
    try:
        lacking = 0 if chain else probes_cost(windows, np.clip(problem.environment.space.default_theta, 0, 1))
    except ValueError:  # the model as given diverges, which the check will say
        lacking = 0
    return {
        Check.STARTS: 0 if known else 2 * search,
        Check.LOGS: (0 if chain else lin) + LOG_BUDGET * logs if logs > 1 and not grows(windows) else 0,
        Check.LACKING: lacking if chain else lacking + lin + logs,
        Check.PREDICTIONS: 2 * (logs + held),
        Check.COMPARISON: 2 * search * (logs + held) // logs,
        Check.PRIOR: PREDICTIVE.simulations * logs,
        Check.BANDS: band_cost(windows) * (logs + held) // logs,
        Check.RANGES: 2 * len(GRID) * n * logs,
    }


def with_checks(progress: Progress, expected: Mapping[Check, int]) -> Progress:
    """The progress of a fit that the checks come after."""
    later = sum(expected.values())

    def of_fit(what: str, done: int, total: int) -> None:
        progress(f"{what} (then checks, {later} of the rollouts)", done, total + later)

    return of_fit
