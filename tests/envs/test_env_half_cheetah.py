"""The half-cheetah against Gymnasium's HalfCheetah-v5 and against models compiled from edited XML."""

from __future__ import annotations

from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest

from sipe_bayes.envs.assets import gymnasium_asset
from sipe_bayes.envs.registry import make_task
from sipe_bayes.envs.tasks.half_cheetah import HalfCheetah
from sipe_bayes.simulation.simulator import Simulator
from tests.problems.lengthened import compiled, differences, edited, read

TASKS = ("HalfCheetahLinks", "HalfCheetahJoints", "HalfCheetahAllJoints")
XML = str(gymnasium_asset("half_cheetah.xml"))
PAIRS = {"torso": ["torso"], "head": ["head"]} | {
    name: [f"b{name}", f"f{name}"] for name in ("thigh", "shin", "foot")
}  # parameter -> its links


@pytest.fixture(scope="module", params=TASKS)
def simulator(request: pytest.FixtureRequest) -> Simulator:
    return Simulator(make_task(request.param), num_threads=2)


@pytest.fixture(scope="module")
def published() -> Any:
    env: Any = gymnasium.make("HalfCheetah-v5").unwrapped
    env.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_WARMSTART
    return env


def cheetah(simulator: Simulator) -> HalfCheetah:
    assert isinstance(simulator.environment, HalfCheetah)
    return simulator.environment


def reference(task: HalfCheetah, theta: np.ndarray) -> Any:
    """The model compiled from XML that says what theta (N,) says."""
    if task.name == "HalfCheetahLinks":
        factors = dict(zip(PAIRS, 0.5 + theta, strict=True))
        return compiled(edited(XML, {link: factors[p] for p, links in PAIRS.items() for link in links}))
    spec = read(XML)
    for parameter, value in zip(task.space, task.space.values(theta), strict=True):
        joint, kind = parameter.name.split("_")
        if kind == "gear":
            spec.actuator(joint).gear[0] = value
        else:
            getattr(spec.joint(joint), kind)[0] = value
    return compiled(spec)


@pytest.mark.parametrize("seed", range(3))
def test_parity_with_the_published_environment(simulator: Simulator, published: Any, seed: int) -> None:
    task = cheetah(simulator)
    observations = [published.reset(seed=seed)[0]]
    start = task.states(published.data.qpos[None].copy(), published.data.qvel[None].copy())
    actions = np.random.default_rng(seed).uniform(-1.2, 1.2, (100, 6))  # beyond the actuators' limits as well
    rewards = []
    for action in actions:
        observation, reward, *_ = published.step(action)
        observations.append(observation)
        rewards.append(reward)
    ours = simulator.rollout(task.theta("default"), actions, start)
    np.testing.assert_allclose(ours.observations[0], observations, rtol=0, atol=1e-9)
    assert ours.rewards is not None
    np.testing.assert_allclose(ours.rewards[0], rewards, rtol=0, atol=1e-9)


def test_theta_a_half_is_the_published_model_to_the_last_bit(simulator: Simulator, published: Any) -> None:
    ours, theirs = simulator.written(np.full(len(simulator.space), 0.5)), published.model
    for name in ("body_mass", "body_inertia", "body_pos", "geom_size", "dof_damping", "jnt_stiffness", "actuator_gear"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name), err_msg=name)


def test_start_is_the_published_distribution(simulator: Simulator) -> None:
    states, goals = cheetah(simulator).initial_states(np.random.default_rng(0), 4000)
    assert goals is None
    assert (states[:, 0] == 0).all()
    assert (np.abs(states[:, 1:10]).max(0) < 0.1).all()
    np.testing.assert_allclose(states[:, 1:10].std(0), 0.2 / np.sqrt(12), rtol=0.1)
    np.testing.assert_allclose(states[:, 10:].std(0), 0.1, rtol=0.1)


@pytest.mark.parametrize("seed", range(3))
def test_in_place_equals_compiled(simulator: Simulator, seed: int) -> None:
    """Every field; 500 control steps of quiet motion.

    Each of 500 steps of wild motion from the same state, since there a difference of 1e-15 in the start alone has grown
    to 1 after 500 physics steps.
    """
    task, rng = cheetah(simulator), np.random.default_rng(seed)
    theta = rng.uniform(-0.2, 1.2, len(task.space))
    expected, found = reference(task, theta), simulator.written(theta)
    unequal = {k: v for k, v in differences(found, expected).items() if v > 1e-10}
    assert not unequal

    (start, _), data = task.initial_states(rng, 1), mujoco.MjData(expected)
    for reach, whole in ((0.3, True), (1.0, False)):
        actions = rng.uniform(-reach, reach, (500, 6))
        ours = simulator.rollout(theta, actions, start, allow_outside=True).states
        assert ours is not None
        for t, action in enumerate(actions):
            if t == 0 or not whole:
                data.qpos[:], data.qvel[:] = ours[0, t, 1:10], ours[0, t, 10:]
            data.ctrl[:] = action
            mujoco.mj_step(expected, data, 5)
            np.testing.assert_allclose(ours[0, t + 1, 1:], [*data.qpos, *data.qvel], rtol=0, atol=1e-9)


def test_every_parameter_moves_it(simulator: Simulator) -> None:
    task, rng = cheetah(simulator), np.random.default_rng(0)
    n = len(task.space)
    theta = np.full((2 * n + 1, n), 0.5)
    theta[np.arange(n), np.arange(n)], theta[n + np.arange(n), np.arange(n)] = 0.9, 0.1
    start, _ = task.initial_states(rng, 1)
    ours = simulator.rollout(theta, rng.uniform(-1, 1, (25, 6)), start)
    assert ours.valid.all()
    assert (np.abs(ours.observations[:-1] - ours.observations[-1]).max((1, 2)) > 1e-3).all()


def test_front_and_back_links_keep_their_proportions() -> None:
    task = make_task("HalfCheetahLinks")
    simulator = Simulator(task, num_threads=1)
    model, default = simulator.written(np.ones(5)), task.published
    capsules = default.geom_type == mujoco.mjtGeom.mjGEOM_CAPSULE
    np.testing.assert_allclose(model.geom_size[capsules, 1], 1.5 * default.geom_size[capsules, 1], rtol=1e-12)
    assert default.body_mass.sum() == pytest.approx(14)
    assert 14 < model.body_mass.sum() < 21  # longer tubes, the same ends


def test_a_length_of_nothing_is_not_simulated() -> None:
    task = make_task("HalfCheetahLinks")
    simulator = Simulator(task, num_threads=1)
    start, _ = task.initial_states(np.random.default_rng(0), 2)
    theta = np.array([[-0.5, 0.5, 0.5, 0.5, 0.5], [0.5] * 5])
    ours = simulator.rollout(theta, np.zeros((1, 5, 6)), start, allow_outside=True)
    assert not ours.valid[0].any()
    assert ours.valid[1].all()
