"""Do the 90 % intervals of `npe` and `bayessim` hold the truth?

Logs have 1 % observation noise; each method is trained once for each task.

    python examples/studies/amortised_coverage.py [--task HalfCheetahLinks] [--budget 2000] [--truths 400]
                                                  [--methods npe bayessim]

One log of 100 control steps (FetchPush: 50) gives actions and starting state: of smooth random actions on the
half-cheetah, of the expert on the hand and FetchPush. Each method is trained once, on ``budget`` simulations of the
prior with noise of 1 % of each channel's spread, on the hand and FetchPush of a tenth of the largest channel's at
least, and then conditions on ``truths`` new simulations of truths drawn from the prior, noise included. Coverage is
pooled over the parameters and the truths, its standard error clustered by truth. contraction = 1 - sd / prior sd, mean.
A parameter counts as determined by a log that leaves less than half of the prior's sd.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch

import sipe_bayes as sipe
from sipe_bayes.core.files import write_text
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.datasets import acting
from sipe_bayes.datasets.demonstrations import behaviour_of
from sipe_bayes.diagnostics.coverage import check_calibration
from sipe_bayes.posterior import Particles, prior

HERE = Path(__file__).parent
STEPS, NOISE, LEVEL, DRAWS = {"FetchPush": 50}, 0.01, 0.9, 2000
TASKS = ("HalfCheetahLinks", "Door", "Relocate", "FetchPush")
LEAST_SPREAD = 0.1  # of the largest


def logs(simulator: sipe.Simulator, count: int) -> tuple[Trajectories, Trajectories, np.ndarray, tuple[float, ...]]:
    """A recorded log and ``count`` others, the truths of those (count, N), and the noise's sd of each channel."""
    task = simulator.environment
    excited = task.name == TASKS[0]
    behaviour = acting.excitation(task, simulator.dt) if excited else behaviour_of(task, "expert")
    if behaviour is None:
        raise SystemExit(f"{task.name}: its expert is not installed")
    steps = STEPS.get(task.name, 100)
    recorded, _ = acting.simulate(
        simulator, task.theta("default"), behaviour, acting.Recording("reference", 1, 0, steps)
    )
    spread = recorded.observations[0].std(0)
    if not excited:
        spread = np.maximum(spread, LEAST_SPREAD * spread.max())
    sd = NOISE * spread
    rng = np.random.default_rng(2026)
    truths = prior(simulator.space).sample((count,), generator=torch.Generator().manual_seed(2026)).numpy()
    motion = simulator.replay(truths, recorded)
    noisy = motion.observations + sd * rng.standard_normal(motion.observations.shape)
    held = replace(motion, observations=noisy, states=None, rewards=None, names=recorded.names * count)
    first = replace(
        recorded, observations=recorded.observations + sd * rng.standard_normal(recorded.observations.shape)
    )
    return first, held, truths, tuple(float(s) for s in sd)


def run(task: str, name: str, budget: int, count: int) -> dict[str, Any]:
    simulator = sipe.Simulator(sipe.make_task(task))
    recorded, held, truths, sd = logs(simulator, count)
    likelihood = sipe.Segments(noise_sd=sd)
    estimator = sipe.get_estimator(simulator, name, budget=budget, seed=0, likelihood=likelihood)
    begin = time.perf_counter()
    estimator.fit(recorded)
    trained = time.perf_counter() - begin
    covered, contraction, posteriors = [], [], []
    prior_sd = prior(simulator.space).stddev.numpy()
    for k in range(count):
        posterior = estimator.get_parameter_estimate(held[k : k + 1])
        draws = posterior.sample((DRAWS,), generator=torch.Generator().manual_seed(k))
        low, high = np.quantile(draws.numpy(), [(1 - LEVEL) / 2, (1 + LEVEL) / 2], axis=0)
        covered.append((low <= truths[k]) & (truths[k] <= high))
        contraction.append(1 - draws.numpy().std(0) / prior_sd)
        posteriors.append(Particles(draws, simulator.space))
    hits, known = np.array(covered), np.array(contraction) > 0.5
    rest = ((hits - hits[known].mean()) * known).sum(1) if known.any() else np.zeros(count)
    check = check_calibration(posteriors, truths)
    return {
        "method": name,
        "coverage": round(float(hits.mean()), 4),
        "standard_error": round(float(hits.mean(1).std(ddof=1) / np.sqrt(count)), 4),
        "coverage_per_parameter": [round(float(x), 3) for x in hits.mean(0)],
        "contraction": round(float(np.mean(contraction)), 3),
        "contraction_per_parameter": [round(float(x), 3) for x in np.mean(contraction, axis=0)],
        "determined": round(float(known.mean()), 4),
        "coverage_determined": round(float(hits[known].mean()), 4) if known.any() else None,
        "standard_error_determined": round(float(np.sqrt((rest**2).sum()) / max(known.sum(), 1)), 4),
        "verdicts": check.sentences(),
        "training_seconds": round(trained, 1),
        "seconds": round(time.perf_counter() - begin, 1),
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default=TASKS[0], choices=TASKS)
    parser.add_argument("--budget", type=int, default=2000)
    parser.add_argument("--truths", type=int, default=400)
    parser.add_argument("--methods", nargs="+", default=["bayessim", "npe"])
    parser.add_argument("--out", type=Path, help="default: results/amortised_coverage_TASK.json")
    given = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    for method in given.methods:
        rows.append(run(given.task, method, given.budget, given.truths))
        print(json.dumps(rows[-1]), flush=True)
    settings = f"--task {given.task} --budget {given.budget} --truths {given.truths}"
    command = f"python examples/studies/amortised_coverage.py {settings}"
    versions = {p: version(p) for p in ("mujoco", "torch", "sbi", "numpy")}
    found = {"command": command, "task": given.task, "level": LEVEL, "noise": NOISE, "versions": versions, "rows": rows}
    out = given.out or HERE / "results" / f"amortised_coverage_{given.task}.json"
    write_text(out, json.dumps(found, indent=1) + "\n")
