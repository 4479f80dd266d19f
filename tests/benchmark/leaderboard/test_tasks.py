"""The leaderboard's tasks: what a method is given fits together, and does not give the truth away."""

from __future__ import annotations

import numpy as np
import pytest

from sipe_bayes.benchmark.leaderboard.registry import TASKS
from sipe_bayes.benchmark.leaderboard.scoring import heldout_ratio, made
from sipe_bayes.benchmark.leaderboard.task import Kind

NAMES = ("HalfCheetahLinks", "simple_pendulum", "arm_white", "gaussian_linear", "two_moons", "lacks_backlash")
"""Of each kind one that is made quickly."""


def test_there_are_enough() -> None:
    counts = {kind: sum(task.kind is kind for task in TASKS.values()) for kind in Kind}
    assert counts == {Kind.ENVIRONMENT: 9, Kind.REAL: 2, Kind.ARM: 2, Kind.EXACT: 4, Kind.WRONG: 3}


@pytest.mark.parametrize("name", NAMES)
def test_a_method_is_given_what_it_needs(name: str) -> None:
    problem = made(name)
    assert TASKS[name].truths == any(np.isfinite(case.truth).any() for case in problem.cases)
    assert TASKS[name].heldout == any(case.heldout is not None for case in problem.cases)
    values = problem.space.values(np.stack([np.full(len(problem.space), level) for level in (0.4, 0.6)]))
    for case in problem.cases[:2]:
        observed, simulated = problem.observed(case), problem.simulate(case, values)
        assert simulated.shape == (2, len(observed))
        assert np.isfinite(observed).all()
        assert case.truth.shape == (len(problem.space),)
        known = case.truth[np.isfinite(case.truth)]
        assert ((known > 0) & (known < 1)).all()
        states, starts = case.trajectories.states, problem.windows(case.trajectories).start
        given = [] if states is None else np.flatnonzero(np.isfinite(states[0]).all(1)).tolist()
        assert states is None or set(given) - {states.shape[1] - 1} == set(starts.tolist()), "starts of windows alone"


@pytest.mark.parametrize(("name", "share"), [("HalfCheetahLinks", 0.01), ("arm_white", None)])
def test_the_noise_is_as_stated(name: str, share: float | None) -> None:
    """At the truth what is left is the noise; within 15 % of its sd, some six standard errors."""
    problem = made(name)
    for case in problem.cases:
        residual = problem.observed(case) - problem.simulate(case, problem.space.values(case.truth)[None])[0]
        per_channel = residual.reshape(-1, case.trajectories.observations.shape[-1])
        spread = case.trajectories.observations[0].std(0)
        sd = 0.6 * np.ones_like(spread) if share is None else share * spread
        assert np.sqrt(np.mean((per_channel / sd) ** 2)) == pytest.approx(1, abs=0.15)


def test_a_held_out_error_is_that_over_the_model_as_given() -> None:
    problem = made("lacks_backlash")
    case, given = problem.cases[0], np.clip(problem.space.default_theta, 0, 1)
    assert heldout_ratio(problem, case.heldout, given) == pytest.approx(1)
    assert heldout_ratio(problem, case.heldout, case.truth) < 0.2
    assert heldout_ratio(problem, None, given) == 1


def test_the_definition_changes_with_the_truth() -> None:
    task, problem = TASKS["two_moons"], made("two_moons")
    before = task.definition(problem)
    problem.cases[0].truth[0] += 1e-6
    changed = task.definition(problem)
    problem.cases[0].truth[0] -= 1e-6
    assert changed != before == task.definition(problem)


SIZES = {  # sums of what is recorded, by log: a task keeps its logs as long as it keeps its version
    "arm_white": (5544.5, 5547.31, 5471.38, 5650.03, 5806.23),
    "arm_ar1": (5459.43, 5614.0, 4980.8, 5608.28, 6096.34),
    "lacks_load_friction": (232.14, 235.54, 350.07, 201.76, 178.6),
    "lacks_delay": (205.96, 153.02, 142.69, 385.89, 305.82),
    "lacks_backlash": (361.86, 369.8, 315.14, 294.17, 254.45),
}


@pytest.mark.parametrize("name", SIZES)
def test_simulated_logs_stay_what_they_were(name: str) -> None:
    """What the package may plant grows; what these tasks have planted does not change with it."""
    size = [float(np.abs(np.nan_to_num(case.trajectories.observations)).sum()) for case in made(name).cases]
    assert size == pytest.approx(SIZES[name], rel=1e-3)
