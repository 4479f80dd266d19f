"""The search from known first states where a mass is not measured, and with little budget."""

from __future__ import annotations

import numpy as np

from sipe_bayes.core.budget import BudgetTooSmall
from sipe_bayes.inference.laplace.estimator import Laplace
from sipe_bayes.likelihood.settings import StateSpace
from tests.problems.hung import hung, hung_log


def test_what_nothing_measures_is_followed() -> None:
    """Of 9 intervals of 90 % at least 6 hold the truth (right ones fail with probability 0.8 %)."""
    rng, covered = np.random.default_rng(3), 0
    for seed in range(9):
        theta = rng.uniform(0.1, 0.9, 1)
        estimator = Laplace(hung(), likelihood=StateSpace(starts="recorded"), restarts=1, candidates=0)
        posterior = estimator.fit(hung_log(theta, seed))
        low, high = posterior.quantile([0.05, 0.95]).numpy()
        covered += int(low[0] <= theta[0] <= high[0])
        print(theta, posterior.mean.numpy(), posterior.stddev.numpy(), estimator.warnings)
        assert float(posterior.stddev[0]) < 0.1
    print(covered)
    assert covered >= 6


def test_a_budget_that_ends_early_leaves_an_honest_posterior_or_says_so() -> None:
    """Of six logs with each of four budgets: the truth within four sds (right ones fail with probability 0.1 %)."""
    ended = 0
    for seed in range(6):
        for budget in (2, 50, 100, 200):
            estimator = Laplace(hung(), likelihood=StateSpace(starts="recorded"), budget=budget, seed=seed)
            try:
                posterior = estimator.fit(hung_log(np.array([0.4]), seed))
            except BudgetTooSmall:
                continue
            mean, sd = float(posterior.mean[0]), float(posterior.stddev[0])
            ended += 1
            print(seed, budget, mean, sd)
            assert abs(mean - 0.4) < 4 * sd
    assert ended >= 6
