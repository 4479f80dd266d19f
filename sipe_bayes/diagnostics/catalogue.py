"""What `sipe envs` prints: the benchmark's tasks and one task's parameters, as plain data."""

from __future__ import annotations

from sipe_bayes.envs.registry import TASKS, make_task
from sipe_bayes.envs.task import VARIANTS, Task


def tasks() -> list[dict[str, object]]:
    """One row for every task of the registry."""
    return [describe(make_task(name)) for name in TASKS]


def describe(task: Task) -> dict[str, object]:
    """The row of one task."""
    return {
        "name": task.name,
        "id": f"sipe/{task.name}-v0",
        "summary": task.summary,
        "parameters": len(task.space),
        "observations": len(task.channels),
        "actions": task.num_actions,
        "episode_steps": task.episode_steps,
        "solved_by": task.solved.measure,
        "solved_at": task.solved.threshold,
        "reproduces": task.reference,
    }


def to_json_row(task: Task) -> dict[str, object]:
    """What ``--json`` prints of one task: its row, with the parameters, channels and variants in full."""
    kept = ("name", "unit", "default", "low", "high", "description")
    parameters = [{key: getattr(p, key) for key in kept} | {"writes": list(p.targets)} for p in task.space]
    variants = {v: task.theta(v).round(6).tolist() for v in VARIANTS}
    return {**describe(task), "observation": list(task.channels), "parameters": parameters, "variants": variants}
