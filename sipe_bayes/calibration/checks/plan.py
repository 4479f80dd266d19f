"""The checks of a calibration, one after the other: what each is called, what it may take, what is kept of it."""

from __future__ import annotations

import enum
from collections.abc import Callable, Mapping
from functools import partial
from typing import TypeVar

import numpy as np

from sipe_bayes.calibration.problem import Problem
from sipe_bayes.core.checkpoint import Kept
from sipe_bayes.core.telling import Tell
from sipe_bayes.diagnostics.bands import DRAWS
from sipe_bayes.diagnostics.evaluate import LOOKED_AT
from sipe_bayes.diagnostics.identifiability import GRID
from sipe_bayes.diagnostics.prior_predictive import SIMULATIONS, STEPS
from sipe_bayes.inference.base import Estimator
from sipe_bayes.inference.recorded import Progress
from sipe_bayes.likelihood import StateSpace, bind
from sipe_bayes.simulation.base import Simulated
from sipe_bayes.structure.augmented import steps_of
from sipe_bayes.structure.probes import place_extensions, probes_cost

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


Plan = Mapping[Check, int]
"""Rollouts that each check takes, as far as can be said before the fit; linear algebra is in none."""
NO_PLAN: Plan = {}


class Checks:
    """The checks of one fit: what is kept of them is not made again.

    Args:
        kept: keeps their results.
        progress: called along the way.
        spent: rollouts of the fit.
        plan: of the checks.
        simulated: counts the rollouts that were simulated until it is called.
    """

    def __init__(
        self, kept: Kept, progress: Progress | None, spent: int, plan: Plan, simulated: Callable[[], float]
    ) -> None:
        self._kept, self._progress, self._plan = kept, progress, plan
        self._simulated, self._fit = simulated, spent - simulated()

    def of(self, check: Check, kind: type[S], make: Callable[[Tell, Kept], S]) -> S:
        """The result of a check.

        Args:
            check: which.
            kind: of the result, as ``Kept.of`` has it.
            make: called with what is told of its parts, and what keeps them.
        """

        def work(kept: Kept) -> S:
            tell = partial(self._tell, check, self._simulated())
            tell()
            return make(tell, kept)

        return self._kept.of(check.name.lower(), kind, work)

    def _tell(self, check: Check, before: float, part: str = "") -> None:
        """Say how far a check is, what it needs by plan, and what those after it need."""
        if self._progress is not None:
            order, simulated = list(Check), self._simulated()
            number = order.index(check)
            rest = max(self._plan.get(check, 0) - (simulated - before), 0.0)
            rest += sum(self._plan.get(later, 0) for later in order[number + 1 :])
            what = f"check {number + 1} of {len(order)}, {check.value}" + f": {part}" * bool(part)
            done = self._fit + simulated
            self._progress(what, round(done), round(done + rest))


def rollouts_of(problem: Problem) -> Callable[[], float]:
    """A function that counts what this process has simulated, extended models too, in rollouts of a training log."""
    steps = float(problem.train.length.mean())
    return lambda: Simulated.total_steps / steps


def plan_of(problem: Problem, method: Estimator) -> Plan:
    """Rollouts of the checks after a fit.

    About, of what the model lacks: extensions are placed at the model as given. Linear algebra on what was simulated,
    as draws of noise alone take it, is in none.
    """
    windows = bind(problem.segments, problem.simulator, problem.train)
    logs, n = len(problem.train), windows.num_theta
    held = 0 if problem.holdout is None else len(problem.holdout)
    chain = isinstance(problem.likelihood, StateSpace)
    known = chain or method.name == "laplace"
    lin = (1 + n + windows.num_start) * logs
    theta, steps = np.clip(problem.environment.space.default_theta, 0, 1), float(windows.steps.sum())

    def share(most: float) -> float:
        """Of the windows that a check looks at, so many control steps at most."""
        return min(1.0, most / steps)

    search = windows.starts_cost * logs
    try:
        placed = [] if chain else place_extensions(windows, theta, windows.no_starts())
        lacking = round(probes_cost(windows, placed) * share(steps_of(windows, placed)))
    except ValueError:  # the model as given diverges, which the check will say
        lacking = 0
    return {
        Check.STARTS: 0 if known else 2 * search,
        Check.LOGS: round((lin + chain * search) * share(LOOKED_AT)) if logs > 1 and not windows.impacts else 0,
        Check.LACKING: 0 if chain else lacking + logs,
        Check.PREDICTIONS: 2 * (logs + held),
        Check.COMPARISON: round(search * share(LOOKED_AT) * (logs + held)) // logs + 2 * held,
        Check.PRIOR: round(SIMULATIONS * logs * share(STEPS)),
        Check.BANDS: DRAWS * (logs + held),
        Check.RANGES: round(len(GRID) * n * logs * share(LOOKED_AT)),
    }


def with_checks(progress: Progress, plan: Plan, method: Estimator, logs: int) -> Progress:
    """The progress of a fit to so many logs that the checks come after."""

    def of_fit(what: str, done: int, total: int) -> None:
        rest = method.usual_rest()
        expected = total if rest is None else min(done + round(rest), max(total, done))
        progress(f"{what} (then checks)", done, expected + sum(plan.values()))

    return of_fit
