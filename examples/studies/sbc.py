"""Simulation-based calibration of `npe`, `bayessim`, `mcmc` and `laplace`.

On Pendulum and HalfCheetahLinks, with 1 % observation noise.

    python examples/studies/sbc.py run      # every cell, hours; goes on after an interruption
    python examples/studies/sbc.py run --select Pendulum/laplace
    python examples/studies/sbc.py table    # results/sbc.json and .md of the cells there are

A cell is what `sipe check TASK ESTIMATOR` does: one demonstration's commands and start, truths from the prior, a log
simulated at each of them with the noise, a posterior of each log. `npe` and `bayessim` are trained once, on 2,000
simulations, and then condition on 400 logs; `laplace` and `mcmc`, on StateSpace, are fitted to 100. Ranks are uniform
where the smallest p-value over a task's N parameters is at least .05 / N: the whole curve of each lies in its
simultaneous band of 1 - .05 / N, all of them together in one of 95 %. Coverage is that of 90 % intervals, pooled over
parameters, its standard error clustered by log.
"""

from __future__ import annotations

import argparse
import json
from importlib.metadata import version
from pathlib import Path
from typing import Any

from sipe_bayes.calibration.check import RESULT, run
from sipe_bayes.calibration.study import study_of_task
from sipe_bayes.core.files import to_json, write_text

HERE = Path(__file__).parent
RUNS = HERE / "runs" / "sbc"
TASKS, STEPS, NOISE, LEVEL = ("Pendulum", "HalfCheetahLinks"), 100, 0.01, 0.05
METHODS = {"npe": (2000, 400), "bayessim": (2000, 400), "laplace": (None, 100), "mcmc": (10_000, 100)}  # rollouts, logs


def measure(task: str, estimator: str) -> None:
    """Run a cell, or go on with it."""
    budget, truths = METHODS[estimator]
    study = study_of_task(task, estimator, steps=STEPS, noise=NOISE, budget=budget, refits=0, seed=0, threads=1)
    found = run(
        study,
        truths,
        RUNS / f"{task}-{estimator}",
        lambda what, done, of: print(what, flush=True) if done % 10 == 0 else None,
    )
    versions = {p: version(p) for p in ("mujoco", "numpy", "torch", "sbi")}
    write_text(RUNS / f"{task}-{estimator}" / "versions.json", to_json(versions) + "\n")
    print(found.sentence(), flush=True)


def row(task: str, estimator: str, found: dict[str, Any]) -> dict[str, Any]:
    """What a cell came to."""
    parameters = found["parameters"]
    beyond = LEVEL / len(parameters)
    return {
        "task": task,
        "estimator": estimator,
        "logs": found["truths"],
        "failed": found["failed"],
        "warned": found["warned"],
        "uniform": min(p["p_ranks"] for p in parameters) >= beyond,
        "smallest_p": min(p["p_ranks"] for p in parameters),
        "not_uniform": {
            p["name"]: {"p": p["p_ranks"], "coverage_90": p["coverage"]["0.9"], "above_median": p["above_median"]}
            for p in parameters
            if p["p_ranks"] < beyond
        },
        "coverage_90": found["coverage_90"],
        "standard_error": found["standard_error"],
        "tarp_p": found["tarp"]["p"],
        "contraction": sum(s["contraction"] for s in found["sharpness"].values()) / len(parameters),
        "rollouts": found["rollouts"],
        "seconds": found["seconds"],
        "versions": json.loads((RUNS / f"{task}-{estimator}" / "versions.json").read_text(encoding="utf-8")),
    }


def line(found: dict[str, Any]) -> str:
    wrong = "; ".join(
        f"{name}: p = {one['p']:.1g}, covers {one['coverage_90']:.2f}, above the median {one['above_median']:.2f}"
        for name, one in found["not_uniform"].items()
    )
    said = "uniform" if found["uniform"] else f"not uniform ({wrong})"
    logs = f"{found['logs']}" + (f", {found['failed']} failed" if found["failed"] else "")
    logs += f", {found['warned']} with warnings" if found["warned"] else ""
    cells = [found["task"], found["estimator"], logs, said, f"{found['smallest_p']:.2g}"]
    cells += [f"{found['coverage_90']:.3f} ± {found['standard_error']:.3f}", f"{found['tarp_p']:.2g}"]
    return " | ".join(["", *cells, f"{found['contraction']:.2f}", ""]).strip()


def table() -> None:
    """Write the summary of all cells there are."""
    files = {(t, m): RUNS / f"{t}-{m}" / RESULT for t in TASKS for m in METHODS}
    rows = [row(*cell, json.loads(f.read_text(encoding="utf-8"))) for cell, f in files.items() if f.is_file()]
    if not rows:
        raise SystemExit(f"{RUNS}: no cell is finished; make some with `python {Path(__file__).name} run`")
    head = "| task | estimator | logs | ranks | smallest p | coverage of 90 % intervals | TARP p | mean contraction |"
    lines = [head, "|---" * 8 + "|", *map(line, rows)]
    missing = [f"{t}/{m}" for (t, m), f in files.items() if not f.is_file()]
    summary = {
        "command": "python examples/studies/sbc.py run, then table",
        "steps": STEPS,
        "noise": NOISE,
        "missing": missing,
        "cells": rows,
    }
    write_text(HERE / "results" / "sbc.json", to_json(summary, indent=1) + "\n")
    write_text(HERE / "results" / "sbc.md", "\n".join(lines) + "\n")
    print("\n".join([*lines, *(f"missing: {cell}" for cell in missing)]))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", nargs="?", choices=("run", "table"), help="default both")
    parser.add_argument("--select", default="", help="part of TASK/ESTIMATOR")
    given = parser.parse_args()
    cells = [(task, name) for task in TASKS for name in METHODS if given.select in f"{task}/{name}"]
    if not cells:
        parser.error(
            f"--select {given.select}: expected part of one of {', '.join(f'{t}/{m}' for t in TASKS for m in METHODS)}"
        )
    if given.command != "table":
        for cell in cells:
            measure(*cell)
    if given.command != "run":
        table()
