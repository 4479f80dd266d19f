"""A parameter of which half of the range changes nothing: chains against the posterior on a grid."""

from __future__ import annotations

import numpy as np
import pytest

from sipe_bayes.inference.laplace.estimator import Laplace
from sipe_bayes.inference.laplace.state_space.state import ChainOptimum
from sipe_bayes.likelihood.settings import StateSpace
from tests.problems.floors import damping_quantiles, floored_log, floored_pendulum

LEVELS = [0.05, 0.5, 0.95]


@pytest.mark.parametrize("starts", ["recorded", "estimated"])
def test_draws_hold_the_side_that_changes_nothing(starts: str) -> None:
    """Quantiles of the damping to .08 of the range of those on the grid, where the normal's lower end is .3 too high.

    Nothing blocks, and the mass holds the truth.
    """
    theta = np.array([0.4, 0.3])
    log = floored_log(theta, 0, 100, 0.02)
    exact = damping_quantiles(log, LEVELS)
    begin = np.array([[0.5, 0.7]])  # above the floor: below it no slope leads anywhere
    estimator = Laplace(floored_pendulum(), likelihood=StateSpace(starts=starts), initial=begin)
    posterior = estimator.fit(log)
    found = posterior.quantile(LEVELS).numpy()
    assert estimator.state is not None
    (optimum, *_) = estimator.state.search.optima
    low = optimum.mean[1] - 1.645 * np.sqrt(optimum.spread[1, 1])
    print(found.T, exact, "normal from", low, estimator.diagnostics, estimator.warnings)
    np.testing.assert_allclose(found[:, 1], exact, atol=0.08)
    assert low > exact[0] + 0.2
    assert found[0, 0] < theta[0] < found[2, 0]
    assert not estimator.findings.blocking


def test_a_normal_that_stands_is_not_drawn_from() -> None:
    """Well above the floor: the optimum's own normal, and a look of at most 25 points, each simulated twice at most."""
    log = floored_log(np.array([0.4, 0.8]), 0, 100, 0.02)
    estimator = Laplace(floored_pendulum(), likelihood=StateSpace(), restarts=1, candidates=0)
    posterior = estimator.fit(log)
    assert estimator.state is not None
    assert estimator.state.draws is None
    (optimum, *_) = estimator.state.search.optima
    assert isinstance(optimum, ChainOptimum)
    np.testing.assert_allclose(posterior.means[0].numpy(), optimum.mean)  # type: ignore[attr-defined]
    assert "draws" not in estimator.diagnostics
