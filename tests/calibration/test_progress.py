"""What is told of a calibration on its way: what is done, and what is still to come by plan and measured speed."""

from __future__ import annotations

import io
import re
import sys

import pytest

import sipe_bayes as sipe
from sipe_bayes.calibration.checks.plan import Check, Checks
from sipe_bayes.core.checkpoint import NOTHING_KEPT, Kept
from sipe_bayes.core.telling import Tell

PLAN = {Check.LOGS: 200, Check.RANGES: 50}


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


def test_rollouts_are_counted_while_a_check_runs() -> None:
    first, during, last = calls_of(30)
    assert first[1:] == (500, 750)
    assert during == ("check 2 of 8, what each log says by itself: a log", 530, 750)
    assert last[1:] == (530, 580), "what it did not need is no longer ahead"


def test_a_check_that_needs_more_than_its_plan_leaves_those_after_it() -> None:
    assert [call[1:] for call in calls_of(300)[1:]] == [(800, 850), (800, 850)]


# share of its plan that each check takes, and its share of the usual speed
COURSES = {
    "as planned": dict.fromkeys(Check, (1.0, 1.0)),
    "half as much": dict.fromkeys(Check, (0.6, 1.0)),
    "one is skipped, one slow": dict.fromkeys(Check, (1.0, 1.0)) | {Check.LOGS: (0.0, 1.0), Check.RANGES: (1.0, 0.7)},
    "one needs twice its plan": dict.fromkeys(Check, (1.0, 1.0)) | {Check.LACKING: (2.0, 1.0)},
}


@pytest.mark.parametrize("course", COURSES)
def test_the_forecast_is_right_within_a_factor_of_two(course: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """From a fifth of the way on: 1000 rollouts of a fit, 200 of each check, ten a second; of more than 20 s left."""
    now, simulated, stream = [0.0], [0.0], io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setattr("sipe_bayes.inference.progress_bar.time.monotonic", lambda: now[0])
    plan = dict.fromkeys(Check, 200)
    with sipe.ProgressBar() as bar:
        bar._over.set()  # lines at the calls alone
        for done in range(0, 1001, 5):
            bar("fitting", done, 1000 + sum(plan.values()))
            now[0] += 0.5
        checks = Checks(NOTHING_KEPT, bar, 1000, plan, lambda: simulated[0])
        for check, (share, speed) in COURSES[course].items():

            def made(tell: Tell, kept: Kept, share: float = share, speed: float = speed) -> int:
                for _ in range(int(share * 40)):
                    simulated[0] += 5
                    now[0] += 0.5 / speed
                    tell("part")
                return 0

            checks.of(check, int, made)
    lines = re.findall(r"^(\d+) s: .* about (\d+) (s|min) left$", stream.getvalue(), re.MULTILINE)
    ratios = {}
    for at, left, unit in lines:
        truth = now[0] - int(at)
        if int(at) > now[0] / 5 and truth > 20:
            ratios[int(at)] = int(left) * (60 if unit == "min" else 1) / truth
    print(ratios)
    assert len(ratios) > 5
    assert all(0.5 < ratio < 2 for ratio in ratios.values())
