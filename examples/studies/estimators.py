"""Every estimator on five tasks: accuracy, CRPS and skill at 1,000 rollouts, in-distribution variant, three seeds.

    python examples/studies/estimators.py run     # every cell that is not there yet; goes on after an interruption
    python examples/studies/estimators.py run --select FetchPush/npe
    python examples/studies/estimators.py table   # results/estimators.json and .md of the cells there are

A cell is task/method/seed. The log is one excited trajectory of 100 control steps (Fetch: 50), noise-free, with
recorded states; seed k gives log and estimator. A parameter counts as determined by a log where the Fisher information
of its control steps at the truth, under noise of 0.1 % of each channel's spread, leaves less than half of the prior's
sd; whatever the methods say. CRPS and skill are means over the determined parameters; skill is 1 - CRPS / CRPS of the
prior's mean, and against the prior itself.
"""

from __future__ import annotations

import argparse
import json
import os
import time
import traceback
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch

import sipe_bayes as sipe
from sipe_bayes.core.files import write_text
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.datasets import acting
from sipe_bayes.diagnostics.scores import score
from sipe_bayes.likelihood import bind
from sipe_bayes.posterior import Dirac, Posterior, prior

HERE = Path(__file__).parent
RUNS = HERE / "runs" / "estimators"
TASKS = ("HalfCheetahLinks", "HalfCheetahJoints", "FetchPush", "Door", "Relocate")
METHODS: dict[str, tuple[str, dict[str, Any]]] = {
    "laplace": ("laplace", {"candidates": 100}),
    "mcmc": ("mcmc", {"candidates": 100}),
    "bayessim": ("bayessim", {}),
    "npe": ("npe", {}),
    "abc": ("abc", {}),
    "regression": ("regression", {}),
    "maml": ("maml", {}),
    "bayesopt": ("bayesopt", {}),
    "simopt": ("simopt", {}),
    "simopt, learned reward": ("simopt", {"reward": "learned"}),
    "adr": ("adr", {}),
    "adr, learned reward": ("adr", {"reward": "learned"}),
    "cem": ("cem", {}),
}
ONE_STEP = ("laplace", "mcmc")  # with one-step windows from the recorded states
BUDGET, SEEDS, STEPS = 1000, 3, 100


def recorded(task: str, seed: int) -> tuple[sipe.Simulator, np.ndarray, Trajectories]:
    """Simulator, true theta and log, by the excitation policy, also where an agent is installed."""
    simulator = sipe.Simulator(sipe.make_task(task), num_threads=1)
    environment = simulator.environment
    steps, truth = min(STEPS, environment.episode_steps), environment.theta("in_distribution")
    behaviour = acting.excitation(environment, simulator.dt)
    trajectories, _ = acting.simulate(simulator, truth, behaviour, acting.Recording("reference", 1, seed, steps))
    return simulator, truth, trajectories


def path(task: str, method: str, seed: int) -> Path:
    return RUNS / f"{task}-{method.replace(', ', '-').replace(' ', '_')}-{seed}.json"


def run_cell(task: str, method: str, seed: int) -> dict[str, Any]:
    simulator, truth, trajectories = recorded(task, seed)
    name, settings = METHODS[method]
    if method in ONE_STEP:
        settings = {**settings, "likelihood": sipe.Segments(simulator.dt, noise="white", starts="recorded")}
    estimator = sipe.get_estimator(simulator, name, budget=BUDGET, seed=seed, **settings, **_cache(name, task, seed))
    begin, cpu = time.perf_counter(), time.process_time()
    posterior = estimator.fit(trajectories)
    seconds, cpu = time.perf_counter() - begin, time.process_time() - cpu
    return {
        "task": task,
        "method": method,
        "seed": seed,
        "seconds": round(seconds, 1),
        "cpu_seconds": round(cpu, 1),
        "rollouts": estimator.rollouts,
        "warnings": estimator.warnings,
        **_scored(posterior, truth),
    }


def _scored(posterior: Posterior, truth: np.ndarray) -> dict[str, Any]:
    scores = score(posterior, truth).to_dict()
    mean = [round(float(x), 6) for x in posterior.mean]
    return {"truth": [round(float(x), 6) for x in truth], "mean": mean, "scores": scores}


def _cache(name: str, task: str, seed: int) -> dict[str, Any]:
    from sipe_bayes.inference.amortised.prior_sampling import PriorSampling
    from sipe_bayes.inference.registry import estimator_class

    return {"cache": RUNS / "simulations"} if issubclass(estimator_class(name), PriorSampling) else {}


def run(select: str) -> None:
    RUNS.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)
    for seed in range(SEEDS):
        for task in TASKS:
            for method in METHODS:
                file = path(task, method, seed)
                if select not in f"{task}/{method}/{seed}" or (file.exists() and not _failed(file)):
                    continue
                lock = file.with_suffix(".lock")
                try:
                    lock.touch(exist_ok=False)  # two processes may share the work
                except FileExistsError:
                    continue
                try:
                    record = run_cell(task, method, seed)
                except Exception as error:  # a failed cell must not stop the others
                    record = {"task": task, "method": method, "seed": seed, "error": f"{type(error).__name__}: {error}"}
                    traceback.print_exc()
                finally:
                    lock.unlink()
                write_text(file, json.dumps(record, default=float))
                print(task, method, seed, record.get("seconds"), record.get("error", ""), flush=True)


def _failed(file: Path) -> bool:
    return "error" in json.loads(file.read_text(encoding="utf-8"))


def baselines(task: str) -> list[dict[str, Any]]:
    space = sipe.make_task(task).space
    truth = sipe.make_task(task).theta("in_distribution")
    rows = (("prior", prior(space)), ("prior mean", Dirac(np.full(len(space), 0.5), space)))
    return [{"task": task, "method": m, "seed": 0, **_scored(p, truth)} for m, p in rows]


def table() -> None:
    records = [json.loads(f.read_text(encoding="utf-8")) for f in sorted(RUNS.glob("*.json"))]
    determined = {(t, k): is_determined(t, k).tolist() for t in TASKS for k in range(SEEDS)}
    lines = _overview(records, determined)
    for task in TASKS:
        here = [r for r in records if r["task"] == task] + baselines(task)
        known = [sum(d) for (t, _), d in sorted(determined.items()) if t == task]
        space = sipe.make_task(task).space
        lines += [
            f"\n**{task}**, {len(space)} parameters, determined by the logs: {', '.join(map(str, known)) or '?'}\n",
            "| method | accuracy mean / min | mean error | CRPS | skill | against the prior | CPU s |",
            "|---|---|---|---|---|---|---|",
        ]
        reference = _row([r for r in here if r["method"] == "prior"], determined)
        for method in ("prior", "prior mean", *METHODS):
            cells = [r for r in here if r["method"] == method]
            if cells:
                lines.append(_line(method, cells, determined, reference))
    summary = {
        "command": "python examples/studies/estimators.py run, then table",
        "versions": {p: version(p) for p in ("mujoco", "numpy", "torch", "sbi", "botorch")},
        "budget": BUDGET,
        "cells": records,
    }
    write_text(HERE / "results" / "estimators.json", json.dumps(summary, default=float) + "\n")
    write_text(HERE / "results" / "estimators.md", "\n".join(lines).strip() + "\n")
    print("\n".join(lines))


def _overview(records: list[dict[str, Any]], determined: dict[tuple[str, int], list[bool]]) -> list[str]:
    """Skill against the prior of every method on every task, with the number of seeds behind it."""
    lines = ["| method | " + " | ".join(TASKS) + " |", "|---" * (1 + len(TASKS)) + "|"]
    for method in METHODS:
        row = []
        for task in TASKS:
            every = [r for r in records if (r["task"], r["method"]) == (task, method)]
            cells = [r for r in every if "error" not in r]
            failed = f", {len(every) - len(cells)} failed" if len(cells) < len(every) else ""
            reference = _row([b for b in baselines(task) if b["method"] == "prior"], determined)
            skill = 1 - _row(cells, determined)["crps"] / reference["crps"]
            row.append(f"{skill:.2f} ({len(cells)}{failed})" if cells else "")
        lines.append(f"| {method} | {' | '.join(row)} |")
    return lines


def is_determined(task: str, seed: int) -> np.ndarray:
    """Which parameters (N,) the log determines; see the module's docstring."""
    simulator, truth, trajectories = recorded(task, seed)
    windows = bind(sipe.Segments(simulator.dt, noise="white", starts="recorded"), simulator, trajectories)
    jacobian = windows.linearise(truth, windows.no_starts()).jacobian
    spread = trajectories.observations[0].std(0)
    sd = 1e-3 * np.maximum(spread, 1e-3 * np.median(spread[spread > 0]))
    rows = (jacobian / sd[:, None]).reshape(-1, len(truth))
    information = rows.T @ rows + np.diag(1 / prior(simulator.space).variance.numpy())
    return np.sqrt(np.diag(np.linalg.inv(information))) < 0.5 * prior(simulator.space).stddev.numpy()


def _row(cells: list[dict[str, Any]], determined: dict[tuple[str, int], list[bool]]) -> dict[str, float]:
    found: dict[str, list[float]] = {"accuracy": [], "least": [], "error": [], "crps": []}
    for cell in cells:
        seeds = [cell["seed"]] if "seconds" in cell else range(SEEDS)
        for seed in seeds:
            keep = np.array(determined.get((cell["task"], seed), [True] * len(cell["truth"])))
            if not keep.any():
                continue
            accuracy = np.array(cell["scores"]["accuracy"])
            found["accuracy"].append(accuracy.mean())
            found["least"].append(accuracy.min())
            found["error"].append(1 - accuracy[keep].mean())
            found["crps"].append(np.array(cell["scores"]["crps"])[keep].mean())
    return {name: float(np.mean(values)) if values else float("nan") for name, values in found.items()}


def _line(
    method: str,
    cells: list[dict[str, Any]],
    determined: dict[tuple[str, int], list[bool]],
    reference: dict[str, float],
) -> str:
    good = [c for c in cells if "error" not in c]
    failed = f" ({len(cells) - len(good)} failed)" if len(good) < len(cells) else ""
    if not good:
        return f"| {method}{failed} | | | | | | |"
    row = _row(good, determined)
    mean = _row([b for b in baselines(good[0]["task"]) if b["method"] == "prior mean"], determined)
    seconds = [c["cpu_seconds"] for c in good if "cpu_seconds" in c]
    return (
        f"| {method}{failed} | {row['accuracy']:.3f} / {row['least']:.3f} | {row['error']:.2g} | {row['crps']:.2g} | "
        f"{1 - row['crps'] / mean['crps']:.2f} | {1 - row['crps'] / reference['crps']:.2f} | "
        f"{f'{np.mean(seconds):.0f}' if seconds else ''} |"
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", nargs="?", choices=("run", "table"), help="default both")
    parser.add_argument("--select", default="", help="part of task/method/seed")
    given = parser.parse_args()
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    if given.command != "table":
        run(given.select)
    if given.command != "run":
        table()
