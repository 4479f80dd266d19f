"""A free body that only its inertial unit tells of: gravity, the gyro and standing on the ground place it."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

from sipe_bayes.calibration.problem import prepare
from sipe_bayes.core.rotations import product, quaternions, turned
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.envs.poses import inertial_joints
from sipe_bayes.likelihood.binding import bind
from sipe_bayes.likelihood.settings import StateSpace
from sipe_bayes.likelihood.starts.estimates import estimate_states, unmeasured_joints
from sipe_bayes.likelihood.state_space.inertial import orientations
from sipe_bayes.simulation.simulator import Simulator

QUADRUPED = Path(__file__).parents[3] / "examples" / "quadruped"
UP, G = np.array([0.0, 0.0, 1.0]), 9.81
DT, STEPS = 0.005, 100


@pytest.mark.parametrize("gyro", [True, False])
def test_gravity_and_gyro_tell_roll_and_pitch(gyro: bool) -> None:
    """A body that rocks by 10 degrees about a tilt of 30, three times as fast with a gyro, whose bias is 0.02 rad/s."""
    rng, rate = np.random.default_rng(0), 1.5 if gyro else 0.05
    time = DT * np.arange(2001)
    rocking = np.stack([0.17 * np.sin(2 * np.pi * rate * time), 0.1 * np.cos(2 * np.pi * rate * time), 0.3 * time], -1)
    true = product(quaternions(np.array([0.4, 0.3, 0.0])), quaternions(rocking * [1, 1, gyro]))
    later, before = np.roll(true, -1, axis=0), np.roll(true, 1, axis=0)
    spin = product(true * [1, -1, -1, -1], later - before)[:, 1:] / DT
    spin[[0, -1]] = spin[[1, -2]]
    felt = turned(true * [1, -1, -1, -1], G * UP) + 0.1 * rng.standard_normal((2001, 3))
    found = orientations(felt, spin + 0.02 if gyro else None, DT, UP)
    tilt = np.degrees(np.arccos(np.clip((turned(found, turned(true * [1, -1, -1, -1], UP)) @ UP), -1, 1)))
    assert np.median(tilt) < 1.5, np.median(tilt)
    assert np.linalg.norm(found, axis=1) == pytest.approx(np.ones(2001))


def standing() -> tuple[Simulator, Trajectory, np.ndarray]:
    """The example's machine, settled somewhere, as it squats, with its states; noise and biases of its sensors."""
    own = prepare(QUADRUPED / "calibrate.toml", 1)
    simulator, rng = own.simulator, np.random.default_rng(3)
    state = simulator.default_state()
    quaternion = quaternions(np.array([0.0, 0.0, 2.0]))
    state[1:4], state[4:8] = [0.4, -0.7, 0.31], quaternion
    state[8:16] = np.tile([0.75, -1.5], 4)
    actions = np.tile([0.75, -1.5], 4) + np.tile([0.1, -0.2], 4) * np.sin(np.linspace(0, 6, STEPS))[:, None]
    theta = simulator.space.default_theta
    rest = simulator.rollout(theta[None], np.tile(actions[:1], (300, 1))[None], state[None], DT)
    assert rest.states is not None
    moves = simulator.rollout(theta[None], actions[None], rest.states[:, -1], DT)
    assert moves.states is not None
    noise = np.repeat([0.01, 0.1, 1e-3], [3, 3, 8]) * rng.standard_normal((STEPS + 1, 14))
    bias = np.repeat([0.02, -0.15, 0.0], [3, 3, 8])
    return simulator, Trajectory(moves.observations[0] + noise + bias, actions, DT), moves.states[0]


def test_it_stands_where_it_stood() -> None:
    """Tilt within a third of a degree and height within 2 mm, though the accelerometer alone is off by a degree."""
    simulator, log, true = standing()
    found = estimate_states(simulator, log)
    up = [turned(s[:, 4:8] * [1, -1, -1, -1], UP) for s in (found, true)]
    assert np.degrees(np.abs(up[0] - up[1]).max()) < 0.33
    assert np.abs(found[:, 3] - true[:, 3]).max() < 2e-3
    assert np.abs(found[:, 1 + simulator.model.nq : 7 + simulator.model.nq] - 0).max() < 1.0, "it stays about its place"
    lying = orientations(log.observations[:, 3:6], log.observations[:, :3], DT, UP)
    alone = np.degrees(np.abs(turned(lying * [1, -1, -1, -1], UP) - up[1]).max())
    assert alone > 0.8, f"{alone:.2f} degrees: nothing to be gained here"


def test_the_chain_takes_such_a_body_for_placed_and_leaves_its_yaw_and_place_to_the_prior() -> None:
    simulator, log, _ = standing()
    logs = Trajectories.stack([log])
    environment = simulator.environment
    assert isinstance(environment, MjcfEnvironment)
    assert inertial_joints(simulator.model, environment.poses) == (0,)
    assert not unmeasured_joints(simulator, logs)
    sd, nv = environment.start_sd(simulator.model), simulator.model.nv
    assert (sd[:6] == 0.1).all()
    assert (sd[nv : nv + 6] == 1.0).all()
    assert (sd[6:nv] == 10.0).all()
    assert bind(StateSpace(), simulator, logs).determined.all()


def test_an_accelerometer_is_read_before_the_command_that_follows() -> None:
    """With a delay of a control step in the model, as in a machine: the sample is of the command before."""
    own = prepare(QUADRUPED / "calibrate.toml", 1)
    simulator, log = own.simulator, own.train[0]
    model = simulator.written(simulator.space.default_theta)
    data, state = mujoco.MjData(model), simulator.default_state()[None]
    state[:, 8:16] = np.tile([0.75, -1.5], 4)
    past = np.repeat(log.actions[:1], 10, axis=0)
    simulator.environment.history(simulator.model, state, [past], np.array([model.opt.timestep]))  # type: ignore[attr-defined]
    seen = simulator.rollout(simulator.space.default_theta[None], log.actions[None, :40], state, DT).observations[0]
    mujoco.mj_setState(model, data, state[0], mujoco.mjtState.mjSTATE_FULLPHYSICS)
    for k in range(40):
        data.ctrl[:] = log.actions[max(k - 1, 0)]
        mujoco.mj_forward(model, data)
        expected = np.concatenate([data.sensor("gyro").data, data.sensor("accelerometer").data])
        np.testing.assert_allclose(seen[k, :6], expected, atol=1e-8)
        data.ctrl[:] = log.actions[k]
        mujoco.mj_step(model, data, 2)
