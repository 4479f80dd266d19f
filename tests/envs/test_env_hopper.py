"""The hopper against Gymnasium's Hopper-v5 and against models compiled from edited XML."""

from __future__ import annotations

from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest

from sipe_bayes.envs.assets import gymnasium_asset
from sipe_bayes.envs.registry import make_task
from sipe_bayes.envs.task import Transition
from sipe_bayes.envs.tasks.hopper import Hopper
from sipe_bayes.simulation.simulator import Simulator
from tests.problems.lengthened import compiled, differences, edited

XML = str(gymnasium_asset("hopper.xml"))


@pytest.fixture(scope="module")
def simulator() -> Simulator:
    return Simulator(make_task("Hopper"), num_threads=2)


@pytest.fixture(scope="module")
def published() -> Any:
    env: Any = gymnasium.make("Hopper-v5").unwrapped
    env.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_WARMSTART
    return env


def task_of(simulator: Simulator) -> Hopper:
    assert isinstance(simulator.environment, Hopper)
    return simulator.environment


def reference(task: Hopper, theta: np.ndarray) -> Any:
    """The model compiled from XML that says what theta (6,) says."""
    factors = dict(zip(task.space.names, task.space.values(theta) / task.space.values(np.full(6, 0.5)), strict=True))
    spec = edited(XML, {f"{link}_geom": factors[f"{link}_length"] for link in ("thigh", "leg", "foot")})
    spec.geom("torso_geom").density *= factors["torso_mass"]
    spec.geom("foot_geom").friction[0] *= factors["foot_friction"]
    for joint in ("thigh", "leg", "foot"):
        spec.joint(f"{joint}_joint").damping[0] *= factors["joint_damping"]
    return compiled(spec)


def stepped(env: Any, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Observations (T, 11), rewards (T,) and ends (T,)."""
    observations, rewards, ends, *_ = zip(*(env.step(action) for action in actions), strict=True)
    return np.array(observations), np.array(rewards), np.array(ends)


@pytest.mark.parametrize("seed", range(4))
def test_parity_with_the_published_environment(simulator: Simulator, published: Any, seed: int) -> None:
    """Past the fall, which ends no open loop."""
    task, first = task_of(simulator), published.reset(seed=seed)[0]
    start = task.states(published.data.qpos[None].copy(), published.data.qvel[None].copy())
    actions = np.random.default_rng(seed).uniform(-1.2, 1.2, (100, 3))  # beyond the actuators' limits as well
    observations, rewards, ends = stepped(published, actions)
    ours = simulator.rollout(task.theta("default"), actions, start)
    assert ours.rewards is not None
    assert ours.states is not None
    np.testing.assert_allclose(ours.observations[0], [first, *observations], rtol=0, atol=1e-9)
    np.testing.assert_allclose(ours.rewards[0], rewards, rtol=0, atol=1e-9)
    step = Transition(ours.states[:, :-1], None, ours.actions, ours.states[:, 1:], None)
    np.testing.assert_array_equal(task.terminated(step)[0], ends)
    assert ends.any()
    assert not ends.all()
    assert (np.abs(observations[:, 5:]).max(0) <= 10).all()


def test_ends_as_published(published: Any, simulator: Simulator) -> None:
    """Heights, angles and speeds on both sides of their limits."""
    rng, task = np.random.default_rng(0), task_of(simulator)
    qpos = rng.uniform(-1, 1, (400, 6)) * (5, 0.1, 0.3, 2, 2, 2) + (0, 0.75, 0, 0, 0, 0)
    qvel = rng.uniform(-1, 1, (400, 6)) * rng.choice((50, 102), (400, 1))
    ends = []
    for position, velocity in zip(qpos, qvel, strict=True):
        published.set_state(position, velocity)
        ends.append(not published.is_healthy)
    states = task.states(qpos, qvel)
    np.testing.assert_array_equal(task.terminated(Transition(states, None, np.zeros((400, 3)), states, None)), ends)
    assert 0.2 < np.mean(ends) < 0.9


@pytest.mark.parametrize("seed", range(4))
def test_in_place_equals_compiled(simulator: Simulator, seed: int) -> None:
    task, rng = task_of(simulator), np.random.default_rng(seed)
    theta = rng.uniform(-0.2, 1.2, 6)
    expected, found = reference(task, theta), simulator.written(theta)
    unequal = {k: v for k, v in differences(found, expected).items() if v > 1e-10}
    assert not unequal
    data, (start, _), actions = mujoco.MjData(expected), task.initial_states(rng, 1), rng.uniform(-1, 1, (125, 3))
    ours = simulator.rollout(theta, actions, start, allow_outside=True).states
    assert ours is not None
    data.qpos[:], data.qvel[:] = start[0, 1:7], start[0, 7:]
    for t, action in enumerate(actions):
        data.ctrl[:] = action
        mujoco.mj_step(expected, data, 4)
        np.testing.assert_allclose(ours[0, t + 1, 1:], [*data.qpos, *data.qvel], rtol=0, atol=1e-9)


def test_every_parameter_moves_it(simulator: Simulator) -> None:
    task, rng = task_of(simulator), np.random.default_rng(1)
    theta = np.full((13, 6), 0.5)
    theta[np.arange(6), np.arange(6)], theta[6 + np.arange(6), np.arange(6)] = 0.9, 0.1
    start, _ = task.initial_states(rng, 1)
    ours = simulator.rollout(theta, rng.uniform(-1, 1, (50, 3)), start)
    moved = np.abs(ours.observations[:-1] - ours.observations[-1]).max((1, 2))
    assert (moved > 1e-3).all(), dict(zip(2 * task.space.names, moved, strict=True))
