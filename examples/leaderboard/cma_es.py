"""CMA-ES on the squared error, with the cma package, as actuator models are fitted to joint positions by PACE.

    python examples/leaderboard/cma_es.py --out runs/leaderboard/cma_es

theta in the unit cube, from its centre with a step of .3, bounds by cma's own transformation, the population by its
default; each channel counts over its spread in the log. The best point of the search is given, without intervals.
N. Hansen 2016, "The CMA Evolution Strategy: A Tutorial", https://arxiv.org/abs/1604.00772. PACE: F. Bjelonic and others
2025, https://arxiv.org/abs/2509.06342. `pip install 'sipe-bayes[leaderboard]'`.
"""

from __future__ import annotations

import cma
import numpy as np

from sipe_bayes.benchmark.leaderboard.run import Estimate, Method, run_from_command_line
from sipe_bayes.benchmark.leaderboard.task import Case, Problem, Task

STEP = 0.3


def method(seed: int) -> Method:
    def search(task: Task, problem: Problem, case: Case) -> Estimate:
        observed, scale, size = problem.observed(case), problem.scale(case), len(case.trajectories)
        options = {
            "bounds": [0, 1],
            "seed": seed + 1,
            "verbose": -9,
            "maxfevals": task.budget // size,
        }  # 0 is the clock
        strategy = cma.CMAEvolutionStrategy(np.full(len(problem.space), 0.5), STEP, options)
        spent = 0
        while not strategy.stop() and (spent + strategy.popsize) * size <= task.budget:
            asked = strategy.ask()
            off = (problem.simulate(case, problem.space.values(np.stack(asked))) - observed) / scale
            cost = np.nan_to_num(np.square(off).sum(1), nan=np.inf)
            strategy.tell(asked, cost.tolist())
            spent += len(asked)
        if strategy.result.xbest is None:
            raise RuntimeError("no simulation was valid")
        return Estimate(problem.space.values(strategy.result.xbest)[None], spent * size)

    return search


if __name__ == "__main__":
    run_from_command_line("CMA-ES", "the cma package on the squared error, its defaults; a point", ["cma"], method)
