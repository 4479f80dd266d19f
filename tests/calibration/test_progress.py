"""What is told of a calibration on its way: counted, and foretold by what fits usually need."""

from __future__ import annotations

import dataclasses

import numpy as np

from sipe_bayes.calibration.checks.plan import Check, Checks, Plan
from sipe_bayes.core.checkpoint import NOTHING_KEPT, Kept
from sipe_bayes.inference.laplace.forecast import usual_rest, usual_rollouts
from sipe_bayes.inference.laplace.windows.state import Phase, Position, WindowState
from sipe_bayes.inference.recorded import Tell
from sipe_bayes.likelihood.noise import Noise

PLAN = Plan({Check.LOGS: 1000, Check.RANGES: 50}, logs=200)


def calls_of(rollouts: float) -> list[tuple[str, int, int]]:
    """Of two checks after a fit of 500 rollouts, of which the first simulates so many."""
    calls, simulated = [], [7.0]
    checks = Checks(NOTHING_KEPT, lambda *call: calls.append(call), 500, PLAN, lambda: simulated[0])

    def made(tell: Tell, kept: Kept) -> int:
        simulated[0] += rollouts
        tell("a log")
        return 1

    assert checks.of(Check.LOGS, int, made) == 1
    assert checks.of(Check.RANGES, int, lambda tell, kept: 2) == 2
    return calls


def test_fits_of_logs_are_counted_while_they_run() -> None:
    first, during, last = calls_of(30)
    assert first[1:] == (500, 1550)
    assert during == ("check 2 of 8, what each log says by itself: a log", 530, 1550)
    assert last[1:] == (530, 580), "what it did not need is no longer ahead"


def test_no_more_is_counted_than_there_may_be() -> None:
    assert calls_of(9999)[1][1:] == (1500, 1550)


def test_what_is_usual_is_between_nothing_and_the_most() -> None:
    assert PLAN.total == 1050
    assert PLAN.usual == 250


def test_less_is_to_come_the_farther_a_search_is() -> None:
    here = Position(Phase.ROUGH, np.zeros(3), np.zeros((1, 2)), Noise(np.ones(1), np.zeros(1)), 1.0, 0.1)
    begun = WindowState(np.zeros((2, 3)), 0, here)
    states = [begun, dataclasses.replace(begun, here=dataclasses.replace(here, iteration=20))]
    states.append(dataclasses.replace(begun, point=1))
    rest = [usual_rest(state, 0, 5, logs=2) for state in states]
    rest += [usual_rest(states[-1], drawn, 5, logs=2) for drawn in (50, 250, 1000)]
    assert rest == sorted(rest, reverse=True)
    assert rest[0] == usual_rollouts(5, logs=2, starts=2)
    assert rest[-1] > 0, "a search that is longer than usual still goes on"
