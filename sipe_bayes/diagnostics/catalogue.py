"""What `sipe envs` prints: the benchmark's tasks and one task's parameters, as plain data."""

from __future__ import annotations

from typing import Any

from sipe_bayes.diagnostics.sensitivity import LEVELS, Sensitivity, sensitivity
from sipe_bayes.envs.registry import TASKS, make_task
from sipe_bayes.envs.task import VARIANTS, Task
from sipe_bayes.simulation.simulator import Simulator


def tasks() -> list[dict[str, Any]]:
    """One row for every task of the registry."""
    return [_row(make_task(name)) for name in TASKS]


def describe(name: str) -> dict[str, Any]:
    """One task with its parameters, variants and measured sensitivities; raises ValueError for an unknown name."""
    task = make_task(name)
    measured = sensitivity(Simulator(task))
    return {
        **_row(task),
        "observation": list(task.channels),
        "sensitivity_at_theta": list(LEVELS),
        "parameters": [_parameter(task, j, measured) for j in range(len(task.space))],
        "variants": {v: task.theta(v).round(6).tolist() for v in VARIANTS},
        "changes_nothing": measured.dead,
        "changes_nothing_at_theta": measured.dead_ranges,
    }


def _row(task: Task) -> dict[str, Any]:
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


def _parameter(task: Task, index: int, measured: Sensitivity) -> dict[str, Any]:
    parameter = task.space[index]
    return {
        "name": parameter.name,
        "unit": parameter.unit,
        "default": parameter.default,
        "low": parameter.low,
        "high": parameter.high,
        "writes": list(parameter.targets),
        "description": parameter.description,
        "sensitivity": [float(f"{x:.3g}") for x in measured.moved[:, index]],
    }
