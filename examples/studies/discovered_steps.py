"""Does `sipe discover` take what physics steps do for a delay, a lag or a filter?

The five machines of ``physics_steps.py``: three logs each, of simulations in steps of 0.2 ms or in the model's own, and
a model in steps of 2 ms that lacks nothing.

    python examples/studies/discovered_steps.py      # 25 minutes of a core

``kept`` is what the best structure has beyond the model, by logs; coverage is that of 90 % intervals, pooled over
parameters and logs, of the plain model and averaged over the structures. Results: results/discovered_steps.json
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from importlib.metadata import version
from pathlib import Path

import numpy as np
from physics_steps import ALL, FINE, commands, simulator_of

import sipe_bayes as sipe
from sipe_bayes.benchmark.measurement import source
from sipe_bayes.core.arrays import BoolArray
from sipe_bayes.core.files import write_text
from sipe_bayes.structure import discover

RESULTS = Path(__file__).parent / "results" / "discovered_steps.json"
OWN, LOGS, SEEDS = 0.002, 3, (500, 501)


def searched(name: str, of_machine: float, seed: int) -> tuple[tuple[str, ...], BoolArray, BoolArray]:
    """Labels of what is kept for logs in steps ``of_machine`` seconds long, and which intervals (N,) hold."""
    rng, simulator, machine = np.random.default_rng([seed, 11]), simulator_of(name, OWN), simulator_of(name, of_machine)
    theta, logs = rng.uniform(0.15, 0.85, len(simulator.space)), []
    sd = [
        next(sd for target, sd in ALL[name].channels.items() if channel.startswith(target))
        for channel in simulator.environment.channels
    ]
    for _ in range(LOGS):
        actions, dt = commands(name, rng)
        many = round(dt / of_machine)
        motion = machine.rollout(theta, np.repeat(actions, many, axis=0), machine.default_state(), dt=of_machine)
        clean = motion[0].observations[::many]
        logs.append(sipe.Trajectory(clean + rng.standard_normal(clean.shape) * sd, actions, dt))
    structures = discover(simulator, sipe.Trajectories.stack(logs), seed=seed)
    ends = [
        np.asarray(one.quantile([0.05, 0.95]).numpy())
        for one in (structures.posterior_of(structures.plain), structures.posterior)
    ]
    plain, averaged = ((low <= theta) & (theta <= high) for low, high in ends)
    return structures.best.labels, plain, averaged


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--machines", nargs="+", default=list(ALL), choices=list(ALL))
    given, cells = parser.parse_args(), {}
    for name in given.machines:
        for of_machine in (FINE, OWN):
            runs = [searched(name, of_machine, seed) for seed in SEEDS]
            label = f"{name}, logs in steps of {1e3 * of_machine:g} ms"
            cells[label] = {
                "searches": len(runs),
                "kept": dict(Counter(" and ".join(labels) or "nothing" for labels, *_ in runs)),
                "plain": round(float(np.mean([plain for _, plain, _ in runs])), 3),
                "averaged": round(float(np.mean([averaged for *_, averaged in runs])), 3),
            }
            print(label, json.dumps(cells[label]), flush=True)
    machines = "" if given.machines == list(ALL) else f" --machines {' '.join(given.machines)}"
    table = {
        "command": f"python examples/studies/discovered_steps.py{machines}",
        "source": source(),
        "versions": {p: version(p) for p in ("mujoco", "numpy", "scipy")},
        "cells": cells,
    }
    write_text(RESULTS, json.dumps(table, indent=2) + "\n")


if __name__ == "__main__":
    main()
