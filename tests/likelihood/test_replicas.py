"""Replicas with process noise: the same simulation control step by control step, shaken as much as asked for."""

from __future__ import annotations

import numpy as np

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.likelihood import Noise, Replicas
from sipe_bayes.simulation.simulator import Simulator
from tests.problems.pendulums import XML
from tests.problems.springs import HIGH, LOW, PROCESS, spring, spring_logs, spring_step


def test_next_to_no_process_noise_is_the_plain_replay() -> None:
    """With a delayed motor, a sensor read a physics step late, two logs of different lengths and a missing sample."""
    xml = XML.replace("</mujoco>", '<sensor><jointvel name="rate" joint="hinge"/></sensor></mujoco>')
    parameters = [
        Parameter("rod_mass", 0.3, 1.0, targets=("body:rod.mass",)),
        Parameter("delay", 0.0, 0.06, targets=("actuator:motor.delay",)),
    ]
    environment = MjcfEnvironment.build(xml, parameters, ["motor"], ["joint:hinge.position", "sensor:rate"])
    simulator, rng = Simulator(environment, num_threads=1), np.random.default_rng(0)
    logs = []
    for length in (40, 30):
        actions = rng.uniform(-1, 1, (length, 1))
        motion = simulator.rollout(np.array([0.5, 0.7]), actions, simulator.default_state(), dt=0.02)
        seen = motion.observations[0].copy()
        seen[7, 0] = np.nan
        logs.append(Trajectory(seen, actions, 0.02, name=f"log{length}", channels=environment.channels))
    recorded, noise, theta = (
        Trajectories.stack(logs),
        Noise(np.array([0.01, 0.1]), np.zeros(2)),
        np.array([[0.4, 0.6], [0.6, 0.3]]),
    )
    tiny = np.full(2, 1e-300)
    plain = Replicas(simulator, recorded, noise).many(theta, np.random.default_rng(1))
    stepped = Replicas(simulator, recorded, noise, tiny).many(theta, np.random.default_rng(1))
    for one, other in zip(plain, stepped, strict=True):
        assert one is not None
        assert other is not None
        np.testing.assert_allclose(one.observations, other.observations, atol=1e-10)


def test_states_are_shaken_as_much_as_asked_for() -> None:
    """Variances of 600 replicas of a linear spring's position along the log, against the plain recursion.

    All of 59 within 5 standard errors (28 %).
    """
    simulator, (log,) = spring(), spring_logs(count=1)
    recorded = Trajectories.stack(log)
    theta = np.tile([(12.0 - LOW) / (HIGH - LOW)], (600, 1))
    quiet = Noise(np.array([1e-9]), np.zeros(1))
    found = Replicas(simulator, recorded, quiet, PROCESS).many(theta, np.random.default_rng(0))
    assert all(one is not None for one in found)
    seen = np.stack([one.observations[0, :, 0] for one in found if one is not None])
    transition, covariance, expected = spring_step(12.0)[0], np.zeros((2, 2)), []
    for _ in range(seen.shape[1] - 1):
        covariance = transition @ covariance @ transition.T + np.diag(PROCESS**2)
        expected.append(covariance[0, 0])
    there = np.isfinite(seen[0, 1:])
    np.testing.assert_allclose(seen[:, 1:].var(0)[there], np.array(expected)[there], rtol=0.29)
    assert seen[:, 0].std() < 1e-8


def test_no_process_noise_is_none() -> None:
    simulator, logs = spring(), Trajectories.stack(spring_logs())
    assert Replicas(simulator, logs, Noise(np.array([0.01]), np.zeros(1)), np.zeros(2)).process is None
