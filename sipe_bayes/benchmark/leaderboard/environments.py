"""Nine environments of the benchmark, five truths in distribution each, 1 % noise, every fifth state known.

Each truth has every parameter .1 to .4 of its range from the centre, on a side drawn at random. The expert acts, as in
``sipe.demonstrations``, for 50 control steps from a start of its own; white noise of 1 % of each channel's spread over
the log lies on every sample. The exact state is known before every fifth control step: over longer open loops contact
is chaotic (on FetchPush the next grid point to the truth is off by seventy times the noise), so that no method could
tell anything.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from sipe_bayes.benchmark.leaderboard.task import Case, Kind, Problem, Task, known_start
from sipe_bayes.datasets import acting
from sipe_bayes.datasets.demonstrations import behaviour_of
from sipe_bayes.datasets.trajectory_sets import TASKS as NINE
from sipe_bayes.envs.registry import make_task
from sipe_bayes.likelihood import Segments
from sipe_bayes.simulation.simulator import Simulator

_STEPS, _KNOWN, _TRUTHS, _NOISE, _BUDGET = 50, 5, 5, 0.01, 1000
_NEAREST, _FURTHEST = 0.1, 0.4  # of a truth from the centre, as of the benchmark's own variant


def tasks() -> list[Task]:
    """One for each environment."""
    about = (
        f"{_TRUTHS} truths in distribution, {_STEPS} control steps of the expert, 1 % noise, every fifth state known"
    )
    return [Task(name, Kind.ENVIRONMENT, about, _BUDGET, partial(_problem, name)) for name in NINE]


def _problem(name: str) -> Problem:
    simulator = Simulator(make_task(name), num_threads=1)
    likelihood = Segments(_KNOWN * simulator.dt, starts="recorded")
    return Problem(simulator, likelihood, tuple(_case(simulator, name, k) for k in range(_TRUTHS)))


def _case(simulator: Simulator, name: str, number: int) -> Case:
    task, rng = simulator.task, np.random.default_rng([1, NINE.index(name), number])
    size = len(task.space)
    truth = 0.5 + rng.choice([-1.0, 1.0], size) * rng.uniform(_NEAREST, _FURTHEST, size)
    behaviour = behaviour_of(task, "expert") or acting.excitation(task, simulator.dt)
    asked = acting.Recording("test", 1, 1000 + number, min(_STEPS, task.episode_steps))
    clean = acting.simulate(simulator, truth, behaviour, asked)[0]
    noise = _NOISE * clean.observations.std(1, keepdims=True) * rng.standard_normal(clean.observations.shape)
    noisy = replace(known_start(clean, _KNOWN), observations=clean.observations + noise, names=(f"log {number}",))
    return Case(f"log {number}", noisy, truth)
