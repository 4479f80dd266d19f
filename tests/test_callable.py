"""Functions in MuJoCo's place."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

import sipe_bayes as sipe
from sipe_bayes.inference import ESTIMATORS
from tests.quick import SMALL

SPACE = sipe.ParameterSpace([sipe.Parameter("a", low=0.0, high=2.0), sipe.Parameter("b", low=-1.0, high=1.0)])
MATRIX = np.array([[1.0, 0.5], [0.0, 1.0], [1.0, -1.0]])
X = MATRIX @ np.array([0.9, 0.2])
SD = 0.1


def plain(values: np.ndarray) -> np.ndarray:
    return values @ MATRIX.T


def noisy(values: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    return plain(values) + SD * generator.standard_normal((len(values), 3))


def exact() -> tuple[np.ndarray, np.ndarray]:
    """Mean and sd (2,) in physical units."""
    covariance = np.linalg.inv(MATRIX.T @ MATRIX) * SD**2
    return covariance @ MATRIX.T @ X / SD**2, np.sqrt(np.diag(covariance))


@pytest.mark.parametrize("name", list(ESTIMATORS))
def test_every_estimator_takes_an_observed_x(name: str) -> None:
    """Those with a likelihood or a density find the exact posterior, mean to 0.4 sd and sds to 40 %; all give something."""
    simulator = sipe.CallableSimulator(plain, SPACE, likelihood=SD)
    estimator = sipe.get_estimator(simulator, name, **{"seed": 0, "budget": 1500, **SMALL.get(name, {})})
    posterior = estimator.fit(X)
    values = posterior.values(4000, generator=torch.Generator().manual_seed(0))
    mean, sd = exact()
    print(name, values.mean(0), values.std(0), mean, sd)
    assert estimator.rollouts <= estimator.budget
    if name in ("laplace", "mcmc", "npe", "bayessim"):
        np.testing.assert_array_less(np.abs(values.mean(0) - mean), 0.4 * sd)
        np.testing.assert_allclose(values.std(0), sd, rtol=0.4)
    elif name != "regression":
        np.testing.assert_array_less(np.abs(values.mean(0) - mean), 0.35)


def test_noise_of_a_row_depends_on_theta_and_seed_alone() -> None:
    theta = np.random.default_rng(0).random((5, 2))
    simulator = sipe.CallableSimulator(noisy, SPACE, seed=1)
    log = sipe.Trajectories.stack(simulator.trajectory(X))
    together = simulator.replay(theta, log).observations
    assert np.array_equal(simulator.replay(theta[2:3], log).observations[0], together[2])
    other = sipe.CallableSimulator(noisy, SPACE, seed=2).replay(theta, log).observations
    assert not np.allclose(other[:, 1], together[:, 1])


def test_failed_simulations_are_named() -> None:
    def fails(values: np.ndarray) -> np.ndarray:
        return np.where(values[:, :1] > 1.8, np.nan, plain(values))

    estimator = sipe.get_estimator(sipe.CallableSimulator(fails, SPACE, likelihood=SD), "abc", budget=400)
    estimator.fit(X)
    assert any("simulations made fn return NaN or infinity, mostly at high a" in w for w in estimator.warnings)


def test_a_missing_output_is_skipped_where_it_can_be() -> None:
    """laplace told to compare two of three outputs is wider, and right."""
    simulator, mean = sipe.CallableSimulator(plain, SPACE, likelihood=SD), exact()[0]
    missing, two = [X[0], X[1], np.nan], sipe.Segments(None, noise="white", noise_sd=(SD, SD), fit=("x0", "x1"))
    whole = sipe.get_estimator(simulator, "laplace").fit(X)
    part = sipe.get_estimator(simulator, "laplace", likelihood=two).fit(missing)
    assert (part.stddev > whole.stddev).all()
    np.testing.assert_allclose(SPACE.values(part.mean.numpy()), mean, atol=0.02)


def always_nan(values: np.ndarray) -> np.ndarray:
    return np.full((len(values), 3), np.nan)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: sipe.CallableSimulator("name", SPACE), "fn: expected a function"),
        (lambda: sipe.CallableSimulator(plain, SPACE, seed="one"), "seed: expected a whole number"),
        (lambda: sipe.CallableSimulator(plain, SPACE, likelihood="small"), "likelihood: expected one sd"),
        (lambda: sipe.CallableSimulator(plain, SPACE).trajectory([np.nan] * 3), "x: expected finite numbers"),
        (lambda: sipe.CallableSimulator(plain, SPACE).trajectory([np.inf, 0, 0]), "x: expected finite numbers"),
        (lambda: sipe.CallableSimulator(plain, SPACE).trajectory("abc"), "x: expected numbers"),
        *(
            (
                lambda n=name: sipe.get_estimator(sipe.CallableSimulator(plain, SPACE, SD), n).fit([0.0, 0.0, np.nan]),
                r"x: .*x(2|\[2\]) is NaN; leave it out of fn",
            )
            for name in ESTIMATORS
        ),
        (
            lambda: sipe.get_estimator(sipe.CallableSimulator(always_nan, SPACE), "abc", budget=50).fit(X),
            "0 of 50 simulations are valid, abc needs 10, the others made fn return NaN or infinity",
        ),
        (
            lambda: sipe.get_estimator(sipe.CallableSimulator(always_nan, SPACE), "bayesopt", budget=8).fit(X),
            "simulations made fn return NaN",
        ),
        (lambda: sipe.get_estimator(sipe.CallableSimulator(noisy, SPACE), "laplace"), "likelihood: laplace needs one"),
        (lambda: sipe.get_estimator(sipe.CallableSimulator(noisy, SPACE), "mcmc"), "likelihood: mcmc needs one"),
        (lambda: sipe.CallableSimulator(noisy, SPACE, likelihood=0.1), "fn's own"),
        (lambda: sipe.CallableSimulator(plain, SPACE, likelihood=-1.0), "one sd above zero"),
        (lambda: sipe.CallableSimulator(lambda v: v[:, 0], SPACE), "expected x"),
        (
            lambda: sipe.get_estimator(sipe.CallableSimulator(plain, SPACE), "abc").fit(np.zeros(2)),
            r"expected shape \(3,\)",
        ),
    ],
)
def test_wrong_input(call: Callable[[], Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        call()
