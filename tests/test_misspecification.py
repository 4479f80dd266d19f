"""What the model lacks is seen in the residuals and named; a right model with white or coloured noise is left in peace.

One log each at fixed seeds; rates over many are measured by examples/studies/misspecification.py.
"""

from __future__ import annotations

import numpy as np
import pytest

from sipe_bayes.diagnostics.misspecification import Misfit, misfit, outside_prior
from sipe_bayes.inference import get_estimator
from sipe_bayes.noise import Noise
from sipe_bayes.parameters import Parameter
from sipe_bayes.posterior import prior
from sipe_bayes.trajectory import Trajectories, Trajectory
from tests.pendulums import log, pendulum

FRICTION = Parameter("coulomb", 0.0, 0.1, targets=("joint:hinge.frictionloss",))
DELAY = Parameter("delay", 0.0, 0.06, targets=("actuator:motor.delay",))


def found(recorded: Trajectory, seed: int = 0) -> Misfit:
    """Of a fit of rod mass and damping alone."""
    simulator = pendulum()
    method = get_estimator(simulator, "laplace", restarts=1, candidates=0)
    posterior = method.fit(recorded)
    windows = method.likelihood.bind(simulator, Trajectories.stack(recorded))
    noise = Noise(np.array(method.diagnostics["noise_sd"]), np.array(method.diagnostics["noise_tau"]))
    return misfit(windows, posterior.mode.numpy(), noise, seed=seed, simulated=39)


@pytest.mark.parametrize(
    ("missing", "value", "rho", "cause"),
    [(FRICTION, 0.03, 0.0, "friction"), (DELAY, 0.02, 0.9, "a delay of motor")],
)
def test_what_is_left_out_is_seen_and_named(missing: Parameter, value: float, rho: float, cause: str) -> None:
    """Odder than all 39 simulations of the null."""
    seen = found(log(pendulum(missing), [0.6, 0.08, value], 2, rho=rho))
    print(seen.text)
    assert seen.p == 1 / 40
    assert cause in seen.cause
    assert seen.channel == "joint:hinge.position"
    assert seen.log == "log"
    assert 0 <= seen.start < seen.stop <= 4
    for word in (seen.cause, seen.channel, "do not trust"):
        assert word in seen.text


@pytest.mark.parametrize("rho", [0.0, 0.9])
def test_a_right_model_is_left_in_peace(rho: float) -> None:
    """Two logs, each below p = 0.05 with a probability of 5 %; the same seed gives the same p."""
    recorded = log(pendulum(), [0.6, 0.08], 3, rho=rho)
    seen = found(recorded)
    print(seen)
    assert seen.p > 0.05
    assert found(recorded) == seen


def test_a_burst_of_noise_is_placed_in_time() -> None:
    """Ten times the noise for half a second."""
    recorded = log(pendulum(), [0.6, 0.08], 4)
    burst = recorded.observations.copy()
    burst[200:250] += 0.1 * np.random.default_rng(0).standard_normal((50, 1))
    seen = found(Trajectory(burst, recorded.actions, recorded.dt, name="log", channels=recorded.channels))
    print(seen.text)
    assert seen.p == 1 / 40
    assert seen.start < 2.5
    assert seen.stop > 2.0


def test_a_log_outside_the_prior_is_named_and_one_inside_is_not() -> None:
    """p of a log of the prior is uniform: below 0.02 once in fifty. An angle in degrees taken for radians is none of these."""
    simulator = pendulum()
    inside = log(simulator, [0.6, 0.08], 5, steps=100)
    outside = Trajectory(np.degrees(inside.observations), inside.actions, inside.dt, name="degrees")
    logs = Trajectories.stack([inside, outside])
    windows = get_estimator(simulator, "laplace").likelihood.bind(simulator, logs)
    one, other = outside_prior(windows, prior(simulator.space), Noise(np.array([0.01]), np.zeros(1)))
    print(one, other)
    assert one.p > 0.02
    assert other.p == pytest.approx(1 / 101)
    assert "log degrees is unlike every simulation" in other.text
    assert "units or signs" in other.text
