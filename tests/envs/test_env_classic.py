"""Pendulum and cart-pole: without friction the published ones; in place equals compiled from edited XML."""

from __future__ import annotations

from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest

from sipe_bayes.envs.registry import make_task
from sipe_bayes.envs.target import TargetError
from sipe_bayes.envs.task import Task, Transition
from sipe_bayes.envs.tasks.classic import CART_POLE, PENDULUM, rod_length
from sipe_bayes.simulation.simulator import Simulator
from tests.problems.lengthened import compiled, differences, read

TASKS = {"Pendulum": ("rod", "hinge", PENDULUM), "CartPole": ("pole", "slider", CART_POLE)}
NO_FRICTION = np.array([0.5, 0.5, -0.5 + 1e-15])  # rounding must not make it negative


@pytest.fixture(params=TASKS)
def simulator(request: pytest.FixtureRequest) -> Simulator:
    return Simulator(make_task(request.param), num_threads=1)


def task_of(simulator: Simulator) -> Task:
    assert isinstance(simulator.environment, Task)
    return simulator.environment


@pytest.mark.parametrize("seed", range(3))
def test_parity_of_the_pendulum(seed: int) -> None:
    task, rng = make_task("Pendulum"), np.random.default_rng(seed)
    env: Any = gymnasium.make("Pendulum-v1").unwrapped
    start = task.states(np.pi + rng.uniform(-2, 2, (1, 1)), rng.uniform(-1, 1, (1, 1)))  # not above, where it gets fast
    env.reset()
    env.state = start[0, 1:].copy()
    actions = rng.uniform(-3, 3, (100, 1))  # beyond the motor's limit as well
    ours = Simulator(task).rollout(NO_FRICTION, actions, start, allow_outside=True)
    assert ours.states is not None
    assert ours.rewards is not None
    fastest = 0.0
    for t, action in enumerate(actions):
        observation, reward, *_ = env.step(action)
        fastest = max(fastest, abs(env.state[1]))
        np.testing.assert_allclose(ours.states[0, t + 1, 1:], env.state, rtol=0, atol=1e-9)
        np.testing.assert_allclose(ours.observations[0, t + 1], observation, rtol=0, atol=1e-5)  # theirs is float32
        assert ours.rewards[0, t] == pytest.approx(float(reward), abs=1e-9)
    assert fastest < 8  # where the published one would be stopped


@pytest.mark.filterwarnings("ignore:.*terminated = True")
@pytest.mark.parametrize("seed", range(3))
def test_parity_of_the_cart_pole(seed: int) -> None:
    """Semi-implicit, far beyond the fall."""
    task, rng = make_task("CartPole"), np.random.default_rng(seed)
    env: Any = gymnasium.make("CartPole-v1").unwrapped
    env.kinematics_integrator = "semi-implicit euler"
    start, _ = task.initial_states(rng, 1)
    env.reset()
    env.state = start[0, [1, 3, 2, 4]]
    pushes = rng.integers(0, 2, 100)
    ours = Simulator(task).rollout(NO_FRICTION, np.where(pushes, 1.0, -1.0)[:, None], start, allow_outside=True)
    assert ours.states is not None
    ends = task.terminated(Transition(ours.states[:, :-1], None, ours.actions, ours.states[:, 1:], None))[0]
    for t, push in enumerate(pushes):
        _, reward, ended, *_ = env.step(int(push))
        np.testing.assert_allclose(ours.observations[0, t + 1], env.state, rtol=0, atol=1e-9)
        assert ends[t] == ended
        if not ends[:t].any():
            assert reward == 1
    assert ends.any()
    assert ours.rewards is not None
    np.testing.assert_array_equal(ours.rewards, 1)


@pytest.mark.parametrize("seed", range(4))
def test_in_place_equals_compiled(simulator: Simulator, seed: int) -> None:
    task, rng = task_of(simulator), np.random.default_rng(seed)
    body, joint, source = TASKS[task.name]
    theta = rng.uniform(-0.2, 1.2, 3)
    mass, length, damping = task.space.values(theta)
    spec = read(source)
    across = mass * length**2 / 12
    rod, drawn = spec.body(body), spec.geom(body)
    rod.mass, rod.ipos[2], rod.inertia[:] = mass, length / 2, (across, across, across * 0.0012)
    drawn.pos[2], drawn.size[1] = length / 2, length / 2
    spec.joint(joint).damping[0] = damping
    expected, found = compiled(spec), simulator.written(theta)
    unequal = {k: v for k, v in differences(found, expected).items() if v > 1e-10}
    assert not unequal

    (start, _), actions = task.initial_states(rng, 1), rng.uniform(task.action_low, task.action_high, (500, 1))
    ours = simulator.rollout(theta, actions, start, allow_outside=True).states
    assert ours is not None
    data = mujoco.MjData(expected)
    data.qpos[:], data.qvel[:] = np.split(start[0, 1:], 2)
    for t, action in enumerate(actions):
        data.ctrl[:] = action
        mujoco.mj_step(expected, data)
        np.testing.assert_allclose(ours[0, t + 1, 1:], [*data.qpos, *data.qvel], rtol=1e-9, atol=1e-9)


def test_every_parameter_moves_it(simulator: Simulator) -> None:
    task, rng = task_of(simulator), np.random.default_rng(0)
    theta = np.full((7, 3), 0.5)
    theta[np.arange(3), np.arange(3)], theta[3 + np.arange(3), np.arange(3)] = 0.9, 0.1
    start, _ = task.initial_states(rng, 1)
    ours = simulator.rollout(theta, rng.uniform(task.action_low, task.action_high, (50, 1)), start)
    assert (np.abs(ours.observations[:-1] - ours.observations[-1]).max((1, 2)) > 1e-3).all()


def test_the_pendulum_can_be_swung_up() -> None:
    """Pumping energy and then holding it up solves the default task by its threshold."""
    simulator = Simulator(make_task("Pendulum"))
    task = task_of(simulator)
    begun = simulator.reset(seed=0, count=32)
    observations, total = begun.observations, np.zeros(32)
    for _ in range(task.episode_steps):
        cosine, sine, speed = observations.T
        missing = 10 / 2 * (1 - cosine) - speed**2 / 6  # J
        swing = 2.0 * np.sign(missing) * np.where(speed == 0, 1, np.sign(speed))
        hold = -12 * np.arctan2(sine, cosine) - 4 * speed
        near = (cosine > 0.85) & (np.abs(12 * np.arctan2(sine, cosine) + 4 * speed) < 6)
        step = simulator.step(np.clip(np.where(near, hold, swing), -2, 2)[:, None])
        observations, total = step.observations, total + step.rewards
    assert total.mean() > task.solved.threshold, total


BAD = ["rod:rd.length", "rod:rod.width"]


@pytest.mark.parametrize("spec", BAD)
def test_wrong_targets(spec: str) -> None:
    with pytest.raises(TargetError, match="rod"):
        rod_length(make_task("Pendulum").published, spec)
