"""The target of mcmc against a Kalman filter."""

from __future__ import annotations

import numpy as np
import pytest

import sipe_bayes as sipe
from sipe_bayes.inference.laplace.state_space.state import ChainOptimum
from sipe_bayes.inference.laplace.state_space.target import ChainFit, ChainTarget
from sipe_bayes.likelihood.state_space.differences import linearise
from sipe_bayes.likelihood.state_space.linearisation import eliminate_states
from tests.problems.springs import (
    HIGH,
    LOW,
    MADE_WITH,
    PROCESS,
    kalman,
    spring,
    spring_chain,
)


@pytest.mark.parametrize("lengths", [0.0, 0.01])
def test_the_target_with_fresh_jacobians_is_the_kalman_filter(lengths: float) -> None:
    """Refreshed: differences between thetas to 1e-6 nats.

    As mcmc has it: to 0.2 nats within two sds of the optimum. The model is linear, so longer differences change
    nothing.
    """
    chain, logs, firsts = spring_chain()
    noise, theta = MADE_WITH, np.array([0.35])
    linear = linearise(chain, theta, chain.reference)
    assert linear is not None
    solved = eliminate_states(linear, noise)
    states = chain.moved(chain.reference, solved.blocks(np.zeros(1)))
    optimum = ChainOptimum(
        theta=theta,
        mean=theta,
        covariance=np.eye(1),
        evidence=0.0,
        sd=noise.sd,
        tau=np.zeros(len(noise.sd)),
        states=states,
        slope=solved.slope,
        process=noise.process,
        movement=PROCESS,
        outliers=np.zeros(len(chain.linked), bool),
        theta_step=np.full(1, lengths),
        state_step=np.full((len(states), 2), lengths),
        settled=True,
        point=0,
    )
    target = ChainTarget(sipe.get_estimator(spring(), "laplace").prior, chain, ChainFit.at(chain, optimum))
    sd = solved.precision[0, 0] ** -0.5
    points = theta + sd * np.array([[-2.0], [-1.0], [0.0], [1.0], [2.0]])
    exact = np.array([kalman(logs, firsts, LOW + p[0] * (HIGH - LOW)) for p in points])
    fresh = np.array([target.refreshed(p) for p in points])
    np.testing.assert_allclose(fresh - fresh[2], exact - exact[2], atol=1e-6)
    kept = target(points)
    print("kept jacobians", kept - kept[2] - (exact - exact[2]))
    np.testing.assert_allclose(kept - kept[2], exact - exact[2], atol=0.2)
    assert np.isneginf(target(np.array([[-0.1], [1.2]]))).all()
