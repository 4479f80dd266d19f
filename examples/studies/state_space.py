"""Accuracy, coverage and time of `laplace` on StateSpace.

Half-cheetah with 1 % and 5 % observation noise, the hand and FetchPush with 1 %.

    python examples/studies/state_space.py                                             # every cell, some hours
    python examples/studies/state_space.py --task HalfCheetahJoints --level 0.01 --seeds 0 10   # ten fits of one cell
    python examples/studies/state_space.py --slowest 5 --threads 2  # the half-cheetah's slowest fits anew

Truths are uniform in [0.1, 0.9]^N on the half-cheetah, whose logs determine all parameters far better than that, and
drawn from the prior on the others, where a truth that keeps from the bounds would be held too often. Every observed
channel gets white noise of the given share of its own spread along the log, and the states are withheld. Noise, process
noise, states and theta are all inferred. On the half-cheetah the excitation policy acts for 200 control steps and the
start is unknown; velocities are observed. On Door and Relocate the expert acts for 100, on FetchPush for 50; the start
is known, one starting point is followed, and no velocities are observed, nor what other channels say as well, nor the
flag that says whether the door is open; a channel's spread counts as at least a tenth of the largest. Fits are kept one
by one in runs/state_space, so an interrupted study goes on and several processes may share it; those of another state
of the code are made anew. Each run writes the summary of all fits there are to results/. Coverage of the 90 % intervals
is pooled over the parameters, its standard error clustered by fit; a parameter counts as determined in a fit that
leaves less than half of the prior's sd. Seconds are the processor's over all threads: the wall time of a quiet machine
with one.
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
from sipe_bayes.benchmark.measurement import source
from sipe_bayes.core.files import write_text
from sipe_bayes.datasets import acting
from sipe_bayes.datasets.demonstrations import behaviour_of

HERE = Path(__file__).parent
RUNS = HERE / "runs" / "state_space"
CHEETAHS, KNOWN = ("HalfCheetahJoints", "HalfCheetahLinks"), ("Door", "Relocate", "FetchPush")
UNSEEN = {"Door": ("door_open",), "FetchPush": ("velocity", "turning", "from_grip", "goal")}  # parts of channels' names
CELLS = [*((task, level) for task in CHEETAHS for level in (0.01, 0.05)), *((task, 0.01) for task in KNOWN)]
INSIDE, PRIOR = (0.1, 0.9), (0.0, 1.0)
_TRUTHS = 7  # of a generator of their own: that of the seed alone draws the start
STEPS = {**dict.fromkeys(CHEETAHS, 200), **dict.fromkeys(KNOWN, 100), "FetchPush": 50}
FITS = {**dict.fromkeys(CHEETAHS, 100), **dict.fromkeys(KNOWN, 40)}
LEAST_SPREAD = 0.1  # of the largest, where the start is known


def recorded(
    simulator: sipe.Simulator, task: str, level: float, seed: int, steps: int
) -> tuple[np.ndarray, sipe.Trajectory, sipe.StateSpace]:
    """A true theta, its noisy log, without states but for a known first one, and the likelihood."""
    noise = np.random.default_rng([seed, round(1e4 * level)])  # another one at each level: cells are independent
    theta = np.random.default_rng([seed, _TRUTHS]).uniform(*(PRIOR if task in KNOWN else INSIDE), len(simulator.space))
    known, channels = task in KNOWN, simulator.environment.channels
    behaviour = behaviour_of(simulator.environment, "expert") if known else None
    behaviour = behaviour or acting.excitation(simulator.environment, simulator.dt)
    motion, _ = acting.simulate(simulator, theta, behaviour, acting.Recording("reference", 1, seed, steps))
    clean = motion[0].observations
    used = np.array([not any(part in name for part in UNSEEN.get(task, ())) for name in channels])
    spread = clean.std(axis=0)
    if known:
        spread = np.maximum(spread, LEAST_SPREAD * spread[used].max())
    noisy = clean + level * spread * noise.standard_normal(clean.shape)
    log = sipe.Trajectory(noisy, motion[0].actions, motion[0].dt, states=motion[0].states if known else None)
    fit = tuple(name for name, kept in zip(channels, used, strict=True) if kept)
    return theta, log, sipe.StateSpace(fit, starts="recorded") if known else sipe.StateSpace()


def one_fit(simulator: sipe.Simulator, task: str, level: float, seed: int, steps: int) -> dict[str, Any]:
    """Where the truth lies in the posterior, and what the fit took."""
    theta, log, likelihood = recorded(simulator, task, level, seed, steps)
    restarts = 1 if task in KNOWN else 2
    estimator = sipe.get_estimator(simulator, "laplace", likelihood=likelihood, restarts=restarts, seed=seed)
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
        "process_over_measurement": round(_process_share(estimator.diagnostics, task in CHEETAHS), 4),
        "loose_jumps": len(estimator.diagnostics["outliers"]),
        "warnings": estimator.warnings,
        "source": source(),
    }


def _process_share(diagnostics: dict[str, Any], runs: bool) -> float:
    """Median process noise over the coordinates by median measurement noise.

    How far a cheetah has run is not observed and left out.
    """
    return float(np.median(diagnostics["process_noise"][runs:]) / np.median(diagnostics["noise_sd"]))


def summary(rows: list[dict[str, Any]], names: tuple[str, ...]) -> dict[str, Any]:
    """Of one cell; the standard error is clustered by fit."""
    covered, error = np.array([r["covered"] for r in rows], float), np.array([r["error"] for r in rows])
    sd = np.array([r["sd"] for r in rows])
    processor = [r["processor_seconds"] for r in rows]
    known = sd < 0.5 / np.sqrt(12)
    spread = covered.mean(1).std(ddof=1) / np.sqrt(len(rows)) if len(rows) > 1 else np.nan
    return {
        "fits": len(rows),
        "mean_error": round(float(error.mean()), 5),
        "worst_fit_error": round(float(error.mean(1).max()), 5),
        "coverage_90": round(float(covered.mean()), 4),
        "standard_error": round(float(spread), 4),
        "mean_sd": round(float(sd.mean()), 5),
        "mean_contraction": round(float(1 - sd.mean() * np.sqrt(12)), 4),
        "determined": round(float(known.mean()), 4),
        "coverage_90_determined": round(float(covered[known].mean()), 4) if known.any() else None,
        "standard_error_determined": round(_ratio_error((covered * known).sum(1), known.sum(1)), 4)
        if known.any()
        else None,
        "contraction_by_parameter": dict(zip(names, (1 - sd.mean(0) * np.sqrt(12)).round(3).tolist(), strict=True)),
        "coverage_by_parameter": dict(zip(names, covered.mean(0).round(3).tolist(), strict=True)),
        "median_rollouts": float(np.median([r["rollouts"] for r in rows])),
        "processor_seconds_median_and_most": [round(float(np.median(processor)), 1), max(processor)],
        "wall_seconds_median": round(float(np.median([r["wall_seconds"] for r in rows])), 1),
        "process_over_measurement_median": float(np.median([r["process_over_measurement"] for r in rows])),
        "fits_with_loose_jumps": sum(bool(r["loose_jumps"]) for r in rows),
        "fits_with_warnings": sum(bool(r["warnings"]) for r in rows),
    }


def _ratio_error(part: np.ndarray, whole: np.ndarray) -> float:
    """Standard error of sum(part) / sum(whole), clustered by fit."""
    rest, count = part - part.sum() / whole.sum() * whole, len(part)
    return float(np.sqrt(count / (count - 1) * (rest**2).sum()) / whole.sum()) if count > 1 else np.nan


def path(task: str, level: float, steps: int, seed: int) -> Path:
    return RUNS / f"{task}-{level:g}-{steps}-{seed}.json"


def _kept(task: str, level: float, steps: int) -> list[dict[str, Any]]:
    files = sorted(RUNS.glob(path(task, level, steps, 0).name.replace("-0.json", "-*.json")))
    return [json.loads(file.read_text(encoding="utf-8")) for file in files]


def table(steps: int | None) -> None:
    """Write the summary of all fits there are."""
    cells = {}
    for task, level in CELLS:
        names, length = sipe.make_task(task).space.names, steps or STEPS[task]
        rows = _kept(task, level, length)
        if len({row.get("source") for row in rows}) > 1:
            raise SystemExit(
                f"{RUNS}: holds fits of {task} by several states of the code; delete those of the older ones"
            )
        if rows:
            cells[f"{task}, {level:.0%}, {length} steps"] = summary(rows, names)
    found = {
        "command": "python examples/studies/state_space.py" + (f" --steps {steps}" if steps else ""),
        "versions": {p: version(p) for p in ("mujoco", "numpy", "scipy")},
        "cells": cells,
    }
    name = f"state_space_{steps}.json" if steps else "state_space.json"
    write_text(HERE / "results" / name, json.dumps(found, indent=2) + "\n")
    for cell, row in cells.items():
        print(cell, {k: v for k, v in row.items() if "by_parameter" not in k}, flush=True)


def slowest(count: int, threads: int) -> None:
    """Fit the half-cheetah logs anew that took longest, and write the seconds to results/."""
    took = {
        (task, level, row["seed"]): row["processor_seconds"]
        for task in CHEETAHS
        for level in (0.01, 0.05)
        for row in _kept(task, level, STEPS[task])
    }
    rows = []
    for task, level, seed in sorted(took, key=lambda fit: -took[fit])[:count]:
        simulator = sipe.Simulator(sipe.make_task(task), num_threads=threads)
        fit = one_fit(simulator, task, level, seed, STEPS[task])
        names = ("seed", "wall_seconds", "processor_seconds", "rollouts")
        rows.append({"task": task, "level": level, **{name: fit[name] for name in names}})
        print(json.dumps(rows[-1]), flush=True)
    command = f"python examples/studies/state_space.py --slowest {count} --threads {threads}"
    text = json.dumps({"command": command, "fits": rows}, indent=2)
    write_text(HERE / "results" / "state_space_slowest.json", text + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", nargs="*", default=[*CHEETAHS, *KNOWN], choices=[*CHEETAHS, *KNOWN])
    parser.add_argument("--level", type=float, nargs="*", default=[0.01, 0.05], choices=[0.01, 0.05])
    parser.add_argument("--seeds", type=int, nargs=2, metavar=("FIRST", "END"), help=f"default: all of {FITS}")
    parser.add_argument("--steps", type=int, help=f"default: {STEPS}")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--slowest", type=int, metavar="COUNT", help="time these anew instead")
    given = parser.parse_args()
    if given.slowest:
        slowest(given.slowest, given.threads)
        return
    for task, level in CELLS:
        if task not in given.task or level not in given.level:
            continue
        simulator, steps = sipe.Simulator(sipe.make_task(task), num_threads=given.threads), given.steps or STEPS[task]
        for seed in range(*(given.seeds or (0, FITS[task]))):
            file = path(task, level, steps, seed)
            if not file.exists() or json.loads(file.read_text(encoding="utf-8")).get("source") != source():
                write_text(file, json.dumps(one_fit(simulator, task, level, seed, steps)) + "\n")
    table(given.steps)


if __name__ == "__main__":
    main()
