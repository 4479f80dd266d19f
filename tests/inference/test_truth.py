"""Estimators of every kind against exact posteriors; the full study is examples/studies/truth.py."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from sipe_bayes.inference import get_estimator
from tests.problems import quick
from tests.problems.linear_gaussian import carts_problem, function_problem, squared_function, squared_rod

SMALL = {**quick.SMALL, "bayessim": {"components": 2, "calibration": 0.0}}


@pytest.mark.parametrize("name", ["laplace", "mcmc", "npe", "bayessim"])
def test_the_linear_gaussian_posterior(name: str) -> None:
    """Mean to 0.4 sd, sds to 25 %, the correlation to 0.15, of 2,000 simulations or rollouts."""
    problem = carts_problem if name in ("laplace", "mcmc") else function_problem
    simulator, log, exact, likelihood = problem()
    estimator = get_estimator(simulator, name, budget=2000, seed=0, likelihood=likelihood, **SMALL.get(name, {}))
    posterior = estimator.fit(log)
    sd, found = exact.stddev.numpy(), posterior.covariance.numpy()
    true = exact.covariance.numpy()
    print(name, (posterior.mean - exact.mean).numpy() / sd, posterior.stddev.numpy() / sd)
    np.testing.assert_array_less(np.abs((posterior.mean - exact.mean).numpy()), 0.4 * sd)
    np.testing.assert_allclose(posterior.stddev.numpy(), sd, rtol=0.25)
    correlation = found[0, 1] / np.sqrt(found[0, 0] * found[1, 1]), true[0, 1] / np.sqrt(true[0, 0] * true[1, 1])
    assert abs(true[0, 1]) / np.sqrt(true[0, 0] * true[1, 1]) > 0.6
    assert abs(correlation[0] - correlation[1]) < 0.15, correlation


@pytest.mark.parametrize("name", ["laplace", "mcmc", "npe", "bayessim"])
def test_both_modes_of_a_squared_parameter(name: str) -> None:
    """Modes at 0.2 and 0.8: each has a third of the draws or more, and hardly any lie between.

    Laplace says there are two.
    """
    simulator, log, likelihood = squared_rod() if name in ("laplace", "mcmc") else squared_function()
    settings: dict[str, Any] = {"restarts": 4} if name in ("laplace", "mcmc") else SMALL[name]
    estimator = get_estimator(simulator, name, budget=2000, seed=1, likelihood=likelihood, **settings)
    draws = estimator.fit(log).sample((2000,), generator=torch.Generator().manual_seed(0)).numpy()[:, 0]
    low, high, between = (draws < 0.35).mean(), (draws > 0.65).mean(), np.abs(draws - 0.5).min()
    print(name, low, high, np.median(draws[draws < 0.5]), np.median(draws[draws > 0.5]), estimator.diagnostics)
    assert min(low, high) > 0.3, (low, high)
    assert low + high > 0.97, between
    assert np.median(draws[draws < 0.5]) == pytest.approx(0.2, abs=0.03)
    assert np.median(draws[draws > 0.5]) == pytest.approx(0.8, abs=0.03)
    if name == "laplace":
        assert estimator.diagnostics["modes"] == 2
