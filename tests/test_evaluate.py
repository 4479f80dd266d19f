"""Scores over windows from measured starts: a bias is not counted twice, a divergence is said and stays where it is."""

from __future__ import annotations

import numpy as np

import sipe_bayes as sipe
from sipe_bayes.diagnostics.evaluate import channel_scores, errors
from sipe_bayes.likelihood import Segments, Windows
from sipe_bayes.parameters import Parameter
from sipe_bayes.simulator import Simulator
from sipe_bayes.trajectory import Trajectories, Trajectory
from tests.pendulums import XML, log, pendulum


def test_the_truth_with_a_sensor_bias_has_no_error() -> None:
    environment = sipe.MjcfEnvironment.build(
        XML,
        [
            Parameter("rod_mass", 0.3, 1.0, targets=("body:rod.mass",)),
            Parameter("bias", -0.5, 0.5, targets=("sensor:angle.bias",)),
        ],
        ["motor"],
        [sipe.Channel("joint:hinge.position", "angle"), sipe.Channel("joint:hinge.velocity", "rate")],
    )
    simulator = Simulator(environment, num_threads=1)
    theta = simulator.space.normalise(np.array([0.6, 0.3]))
    actions = 0.5 * np.sin(0.05 * np.arange(300))[:, None]
    motion = simulator.rollout(theta, actions, simulator.default_state(), dt=0.01)
    trajectory = Trajectory(motion.observations[0], actions, 0.01, name="biased", channels=environment.channels)
    windows = Windows(Segments(0.5), simulator, Trajectories.stack(trajectory))
    found = errors(windows, np.stack([theta, simulator.space.normalise(np.array([0.6, 0.0]))]))
    assert found[0].max() < 2e-3  # what is left is the smoothing of the starts
    assert found[1, 0, 0] > 0.02


def test_a_diverging_log_does_not_hide_the_others() -> None:
    simulator = pendulum()
    good = log(simulator, [0.6, 0.05], 1, "good")
    wild = Trajectory(good.observations.copy(), good.actions, 0.01, name="wild", channels=good.channels)
    wild.observations[200:] = 1e12 * np.sign(np.sin(np.arange(201)))[:, None]
    windows = Windows(Segments(1.0), simulator, Trajectories.stack([good, wild]))
    rows = {row.log: row for row in channel_scores(windows, simulator.space.normalise(np.array([0.6, 0.05])))}
    assert rows["good"].rmse < 0.05
    assert not rows["wild"].rmse < 1e3
