"""Policies of random weights."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from sipe_bayes.envs.task import Task
from sipe_bayes.models.policy import Policy


def agent(task: Task, seed: int = 0) -> Policy:
    """A small policy of random weights."""
    rng, sizes = np.random.default_rng(seed), (len(task.channels), 8, task.num_actions)
    layers = tuple(
        (rng.standard_normal((m, n)).astype(np.float32) / 2, np.zeros(m, np.float32)) for n, m in pairwise(sizes)
    )
    return Policy(task.name, layers, task.action_low, task.action_high)
