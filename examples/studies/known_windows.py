"""Coverage and silent misses of `laplace` on windows that begin at known states, through contact.

As the environment tasks of the leaderboard, of truths and starts that are in none of them: each parameter .1 to .4 of
its range from the centre, 50 control steps of the expert, white noise of 1 % of each channel's spread, the exact state
known before every fifth control step (`--known`), `sipe.Segments` with the noise inferred, 1,000 rollouts (`--budget`).
A silent miss is a fit with a determined parameter more than five of its sds off and no blocking finding.

    python examples/studies/known_windows.py --seeds 0 12                          # HalfCheetahLinks
    python examples/studies/known_windows.py --select Hopper HalfCheetahJoints --seeds 0 6

Fits are kept in runs/known_windows and an interrupted study goes on; each run writes the summary of all there are.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from _kept import ensure, fits
from contact import summary

import sipe_bayes as sipe
from sipe_bayes.benchmark.leaderboard.task import known_start
from sipe_bayes.core.files import write_text
from sipe_bayes.core.findings import Severity
from sipe_bayes.datasets import acting
from sipe_bayes.datasets.demonstrations import behaviour_of
from sipe_bayes.envs.registry import TASKS

HERE = Path(__file__).parent
FILE = HERE / "runs" / "known_windows" / "fits.jsonl"
STEPS, LEVEL = 50, 0.01


def one_fit(name: str, seed: int, known: int, budget: int) -> dict[str, Any]:
    """Where the truth lies in the posterior, and what is found against it."""
    simulator = sipe.Simulator(sipe.make_task(name), num_threads=1)
    rng, size = np.random.default_rng([77, seed]), len(simulator.space)
    theta = 0.5 + rng.choice([-1.0, 1.0], size) * rng.uniform(0.1, 0.4, size)
    behaviour = behaviour_of(simulator.task, "expert") or acting.excitation(simulator.task, simulator.dt)
    asked = acting.Recording("test", 1, 5000 + seed, min(STEPS, simulator.task.episode_steps))
    clean = acting.simulate(simulator, theta, behaviour, asked)[0]
    noise = LEVEL * clean.observations.std(1, keepdims=True) * rng.standard_normal(clean.observations.shape)
    log = replace(known_start(clean, known), observations=clean.observations + noise)
    likelihood = sipe.Segments(known * simulator.dt, starts="recorded")
    estimator = sipe.get_estimator(simulator, "laplace", likelihood=likelihood, budget=budget, seed=0)
    begin = time.process_time()
    posterior = estimator.fit(log)
    mean, sd = posterior.mean.numpy(), posterior.stddev.numpy()
    low, high = posterior.quantile([0.05, 0.95]).numpy()
    return {
        "model": name,
        "seed": seed,
        "known": known,
        "budget": budget,
        "error": np.abs(mean - theta).tolist(),
        "sd": sd.tolist(),
        "z": ((mean - theta) / sd).tolist(),
        "covered": ((low <= theta) & (theta <= high)).tolist(),
        "blocking": [str(f.code) for f in estimator.findings if f.severity is Severity.BLOCKING],
        "rollouts": estimator.rollouts,
        "processor_seconds": round(time.process_time() - begin, 1),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--select", nargs="*", default=["HalfCheetahLinks"], choices=list(TASKS))
    parser.add_argument("--seeds", type=int, nargs=2, metavar=("FIRST", "END"), default=[0, 12])
    parser.add_argument("--known", type=int, default=5, help="control steps from one known state to the next")
    parser.add_argument("--budget", type=int, default=1000)
    given = parser.parse_args()
    for name in given.select:
        for seed in range(*given.seeds):
            which = {"model": name, "seed": seed, "known": given.known, "budget": given.budget}
            ensure(FILE, which, partial(one_fit, name, seed, given.known, given.budget))
    by_cell: dict[str, list[dict[str, Any]]] = {}
    for row in fits(FILE):
        cell = f"{row['model']}, every {row['known']} steps, {row['budget']} rollouts"
        by_cell.setdefault(cell, []).append(row)
    table = {
        "command": "python examples/studies/known_windows.py --select MODEL --seeds FIRST END, for each cell",
        "versions": {p: version(p) for p in ("mujoco", "numpy", "scipy")},
        "cells": {cell: {**summary(rows), **_middle(rows)} for cell, rows in sorted(by_cell.items())},
    }
    write_text(HERE / "results" / "known_windows.json", json.dumps(table, indent=2) + "\n")


def _middle(rows: list[dict[str, Any]]) -> dict[str, float]:
    return {"median_error": round(float(np.median([np.mean(r["error"]) for r in rows])), 5)}


if __name__ == "__main__":
    main()
