"""Windows through impacts that are not followed: their starts are looked for anew; where all are lost a fit blocks."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scipy.stats

from sipe_bayes.core.findings import Code, Severity
from sipe_bayes.inference.laplace.estimator import Laplace
from sipe_bayes.inference.laplace.options import FollowedTuning, GrowingTuning, LaplaceTuning
from sipe_bayes.inference.laplace.windows import followed, followed_posterior
from sipe_bayes.inference.laplace.windows.followed import FollowedLook, regrown
from sipe_bayes.inference.laplace.windows.growing_windows import Doubt
from sipe_bayes.likelihood.settings import BudgetExhausted, Segments
from sipe_bayes.likelihood.windows import Windows
from tests.problems.buffers import NOISE, TRUTH, changed, everything, look_at, machine, recorded


def test_few_windows_without_jumps_are_few_and_those_of_another_motion_lost() -> None:
    """Where simulations jump in all: what they leave is noise, or it hides a motion that the model does not have."""
    logs, rough = recorded(), FollowedTuning(differs=1e-9, matters=1e-9)
    assert look_at(everything(logs), rough) is Doubt.FEW
    observations = logs.observations.copy()
    observations[..., 1] += 4 * NOISE[1] * np.sin(0.8 * np.arange(121))
    other = everything(replace(logs, observations=observations))
    assert look_at(other, rough) is Doubt.LOST
    assert look_at(other, replace(rough, loose=100.0)) is Doubt.FEW


def test_lost_windows_are_followed_again_from_starts_that_are_looked_for_anew() -> None:
    """Of starts far off those that are found again; the others stay, and what it took is counted."""
    given = everything(recorded())
    windows, far = given.windows, given.starts.copy()
    lost = np.arange(0, 24, 3)
    far[lost] += [0.02, 0.02, 0.5, 0.5]
    before = windows.rollouts
    again = regrown(windows, lost, TRUTH, far, given.noise)
    assert again is not None
    kept = np.setdiff1d(np.arange(24), lost)
    np.testing.assert_array_equal(again[kept], given.starts[kept])
    left = (windows.residuals(TRUTH[None], again[None])[0][0] / NOISE) ** 2
    assert (left.sum((1, 2))[lost] < scipy.stats.chi2.isf(1e-4, 40)).all()
    spent = windows.rollouts - before
    assert 4 * 20 < spent < 4 * 100  # of a third of the windows, on beginnings
    nothing = regrown(windows, lost[:0], TRUTH, far, given.noise)
    assert nothing is not None
    np.testing.assert_array_equal(nothing, far)
    best = regrown(windows, lost, TRUTH, given.starts, given.noise)  # at the best starts already
    assert best is not None
    np.testing.assert_allclose(best, given.starts, atol=1e-3)
    windows.budget = windows.rollouts + spent  # the share of the windows that is simulated has to fit, not all
    assert regrown(windows, lost, TRUTH, far, given.noise) is not None
    windows.budget = windows.rollouts + spent // 2
    with pytest.raises(BudgetExhausted):
        regrown(windows, lost, TRUTH, far, given.noise)
    assert windows.budget - 40 < windows.rollouts <= windows.budget + 20  # counted all the same


def test_lost_windows_that_diverge_from_both_starts_are_none(monkeypatch: pytest.MonkeyPatch) -> None:
    given, lost, predict = everything(recorded()), np.arange(0, 24, 3), Windows.predict

    def diverging(self: Windows, theta: np.ndarray, *rest: Any) -> tuple[np.ndarray, np.ndarray]:
        predicted, valid = predict(self, theta, *rest)
        predicted[: len(theta) - one, 2] = np.nan
        return predicted, valid

    monkeypatch.setattr(Windows, "predict", diverging)
    monkeypatch.setattr(followed, "grown_starts", lambda windows, *_: windows.no_starts())
    one = 1  # of two
    assert regrown(given.windows, lost, TRUTH, given.starts, given.noise) is not None
    one = 0
    assert regrown(given.windows, lost, TRUTH, given.starts, given.noise) is None


def test_a_budget_that_ends_meanwhile_leaves_the_scatter() -> None:
    """All but a few rollouts of what the fit takes by itself: groups have been fitted, the windows not all chosen."""
    tuning = LaplaceTuning(growing=GrowingTuning(rough=1.0001))
    logs = changed(recorded(), [(0, slice(28, 40), 0.02), (2, slice(68, 80), 0.02)])
    whole = Laplace(machine(), likelihood=Segments(0.2, "white"), tuning=tuning)
    whole.fit(logs)
    for budget in (whole.rollouts + 200, whole.rollouts - 40):
        method = Laplace(machine(), likelihood=Segments(0.2, "white"), tuning=tuning, budget=budget)
        method.fit(logs)
        assert method.rollouts <= budget
        if budget > whole.rollouts:
            assert [f.text for f in method.findings] == [f.text for f in whole.findings]
    (noticed,) = method.findings
    assert noticed.code is Code.SCATTER
    assert str(Doubt.UNASKED) in noticed.text


def test_windows_that_are_not_followed_block(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whether groups scatter or agree: what misses alike is off alike. First all starts are looked for anew."""
    looks = []

    def lost(*_: object) -> Doubt:
        looks.append(Doubt.LOST)
        return Doubt.LOST

    monkeypatch.setattr(followed_posterior, "followed_at", lost)
    for rough in (1.0001, 1e9):  # groups scatter, and agree
        method = Laplace(
            machine(),
            likelihood=Segments(0.2, "white"),
            tuning=LaplaceTuning(growing=GrowingTuning(rough=rough)),
            restarts=1,
            candidates=0,
        )
        method.fit(recorded())
        (noticed,) = method.findings
        assert noticed.code is Code.WINDOWS_LOST
        assert noticed.severity is Severity.BLOCKING
    assert len(looks) == 4
    monkeypatch.setattr(followed_posterior, "regrown", lambda *_: None)  # starts that diverge are none
    method.fit(recorded(seed=1))
    assert {f.code for f in method.findings} == {Code.WINDOWS_LOST}


def test_a_step_after_which_a_window_diverges_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is followed before it stands."""
    monkeypatch.setattr(followed, "regrown", lambda *_: None)
    given = everything(recorded(), TRUTH + np.array([0.03, -0.03]))
    some = look_at(given)
    assert isinstance(some, FollowedLook)
    np.testing.assert_array_equal(some.at.theta, given.theta)
