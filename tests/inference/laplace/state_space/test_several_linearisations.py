"""What other linearisations say of an optimum: nothing where the model is linear, their scatter where slopes jump."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.inference.laplace.estimator import Laplace
from sipe_bayes.inference.laplace.state_space import several_linearisations
from sipe_bayes.inference.laplace.state_space.options import WideTuning
from sipe_bayes.inference.laplace.state_space.several_linearisations import linearisations_cost, scattered
from sipe_bayes.inference.laplace.state_space.state import ChainOptimum
from sipe_bayes.inference.laplace.state_space.target import ChainFit, ChainTarget
from sipe_bayes.inference.laplace.strategy import SearchProblem
from sipe_bayes.likelihood.settings import StateSpace
from sipe_bayes.likelihood.state_space.differences import linearise_by
from tests.problems.springs import spring, spring_logs


def fitted(rough: bool) -> tuple[SearchProblem, ChainTarget, ChainOptimum]:
    """The optimum of a linear model, as if wide differences had ended there, and said to be rough or not."""
    estimator, logs = Laplace(spring(), likelihood=StateSpace(), restarts=1, candidates=0), spring_logs()
    estimator.fit(logs)
    assert estimator.state is not None
    (end,) = estimator.state.search.optima
    assert isinstance(end, ChainOptimum)
    assert end.shift is None  # nothing was asked: it is smooth
    chain = estimator.bound(Trajectories.stack(logs))
    lengths = {"theta_step": np.full(1, 0.01), "state_step": np.full((len(end.states), 2), 0.01)}
    optimum = replace(end, rough=rough, **lengths)
    return estimator.problem, ChainTarget(estimator.prior, chain, ChainFit.at(chain, optimum)), optimum


def test_a_linear_model_says_the_same_everywhere() -> None:
    """Ten linearisations of it have one normal, to a hundredth of its sd; where it is not rough none is taken."""
    problem, target, optimum = fitted(rough=True)
    before = target.chain.rollouts
    whole, sd = scattered(problem, target, optimum), np.sqrt(optimum.covariance[0, 0])
    taken, logs = target.chain.rollouts - before, len(target.chain.trajectories)
    assert 0 < taken <= linearisations_cost(problem, target.chain.num_start) * logs
    assert whole.shift is not None
    assert whole.scatter is not None
    print("shift", whole.shift / sd, "scatter", whole.scatter / sd**2)
    assert abs(whole.shift[0]) < 0.03 * sd
    assert whole.scatter[0, 0] < 0.01 * sd**2
    smooth = replace(optimum, rough=False)
    assert scattered(problem, target, smooth) is smooth


def test_slopes_that_jump_scatter_the_mean_and_widen_the_interval(monkeypatch: pytest.MonkeyPatch) -> None:
    """Jumps with a bias and noise: their average is the shift, within its error, and their scatter is added."""
    problem, target, optimum = fitted(rough=True)
    rng, bias, noise = np.random.default_rng(0), 0.02, 0.05
    plain = optimum.spread

    def torn(*of: Any) -> Any:
        linear = linearise_by(*of)
        assert linear is not None
        jump = linear.jump.copy()
        jump[10:20, 1] += bias + noise * rng.standard_normal()
        return replace(linear, jump=jump)

    def shifts(count: int) -> ChainOptimum:
        monkeypatch.setattr(WideTuning, "linearisations", count)
        return scattered(problem, target, optimum)

    assert shifts(0) is optimum
    monkeypatch.setattr(several_linearisations, "linearise_by", torn)
    few, many = shifts(10), shifts(100)
    assert few.scatter is not None
    assert many.scatter is not None
    assert few.shift is not None
    assert many.shift is not None
    error = np.sqrt(many.scatter[0, 0] / 10)
    print("few", few.shift, few.scatter, "many", many.shift, many.scatter, "error", error)
    assert abs(few.shift[0] - many.shift[0]) < 3.5 * error  # one in two thousand
    assert few.scatter[0, 0] == pytest.approx(many.scatter[0, 0], rel=0.9)
    assert np.allclose(few.spread, plain + few.scatter)
    assert np.allclose(few.centre, optimum.mean + few.shift)
    assert few.as_linearised.centre is optimum.mean
