"""Do the 90 % intervals of `npe` and `bayessim` hold the truth, as they are, regressed, calibrated, as ensembles?

Logs have 1 % observation noise; each method is trained once for each task.

    python examples/studies/amortised_coverage.py [--task HalfCheetahLinks] [--budget 2000] [--truths 400]
                                                  [--methods npe bayessim "npe regressed"] [--calibration 0 0.2]

One log of 100 control steps (FetchPush: 50) gives actions and starting state: of smooth random actions on the
pendulum and the half-cheetah, of the expert on the hand and FetchPush. Each method is trained once, on ``budget``
simulations of the prior with noise of 1 % of each channel's spread, on the hand and FetchPush of a tenth of the
largest channel's at least, and then conditions on ``truths`` new simulations of truths drawn from the prior, noise
included. Coverage is pooled over the parameters and the truths, its standard error clustered by truth. contraction =
1 - sd / prior sd, mean. A parameter counts as determined by a log that leaves less than half of the prior's sd. Skill
is 1 - CRPS / CRPS of the prior, the interval score that of 90 % intervals in theta, both means over parameters and
truths. Ranks are uniform where the smallest of N p-values is at least .05 / N. Rows that the file holds already are
kept.
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
EXCITED = ("Pendulum", "HalfCheetahLinks", "HalfCheetahJoints")
TASKS = (*EXCITED, "Door", "Relocate", "FetchPush")
LEAST_SPREAD = 0.1  # of the largest
METHODS: dict[str, tuple[str, dict[str, Any]]] = {
    "bayessim": ("bayessim", {}),
    "bayessim regressed": ("bayessim", {"summary": "regressed"}),
    "bayessim regressed, 5 members": ("bayessim", {"summary": "regressed", "members": 5}),
    "npe transitions": ("npe", {"embedding": "transitions"}),
    "npe": ("npe", {}),
    "npe robust": ("npe", {"embedding": "robust"}),
    "abc regressed": ("abc", {"summary": "regressed"}),
}
CACHE = HERE / "runs" / "simulations"


def logs(simulator: sipe.Simulator, count: int) -> tuple[Trajectories, Trajectories, np.ndarray, tuple[float, ...]]:
    """A recorded log and ``count`` others, the truths of those (count, N), and the noise's sd of each channel."""
    task = simulator.environment
    excited = task.name in EXCITED
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


def run(task: str, label: str, calibration: float, budget: int, count: int) -> dict[str, Any]:
    simulator = sipe.Simulator(sipe.make_task(task), num_threads=1)
    recorded, held, truths, sd = logs(simulator, count)
    likelihood, (name, settings) = sipe.Segments(noise_sd=sd), METHODS[label]
    given = {
        "budget": budget,
        "seed": 0,
        "likelihood": likelihood,
        "calibration": calibration,
        "cache": CACHE,
        **settings,
    }
    estimator = sipe.get_estimator(simulator, name, **given)
    begin = time.process_time()
    estimator.fit(recorded)
    trained = time.process_time() - begin
    covered, contraction, crps, width, posteriors = [], [], [], [], []
    prior_sd = prior(simulator.space).stddev.numpy()
    for k in range(count):
        posterior = estimator.posterior(estimator.state, held[k : k + 1])
        theta = posterior.sample((DRAWS,), generator=torch.Generator().manual_seed(k)).numpy()
        low, high = np.quantile(theta, [(1 - LEVEL) / 2, (1 + LEVEL) / 2], axis=0)
        covered.append((low <= truths[k]) & (truths[k] <= high))
        outside = np.maximum(low - truths[k], 0) + np.maximum(truths[k] - high, 0)
        width.append(high - low + 2 / (1 - LEVEL) * outside)
        contraction.append(1 - theta.std(0) / prior_sd)
        apart = np.abs(theta[: DRAWS // 2] - theta[DRAWS // 2 :]).mean(0)
        crps.append(np.abs(theta - truths[k]).mean(0) - apart / 2)
        posteriors.append(Particles(theta, simulator.space))
    hits, known = np.array(covered), np.array(contraction) > 0.5
    rest = ((hits - hits[known].mean()) * known).sum(1) if known.any() else np.zeros(count)
    check = check_calibration(posteriors, truths)
    of_prior = (truths**2 + (1 - truths) ** 2).mean(0) / 2 - 1 / 6  # CRPS of a uniform prior
    skill = 1 - np.mean(crps, axis=0) / of_prior
    return {
        "method": label,
        "calibration": calibration,
        "coverage": round(float(hits.mean()), 4),
        "standard_error": round(float(hits.mean(1).std(ddof=1) / np.sqrt(count)), 4),
        "coverage_per_parameter": [round(float(x), 3) for x in hits.mean(0)],
        "contraction": round(float(np.mean(contraction)), 3),
        "contraction_per_parameter": [round(float(x), 3) for x in np.mean(contraction, axis=0)],
        "skill": round(float(skill.mean()), 3),
        "skill_per_parameter": [round(float(x), 3) for x in skill],
        "interval_score": round(float(np.mean(width)), 4),
        "determined": round(float(known.mean()), 4),
        "coverage_determined": round(float(hits[known].mean()), 4) if known.any() else None,
        "standard_error_determined": round(float(np.sqrt((rest**2).sum()) / max(known.sum(), 1)), 4),
        "smallest_p_of_ranks": min(check.p_values),
        "uniform": min(check.p_values) >= 0.05 / len(simulator.space),
        "tarp_p": check.tarp.p,
        "verdicts": check.sentences(),
        "training_cpu_seconds": round(trained, 1),
        "cpu_seconds": round(time.process_time() - begin, 1),
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="HalfCheetahLinks", choices=TASKS)
    parser.add_argument("--budget", type=int, default=2000)
    parser.add_argument("--truths", type=int, default=400)
    parser.add_argument("--methods", nargs="+", default=list(METHODS), choices=list(METHODS))
    parser.add_argument("--calibration", nargs="+", type=float, default=[0.2, 0.0])
    parser.add_argument("--out", type=Path, help="default: results/amortised_coverage_TASK.json")
    given = parser.parse_args()
    torch.set_num_threads(1)
    out = given.out or HERE / "results" / f"amortised_coverage_{given.task}.json"
    settings = f"--task {given.task} --budget {given.budget} --truths {given.truths}"
    command = f"python examples/studies/amortised_coverage.py {settings}"
    versions = {p: version(p) for p in ("mujoco", "torch", "sbi", "numpy")}
    summary = {"command": command, "task": given.task, "level": LEVEL, "noise": NOISE, "versions": versions, "rows": []}
    if out.is_file():
        summary = json.loads(out.read_text(encoding="utf-8"))
        if summary["command"] != command:
            raise SystemExit(f"{out}: holds rows of {summary['command']}; choose another --out")
    for calibration in given.calibration:
        for method in given.methods:
            if any((row["method"], row.get("calibration")) == (method, calibration) for row in summary["rows"]):
                continue
            summary["rows"].append(run(given.task, method, calibration, given.budget, given.truths))
            print(json.dumps(summary["rows"][-1]), flush=True)
            write_text(out, json.dumps(summary, indent=1) + "\n")
