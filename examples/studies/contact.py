"""Coverage and silent misses of `laplace` on StateSpace through contact, and what draws from its normal say of it.

The environments of the registry, and three models of `models/` that are in none: a planar quadruped, a biped and a box
that is pushed. Truths uniform in [0.1, 0.9]^N, 200 control steps of 8 ms (`--steps`), sums of sines as commands, white
noise of the given share of each channel's spread, states withheld and starts unknown; but where a controller has a
memory, which no measurement shows (Fetch), starts are known. A silent miss is a fit with a parameter more than five of
its sds off and no blocking finding; an alarm on a right fit is a blocking finding where all are within three.

    python examples/studies/contact.py --list                                      # the cells
    python examples/studies/contact.py --select 'Hopper/0.01' --seeds 0 16         # two minutes of a core each
    python examples/studies/contact.py --select 'pushed/*' 'biped/0.05'

Fits are kept in runs/contact and an interrupted study goes on; each run writes the summary of all there are into
results/contact.json, and leaves cells there of which it has none as they were, with the state of the code that made
them where it is known. Coverage is of determined parameters, whose sd is less than half of the prior's; its standard
error is clustered by log.
"""

from __future__ import annotations

import argparse
import json
import time
from fnmatch import fnmatch
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from _kept import ensure, fits

import sipe_bayes as sipe
from sipe_bayes.core.files import write_text
from sipe_bayes.core.findings import Severity
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.datasets import acting
from sipe_bayes.envs.registry import TASKS

HERE = Path(__file__).parent
RUNS = HERE / "runs" / "contact"
DT, LEVELS = 0.008, (0.01, 0.05)
LEGS = ("front_hip", "front_knee", "hind_hip", "hind_knee")
WALKS = ("left_hip", "left_knee", "right_hip", "right_knee")
JOINTS = {
    "quadruped": ("z", "pitch", *LEGS),
    "biped": ("z", "pitch", *WALKS),
    "pushed": ("pusher", "box_x", "box_z", "box_pitch"),
}
MOTORS = {"quadruped": LEGS, "biped": WALKS, "pushed": ("push",)}
UNKNOWN = {
    "quadruped": [
        ("trunk_mass", 4.0, 9.0, ("body:trunk.mass",)),
        ("knee_stiffness", 10.0, 25.0, ("joint:front_knee.stiffness", "joint:hind_knee.stiffness")),
        ("friction", 0.4, 1.4, ("geom:front_foot.friction", "geom:hind_foot.friction")),
        ("damping", 0.5, 2.0, tuple(f"joint:{j}.damping" for j in LEGS)),
    ],
    "biped": [
        ("torso_mass", 6.0, 15.0, ("body:torso.mass",)),
        ("damping", 1.0, 4.0, tuple(f"joint:{j}.damping" for j in WALKS)),
        ("hip_gear", 40.0, 80.0, ("actuator:left_hip.gear", "actuator:right_hip.gear")),
    ],
    "pushed": [
        ("box_mass", 0.4, 1.6, ("body:box.mass",)),
        ("box_friction", 0.2, 0.9, ("geom:box.friction",)),
        ("pusher_damping", 2.0, 10.0, ("joint:pusher.damping",)),
    ],
}


def simulator_of(name: str) -> sipe.Simulator:
    """Of the registry, or of an MJCF in models/."""
    if name not in UNKNOWN:
        return sipe.Simulator(sipe.make_task(name), num_threads=1)
    parameters = [Parameter(what, low, high, targets=targets) for what, low, high, targets in UNKNOWN[name]]
    measured = [f"joint:{j}.{what}" for what in ("position", "velocity") for j in JOINTS[name]]
    path = HERE / "models" / f"{name}.xml"
    return sipe.Simulator(sipe.MjcfEnvironment.build(path, parameters, MOTORS[name], measured), num_threads=1)


def clean(simulator: sipe.Simulator, name: str, theta: np.ndarray, seed: int, steps: int) -> sipe.Trajectory:
    """A log without noise."""
    if name not in UNKNOWN:
        behaviour = acting.excitation(simulator.environment, simulator.dt)
        return acting.simulate(simulator, theta, behaviour, acting.Recording("reference", 1, seed, steps))[0][0]
    rng, count = np.random.default_rng([seed, 3]), simulator.environment.num_actions
    frequency, phase = rng.uniform(0.3, 2.0, (3, count)), rng.uniform(0, 2 * np.pi, (3, count))
    times = DT * np.arange(steps)[:, None, None]
    actions = 0.8 * np.sin(2 * np.pi * frequency * times + phase).mean(1)
    return simulator.rollout(theta, actions, simulator.default_state(), dt=DT)[0]


def one_fit(name: str, level: float, seed: int, steps: int) -> dict[str, Any]:
    """Where the truth lies in the posterior, and what was said of it."""
    simulator = simulator_of(name)
    theta = np.random.default_rng([seed, 7]).uniform(0.1, 0.9, len(simulator.space))
    motion = clean(simulator, name, theta, seed, steps)
    noise = np.random.default_rng([seed, round(1e4 * level)]).standard_normal(motion.observations.shape)
    known = bool(simulator.environment.memory_size)
    noisy = motion.observations + level * motion.observations.std(axis=0) * noise
    log = sipe.Trajectory(noisy, motion.actions, motion.dt, states=motion.states if known else None)
    likelihood = sipe.StateSpace(starts="recorded") if known else sipe.StateSpace()
    estimator = sipe.get_estimator(simulator, "laplace", likelihood=likelihood, seed=seed)
    begin = time.process_time()
    posterior = estimator.fit(log)
    mean, sd = posterior.mean.numpy(), posterior.stddev.numpy()
    low, high = posterior.quantile([0.05, 0.95]).numpy()
    return {
        "model": name,
        "level": level,
        "steps": steps,
        "seed": seed,
        "error": np.abs(mean - theta).tolist(),
        "sd": sd.tolist(),
        "z": ((mean - theta) / sd).tolist(),
        "covered": ((low <= theta) & (theta <= high)).tolist(),
        "pareto_k": estimator.diagnostics["pareto_k"],
        "blocking": [str(f.code) for f in estimator.findings if f.severity is Severity.BLOCKING],
        "rollouts": estimator.rollouts,
        "processor_seconds": round(time.process_time() - begin, 1),
    }


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Of one cell."""
    covered, z = np.array([r["covered"] for r in rows], float), np.abs([r["z"] for r in rows]).max(1)
    known = np.array([r["sd"] for r in rows]) < 0.5 / np.sqrt(12)
    blocked = np.array([bool(r["blocking"]) for r in rows])
    held, count, logs = (covered * known).sum(1), known.sum(1), len(rows)
    share = float(held.sum() / max(1, count.sum()))
    spread = np.sqrt(logs / (logs - 1) * ((held - share * count) ** 2).sum()) / count.sum() if logs > 1 else None
    silent = ~blocked
    return {
        "source": rows[0]["source"],
        "logs": logs,
        "seeds": [r["seed"] for r in rows],
        "mean_error": round(float(np.mean([r["error"] for r in rows])), 5),
        "mean_sd": round(float(np.mean([r["sd"] for r in rows])), 5),
        "determined": round(float(known.mean()), 3),
        "coverage_90": round(share, 3),
        "standard_error": None if spread is None else round(float(spread), 3),
        "coverage_90_without_blocking": round(float(held[silent].sum() / count[silent].sum()), 3)
        if count[silent].any()
        else None,
        "fits_with_blocking": int(blocked.sum()),
        "blocking": sorted({code for r in rows for code in r["blocking"]}),
        "silent_misses": int(((z > 5) & silent).sum()),
        "misses": int((z > 5).sum()),
        "worst_silent_z": round(float(z[silent].max()), 1) if silent.any() else None,
        "alarms_on_right_fits": f"{int(((z < 3) & blocked).sum())} of {int((z < 3).sum())}",
        "processor_seconds_median": float(np.median([r["processor_seconds"] for r in rows])),
    }


def main() -> None:
    cells = [f"{name}/{level:g}" for level in LEVELS for name in [*TASKS, *UNKNOWN]]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--select", nargs="*", default=["*"], help="cells, with wildcards")
    parser.add_argument("--seeds", type=int, nargs=2, metavar=("FIRST", "END"), default=[0, 40])
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--list", action="store_true", help="print the cells that are selected")
    given = parser.parse_args()
    chosen = [cell for cell in cells if any(fnmatch(cell, pattern) for pattern in given.select)]
    if given.list or not chosen:
        print("\n".join(chosen or cells))
        return
    file = RUNS / "fits.jsonl"
    for seed in range(*given.seeds):
        for name, level in (cell.split("/") for cell in chosen):
            which = {"model": name, "level": float(level), "steps": given.steps, "seed": seed}
            ensure(file, which, partial(one_fit, name, float(level), seed, given.steps))
    by_cell: dict[str, list[dict[str, Any]]] = {}
    for row in fits(file):
        by_cell.setdefault(f"{row['model']}, {row['level']:.0%}, {row['steps']} steps", []).append(row)
    results = HERE / "results" / "contact.json"
    earlier = json.loads(results.read_text(encoding="utf-8"))["cells"] if results.is_file() else {}
    table = {
        "command": "python examples/studies/contact.py --select CELL --seeds FIRST END, for the logs of each cell",
        "versions": {p: version(p) for p in ("mujoco", "numpy", "scipy")},
        "cells": dict(sorted((earlier | {cell: summary(rows) for cell, rows in by_cell.items()}).items())),
    }
    write_text(results, json.dumps(table, indent=2) + "\n")


if __name__ == "__main__":
    main()
