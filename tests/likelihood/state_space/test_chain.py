"""A chain of states against a Kalman filter; what is refused."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import sipe_bayes as sipe
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.inference.laplace.estimator import Laplace
from sipe_bayes.likelihood.binding import bind
from sipe_bayes.likelihood.settings import StateSpace
from sipe_bayes.likelihood.state_space.chain import KNOWN_SD
from sipe_bayes.likelihood.state_space.differences import linearise
from sipe_bayes.likelihood.state_space.linearisation import eliminate_states, log_likelihood
from sipe_bayes.simulation.simulator import Simulator
from tests.problems.pendulums import log as pendulum_log
from tests.problems.pendulums import pendulum
from tests.problems.springs import (
    HIGH,
    LOW,
    MADE_WITH,
    SD,
    kalman,
    spring,
    spring_chain,
    spring_logs,
)


@pytest.mark.parametrize("theta", [0.1, 0.35, 0.8])
def test_the_marginal_likelihood_is_the_kalman_filters(theta: float) -> None:
    """To 1e-6 nats, two logs, wherever the states are when it is linearised."""
    chain, logs, firsts = spring_chain()
    noise = MADE_WITH
    away = chain.moved(chain.reference, 0.3 * np.random.default_rng(1).standard_normal((len(chain.log), 2)))
    for states in (chain.reference, away):
        linear = linearise(chain, np.array([theta]), states)
        assert linear is not None
        value = log_likelihood(linear, noise, eliminate_states(linear, noise))
        assert value == pytest.approx(kalman(logs, firsts, LOW + theta * (HIGH - LOW)), abs=1e-6)


def test_a_recorded_start_is_believed_and_the_other_states_are_not() -> None:
    logs = [replace(log, states=np.full((len(log) + 1, 3), 7.0)) for log in spring_logs()]
    for log in logs:
        assert log.states is not None
        log.states[0] = 0.0, 0.3, 0.0
    chain = bind(StateSpace(noise_sd=(SD,), starts="recorded"), spring(), Trajectories.stack(logs))
    measured = bind(StateSpace(noise_sd=(SD,)), spring(), Trajectories.stack(spring_logs())).reference
    np.testing.assert_array_equal(chain.reference[~chain.first], measured[~chain.first])
    linear = linearise(chain, np.array([0.35]), chain.reference)
    assert linear is not None
    value = log_likelihood(linear, MADE_WITH, eliminate_states(linear, MADE_WITH))
    assert value == pytest.approx(
        kalman(logs, np.array([[0.3, 0.0]] * 2), LOW + 0.35 * (HIGH - LOW), start_sd=KNOWN_SD), abs=1e-6
    )


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: sipe.get_estimator(spring(), "abc", likelihood=StateSpace()), "StateSpace is for laplace and mcmc"),
        (lambda: bind(StateSpace(fit=("speed",)), spring(), Trajectories.stack(spring_logs())), "unknown channels"),
        (
            lambda: bind(
                StateSpace(),
                sipe.CallableSimulator(lambda v: v, pendulum().space, likelihood=0.1),
                Trajectories.stack(spring_logs()),
            ),
            "needs a MuJoCo simulator",
        ),
        (
            lambda: bind(StateSpace(), Simulator(sipe.make_task("FetchPush")), Trajectories.stack(spring_logs())),
            "no controller's memory, as Fetch has one, in measurements; use starts='recorded'",
        ),
        (lambda: StateSpace(starts="known"), "expected 'estimated' or 'recorded', got 'known'"),
        (
            lambda: bind(StateSpace(starts="recorded"), spring(), Trajectories.stack(spring_logs())),
            "needs trajectories with states",
        ),
        (lambda: Laplace(spring(), likelihood=StateSpace(), budget=5).fit(spring_logs()), "raise the budget|raise it"),
    ],
)
def test_wrong_input_is_named(call, words: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ValueError, match=words):
        call()


@pytest.mark.parametrize("kind", [StateSpace, sipe.Segments])
@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"noise_sd": 0.1}, "noise_sd: expected one sd for each channel, None where unknown, got 0.1"),
        ({"noise_sd": (-0.1,)}, "noise_sd: expected finite sds .* zero, got -0.1"),
        ({"noise_sd": (float("nan"),)}, "noise_sd: expected finite sds .* zero, got nan"),
        (
            {"noise_sd": (0.1, 0.1)},
            r"noise_sd: expected one for each of the channels \['joint:hinge.position'\], got 2",
        ),
        ({"fit": "hinge"}, "fit: expected names of channels, .* got 'hinge'"),
        ({"fit": ()}, "fit: expected names of channels"),
    ],
)
def test_wrong_settings_are_named(kind: Any, settings: dict[str, Any], words: str) -> None:
    simulator = pendulum()
    log = pendulum_log(simulator, [0.6, 0.1], 1, steps=100)
    with pytest.raises(ValueError, match=words):
        Laplace(simulator, likelihood=kind(**settings)).fit(log)


def test_states_without_measurement_noise_are_refused() -> None:
    with pytest.raises(ValueError, match="noise_sd: expected finite sds above zero"):
        StateSpace(noise_sd=(0.0,))
