"""Accuracy, coverage and time of `laplace` on StateSpace: half-cheetah with 1 % and 5 % observation noise, 200 control steps.

    python examples/studies/state_space.py                                             # every cell, some hours
    python examples/studies/state_space.py --task HalfCheetahJoints --level 0.01 --seeds 0 10   # ten fits of one cell

Truths are uniform in [0.1, 0.9]^N; the excitation policy acts; every observed channel gets white noise of the given share of
its own spread along the log, and the states are withheld. Noise, process noise, states and theta are all inferred. Fits are
kept one by one in runs/state_space, so an interrupted study goes on and several processes may share it; each run writes
the summary of all fits there are to results/. Coverage of the 90 % intervals is pooled over the parameters, its standard
error clustered by fit. Seconds are the processor's over all threads: the wall time of a quiet machine with one.
"""

from __future__ import annotations

import argparse
import json
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

import sipe_bayes as sipe
from sipe_bayes import acting
from sipe_bayes.atomic import write_text

HERE = Path(__file__).parent
RUNS = HERE / "runs" / "state_space"
TASKS = ("HalfCheetahJoints", "HalfCheetahLinks")
LEVELS = (0.01, 0.05)
INSIDE = (0.1, 0.9)
STEPS, FITS = 200, 100


def recorded(simulator: sipe.Simulator, level: float, seed: int, steps: int) -> tuple[np.ndarray, sipe.Trajectory]:
    """A true theta and its noisy log without states."""
    noise = np.random.default_rng([seed, round(1e4 * level)])  # another one at each level: cells are independent
    theta = np.random.default_rng(seed).uniform(*INSIDE, len(simulator.space))
    behaviour = acting.excitation(simulator.environment, simulator.dt)
    motion, _ = acting.simulate(simulator, theta, behaviour, "reference", 1, seed, steps)
    clean = motion[0].observations
    noisy = clean + level * clean.std(axis=0) * noise.standard_normal(clean.shape)
    return theta, sipe.Trajectory(noisy, motion[0].actions, motion[0].dt)


def one_fit(simulator: sipe.Simulator, level: float, seed: int, steps: int) -> dict[str, Any]:
    """Where the truth lies in the posterior, and what the fit took."""
    theta, log = recorded(simulator, level, seed, steps)
    estimator = sipe.get_estimator(simulator, "laplace", likelihood=sipe.StateSpace(), seed=seed)
    begin, processor = time.perf_counter(), time.process_time()
    posterior = estimator.fit(log)
    seconds, processor = time.perf_counter() - begin, time.process_time() - processor
    mean, sd = posterior.mean.numpy(), posterior.stddev.numpy()
    low, high = posterior.quantile([0.05, 0.95]).numpy()
    return {
        "seed": seed,
        "error": np.abs(mean - theta).tolist(),
        "sd": sd.tolist(),
        "covered": ((low <= theta) & (theta <= high)).tolist(),
        "rollouts": estimator.rollouts,
        "wall_seconds": round(seconds, 2),
        "processor_seconds": round(processor, 2),
        "process_over_measurement": round(_process_share(estimator.diagnostics), 4),
        "warnings": estimator.warnings,
    }


def _process_share(diagnostics: dict[str, Any]) -> float:
    """Median ratio of process to measurement noise over the coordinates, root's place left out: it is not observed."""
    return float(np.median(np.array(diagnostics["process_noise"][1:]) / np.array(diagnostics["noise_sd"])))


def summary(rows: list[dict[str, Any]], names: tuple[str, ...]) -> dict[str, Any]:
    """Of one cell; the standard error is clustered by fit."""
    covered, error = np.array([r["covered"] for r in rows], float), np.array([r["error"] for r in rows])
    sd = np.array([r["sd"] for r in rows])
    processor = [r["processor_seconds"] for r in rows]
    spread = covered.mean(1).std(ddof=1) / np.sqrt(len(rows)) if len(rows) > 1 else np.nan
    return {
        "fits": len(rows),
        "mean_error": round(float(error.mean()), 5),
        "worst_fit_error": round(float(error.mean(1).max()), 5),
        "coverage_90": round(float(covered.mean()), 4),
        "standard_error": round(float(spread), 4),
        "mean_sd": round(float(sd.mean()), 5),
        "mean_contraction": round(float(1 - sd.mean() * np.sqrt(12)), 4),
        "coverage_by_parameter": dict(zip(names, covered.mean(0).round(3).tolist(), strict=True)),
        "median_rollouts": float(np.median([r["rollouts"] for r in rows])),
        "processor_seconds_median_and_most": [round(float(np.median(processor)), 1), max(processor)],
        "wall_seconds_median": round(float(np.median([r["wall_seconds"] for r in rows])), 1),
        "process_over_measurement_median": float(np.median([r["process_over_measurement"] for r in rows])),
        "fits_with_warnings": sum(bool(r["warnings"]) for r in rows),
    }


def path(task: str, level: float, steps: int, seed: int) -> Path:
    return RUNS / f"{task}-{level:g}-{steps}-{seed}.json"


def table(steps: int) -> None:
    """Write the summary of all fits there are."""
    cells = {}
    for task in TASKS:
        names = sipe.make_task(task).space.names
        for level in LEVELS:
            files = sorted(RUNS.glob(path(task, level, steps, 0).name.replace("-0.json", "-*.json")))
            rows = [json.loads(f.read_text(encoding="utf-8")) for f in files]
            if rows:
                cells[f"{task}, {level:.0%}"] = summary(rows, names)
    found = {
        "command": f"python examples/studies/state_space.py --steps {steps}",
        "versions": {p: version(p) for p in ("mujoco", "numpy", "scipy")},
        "steps": steps,
        "cells": cells,
    }
    write_text(HERE / "results" / f"state_space_{steps}.json", json.dumps(found, indent=2) + "\n")
    for cell, row in cells.items():
        print(cell, {k: v for k, v in row.items() if k != "coverage_by_parameter"}, flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", nargs="*", default=list(TASKS), choices=TASKS)
    parser.add_argument("--level", type=float, nargs="*", default=list(LEVELS), choices=LEVELS)
    parser.add_argument("--seeds", type=int, nargs=2, default=[0, FITS], metavar=("FIRST", "END"))
    parser.add_argument("--steps", type=int, default=STEPS)
    parser.add_argument("--threads", type=int, default=1)
    given = parser.parse_args()
    for task in given.task:
        simulator = sipe.Simulator(sipe.make_task(task), num_threads=given.threads)
        for level in given.level:
            for seed in range(*given.seeds):
                file = path(task, level, given.steps, seed)
                if not file.exists():
                    write_text(file, json.dumps(one_fit(simulator, level, seed, given.steps)) + "\n")
    table(given.steps)


if __name__ == "__main__":
    main()
