"""The two real pendulums of ``examples/``: fitted on the logs that train, scored by how the others are predicted.

Of the simple pendulum the weight was weighed, .546 kg, which is scored too; all else of either is unknown. The logs are
those of the source tree, which a wheel does not hold.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from sipe_bayes.benchmark.leaderboard.task import Case, Kind, Problem, Task
from sipe_bayes.calibration.problem import prepare

_EXAMPLES = Path(__file__).parents[3] / "examples"
_BUDGET = 1000
_WEIGHED: dict[str, dict[str, float]] = {"simple_pendulum": {"weight_mass": 0.546}, "furuta_pendulum": {}}
_ABOUT = {
    "simple_pendulum": "a real pendulum (DFKI), two logs held out, its weight weighed",
    "furuta_pendulum": "a real Furuta pendulum (SimuRLacra), six logs held out",
}


def tasks() -> list[Task]:
    """The two."""
    return [
        Task(name, Kind.REAL, about, _BUDGET, partial(_problem, name), bool(_WEIGHED[name]), True)
        for name, about in _ABOUT.items()
    ]


def _problem(name: str) -> Problem:
    path = _EXAMPLES / name / "calibrate.toml"
    if not path.is_file():
        raise FileNotFoundError(
            f"{path}: no such file; the real logs come with the source tree, not with the wheel: run from a checkout"
        )
    made = prepare(path, num_threads=1)
    space, truth = made.simulator.space, np.full(len(made.simulator.space), np.nan)
    for parameter, value in _WEIGHED[name].items():
        index = space.index(parameter)
        truth[index] = space[index].normalise(value)
    case = Case("all logs", made.train, truth, heldout=made.holdout)
    search = made.config.search.model_dump(exclude={"start"})
    return Problem(made.simulator, made.segments, (case,), made.prior, search)
