"""StateSpace where the first states are known, through contact: a pushed mass that bounces off the floor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import sipe_bayes as sipe
from sipe_bayes.inference.laplace import Laplace
from sipe_bayes.parameters import Parameter
from sipe_bayes.simulator import Simulator
from sipe_bayes.state_space import StateSpace
from sipe_bayes.trajectory import Trajectory

KNOWN = StateSpace(starts="recorded")


def bouncing(num_threads: int = 1) -> Simulator:
    """A ball of unknown mass on a spring of unknown stiffness above a stiff floor, which it hits again and again; its height measured,
    and a second joint that nothing moves or measures, whose damping is unknown, too."""
    xml = (
        '<mujoco><option timestep="0.005"/><worldbody><geom type="plane" size="1 1 .1" solref="-8000 -2"/>'
        '<body name="ball" pos="0 0 .25"><joint name="z" type="slide" axis="0 0 1" stiffness="20" damping="0.2"/>'
        '<geom name="ball" size=".1" mass="1" solref="-8000 -2"/></body>'
        '<body pos="5 0 1"><joint name="idle" type="hinge" axis="0 0 1" damping="1"/><geom size=".1"/></body>'
        '</worldbody><actuator><motor name="m" joint="z"/></actuator></mujoco>'
    )
    parameters = [
        Parameter("mass", 0.5, 2.0, targets=("body:ball.mass",)),
        Parameter("stiffness", 5.0, 40.0, targets=("joint:z.stiffness",)),
        Parameter("idle_damping", 0.5, 1.5, targets=("joint:idle.damping",)),
    ]
    environment = sipe.MjcfEnvironment.build(xml, parameters, ["m"], ["joint:z.position"])
    return Simulator(environment, num_threads=num_threads)


def bouncing_log(theta: np.ndarray, seed: int, steps: int = 100) -> Trajectory:
    """2 s from rest in the air, with 5 mm of noise and the states."""
    simulator, actions = bouncing(), 6 * np.sin(np.arange(steps) * 0.2 + seed)[:, None]
    (motion,) = simulator.rollout(theta, actions, simulator.default_state(), dt=0.02)
    noise = 0.005 * np.random.default_rng(seed).standard_normal(motion.observations.shape)
    return replace(motion, observations=motion.observations + noise)


def test_intervals_through_a_bouncing_contact_hold_the_truth() -> None:
    """Of 20 intervals of 90 % for what bounces at least 14 hold the truth (right ones fail with probability 0.2 %, were they
    independent); what nothing moves keeps its prior."""
    rng, covered, errors = np.random.default_rng(4), 0, []
    for seed in range(10):
        theta = rng.uniform(0.1, 0.9, 3)
        estimator = Laplace(bouncing(), likelihood=KNOWN, restarts=1, seed=seed)
        posterior = estimator.fit(bouncing_log(theta, seed))
        low, high = posterior.quantile([0.05, 0.95]).numpy()
        covered += int(((low <= theta) & (theta <= high))[:2].sum())
        errors.append(np.abs(posterior.mean.numpy() - theta)[:2])
        print(
            seed, theta.round(3), posterior.mean.numpy().round(3), posterior.stddev.numpy().round(4), estimator.warnings
        )
        assert float(posterior.stddev[2]) == pytest.approx(1 / np.sqrt(12), rel=0.02)
    print("covered", covered, "of 20, median error", np.median(errors))
    assert covered >= 14
    assert np.median(errors) < 0.02


def test_mcmc_agrees_with_laplace() -> None:
    """Means to half an sd and sds to half of each other, of what bounces, with the same Jacobians over wide differences."""
    theta = np.array([0.4, 0.6, 0.5])
    log = bouncing_log(theta, 5)
    fitted = {}
    for name in ("laplace", "mcmc"):
        estimator = sipe.get_estimator(bouncing(), name, likelihood=KNOWN, seed=1)
        posterior = estimator.fit(log)
        fitted[name] = (posterior.mean.numpy()[:2], posterior.stddev.numpy()[:2])
        print(name, *fitted[name], estimator.rollouts, estimator.warnings)
    (mean, sd), (other, other_sd) = fitted.values()
    assert (np.abs(mean - other) < 0.5 * sd).all()
    assert (np.abs(np.log(other_sd / sd)) < np.log(1.5)).all()
