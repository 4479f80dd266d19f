"""Where windows start: free and ball joints from measured poses, and what no measurement tells."""

from __future__ import annotations

import numpy as np
import pytest

from sipe_bayes.core.rotations import between, quaternions
from sipe_bayes.core.smoothing import smoothed, smoothed_rotations
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.likelihood import Segments, estimate_states, unmeasured_joints
from sipe_bayes.likelihood.windows import Windows
from sipe_bayes.simulation.simulator import Simulator
from tests.problems.bodies import BALL, CUBE, DAMPING, FRICTION, POSE, ROUND, cube, tosses, turns

TAG, SPEED, GYRO = (tuple(f"sensor:{name}[{i}]" for i in range(3)) for name in ("tag", "speed", "gyro"))
FLIGHT = 20  # control steps before any of these cubes lands


@pytest.mark.parametrize(
    "measurements",
    [
        POSE,
        (*TAG, "sensor:tag_turn"),
        (*POSE, "body:cube.linear_velocity", "body:cube.angular_velocity"),
        (*TAG, "body:cube.orientation", *SPEED, *GYRO),
    ],
)
def test_a_free_joint_starts_from_the_measured_pose(measurements: tuple[str, ...]) -> None:
    """Of a flight without noise: position and turn to micrometres, velocities to what local quadratics miss."""
    simulator = cube(*measurements)
    logs, states = tosses(simulator, 3, FLIGHT, seed=1)
    for log, true in zip(logs, states, strict=True):
        found = estimate_states(simulator, log)
        gap = turns(simulator.model, found, true)
        raw = turns(simulator.model, estimate_states(simulator, log, raw=True), true)
        assert np.abs(raw).max() < 1e-9, "samples are taken as they are"
        velocity = np.abs(found[:, 8:14] - true[:, 8:14]).max(0)
        limit = [0.02] * 3 + [0.06] * 3  # a physics step of gravity: MuJoCo's place moves by the velocity after it
        assert (np.abs(gap) < [2e-3] * 3 + [6e-3] * 3).all(), np.abs(gap).max(0)
        assert (velocity < limit).all(), velocity
    assert Windows(Segments(None), simulator, logs).starts_measured


def test_a_gap_and_flipped_signs_do_not_matter() -> None:
    simulator = cube()
    logs, states = tosses(simulator, 1, FLIGHT, seed=2)
    seen = logs[0].observations.copy()
    size = np.linalg.norm(seen[:, 3:], axis=1, keepdims=True)
    other = seen.copy()
    other[:, 3:] -= np.where(np.arange(len(seen)) % 2, 2 * np.pi, 0.0)[:, None] * seen[:, 3:] / size
    other[7:9] = np.nan
    found = estimate_states(simulator, Trajectory(other, logs[0].actions, logs[0].dt))
    assert np.abs(turns(simulator.model, found, states[0])).max() < 0.03


@pytest.mark.parametrize("measured", ["sensor:own", "body:bob.orientation"])
def test_a_ball_joint_starts_from_what_its_body_measures(measured: str) -> None:
    """On an arm that moves: by its own quaternion, or its body's beside the arm's encoder."""
    environment = MjcfEnvironment.build(BALL, [DAMPING], [], [measured, "joint:hinge.position"])
    simulator = Simulator(environment, num_threads=1)
    start = simulator.default_state()
    start[1 + simulator.model.nq :] = [1.0, 1.0, -0.5, 1.0]
    made = simulator.rollout(np.array([[0.2]]), np.zeros((1, 30, 0)), start, 0.004)
    log = Trajectory(made.observations[0], np.zeros((30, 0)), 0.004)
    assert made.states is not None
    found, true = estimate_states(simulator, log), made.states[0]
    assert np.abs(turns(simulator.model, estimate_states(simulator, log, raw=True), true)).max() < 1e-9
    assert np.abs(turns(simulator.model, found, true)).max() < 5e-3
    assert np.abs(found[8:-8, -4:] - true[8:-8, -4:]).max() < 0.1
    assert not unmeasured_joints(simulator, Trajectories.stack([log]))


def test_smoothed_rotations_are_those_of_local_quadratics() -> None:
    """About one axis they are ``smoothed`` of the angle; a wrap changes nothing."""
    rng = np.random.default_rng(0)
    angle = np.cumsum(rng.normal(0.3, 0.05, 60))
    axis = np.array([0.6, 0.0, 0.8])
    smooth, velocity = smoothed_rotations(angle[:, None] * axis, 0.01)
    np.testing.assert_allclose(between(smooth, smoothed(angle, 0.01)[:, None] * axis), 0, atol=1e-9)
    np.testing.assert_allclose(velocity, smoothed(angle, 0.01, 1)[:, None] * axis, atol=1e-6)
    for count in (1, 2, 3):
        short, turning = smoothed_rotations(angle[:count, None] * axis, 0.01)
        assert short.shape == turning.shape == (count, 3)


def test_a_turning_frame_is_followed() -> None:
    """Constant velocity in the world's axes comes out as such, whatever the orientation."""
    velocity = np.array([1.0, -2.0, 3.0])
    vectors = np.arange(40)[:, None] * 0.02 * velocity
    _, found = smoothed_rotations(vectors, 0.02)
    np.testing.assert_allclose(found, np.tile(velocity, (40, 1)), atol=1e-6)
    assert np.abs(np.diff(quaternions(vectors), axis=0)).max() > 0.01


@pytest.mark.parametrize(
    ("measurements", "joints"),
    [
        ((*GYRO, *SPEED), [0]),
        (("body:cube.position",), [0]),
        (("body:cube.orientation",), [0]),
        (POSE, []),
    ],
)
def test_joints_that_no_measurement_tells_are_named(measurements: tuple[str, ...], joints: list[int]) -> None:
    simulator = cube(*measurements)
    logs, _ = tosses(simulator, 1, 5, seed=0)
    assert unmeasured_joints(simulator, logs) == joints
    assert Windows(Segments(None), simulator, logs).starts_measured is not bool(joints)


@pytest.mark.parametrize(("measured", "joints"), [(("body:cube.position",), []), (TAG, [0])])
def test_how_a_ball_is_turned_does_not_matter(measured: tuple[str, ...], joints: list[int]) -> None:
    """Its place alone tells where it starts, unless it is that of a tag off its centre."""
    environment = MjcfEnvironment.build(ROUND, [FRICTION], [], measured)
    simulator = Simulator(environment, num_threads=1)
    logs, _ = tosses(simulator, 1, 5, seed=0)
    assert unmeasured_joints(simulator, logs) == joints
    assert Windows(Segments(None), simulator, logs).starts_measured is not bool(joints)


def test_the_sensors_that_read_bodies_are_the_models() -> None:
    """A model that already has one of that name is measured by it, and compiled twice is the same."""
    environment = MjcfEnvironment.build(CUBE, [FRICTION], [], POSE)
    text = environment.spec()
    text.compile()
    again = MjcfEnvironment.build(text.to_xml(), [FRICTION], [], POSE)
    assert again.compile().nsensor == environment.compile().nsensor == 6
