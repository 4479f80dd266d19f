"""What can not start from a measurement is said by name."""

from __future__ import annotations

import numpy as np
import pytest

from sipe_bayes.calibration.gathered import unmeasured_starts
from sipe_bayes.core.findings import Severity
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.likelihood import Segments, StateSpace
from sipe_bayes.simulation.simulator import Simulator
from tests.problems.bodies import BALL, DAMPING, POSE, cube, tosses


def test_a_free_joint_seen_through_its_gyro_alone_blocks() -> None:
    simulator = cube(*(f"sensor:gyro[{i}]" for i in range(3)))
    logs, _ = tosses(simulator, 1, 5, seed=0)
    (said,) = unmeasured_starts(simulator, logs, Segments(), holdout=False)
    assert said.severity is Severity.BLOCKING
    assert "joint free" in said.text
    assert "measure body:cube.position and body:cube.orientation" in said.text
    assert unmeasured_starts(simulator, logs, StateSpace(), holdout=False) == []
    (said,) = unmeasured_starts(simulator, logs, StateSpace(), holdout=True)
    assert said.severity is Severity.CAUTION
    assert "held-out" in said.text


def test_a_measured_pose_says_nothing() -> None:
    simulator = cube(*POSE)
    logs, _ = tosses(simulator, 1, 5, seed=0)
    assert unmeasured_starts(simulator, logs, Segments(), holdout=True) == []


@pytest.mark.parametrize("measured", [True, False])
def test_a_ball_joint_needs_its_orientation_alone(measured: bool) -> None:
    channels = ["joint:hinge.position", *(["body:bob.orientation"] if measured else [])]
    simulator = Simulator(MjcfEnvironment.build(BALL, [DAMPING], [], channels), num_threads=1)
    made = simulator.rollout(np.array([[0.2]]), np.zeros((1, 4, 0)), simulator.default_state(), 0.004)
    logs = Trajectories.stack([Trajectory(made.observations[0], made.actions[0], 0.004, name="swing")])
    said = unmeasured_starts(simulator, logs, Segments(), holdout=False)
    assert len(said) == (not measured)
    assert all("measure body:bob.orientation," in one.text for one in said)
