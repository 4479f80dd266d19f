"""Theta's interval with the noise integrated out, against a quadrature over both noises of a linear chain."""

from __future__ import annotations

import numpy as np
import pytest

import sipe_bayes as sipe
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.inference.laplace.estimator import Laplace
from sipe_bayes.inference.laplace.state_space.noise import process_penalty
from sipe_bayes.inference.laplace.state_space.options import NoiseTuning
from sipe_bayes.inference.laplace.state_space.state import ChainOptimum
from sipe_bayes.likelihood.binding import bind
from sipe_bayes.likelihood.state_space.linearisation import ChainNoise
from sipe_bayes.posterior import GaussianMixture
from tests.problems.springs import HIGH, LOW, SD, kalman, spring, spring_logs


@pytest.mark.parametrize(("count", "steps"), [(1, 30), (2, 60)])
def test_the_interval_is_that_of_a_quadrature_over_the_noise(count: int, steps: int) -> None:
    """Few steps leave the process noise open by a factor, many do not: the sd within 10 % of Kalman filters on a grid.

    Theta, position's and velocity's process noise are each summed over; the scatter of 800 draws is 4 %.
    """
    logs, settings = spring_logs(seed=3, count=count, steps=steps), sipe.StateSpace(noise_sd=(SD,))
    estimator = Laplace(spring(), likelihood=settings, seed=1)
    posterior = estimator.fit(logs)
    assert estimator.state is not None
    optimum = max(estimator.state.search.optima, key=lambda one: one.evidence)
    assert isinstance(optimum, ChainOptimum)
    chain = bind(settings, spring(), Trajectories.stack(logs))
    firsts, held = chain.reference[chain.first][:, 1:3], float(np.sqrt(optimum.covariance[0, 0]))
    theta = optimum.mean[0] + held * np.linspace(-5, 5, 13)
    shares = np.exp(np.linspace(-4.0, 2.0, 9))
    value = np.empty((len(shares), len(shares), len(theta)))
    for i, position in enumerate(shares):
        for j, velocity in enumerate(shares):
            noise = ChainNoise(optimum.sd, optimum.process * [position, velocity])
            penalty = process_penalty(noise, optimum.movement, NoiseTuning())
            value[i, j] = [kalman(logs, firsts, LOW + t * (HIGH - LOW), noise) - penalty for t in theta]
    weight = np.exp(value - value.max()).sum((0, 1))
    mean = theta @ weight / weight.sum()
    exact = np.sqrt((theta - mean) ** 2 @ weight / weight.sum())
    sd = float(np.sqrt(optimum.spread[0, 0]))
    print("held", held, "averaged", sd, "exact", exact)
    assert sd == pytest.approx(exact, rel=0.1)
    assert isinstance(posterior, GaussianMixture)
    np.testing.assert_allclose(posterior.covariances[0], optimum.spread)
