"""Policies of random weights."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

import sipe_bayes as sipe
from sipe_bayes.envs.task import Task
from sipe_bayes.models.policy import Policy
from sipe_bayes.rl.ddpg import Agent
from sipe_bayes.rl.settings import Settings

SMALL = Settings(hidden=(8, 8), batch=16, start_steps=60, learning_rate=1e-3)


def agent(task: Task, seed: int = 0) -> Policy:
    """A small policy of random weights."""
    rng, sizes = np.random.default_rng(seed), (len(task.channels), 8, task.num_actions)
    layers = tuple(
        (rng.standard_normal((m, n)).astype(np.float32) / 2, np.zeros(m, np.float32)) for n, m in pairwise(sizes)
    )
    return Policy(task.name, layers, task.action_low, task.action_high)


def policy(seed: int = 0, normalised: bool = True, task: str = "Pendulum") -> Policy:
    """An untrained agent's."""
    made = sipe.make_task(task)
    rng = np.random.default_rng(seed)
    learner = Agent(len(made.channels), made.num_actions, made.action_low, made.action_high, SMALL, rng)
    found = learner.policy(task)
    if not normalised:
        return found
    mean, scale = rng.standard_normal((2, len(made.channels))).astype(np.float32)
    return Policy(task, found.layers, found.action_low, found.action_high, mean, np.abs(scale) + 0.1)
