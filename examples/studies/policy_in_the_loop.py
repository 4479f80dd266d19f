"""Policy in the loop on HalfCheetahLinks.

Simopt, adr and maml estimate while an agent is trained where they believe, three seeds.

    python examples/studies/policy_in_the_loop.py run    # every cell not there yet; goes on after an interruption
    python examples/studies/policy_in_the_loop.py run --steps 300000 --select simopt/0
    python examples/studies/policy_in_the_loop.py table # results/policy_in_the_loop.json and .md of the cells there are

A cell is method/seed. The reference is the in-distribution variant; each of ten updates takes one trajectory of 100
control steps from it, and the estimator has 1,000 rollouts in all. The agent is that of the transfer study
(``sipe_bayes.benchmark.transfer.study.settings``). The paper's rule: a seed counts only if its policy solves the
environment, here simulators drawn from the last estimate (see ``sipe_bayes.rl.policy_in_the_loop``); the seeds that do
are counted, and all are shown beside them.
"""

from __future__ import annotations

import argparse
import fcntl
import json
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch

import sipe_bayes as sipe
from sipe_bayes.benchmark.transfer.study import settings as agent
from sipe_bayes.core.files import to_json, write_text
from sipe_bayes.diagnostics.scores import score
from sipe_bayes.posterior import Dirac, Posterior, prior
from sipe_bayes.rl.policy_in_the_loop import train_in_the_loop

HERE = Path(__file__).parent
RUNS = HERE / "runs" / "policy_in_the_loop"
TASK, VARIANT = "HalfCheetahLinks", "in_distribution"
METHODS: dict[str, tuple[str, dict[str, Any]]] = {
    "simopt": ("simopt", {}),
    "adr": ("adr", {}),
    "maml": ("maml", {}),
    "simopt, learned reward": ("simopt", {"reward": "learned"}),
    "adr, learned reward": ("adr", {"reward": "learned"}),
}
SEEDS, UPDATES, TRAJECTORY_STEPS = 3, 10, 100


def folder(steps: int, budget: int, method: str, seed: int) -> Path:
    return RUNS / f"{steps}-{budget}" / f"{method.replace(', ', '-').replace(' ', '_')}-{seed}"


def run_cell(steps: int, budget: int, method: str, seed: int) -> None:
    """Run or go on with a cell and write its ``cell.json``."""
    simulator = sipe.Simulator(sipe.make_task(TASK), num_threads=1)
    name, settings = METHODS[method]
    estimator = sipe.get_estimator(simulator, name, budget=budget, seed=seed, **settings)
    out, begin, cpu = folder(steps, budget, method, seed), time.perf_counter(), time.process_time()
    resumed = (out / "checkpoint" / "state.safetensors").exists()

    def report(line: str, step: int, total: int) -> None:
        if step % 5_000 < 100:
            print(f"{method}/{seed}: {line}, {step} of {total}, {time.perf_counter() - begin:.0f} s", flush=True)

    found = train_in_the_loop(
        estimator,
        VARIANT,
        steps,
        updates=UPDATES,
        trajectory_steps=TRAJECTORY_STEPS,
        settings=agent(sipe.make_task(TASK), steps),
        folder=out,
        resume=True,
        report=report,
    )
    record = {
        "method": method,
        "seed": seed,
        "steps": steps,
        "budget": budget,
        "cpu_seconds": None if resumed else round(time.process_time() - cpu, 1),
        "converged": found.converged,
        "solved_reference": found.solved_reference,
        "scores": scored(found.posterior),
        "warnings": found.warnings,
        "history": [asdict(row) for row in found.history],
    }
    write_text(out / "cell.json", to_json(record))


def scored(posterior: Posterior) -> dict[str, Any]:
    return score(posterior, sipe.make_task(TASK).theta(VARIANT)).to_dict()


@contextmanager
def claimed(out: Path) -> Iterator[bool]:
    """Whether the cell is this process's own: several may share the work, and one that ends sets its cell free."""
    out.mkdir(parents=True, exist_ok=True)
    with (out / ".lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            yield False
            return
        yield True


def run(steps: int, budget: int, select: str) -> None:
    torch.set_num_threads(1)
    for seed in range(SEEDS):
        for method in METHODS:
            out = folder(steps, budget, method, seed)
            if select not in f"{method}/{seed}":
                continue
            with claimed(out) as mine:
                if mine and not (out / "cell.json").exists():
                    run_cell(steps, budget, method, seed)


def table(steps: int, budget: int) -> None:
    records = [
        json.loads(f.read_text(encoding="utf-8"))
        for f in sorted(folder(steps, budget, "", 0).parent.glob("*/cell.json"))
    ]
    lines = [
        f"{TASK}, {VARIANT}: {steps} control steps, {budget} rollouts of the estimator, {UPDATES} updates.\n",
        "| method | converged | accuracy mean / min, converged | accuracy mean / min, all | CRPS, all | solves the "
        "reference "
        "| return in simulation / reference | reference trajectories | CPU s |",
        "|---" * 9 + "|",
    ]
    space = sipe.make_task(TASK).space
    for name, baseline in (("prior", prior(space)), ("prior mean", Dirac(np.full(len(space), 0.5), space))):
        scores = scored(baseline)
        lines.append(f"| {name} | | | {accuracy([{'scores': scores}])} | {scores['mean_crps']:.3f} | | | | |")
    lines += [line(method, cells) for method in METHODS if (cells := [r for r in records if r["method"] == method])]
    summary = {
        "command": f"python examples/studies/policy_in_the_loop.py run --steps {steps} --budget {budget}, then table",
        "versions": {p: version(p) for p in ("mujoco", "numpy", "torch")},
        "cells": records,
    }
    write_text(HERE / "results" / "policy_in_the_loop.json", to_json(summary, indent=0) + "\n")
    write_text(HERE / "results" / "policy_in_the_loop.md", "\n".join(lines) + "\n")
    print("\n".join(lines))


def line(method: str, cells: list[dict[str, Any]]) -> str:
    converged = [c for c in cells if c["converged"]]
    last = [c["history"][-1] for c in cells]
    inside, outside, taken = (
        np.mean([row[key] for row in last]) for key in ("simulation_return", "reference_return", "reference_rollouts")
    )
    seconds = [c["cpu_seconds"] for c in cells if c["cpu_seconds"] is not None]
    return (
        f"| {method} | {len(converged)} of {len(cells)} | {accuracy(converged)} | {accuracy(cells)} | "
        f"{np.mean([c['scores']['mean_crps'] for c in cells]):.3f} | {sum(c['solved_reference'] for c in cells)} of "
        f"{len(cells)} | "
        f"{inside:.0f} / {outside:.0f} | {taken:.0f} | {f'{np.mean(seconds):.0f}' if seconds else ''} |"
    )


def accuracy(cells: list[dict[str, Any]]) -> str:
    if not cells:
        return ""
    return " / ".join(f"{np.mean([c['scores'][key] for c in cells]):.3f}" for key in ("mean_accuracy", "min_accuracy"))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", nargs="?", choices=("run", "table"), help="default both")
    parser.add_argument("--steps", type=int, default=150_000, help="control steps of a cell's training")
    parser.add_argument("--budget", type=int, default=1000, help="rollouts of a cell's estimator")
    parser.add_argument("--select", default="", help="part of method/seed")
    given = parser.parse_args()
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    if given.command != "table":
        run(given.steps, given.budget, given.select)
    if given.command != "run":
        table(given.steps, given.budget)
