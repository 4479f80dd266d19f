"""Do 90 % intervals hold the truth 90 % of the time? Simulated logs of the simple pendulum, truths from the prior.

    python examples/studies/pendulum_coverage.py                              # both estimators and noises, two hours
    python examples/studies/pendulum_coverage.py --estimator laplace --rho 0.99 --truths 128

Every log repeats the recorded torque of `ddp` (6 s, 500 Hz) in a pendulum whose five parameters come from the prior;
the angle is measured with noise of stationary sd 0.01 rad, white (rho 0) or first-order autoregressive. Fits are kept
one by one in runs/, so an interrupted study goes on; the summary goes to results/. Coverage is pooled over parameters
and its standard error is clustered by fit.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import sipe_bayes as sipe
from sipe_bayes.calibration.problem import Problem
from sipe_bayes.core.files import write_text

HERE = Path(__file__).parent
CONFIG = HERE.parent / "simple_pendulum" / "calibrate.toml"
NOISE_SD = 0.01  # rad
WINDOW = 0.5  # s
BUDGET = {"laplace": 5000, "mcmc": 2000}  # rollouts; 2000 are 60 steps of 24 walkers or more after the first fit
TRUTHS = {"laplace": 128, "mcmc": 100}


def simulated_log(problem: Problem, theta: np.ndarray, rho: float, rng: np.random.Generator) -> sipe.Trajectory:
    """The recorded commands, replayed from rest at theta, measured with noise."""
    log = problem.train[0]
    simulator = problem.simulator
    motion = simulator.rollout(theta, log.actions, simulator.default_state(), dt=log.dt, logs=[log.name])
    z = rng.standard_normal(motion.observations.shape[1])
    noise = np.empty_like(z)
    noise[0] = z[0]
    for i in range(1, len(z)):
        noise[i] = rho * noise[i - 1] + np.sqrt(1 - rho**2) * z[i]
    observations = motion.observations[0] + NOISE_SD * noise[:, None]
    return sipe.Trajectory(observations, log.actions, log.dt, name=log.name, channels=log.channels)


def one_fit(problem: Problem, estimator: str, rho: float, seed: int) -> dict[str, Any]:
    """Draw a truth, make its log, fit, and record where the truth lies in the posterior."""
    rng = np.random.default_rng([seed, int(1000 * rho)])
    space = problem.environment.space
    theta = rng.uniform(0, 1, len(space))
    log = simulated_log(problem, theta, rho, rng)
    likelihood = replace(problem.likelihood, window=WINDOW)
    method = sipe.get_estimator(
        problem.simulator, estimator, likelihood=likelihood, seed=seed, budget=BUDGET[estimator]
    )
    begin = time.process_time()
    posterior = method.fit(log)
    low, high = posterior.quantile([0.05, 0.95]).numpy()
    return {
        "seed": seed,
        "truth": theta.tolist(),
        "covered": ((low <= theta) & (theta <= high)).tolist(),
        "contraction": (1 - posterior.stddev.numpy() * np.sqrt(12)).tolist(),
        "sds_off": ((posterior.mean.numpy() - theta) / posterior.stddev.numpy()).round(3).tolist(),
        "sd": posterior.stddev.tolist(),
        "findings": [str(item.code) for item in method.findings],
        "blocked": bool(method.findings.blocking),
        "cpu_s": round(time.process_time() - begin, 2),
        "rollouts": method.rollouts,
        "diagnostics": {k: v for k, v in method.diagnostics.items() if k != "mixing"},
        "mixing": method.diagnostics.get("mixing"),
    }


def _setting(estimator: str) -> dict[str, Any]:
    """What every fit of one table must share: budget, window and the code that made it."""
    code = hashlib.sha256()
    for file in sorted(Path(sipe.__file__).parent.glob("**/*.py")):
        if file.parent.name in ("sipe_bayes", "inference", "posterior"):
            code.update(file.read_bytes())
    return {"budget": BUDGET[estimator], "window_s": WINDOW, "code": code.hexdigest()[:12]}


def _mixing(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Quantiles over the fits of what the chains say of themselves."""
    return {
        key: dict(
            zip(
                ("q10", "q50", "q90"),
                np.quantile([r["mixing"][key] for r in rows], (0.1, 0.5, 0.9)).round(3).tolist(),
                strict=True,
            )
        )
        for key in ("steps", "rhat", "ess", "linearisation_error")
    }


def summary(rows: list[dict[str, Any]], names: tuple[str, ...]) -> dict[str, Any]:
    """Pooled coverage with its standard error clustered by fit."""
    covered = np.array([r["covered"] for r in rows], float)
    contraction = np.array([r["contraction"] for r in rows])
    return {
        "truths": len(rows),
        "coverage_90": round(float(covered.mean()), 4),
        "standard_error": round(float(covered.mean(1).std(ddof=1) / np.sqrt(len(rows))), 4),
        "coverage_by_parameter": dict(zip(names, covered.mean(0).round(3).tolist(), strict=True)),
        "mean_contraction": round(float(contraction.mean()), 4),
        "contraction_by_parameter": dict(zip(names, contraction.mean(0).round(3).tolist(), strict=True)),
        **({"mixing": _mixing(rows)} if rows[0]["mixing"] else {}),
        "mean_rollouts": round(float(np.mean([r["rollouts"] for r in rows])), 1),
    }


def study(problem: Problem, estimator: str, rho: float, truths: int) -> None:
    """One cell: fit what is missing, write the summary."""
    name = f"pendulum_coverage_{estimator}_rho{rho:g}"
    kept = Path("runs") / f"{name}.jsonl"
    kept.parent.mkdir(exist_ok=True)
    setting = _setting(estimator)
    rows = [json.loads(line) for line in kept.read_text().splitlines()] if kept.exists() else []
    if any(row["setting"] != setting for row in rows):
        raise SystemExit(f"{kept}: holds fits of other code or settings than {setting}; delete it to start again")
    for seed in range(len(rows), truths):
        rows.append({**one_fit(problem, estimator, rho, seed), "setting": setting})
        with kept.open("a") as file:
            file.write(json.dumps(rows[-1]) + "\n")
        found = summary(rows, problem.environment.space.names)
        print(f"{len(rows)} fits: coverage {found['coverage_90']} ± {found['standard_error']}", flush=True)
    command = (
        f"python {Path(__file__).relative_to(HERE.parents[1])} --estimator {estimator} --rho {rho:g} --truths {truths}"
    )
    head = {"command": command, "noise_sd_rad": NOISE_SD, **setting}
    found = {**head, **summary(rows[:truths], problem.environment.space.names)}
    write_text(HERE / "results" / f"{name}.json", json.dumps(found, indent=2) + "\n")
    print(json.dumps(found, indent=2))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--estimator", nargs="*", default=list(TRUTHS), help="default: both")
    parser.add_argument("--rho", type=float, nargs="*", default=[0.0, 0.99], help="default: both")
    parser.add_argument("--truths", type=int, help=f"default: {TRUTHS}")
    parser.add_argument("--threads", type=int, default=1)
    given = parser.parse_args()
    problem = sipe.prepare(CONFIG, num_threads=given.threads)
    for estimator in given.estimator:
        for rho in given.rho:
            study(problem, estimator, rho, given.truths or TRUTHS[estimator])


if __name__ == "__main__":
    main()
