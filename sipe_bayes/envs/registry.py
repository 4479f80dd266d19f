"""The one list of the benchmark's tasks: name -> module and the function that makes it."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from sipe_bayes.core.validation import nearest_name

if TYPE_CHECKING:
    from sipe_bayes.envs.task import Task

TASKS = {
    "FetchPush": ("sipe_bayes.envs.tasks.fetch", "push"),
    "FetchSlide": ("sipe_bayes.envs.tasks.fetch", "slide"),
    "FetchPickAndPlace": ("sipe_bayes.envs.tasks.fetch", "pick_and_place"),
    "Relocate": ("sipe_bayes.envs.tasks.adroit", "relocate"),
    "Door": ("sipe_bayes.envs.tasks.adroit", "door"),
    "HalfCheetahLinks": ("sipe_bayes.envs.tasks.half_cheetah", "links"),
    "HalfCheetahJoints": ("sipe_bayes.envs.tasks.half_cheetah", "joints"),
    "HalfCheetahAllJoints": ("sipe_bayes.envs.tasks.half_cheetah", "all_joints"),
    "HumanoidLinks": ("sipe_bayes.envs.tasks.humanoid", "links"),
    "HumanoidJoints": ("sipe_bayes.envs.tasks.humanoid", "joints"),
    "Hopper": ("sipe_bayes.envs.tasks.hopper", "hopper"),
    "CartPole": ("sipe_bayes.envs.tasks.classic", "cart_pole"),
    "Pendulum": ("sipe_bayes.envs.tasks.classic", "pendulum"),
}


def make_task(name: str) -> Task:
    """The task called ``name``; raises ValueError that suggests the nearest."""
    if name not in TASKS:
        hint = nearest_name(name, TASKS, 0.5) or f"; known: {', '.join(TASKS)}"
        raise ValueError(f"environment: no {name!r}{hint}")
    module, function = TASKS[name]
    task: Task = getattr(importlib.import_module(module), function)()
    return task
