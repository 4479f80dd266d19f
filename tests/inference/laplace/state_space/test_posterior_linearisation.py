"""A search ends with wide differences, where it was likeliest, and says where its starts exclude one another."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.inference.laplace.estimator import Laplace
from sipe_bayes.inference.laplace.state_space import search
from sipe_bayes.inference.laplace.state_space.noise import NoisePosterior
from sipe_bayes.inference.laplace.state_space.search import StateSpaceSearch
from sipe_bayes.inference.laplace.state_space.state import ChainOptimum, ChainState, Phase, Position, contradiction
from sipe_bayes.likelihood.settings import StateSpace
from sipe_bayes.likelihood.state_space import differences
from tests.problems.springs import spring, spring_logs


def fitted() -> tuple[ChainOptimum, float]:
    """The optimum and the posterior's sd."""
    estimator = Laplace(spring(), likelihood=StateSpace(), restarts=1, candidates=0)
    sd = float(estimator.fit(spring_logs()).stddev[0])
    assert estimator.state is not None
    (optimum,) = estimator.state.search.optima
    assert isinstance(optimum, ChainOptimum)
    return optimum, sd


def test_a_jump_within_a_short_difference_leaves_the_interval_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """At step 30 a velocity jumps within 1e-4 of theta: by itself that slope would tell theta to a tenth of its sd."""
    plain, sd = fitted()
    assert not plain.state_step.any()  # short ones say the same
    short = differences.linearise

    def torn(*of: Any, **more: Any) -> Any:
        linear = short(*of, **more)
        assert linear is not None
        slope = linear.transition_theta.copy()
        slope[30, 1, 0] += 10 * plain.process[1] / sd
        return replace(linear, transition_theta=slope)

    monkeypatch.setattr(differences, "linearise", torn)
    monkeypatch.setattr(search, "linearise", torn)
    optimum, same = fitted()
    print(plain.theta, sd, optimum.theta, same)
    assert optimum.state_step.any()
    assert same == pytest.approx(sd, rel=0.2)
    assert abs(optimum.mean[0] - plain.mean[0]) < 0.3 * sd


@pytest.mark.parametrize("freedom", [None, 0.0])
def test_a_search_that_ends_below_its_likeliest_place_goes_back(
    freedom: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """There the noise settles, unless a step would gain more than fitting noise: as where there is nothing to fit."""
    best, _ = fitted()
    estimator = Laplace(spring(), likelihood=StateSpace(), restarts=1, candidates=0)
    chain = estimator.bound(Trajectories.stack(spring_logs()))
    alternate = np.where(np.arange(len(best.states)) % 2, 1.0, -1.0)[:, None] * np.array([1.0, 0.0])
    recorded = replace(best, settled=False)
    method = StateSpaceSearch(estimator.problem, chain)
    elsewhere = Position(
        phase=Phase.NOISE,
        theta=best.theta,
        states=chain.moved(best.states, 0.5 * alternate),
        noise=best.noise,
        movement=best.movement,
        damping=1e-4,
        estimates=method.tuning.wide.most_estimates - 1,
        steps=3,
        theta_step=np.full(1, 0.01),
        state_step=np.full((len(best.states), 2), 0.01),
        estimate_theta=best.theta,
        refused=np.zeros(len(best.outliers), bool),
    )
    state = ChainState(best.theta[None], 0, elsewhere, (recorded,), regressed=np.empty((0, 1)))
    if freedom is not None:
        monkeypatch.setattr(NoisePosterior, "freedom", freedom)
    while not state.done:
        state = method.step(state)
    (optimum,) = state.optima
    print(optimum.evidence, recorded.evidence, optimum.settled)
    assert np.array_equal(optimum.states, recorded.states)
    assert optimum.settled == (freedom is None)


def test_starts_that_exclude_one_another_contradict() -> None:
    """Ten sds away, and less likely by fewer nats than process noise takes: five squares of jumps are half a nat."""
    best, _ = fitted()
    best = replace(best, absorbed=5.0)
    sd = np.sqrt(best.covariance[0, 0])
    other = replace(best, mean=best.mean + 10 * sd, evidence=best.evidence - 50.0)
    assert contradiction([best]) is None
    assert contradiction([best, other]) is None
    assert contradiction([best, replace(other, evidence=best.evidence - 5.0)]) == pytest.approx(10.0)
    assert contradiction([other, replace(best, absorbed=200.0)]) == pytest.approx(10.0)
    assert contradiction([replace(best, absorbed=200.0), replace(other, mean=best.mean + 3 * sd)]) is None
    wider = replace(other, covariance=25 * best.covariance)
    assert contradiction([replace(best, absorbed=200.0), wider]) is None
