"""Hindsight relabelling on tasks with sparse rewards: what it makes learnable, and what it samples from a real one."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import mujoco
import numpy as np

import sipe_bayes as sipe
from sipe_bayes.core.parameters import ParameterSpace
from sipe_bayes.envs.task import Solved, Task, Transition, scaled
from sipe_bayes.rl.evaluation import evaluate
from sipe_bayes.rl.settings import Settings
from sipe_bayes.rl.trainer import Trainer

NEAR = 0.1
XML = """
<mujoco><option timestep="0.02" gravity="0 0 0"><flag contact="disable"/></option>
<worldbody><body><geom size="0.1" mass="1"/><joint name="x" type="slide" axis="1 0 0" damping="10"/>
<joint name="y" type="slide" axis="0 1 0" damping="10"/></body></worldbody>
<actuator><motor joint="x" gear="20"/><motor joint="y" gear="20"/></actuator></mujoco>
"""


class Point(Task):
    """A point in the plane that must come within 0.1 of a goal in a square of side 3: -1 a step, 0 at the goal."""

    frame_skip, num_actions, goal_size = 5, 2, 2
    channels = ("x", "y", "x_velocity", "y_velocity", "x_goal", "y_goal")

    def compile(self) -> Any:
        return mujoco.MjModel.from_xml_string(XML)

    def initial_states(self, rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
        return self.states(np.zeros((count, 2)), np.zeros((count, 2))), rng.uniform(-1.5, 1.5, (count, 2))

    def observe(self, model: Any, states: np.ndarray, derived: Any, goals: np.ndarray | None = None) -> np.ndarray:
        seen = states[..., 1:5]
        return np.concatenate([seen, np.broadcast_to(np.asarray(goals), seen[..., :2].shape)], axis=-1)

    def achieved_goals(self, states: np.ndarray, derived: Any) -> np.ndarray:
        return states[..., 1:3].copy()

    def goal_reward(self, achieved: np.ndarray, goals: np.ndarray) -> np.ndarray:
        return np.where(np.linalg.norm(achieved - goals, axis=-1) < NEAR, 0.0, -1.0)

    def reward(self, step: Transition) -> np.ndarray:
        return self.goal_reward(step.next_states[..., 1:3], np.asarray(step.goals))

    def success(self, step: Transition) -> np.ndarray:
        return self.reward(step) == 0


POINT = Point(
    name="Point",
    parameters=ParameterSpace((scaled("damping", 10.0, ["joint:x.damping", "joint:y.damping"], "N s/m", "slows"),)),
    summary="a point",
    episode_steps=25,
    solved=Solved("success", 0.9),
)
SETTINGS = Settings(
    hidden=(64, 64),
    learning_rate=2e-3,
    discount=0.95,
    tau=0.02,
    batch=128,
    lanes=10,
    updates_per_step=0.25,
    start_steps=500,
    exploration=0.2,
    random_share=0.3,
    clip_targets=True,
)


def success(settings: Settings, steps: int) -> float:
    """Rate after training."""
    trainer = Trainer(POINT, settings, 0)
    while trainer.steps < steps:
        trainer.advance()
    return float(evaluate(trainer.policy(), POINT, 100, 1).success_rate or 0.0)


def test_hindsight_makes_a_sparse_task_learnable() -> None:
    learnt, without = success(SETTINGS, 3000), success(replace(SETTINGS, hindsight=0), 3000)
    assert without < 0.3 < 0.9 <= learnt, (without, learnt)


def test_relabelled_rewards_are_those_of_the_goals_that_are_seen() -> None:
    task = sipe.make_task("FetchPush")
    trainer = Trainer(task, Settings(lanes=4, start_steps=10**9))
    rng = np.random.default_rng(0)
    trainer._actions = lambda: task.excitation(trainer.episodes.observations, rng)  # type: ignore[method-assign]
    for _ in range(130):
        trainer.advance()
    batch = trainer.replay.sample(np.random.default_rng(0), 4000)
    seen, after, returns = (x.numpy() for x in (batch.observations, batch.next_observations, batch.returns))
    goals = seen[:, -3:]
    np.testing.assert_array_equal(goals, after[:, -3:])
    np.testing.assert_array_equal(returns, task.goal_reward(after[:, 25:28], goals))
    assert (batch.discounts == np.float32(0.99)).all()  # nothing ends the bootstrap: episodes run out of time only
    before = task.goal_reward(seen[:, 25:28], goals)
    assert (before != returns).mean() > 0.01  # the object moved, so the two can be told apart
    assert 0.2 < (returns == 0).mean() < 0.95
