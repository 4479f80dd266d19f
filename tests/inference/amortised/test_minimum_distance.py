"""Summaries by minimum distance, on a normal problem of which some samples are not what the simulator says."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sipe_bayes.core.parameters import Parameter, ParameterSpace
from sipe_bayes.core.trajectory import Trajectory
from sipe_bayes.inference.amortised.abc import ABC
from sipe_bayes.inference.amortised.bayessim import BayesSim
from sipe_bayes.likelihood import Segments
from sipe_bayes.models.minimum_distance import MinimumDistance
from sipe_bayes.models.regressed import Regressed
from sipe_bayes.simulation.callable_simulator import CallableSimulator

SD, FAULTY = 0.3, slice(0, 30, 7)
A = np.random.default_rng(0).normal(0.5, 1.0, (30, 2))
TRUTH = np.array([0.55, 0.4])


def measured(seed: int, fault: float) -> np.ndarray:
    """30 samples A theta with noise, of which every seventh has a fault beside."""
    x = A @ TRUTH + SD * np.random.default_rng(seed).standard_normal(len(A))
    x[FAULTY] += fault
    return x


def exact(x: np.ndarray, left_out: slice) -> tuple[np.ndarray, np.ndarray]:
    """Mean and sd (2,) of the posterior from the samples that are right; the bounds are many sds away."""
    kept = np.delete(np.arange(len(A)), left_out)
    covariance = SD**2 * np.linalg.inv(A[kept].T @ A[kept])
    return covariance @ A[kept].T @ x[kept] / SD**2, np.sqrt(np.diag(covariance))


def test_faulty_samples_do_not_move_the_nearest_summary() -> None:
    """Over 40 logs: without faults as good as least squares, with faults as good as without these samples.

    Squares are in those of the exact posterior's sds, which is .05 for a method of 95 % efficiency.
    """
    rng = np.random.default_rng(1)
    theta = rng.uniform(size=(800, 2))
    samples = theta @ A.T + SD * rng.standard_normal((800, len(A)))
    regressed, summaries = Regressed.of(theta, samples, samples[:, :1], SD)
    nearest = MinimumDistance.of(summaries, regressed.samples(samples))
    off: dict[str, list[np.ndarray]] = {"clean": [], "faulty": [], "plain": []}
    for seed in range(40):
        for fault, name in ((0.0, "clean"), (4.0, "faulty")):
            x = measured(seed, fault)
            mean, sd = exact(x, FAULTY if fault else slice(0, 0))
            point, seen = regressed.samples(x[None])[0].astype(float), np.ones(len(A), bool)
            off[name].append((nearest(point, seen[regressed.samples.kept]) - mean) / sd)
            if fault:
                plain = regressed.summaries(regressed.points_of(x[None], x[None, :1]))[0]
                off["plain"].append((plain - mean) / sd)
    squares = {name: float(np.mean(np.square(values))) for name, values in off.items()}
    print(squares)
    assert squares["clean"] < 0.15
    assert squares["faulty"] < 0.15
    assert squares["plain"] > 5
    x, seen = measured(0, 0.0), np.ones(len(regressed.samples.kept), bool)
    seen[3:9] = False
    point = regressed.samples(x[None])[0].astype(float)
    other = np.where(seen, point, 99.0)
    np.testing.assert_array_equal(nearest(point, seen), nearest(other, seen), "what was not measured does not count")


@pytest.mark.parametrize("method", [BayesSim, ABC])
def test_a_robust_posterior_is_that_of_the_right_samples(method: type[Any]) -> None:
    def function(values: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        return values @ A.T + SD * rng.standard_normal((len(values), len(A)))

    space = ParameterSpace([Parameter(f"p{j}", 0.0, 1.0) for j in range(2)])
    simulator = CallableSimulator(function, space, name="faulty")
    settings = {"components": 2, "calibration": 0.0} if method is BayesSim else {"accepted": 0.2, "regression": True}
    x = measured(3, 4.0)
    mean, sd = exact(x, FAULTY)
    log = Trajectory(np.stack([np.zeros(len(A)), x]), np.zeros((1, 0)), 1.0)
    off, width = {}, {}
    for summary in ("regressed", "robust"):
        given = {"budget": 1500, "likelihood": Segments(noise_sd=(0.0,) * len(A)), "seed": 1, "summary": summary}
        posterior = method(simulator, **given, **settings).fit(log)
        off[summary] = np.abs(posterior.mean.numpy() - mean) / sd
        width[summary] = posterior.stddev.numpy() / sd
    print(off, width)
    assert (off["robust"] < 1.2).all()
    assert off["regressed"].max() > 2.5
    np.testing.assert_allclose(width["robust"], 1, atol=0.35)
