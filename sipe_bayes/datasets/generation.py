"""Making trajectory sets: what `sipe data generate` does."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from sipe_bayes.datasets import acting, trajectory_sets
from sipe_bayes.datasets.demonstrations import agent_file, behaviour_of, default_steps
from sipe_bayes.datasets.trajectory_sets import Origin, SetName
from sipe_bayes.envs.registry import make_task
from sipe_bayes.simulation.simulator import Simulator


@dataclass(frozen=True)
class Made:
    """One set: its file's size in bytes and the seconds it took, or why it was not made."""

    name: SetName
    size: int = 0
    seconds: float = 0.0
    missing: str = ""


def generate(
    names: Iterable[SetName],
    folder: Path,
    count: int = trajectory_sets.COUNT,
    steps: int | None = None,
    seed: int = 0,
    command: str = "",
    num_threads: int | None = None,
) -> Iterator[Made]:
    """Make sets one after the other, each written when it is done.

    A set without an agent, or that diverges, is passed over, and says so.

    Args:
        names: which.
        folder: to write to.
        count: trajectories of each.
        steps: control steps; default of the task.
        seed: of the trajectories.
        command: that asked for them.
        num_threads: of the simulation.
    """
    simulator: Simulator | None = None
    for name in names:
        began = time.monotonic()
        if simulator is None or simulator.task.name != name.task:
            simulator = Simulator(make_task(name.task), num_threads)
        try:
            size = _generate(simulator, name, folder, count, steps, seed, command)
        except (LookupError, RuntimeError) as error:
            yield Made(name, missing=str(error.args[0]))
        else:
            yield Made(name, size, time.monotonic() - began)


def _generate(
    simulator: Simulator, name: SetName, folder: Path, count: int, steps: int | None, seed: int, command: str
) -> int:
    task = simulator.task
    behaviour = behaviour_of(task, name.type)
    if behaviour is None:
        raise LookupError(f"no {name.type} agent of {name.task} is installed")
    horizon = default_steps(task) if steps is None else steps
    asked = acting.Recording(name.split, count, seed, horizon)
    made, goals = acting.simulate(simulator, task.theta(name.variant), behaviour, asked)
    file = agent_file(name.task, name.type)
    agent = hashlib.sha256(file.read_bytes()).hexdigest() if file else ""
    return trajectory_sets.write(folder, name, simulator, made, goals, Origin(seed, agent, command)).bytes
