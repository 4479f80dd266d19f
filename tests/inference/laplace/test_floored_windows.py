"""A parameter of which half of the range changes nothing: windows against the posterior on a grid."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import sipe_bayes as sipe
from sipe_bayes.inference.laplace import Laplace
from tests.problems.floors import damping_quantiles, floored_log, floored_pendulum

LEVELS = [0.05, 0.5, 0.95]


@pytest.mark.parametrize(
    ("starts", "window", "seed"), [("recorded", None, 1), ("estimated", None, 1), ("estimated", 0.5, 0)]
)
def test_draws_hold_the_side_that_changes_nothing(starts: str, window: float | None, seed: int) -> None:
    """Quantiles of the damping to .08 of the range of those on the grid; the normals of all three begin above .44.

    Above the floor the optimum's own normal stays.
    """
    for truth, drawn in ((0.3, True), (0.8, False)):
        log = floored_log(np.array([0.4, truth]), seed, 100, 0.02)
        exact = damping_quantiles(log, LEVELS)
        given = log if starts == "recorded" else replace(log, states=None)
        likelihood = sipe.Segments(window, noise="white", starts=starts)
        estimator = Laplace(floored_pendulum(), likelihood=likelihood, seed=seed)
        found = estimator.fit(given).quantile(LEVELS)[:, 1].numpy()
        print(found, exact, estimator.rollouts, estimator.diagnostics, estimator.warnings)
        assert ("draws" in estimator.diagnostics) is drawn
        np.testing.assert_allclose(found, exact, atol=0.08)
        assert not estimator.findings.blocking


@pytest.mark.parametrize("starts", ["recorded", "estimated"])
def test_a_search_that_ends_where_nothing_changes(starts: str) -> None:
    """Below the floor's edge there is no slope, so the normal is open: the steep side is looked for all the same."""
    log = floored_log(np.array([0.4, 0.3]), 1, 100, 0.02)
    exact = damping_quantiles(log, LEVELS)
    likelihood = sipe.Segments(None, noise="white", starts=starts)
    estimator = Laplace(floored_pendulum(), likelihood=likelihood, seed=1, initial=np.array([[0.4, 0.4999]]))
    drawn = estimator.fit(log if starts == "recorded" else replace(log, states=None)).quantile(LEVELS)[:, 1].numpy()
    print(drawn, exact, estimator.diagnostics)
    np.testing.assert_allclose(drawn, exact, atol=0.08)
