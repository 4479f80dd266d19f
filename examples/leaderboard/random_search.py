"""Random search: of as many draws of the prior as the budget allows, the one whose simulation is nearest to the log.

    python examples/leaderboard/random_search.py --out runs/leaderboard/random_search

Nearest by the sum of squares, each channel over its spread in the log. A point, without intervals:
what every other method has to beat.
"""

from __future__ import annotations

import numpy as np

from sipe_bayes.benchmark.leaderboard.run import Estimate, Method, run_from_command_line
from sipe_bayes.benchmark.leaderboard.task import Case, Problem, Task

BATCH = 100


def method(seed: int) -> Method:
    def best(task: Task, problem: Problem, case: Case) -> Estimate:
        rng = np.random.default_rng([seed, problem.cases.index(case)])
        observed, scale = problem.observed(case), problem.scale(case)
        count = task.budget // len(case.trajectories)
        lowest, chosen = np.inf, problem.space.values(np.full(len(problem.space), 0.5))
        for first in range(0, count, BATCH):
            values = problem.space.values(rng.random((min(BATCH, count - first), len(problem.space))))
            cost = np.square((problem.simulate(case, values) - observed) / scale).sum(1)
            if np.nanmin(cost, initial=np.inf) < lowest:
                lowest, chosen = np.nanmin(cost), values[np.nanargmin(cost)]
        return Estimate(chosen[None], count * len(case.trajectories))

    return best


if __name__ == "__main__":
    run_from_command_line("random search", "the nearest of uniform draws within the bounds", ["scipy"], method)
