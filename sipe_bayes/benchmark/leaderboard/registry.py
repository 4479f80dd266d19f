"""The one list of the leaderboard's tasks: a new task is a file, a line here and another version."""

from __future__ import annotations

from collections.abc import Sequence

from sipe_bayes.benchmark.leaderboard import arm, environments, exact, misspecified, real
from sipe_bayes.benchmark.leaderboard.task import Task
from sipe_bayes.core.validation import nearest_name

TASKS = {
    task.name: task
    for task in (*environments.tasks(), *real.tasks(), *arm.tasks(), *exact.tasks(), *misspecified.tasks())
}


def chosen(names: Sequence[str]) -> list[Task]:
    """The tasks of some names, or of none all; raises ValueError for a name that there is not."""
    for name in names:
        if name not in TASKS:
            hint = nearest_name(name, TASKS) or f"; known: {', '.join(TASKS)}"
            raise ValueError(f"--tasks {name}: no such task{hint}")
    return [TASKS[name] for name in dict.fromkeys(names or TASKS)]
