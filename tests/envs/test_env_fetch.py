"""The Fetch tasks against gymnasium-robotics' classes, bit for bit where nothing but the order of sums may differ."""

from __future__ import annotations

import types
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.envs.registry import make_task
from sipe_bayes.envs.tasks.fetch import _euler
from sipe_bayes.likelihood import StateSpace, bind
from sipe_bayes.simulation.engine import Run
from sipe_bayes.simulation.simulator import Simulator

FloatArray = NDArray[np.float64]

CLASSES = {"FetchPush": "Push", "FetchSlide": "Slide", "FetchPickAndPlace": "PickAndPlace"}
HORIZON = 100
SEEDS = (0, 1)


class _Integers:
    """mujoco, but for enumerations that compare with numpy's integers, as the published classes expect."""

    def __getattr__(self, name: str) -> Any:
        value = getattr(mujoco, name)
        if name in ("mjtEq", "mjtJoint"):
            return types.SimpleNamespace(**{key: int(member) for key, member in value.__members__.items()})
        return value


def published(name: str) -> Any:
    import gymnasium_robotics.envs.fetch.pick_and_place
    import gymnasium_robotics.envs.fetch.push
    import gymnasium_robotics.envs.fetch.slide

    modules = gymnasium_robotics.envs.fetch
    module = {"FetchPush": modules.push, "FetchSlide": modules.slide, "FetchPickAndPlace": modules.pick_and_place}[name]
    environment = getattr(module, f"MujocoFetch{CLASSES[name]}Env")()
    environment.model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_WARMSTART)
    return environment


def flat(observation: dict[str, FloatArray]) -> FloatArray:
    return np.concatenate([observation[key] for key in ("observation", "achieved_goal", "desired_goal")])


@pytest.fixture(scope="module", params=list(CLASSES))
def simulator(request: pytest.FixtureRequest) -> Simulator:
    return Simulator(make_task(request.param), 2)


@pytest.fixture
def reference(simulator: Simulator, monkeypatch: pytest.MonkeyPatch) -> Any:
    from gymnasium_robotics.utils import mujoco_utils

    monkeypatch.setattr(mujoco_utils, "mujoco", _Integers())
    return published(simulator.environment.name)


def drive(simulator: Simulator, steps: int, lanes: int = 3) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Starts (B, S), goals (B, 3) and actions (B, T, 4) of steered episodes at the published theta."""
    step, rng, actions = simulator.reset(seed=5, count=lanes), np.random.default_rng(0), []
    start, goals = simulator.episodes.states.copy(), simulator.episodes.goals.copy()
    for _ in range(steps):
        actions.append(simulator.environment.excitation(step.observations, rng))
        step = simulator.step(actions[-1])
    return start, goals, np.stack(actions, axis=1)


def test_it_starts_and_moves_as_published(simulator: Simulator, reference: Any) -> None:
    task, rng, seen = simulator.environment, np.random.default_rng(1), set()
    for seed in SEEDS:
        observations, rewards, success, actions = [], [], [], []
        observation, _ = reference.reset(seed=seed)
        states, goals = task.initial_states(np.random.default_rng(seed), 1)
        np.testing.assert_array_equal(goals[0], reference.goal)
        if seed:  # so that it is reached as well as left
            reference.goal = goals[0] = observation["achieved_goal"] + (0.03, 0.0, 0.0)
            observation["desired_goal"] = reference.goal
        observations.append(flat(observation))
        for _ in range(HORIZON):
            actions.append(task.excitation(observations[-1], rng))
            observation, reward, _, _, info = reference.step(actions[-1])
            observations.append(flat(observation))
            rewards.append(reward)
            success.append(info["is_success"])
        ours = simulator.rollout([[0.5, 0.5]], np.array(actions), states, goals=goals)
        np.testing.assert_allclose(ours.observations[0], observations, rtol=0, atol=1e-9)
        np.testing.assert_array_equal(ours.rewards[0], rewards)
        assert np.ptp(np.array(observations)[:, 3:6], axis=0).max() > 0.02  # it was touched
        seen |= set(rewards)
        reached = np.linalg.norm(task.achieved_goals(ours.states, None)[0, 1:] - goals, axis=-1) < 0.05
        np.testing.assert_array_equal(reached, np.array(success) > 0)
    assert seen == {0.0, -1.0}


def test_a_rollout_goes_on_from_any_recorded_sample(simulator: Simulator) -> None:
    start, goals, actions = drive(simulator, 15)
    theta = np.array([[0.5, 0.5], [0.1, 0.9], [1.2, -0.2]])
    whole = simulator.rollout(theta, actions, start, goals=goals, allow_outside=True)
    for t in range(15):
        window = simulator.rollout(theta, actions[:, t : t + 1], whole.states[:, t], goals=goals, allow_outside=True)
        np.testing.assert_array_equal(window.states, whole.states[:, t : t + 2])
        np.testing.assert_array_equal(window.observations, whole.observations[:, t : t + 2])
        np.testing.assert_array_equal(window.rewards, whole.rewards[:, t : t + 1])
    assert whole.valid.all()


def test_states_tell_the_controllers_memory(simulator: Simulator) -> None:
    """Of a chain of states whose memory is forgotten, in every task to 1e-9.

    But where an episode starts, at rest, to 1e-5: the published environment looks there before it has moved.
    """
    start, goals, actions = drive(simulator, 12, lanes=1)
    (motion,) = simulator.rollout([[0.3, 0.7]], actions, start, goals=goals)
    chain = bind(StateSpace(starts="recorded"), simulator, Trajectories.stack(motion))
    states, physics = motion.states, simulator.engine.physics_size
    assert states is not None
    forgotten = states.copy()
    forgotten[:, physics:] = 7.0
    found = chain.with_memory(forgotten, chain.dt)
    np.testing.assert_allclose(found[1:], states[1:], rtol=0, atol=1e-9)
    np.testing.assert_allclose(found[0], states[0], rtol=0, atol=1e-5)


def _equal(written: Any, compiled: Any) -> None:
    for field in dir(compiled):
        value = getattr(compiled, field)
        if isinstance(value, np.ndarray) and not field.startswith("bvh_"):
            np.testing.assert_allclose(getattr(written, field), value, rtol=1e-10, atol=1e-10, err_msg=field)


@pytest.mark.parametrize("theta", [(0.0, 1.0), (0.93, 0.14), (-0.25, 1.2)])
def test_writing_in_place_equals_compiling(simulator: Simulator, theta: tuple[float, float]) -> None:
    task = simulator.environment
    mass, friction = task.space.values(theta)
    spec = task.spec()
    spec.geom("object0").mass = mass
    for name in ("object0", "table0"):
        spec.geom(name).friction[0] = friction
    written, compiled = simulator.written(np.array(theta)), spec.compile()
    compiled.opt.disableflags = written.opt.disableflags
    _equal(written, compiled)

    # 500 physics steps of a sliding object. The puck's contacts with the table turn one bit into 1e-8 m at once, so its
    # can be compared only where scaling the inertia and computing it anew round alike: powers of two.
    if task.name == "FetchSlide" and np.log2(mass) % 1:
        return
    start, _ = task.initial_states(np.random.default_rng(0), 1)
    velocity = 1 + written.nq + written.joint("object0:joint").dofadr[0]
    start[:, velocity : velocity + 2] = -0.6, -0.4
    ends = [
        simulator.engine.advance(Run(20, [m], np.array([0.002]), np.zeros((1, 25, 4)), start))[0]
        for m in (written, compiled)
    ]
    np.testing.assert_allclose(*ends, rtol=0, atol=1e-9)
    assert np.ptp(task.achieved_goals(ends[0], None)[0], axis=0).max() > 0.01


def test_at_theta_one_half_the_model_is_the_published_one(simulator: Simulator, reference: Any) -> None:
    ours, theirs = simulator.written(np.array([0.5, 0.5])), reference.model
    for field in ("body_mass", "body_inertia", "geom_friction", "body_invweight0", "dof_invweight0", "geom_size"):
        np.testing.assert_array_equal(getattr(ours, field), getattr(theirs, field), err_msg=field)
    np.testing.assert_array_equal(ours.eq_data[:, :11], theirs.eq_data[:, :11])  # the last: set by hand or not


def test_friction_between_object_and_table_is_what_was_written(simulator: Simulator) -> None:
    task = simulator.environment
    model = simulator.written(np.array([0.5, 0.1]))
    data = mujoco.MjData(model)
    data.qpos[:] = task.initial_states(np.random.default_rng(0), 1)[0][0, 1 : 1 + model.nq]
    mujoco.mj_forward(model, data)
    pair = {model.geom("object0").id, model.geom("table0").id}
    found = [c.friction[0] for c in data.contact if set(c.geom.tolist()) == pair]
    assert found
    np.testing.assert_allclose(found, task.space.values((0.5, 0.1))[1])


def test_every_parameter_moves_the_object_differently(simulator: Simulator) -> None:
    start, goals, actions = drive(simulator, 25, lanes=1)
    theta, levels = np.full((2, 5, 2), 0.5), (0.0, 0.25, 0.5, 0.75, 1.0)
    theta[0, :, 0] = theta[1, :, 1] = levels
    observed = simulator.rollout(theta.reshape(10, 2), actions, start, goals=goals).observations
    place = observed[..., 3:6].reshape(2, 5, -1, 3)
    apart = np.linalg.norm(place[:, :, None] - place[:, None], axis=-1).max(-1)
    assert (apart[:, ~np.eye(5, dtype=bool)] > 1e-5).all(), apart


def test_starts_and_goals_are_where_they_should_be(simulator: Simulator) -> None:
    task = simulator.environment
    states, goals = task.initial_states(np.random.default_rng(3), 400)
    first = task.observe(simulator.model, states, None, goals)
    offset, goal = first[:, 6:8], goals - first[:, :3] - (task.scene.goal_offset, 0, 0)
    margin = 1e-3  # the gripper still moves a little where it is drawn about
    assert np.linalg.norm(offset, axis=1).min() >= 0.1 - margin
    assert np.abs(offset).max() <= task.scene.spread + margin
    assert np.abs(goal[:, :2]).max() <= task.scene.goal_spread + margin
    lifted = goals[:, 2] > goals[:, 2].min() + 1e-9
    assert 0.4 < lifted.mean() < 0.6 if task.scene.lifted else not lifted.any()  # 1 in 15000 seeds fails


def test_a_plain_script_lifts_the_block_to_its_goal() -> None:
    simulator = Simulator(make_task("FetchPickAndPlace"), 2)
    start, goals, actions = drive(simulator, 40, lanes=6)
    rewards = simulator.rollout([[0.5, 0.5]], actions, start, goals=goals).rewards
    assert (rewards[:, -1] == 0).mean() >= simulator.environment.solved.threshold


def test_angles_are_those_of_the_published_rotations() -> None:
    from gymnasium_robotics.utils.rotations import euler2mat, mat2euler

    angles = np.random.default_rng(0).uniform(-np.pi, np.pi, (200, 3))
    angles[:20, 1] = np.pi / 2
    matrices = np.concatenate([euler2mat(angles), [[[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]]])
    np.testing.assert_allclose(_euler(*np.moveaxis(matrices, -1, 0)), mat2euler(matrices), rtol=0, atol=1e-12)


def test_rewards_of_lanes_that_were_never_simulated_are_nan(simulator: Simulator) -> None:
    goals = np.zeros((2, 3))
    reward = simulator.environment.goal_reward(np.array([[0.0, 0, 0.05], [np.nan, 0, 0]]), goals)
    np.testing.assert_array_equal(reward, [0.0, np.nan])
