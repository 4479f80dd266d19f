"""Do the 90 % intervals of `npe` and `bayessim` hold the truth? HalfCheetahLinks with 1 % observation noise, trained once.

    python examples/studies/amortised_coverage.py [--budget 2000] [--truths 400] [--methods npe bayessim]

One log of 100 control steps under smooth random actions gives actions and starting state. Each method is trained once, on
``budget`` simulations of the prior with noise of 1 % of each channel's spread, and then conditions on ``truths`` new simulations of
truths drawn from the prior, noise included. Coverage is pooled over the 5 parameters and the truths; its standard error is
clustered by truth. contraction = 1 - sd / prior sd, mean.
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
from sipe_bayes import acting
from sipe_bayes.atomic import write_text
from sipe_bayes.diagnostics.calibration import check_calibration
from sipe_bayes.posterior import Particles, prior
from sipe_bayes.trajectory import Trajectories

HERE = Path(__file__).parent
TASK, STEPS, NOISE, LEVEL, DRAWS = "HalfCheetahLinks", 100, 0.01, 0.9, 2000


def logs(simulator: sipe.Simulator, count: int) -> tuple[Trajectories, Trajectories, np.ndarray, tuple[float, ...]]:
    """A recorded log and ``count`` held-out ones, the truths of those (count, N), and the noise's sd of each channel."""
    task = simulator.environment
    excitation = acting.excitation(task, simulator.dt)
    recorded, _ = acting.simulate(simulator, task.theta("default"), excitation, "reference", 1, 0, STEPS)
    spread = recorded.observations[0].std(0)
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


def run(name: str, budget: int, count: int) -> dict[str, Any]:
    simulator = sipe.Simulator(sipe.make_task(TASK))
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
    hits = np.array(covered)
    check = check_calibration(posteriors, truths)
    return {
        "method": name,
        "coverage": round(float(hits.mean()), 4),
        "standard_error": round(float(hits.mean(1).std(ddof=1) / np.sqrt(count)), 4),
        "coverage_per_parameter": [round(float(x), 3) for x in hits.mean(0)],
        "contraction": round(float(np.mean(contraction)), 3),
        "contraction_per_parameter": [round(float(x), 3) for x in np.mean(contraction, axis=0)],
        "verdicts": check.sentences(),
        "training_seconds": round(trained, 1),
        "seconds": round(time.perf_counter() - begin, 1),
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--budget", type=int, default=2000)
    parser.add_argument("--truths", type=int, default=400)
    parser.add_argument("--methods", nargs="+", default=["bayessim", "npe"])
    parser.add_argument("--out", type=Path, default=HERE / "results" / "amortised_coverage.json")
    given = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    for method in given.methods:
        rows.append(run(method, given.budget, given.truths))
        print(json.dumps(rows[-1]), flush=True)
    command = f"python examples/studies/amortised_coverage.py --budget {given.budget} --truths {given.truths}"
    versions = {p: version(p) for p in ("mujoco", "torch", "sbi", "numpy")}
    found = {"command": command, "task": TASK, "level": LEVEL, "noise": NOISE, "versions": versions, "rows": rows}
    write_text(given.out, json.dumps(found, indent=1) + "\n")
