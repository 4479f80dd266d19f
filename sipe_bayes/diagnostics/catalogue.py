"""What `sipe envs` prints: the benchmark's tasks and one task's parameters, as plain data."""

from __future__ import annotations

from typing import TypedDict

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.diagnostics.identifiability import GRID
from sipe_bayes.diagnostics.sensitivity import sensitivity
from sipe_bayes.envs.registry import TASKS, make_task
from sipe_bayes.envs.task import VARIANTS, Task
from sipe_bayes.simulation.simulator import Simulator


class TaskRow(TypedDict):
    """One task in a line."""

    name: str
    id: str
    summary: str
    parameters: int
    observations: int
    actions: int
    episode_steps: int
    solved_by: str
    solved_at: float
    reproduces: str


class ParameterRow(TypedDict):
    """One parameter of a task; its sensitivity at each of the levels of theta."""

    name: str
    unit: str
    default: float | None
    low: float
    high: float
    writes: list[str]
    description: str
    sensitivity: list[float]


class TaskDescription(TypedDict):
    """One task with its parameters, variants and measured sensitivities."""

    task: TaskRow
    observation: list[str]
    sensitivity_at_theta: list[float]
    parameters: list[ParameterRow]
    variants: dict[str, list[float]]
    changes_nothing: list[str]
    changes_nothing_at_theta: dict[str, list[float]]


def tasks() -> list[TaskRow]:
    """One row for every task of the registry."""
    return [_row(make_task(name)) for name in TASKS]


def to_json_row(description: TaskDescription) -> dict[str, object]:
    """What ``--json`` prints: the task's line and the rest in one object, its parameters in full."""
    return {**description["task"], **{k: v for k, v in description.items() if k != "task"}}


def describe(name: str) -> TaskDescription:
    """One task with its parameters, variants and measured sensitivities; raises ValueError for an unknown name."""
    task = make_task(name)
    measured = sensitivity(Simulator(task))
    return {
        "task": _row(task),
        "observation": list(task.channels),
        "sensitivity_at_theta": list(GRID),
        "parameters": [_parameter(p, moved) for p, moved in zip(task.space, measured.moved.T, strict=True)],
        "variants": {v: task.theta(v).round(6).tolist() for v in VARIANTS},
        "changes_nothing": measured.dead,
        "changes_nothing_at_theta": measured.dead_ranges,
    }


def _row(task: Task) -> TaskRow:
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


def _parameter(parameter: Parameter, moved: FloatArray) -> ParameterRow:
    return {
        "name": parameter.name,
        "unit": parameter.unit,
        "default": parameter.default,
        "low": parameter.low,
        "high": parameter.high,
        "writes": list(parameter.targets),
        "description": parameter.description,
        "sensitivity": [float(f"{x:.3g}") for x in moved],
    }
