"""Closed loop and its Gymnasium faces: seeds, autoreset, parameters of single environments, what is refused."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import sipe_bayes as sipe
from sipe_bayes.envs.registry import TASKS, make_task
from sipe_bayes.envs.task import Task
from sipe_bayes.simulation.simulator import Simulator

gymnasium.register_envs(sipe.gym)  # another test may have imported sipe_bayes before gymnasium

_simulators: dict[str, Simulator] = {}


@pytest.fixture(params=TASKS)
def simulator(request: pytest.FixtureRequest) -> Simulator:
    name = request.param
    if name not in _simulators:
        _simulators[name] = Simulator(make_task(name), num_threads=2)
    return _simulators[name]


@pytest.fixture
def task(simulator: Simulator) -> Task:
    assert isinstance(simulator.environment, Task)
    return simulator.environment


def test_seeds_and_autoreset(task: Task) -> None:
    short = dataclasses.replace(task, episode_steps=3)
    simulator = Simulator(short)
    first = simulator.reset(seed=5, count=3)
    again = Simulator(short).reset(seed=6, count=2)
    np.testing.assert_array_equal(first.observations[1:], again.observations)  # lane i has seed + i
    simulator.reset(seed=5, count=3)
    rng = np.random.default_rng(0)
    for t in range(1, 9):
        step = simulator.step(rng.uniform(task.action_low, task.action_high, (3, task.num_actions)))
        over = step.truncated | step.terminated
        assert not (step.truncated & step.terminated).any()
        if not step.terminated.any() and t <= 3:
            assert over.all() == (t == 3)
        if over.all():
            begun = simulator.step(np.zeros((3, task.num_actions)))
            assert (begun.rewards == 0).all()
            assert not begun.truncated.any()
            assert not begun.terminated.any()
            assert simulator.episodes is not None
            for lane in range(3):  # the second draw of the lane's own generator
                own = np.random.default_rng(5 + lane)
                _, (second, _) = task.initial_states(own, 1), task.initial_states(own, 1)
                np.testing.assert_array_equal(simulator.episodes.states[lane], second[0])
            break
    else:
        pytest.fail("the lanes never ended together")


def test_lanes_that_end_at_different_times_do_not_mix() -> None:
    """Three carts whose poles fall at their own times, together and each by itself."""
    task, rng = make_task("CartPole"), np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (150, 3, 1))
    together = Simulator(task)
    together.reset(seed=7, count=3)
    steps = [together.step(a) for a in actions]
    ends = np.array([s.terminated for s in steps])
    assert (ends.sum(0) >= 2).all()
    assert len({tuple(np.flatnonzero(column)) for column in ends.T}) == 3
    for lane in range(3):
        alone = Simulator(task)
        alone.reset(seed=7 + lane)
        for t, action in enumerate(actions):
            step = alone.step(action[lane : lane + 1])
            for name in ("observations", "rewards", "terminated", "truncated", "valid"):
                np.testing.assert_array_equal(getattr(step, name)[0], getattr(steps[t], name)[lane], err_msg=name)
            if t and ends[t - 1, lane]:
                assert step.rewards[0] == 0


def test_vector_environment_changes_only_the_lanes_that_are_named() -> None:
    env = sipe.make_vec("Pendulum", 4, num_threads=1)
    env.reset(seed=0)
    theta = np.full(3, 0.3)
    env.set_parameters(theta, np.array([False, False, True, True]))
    assert env._episodes is not None
    for held in (env.theta, env._episodes.theta):
        np.testing.assert_array_equal(held, np.repeat([0.5, 0.3], 2)[:, None].repeat(3, 1))
    theta[:] = 0.9
    assert (env.theta[2] == 0.3).all()
    before = env._episodes.states.copy()
    options = {"reset_mask": np.array([True, False, False, False]), "theta": np.full(3, 0.7)}
    env.reset(seed=[9, None, None, None], options=options)
    np.testing.assert_array_equal(env._episodes.states[1:], before[1:])
    assert (env._episodes.states[0] != before[0]).any()
    np.testing.assert_array_equal(env.theta[:, 0], [0.7, 0.5, 0.3, 0.3])


@pytest.mark.filterwarnings("ignore:.*")
def test_gymnasium_environments(task: Task) -> None:
    env = gymnasium.make(f"sipe/{task.name}-v0")
    check_env(env.unwrapped, skip_render_check=True)
    plain: Any = env.unwrapped
    theta = task.theta("in_distribution")
    plain.reset(seed=0, options={"theta": theta})
    np.testing.assert_array_equal(plain.theta, theta)
    observation, info = plain.reset(seed=0)
    vector = gymnasium.make_vec(f"sipe/{task.name}-v0", num_envs=2)
    assert vector.unwrapped.simulator is not None
    vector.unwrapped.set_parameters(theta)
    observations, _ = vector.reset(seed=[0, 1])
    if not task.goal_size:
        np.testing.assert_array_equal(observations[0], observation)
    action = plain.action_space.sample()
    actions = np.stack([action, action])
    mine, theirs = plain.step(action), vector.step(actions)
    np.testing.assert_array_equal(theirs[0][0], mine[0])
    assert theirs[1][0] == mine[1]
    assert info["valid"] is True
    assert ("success" in mine[4]) == (task.solved.measure == "success")
    if task.goal_size:
        achieved, goals = theirs[4]["achieved_goal"], theirs[4]["desired_goal"]
        assert achieved.shape == goals.shape == (2, task.goal_size)
        np.testing.assert_array_equal(vector.unwrapped.compute_reward(achieved, goals), theirs[1])


def push() -> sipe.Simulator:
    return _simulators.setdefault("Pendulum", Simulator(make_task("Pendulum"), num_threads=2))


BAD: list[tuple[Callable[[], Any], list[str]]] = [
    (lambda: sipe.make("FetchPsh"), ["FetchPsh", "FetchPush"]),
    (lambda: sipe.make("FetchPush", variant="defualt"), ["variant", "defualt", "default"]),
    (lambda: sipe.make_vec("Pendulum", 0), ["num_envs", "0"]),
    (lambda: push().reset(count=0), ["count", "0"]),
    (lambda: push().reset(np.full(len(push().space), 1.5)), ["theta", "[0, 1]", "allow_outside"]),
    (lambda: push().reset(np.zeros(1 + len(push().space))), ["parameters", "shape"]),
    (lambda: sipe.make_vec("Pendulum", 3).set_parameters(np.zeros((2, 3))), ["theta", "(3, 3) or (3,)", "(2, 3)"]),
    (lambda: sipe.make_vec("Pendulum", 3).set_parameters(np.zeros(3), np.array([5])), ["lanes", "3", "5"]),
    (lambda: sipe.make_vec("Pendulum", 3).reset(options={"reset_mask": np.ones(2, bool)}), ["reset_mask", "(3,)"]),
    (lambda: push().rollout(np.full(3, 0.5), np.zeros((2, 1)), push().default_state(), dt=0.1), ["dt", "0.05", "0.1"]),
    (lambda: push().reset(np.full(len(push().space), np.nan)), ["theta", "NaN"]),
    (lambda: push().reset() and push().step(np.full((1, 1), np.nan)), ["actions", "NaN"]),
    (lambda: push().reset() and push().step(np.zeros((2, 1))), ["actions", "(1, 1)", "(2, 1)"]),
    (lambda: Simulator(make_task("Pendulum")).step(np.zeros((1, 1))), ["step", "reset"]),
    (lambda: sipe.make("Pendulum").set_parameters(np.full(len(push().space), 2.0)), ["theta", "[0, 1]"]),
]


@pytest.mark.parametrize(("call", "words"), BAD)
def test_bad_input(call: Callable[[], Any], words: list[str]) -> None:
    with pytest.raises(ValueError) as caught:  # noqa: PT011
        call()
    message = str(caught.value)
    assert "\n" not in message
    for word in words:
        assert word in message, message


def test_stable_baselines3_trains_unchanged() -> None:
    from stable_baselines3 import DDPG

    env = gymnasium.make("sipe/Pendulum-v0")
    agent = DDPG("MlpPolicy", env, learning_starts=100, seed=0, device="cpu")
    agent.learn(300)
    assert agent.num_timesteps == 300
    assert agent.replay_buffer is not None
    assert agent.replay_buffer.size() == 300
    assert np.isfinite(agent.replay_buffer.rewards[:300]).all()
