"""One contract over the registry of tasks; nothing here names a task except the published sizes."""

from __future__ import annotations

import json
import pickle
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest
from typer.testing import CliRunner

import sipe_bayes as sipe
from sipe_bayes.cli.app import app
from sipe_bayes.envs.registry import TASKS, make_task
from sipe_bayes.envs.task import VARIANTS, Task
from sipe_bayes.envs.tasks.fetch import Fetch
from sipe_bayes.simulation.engine import Run
from sipe_bayes.simulation.simulator import Simulator

gymnasium.register_envs(sipe.gym)  # another test may have imported sipe_bayes before gymnasium
STEPS = 12
PUBLISHED = {  # parameters, observation, action: Table 1 of the paper, Relocate's 30 actions as the model has them
    "FetchPush": (2, 31, 4),
    "FetchSlide": (2, 31, 4),
    "FetchPickAndPlace": (2, 31, 4),
    "Relocate": (2, 39, 30),
    "Door": (7, 39, 28),
    "HalfCheetahLinks": (5, 17, 6),
    "HalfCheetahJoints": (15, 17, 6),
    "HalfCheetahAllJoints": (18, 17, 6),
    "HumanoidLinks": (17, 376, 17),
    "HumanoidJoints": (51, 376, 17),
}
INERT = {"Door": {"frame_mass"}}

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


class Case:
    """Random lanes of a task: theta (B, N), actions (B, T, A), start (B, S), goals (B, G) or None."""

    def __init__(self, task: Task, lanes: int = 5, steps: int = STEPS, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        self.theta = rng.random((lanes, len(task.space)))
        self.actions = rng.uniform(task.action_low, task.action_high, (lanes, steps, task.num_actions))
        self.start, self.goals = task.initial_states(rng, lanes)

    def rollout(self, simulator: Simulator, lanes: Any = slice(None)) -> sipe.Trajectories:
        goals = None if self.goals is None else self.goals[lanes]
        return simulator.rollout(self.theta[lanes], self.actions[lanes], self.start[lanes], goals=goals)


def same(a: sipe.Trajectories, b: sipe.Trajectories) -> None:
    for name in ("states", "observations", "rewards", "valid"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


def test_sizes_are_the_published_ones() -> None:
    for name, sizes in PUBLISHED.items():
        task = make_task(name)
        assert (len(task.space), len(task.channels), task.num_actions) == sizes, name


def test_description_is_complete(task: Task) -> None:
    assert task.name in TASKS
    assert task.summary
    assert task.reference
    assert task.solved.measure in ("return", "success")
    assert task.episode_steps > 0
    for parameter in task.space:
        assert parameter.description, parameter.name
        assert parameter.targets, parameter.name
        assert parameter.default is not None
        assert float(parameter.normalise(parameter.default)) == pytest.approx(0.5)
    assert len(set(task.channels)) == len(task.channels)


def test_variants(task: Task, simulator: Simulator) -> None:
    default, inside, outside = (task.theta(v) for v in VARIANTS)
    assert (default == 0.5).all()
    assert ((inside >= 0.1) & (inside <= 0.9) & (np.abs(inside - 0.5) >= 0.1)).all()
    assert ((outside < 0) | (outside > 1)).all()
    np.testing.assert_array_equal(inside, make_task(task.name).theta("in_distribution"))
    case = Case(task, lanes=2, steps=min(200, task.episode_steps))
    case.theta = np.tile(outside, (2, 1))
    motion = simulator.rollout(case.theta, case.actions, case.start, goals=case.goals, allow_outside=True)
    assert motion.valid.all(), "the out-of-distribution variant is not stable"


def test_same_bits_whatever_the_threads_the_batch_and_the_past(task: Task, simulator: Simulator) -> None:
    case = Case(task)
    together = case.rollout(simulator)
    same(case.rollout(Simulator(task, num_threads=1)), together)
    order = np.array([3, 0, 4, 2, 1])
    same(case.rollout(simulator, order), together[order])
    for lane in (0, 4):
        same(case.rollout(simulator, slice(lane, lane + 1)), together[[lane]])
    same(case.rollout(simulator), together)  # after the pool was used for other lanes
    same(case.rollout(pickle.loads(pickle.dumps(simulator))), together)  # noqa: S301


def test_one_step_windows_and_stepping_give_the_bits_of_a_rollout(task: Task, simulator: Simulator) -> None:
    case = Case(task)
    whole = case.rollout(simulator)
    assert whole.states is not None
    assert whole.rewards is not None
    step = simulator.reset(case.theta, count=len(case.theta))
    episodes = simulator.episodes
    assert episodes is not None
    episodes.states[:], episodes.observations[:] = case.start, whole.observations[:, 0]
    if episodes.goals is not None and case.goals is not None:
        episodes.goals[:] = case.goals
    if episodes.derived is not None:
        episodes.derived[:] = simulator.engine.sensors(episodes.models, case.start)
    for t in range(STEPS):
        lanes = len(case.theta)
        window = simulator.rollout(
            case.theta, case.actions[:, t : t + 1], whole.states[:, t], goals=case.goals, allow_outside=True
        )
        assert window.states is not None
        np.testing.assert_array_equal(window.states[:, 1, 1:], whole.states[:, t + 1, 1:])
        np.testing.assert_array_equal(window.observations[:, 1], whole.observations[:, t + 1])
        assert window.rewards is not None
        if not task.data_fields:  # the humanoid's first derived numbers are those of the state itself
            np.testing.assert_array_equal(window.rewards[:, 0], whole.rewards[:, t])
        step = simulator.step(case.actions[:, t])
        going = ~step.terminated & ~episodes.over
        np.testing.assert_array_equal(episodes.states[going], whole.states[going, t + 1])
        np.testing.assert_array_equal(step.observations[going], whole.observations[going, t + 1])
        np.testing.assert_array_equal(step.rewards[going], whole.rewards[going, t])
        assert step.observations.shape == (lanes, len(task.channels))
        if not going.all():
            break


def test_a_diverging_lane_is_marked_and_disturbs_no_other(task: Task, simulator: Simulator) -> None:
    case = Case(task)
    before = case.rollout(simulator)
    wild = Case(task)
    first = 1 + simulator.model.nq
    for speed in (1e9, 1e11):  # a pendulum bears the first; the second is more than MuJoCo takes for a number
        wild.start[2, first : first + simulator.model.nv] = speed
        after = wild.rollout(simulator)
        assert after.valid[2, 0] == (speed < 1e10)
        if not after.valid[2, -1]:
            break
    assert not after.valid[2, -1]
    others = np.array([0, 1, 3, 4])
    same(after[others], before[others])
    ends = np.flatnonzero(~after.valid[2])
    assert (np.diff(ends) == 1).all()
    assert ends[-1] == STEPS
    step = simulator.reset(case.theta)
    assert simulator.episodes is not None
    simulator.episodes.states[2] = wild.start[2]
    for t in range(3):
        step = simulator.step(case.actions[:, t])
        if not step.valid[2]:
            break
    assert not step.valid[2]
    assert step.terminated[2]
    assert step.rewards[2] == 0
    assert step.valid[others].all()
    assert np.isfinite(step.observations).all()


def derived_numbers(task: Task, model: Any, data: Any) -> Any:
    """What an MjData holds of the derived quantities after a step."""
    if not task.data_fields:
        return data.sensordata
    mujoco.mj_rnePostConstraint(model, data)
    return np.concatenate([getattr(data, name).ravel() for name in task.data_fields])


def test_states_and_derived_are_those_of_plain_mujoco(task: Task, simulator: Simulator) -> None:
    """The engine against mj_step, one lane: states bit for bit, sensordata of the substep that the task declares."""
    if task.stepwise:
        pytest.skip("compared with the published class in its family's test")
    case = Case(task, lanes=1, steps=3)
    model, skip = simulator.written(case.theta[0]), task.frame_skip
    run = Run(skip, [model], np.array([model.opt.timestep]), case.actions, case.start)
    _, derived, _ = simulator.engine.advance(run)
    whole = case.rollout(simulator)
    data = mujoco.MjData(model)
    mujoco.mj_setState(model, data, case.start[0], mujoco.mjtState.mjSTATE_FULLPHYSICS)
    mujoco.mj_forward(model, data)
    if derived is not None:
        np.testing.assert_array_equal(derived[0, 0], derived_numbers(task, model, data))
    for t in range(3):
        data.ctrl[:] = task.control(model, case.start, case.actions[:, t : t + 1])[0, 0]
        for _ in range(skip):
            mujoco.mj_step(model, data)
        state = np.empty(simulator.state_size)
        mujoco.mj_getState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        assert whole.states is not None
        np.testing.assert_array_equal(whole.states[0, t + 1], state)
        if derived is not None:
            assert task.derived_late
            np.testing.assert_array_equal(derived[0, t + 1], derived_numbers(task, model, data))


def test_writing_leaves_nothing_behind(task: Task, simulator: Simulator) -> None:
    """A model that held other parameters before equals one that never did, field by field."""
    rng = np.random.default_rng(1)
    theta = rng.random(len(task.space))
    fresh, used = simulator.written(theta), simulator.written(rng.random(len(task.space)))
    for values in (rng.random(len(task.space)), theta):
        simulator.written(values, used)
    for name in dir(fresh):
        array = getattr(fresh, name)
        if isinstance(array, np.ndarray):
            np.testing.assert_array_equal(getattr(used, name), array, err_msg=name)


def touching(simulator: Simulator, case: Case) -> Any:
    """Actions (B, T, A) that move the object of the default model from the case's starts."""
    simulator.reset(count=len(case.start))
    episodes = simulator.episodes
    assert episodes is not None
    assert episodes.goals is not None
    assert case.goals is not None
    episodes.states[:], episodes.goals[:] = case.start, case.goals
    task, rng = episodes.task, np.random.default_rng(0)
    assert isinstance(task, Fetch)
    observation = task.observe(simulator.model, case.start, None, case.goals)
    actions = np.empty_like(case.actions)
    for t in range(actions.shape[1]):
        actions[:, t] = task.excitation(observation, rng)
        observation = simulator.step(actions[:, t]).observations
    return actions


def test_every_parameter_moves_the_task(task: Task, simulator: Simulator) -> None:
    case = Case(task, lanes=2, steps=40)
    if isinstance(task, Fetch):  # random actions never touch the object
        case.actions = touching(simulator, case)
    n = len(task.space)
    theta = np.full((2 * n + 1, n), 0.5)
    theta[np.arange(n), np.arange(n)], theta[n + np.arange(n), np.arange(n)] = 0.9, 0.1
    still = set(task.space.names)
    for lane in range(2):
        motion = simulator.rollout(
            theta, case.actions[[lane]], case.start[[lane]], goals=None if case.goals is None else case.goals[[lane]]
        )
        assert motion.states is not None
        change = np.abs(motion.states[:-1] - motion.states[-1]).max((1, 2))
        still -= {p.name for p, c in zip(2 * list(task.space), change, strict=True) if c > 1e-9}  # rounding
    assert still == INERT.get(task.name, set())


def test_the_command_lists_and_describes() -> None:
    listed = CliRunner().invoke(app, ["envs", "--json"])
    assert [row["name"] for row in json.loads(listed.stdout)] == list(TASKS)
    assert all(name in CliRunner().invoke(app, ["envs"]).stdout for name in TASKS)
    door = json.loads(CliRunner().invoke(app, ["envs", "Door", "--json"]).stdout)
    assert [p["name"] for p in door["parameters"]] == list(make_task("Door").space.names)
    assert door["variants"]["default"] == [0.5] * len(door["parameters"])
    printed = CliRunner().invoke(app, ["envs", "Door"]).stdout
    assert all(f"{p['name']} ({', '.join(p['writes'])}): {p['description']}" in printed for p in door["parameters"])
    wrong = CliRunner().invoke(app, ["envs", "Dor"])
    assert wrong.exit_code == 2
    assert wrong.stderr.count("\n") == 1
    assert "Door" in wrong.stderr
