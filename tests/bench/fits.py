"""What each estimator's fit takes beyond simulating: table of `bench.py fits`."""

from __future__ import annotations

import time
import warnings
from typing import Any

import numpy as np

import sipe_bayes as sipe
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.inference import ESTIMATORS, get_estimator
from sipe_bayes.simulation.simulator import Simulator

TASK, STEPS, BUDGET = "HalfCheetahLinks", 100, 1000


class Timed(Simulator):
    """Adds up the seconds of its rollouts."""

    spent = 0.0

    def rollout(self, *args: Any, **settings: Any) -> Trajectories:
        begin = time.perf_counter()
        try:
            return super().rollout(*args, **settings)
        finally:
            self.spent += time.perf_counter() - begin


def table() -> None:
    print(f"\nFits on {TASK}, a log of {STEPS} control steps, budget {BUDGET:,}; seconds")
    print(f"{'method':<12}{'rollouts':>10}{'simulating':>12}{'its own':>10}")
    for name in ESTIMATORS:
        simulator = Timed(sipe.make_task(TASK), num_threads=2)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            log = sipe.demonstrations(sipe.make(TASK, variant="in_distribution"), count=1, steps=STEPS)
            estimator = get_estimator(simulator, name, budget=BUDGET, seed=0, **_one_step(name, simulator))
            begin = time.perf_counter()
            estimator.fit(log)
            seconds = time.perf_counter() - begin
        own = seconds - simulator.spent
        print(f"{name:<12}{estimator.rollouts:>10}{simulator.spent:>12.1f}{own:>10.1f}", flush=True)
    _many_parameters()


def _one_step(name: str, simulator: Simulator) -> dict[str, Any]:
    """Those that would search for the windows' starts as well compare single control steps from the recorded states."""
    if name not in ("laplace", "mcmc"):
        return {}
    return {"likelihood": sipe.Segments(simulator.dt, noise="white", starts="recorded")}


def _many_parameters() -> None:
    """``bayesopt`` where the Gaussian process is at its largest: 1,000 evaluations of 51 parameters."""
    space = sipe.ParameterSpace(sipe.Parameter(f"p{k}", low=0.0, high=1.0) for k in range(51))
    simulator = sipe.CallableSimulator(lambda values: values, space, name="identity")
    estimator = get_estimator(simulator, "bayesopt", budget=BUDGET, seed=0)
    begin = time.perf_counter()
    estimator.fit(np.full(51, 0.3))
    print(f"bayesopt, 51 parameters, {estimator.rollouts} evaluations: {time.perf_counter() - begin:.0f} s")
