"""Coverage of `laplace` on StateSpace where every step has process noise, and what the noise's own uncertainty adds.

The models of `particles.py`, whose logs of 40 control steps have process noise and measurement noise, both inferred.
The fit holds the noise at its estimate. "widened" is the moments of the normals of draws of the noise, whose logarithms
are taken for normal about the estimate with the curvature of the restricted likelihood and its prior; one linearisation
serves all of them, so that it costs no simulation. Truths are uniform in [0.2, 0.8]^N.

    python examples/studies/process_noise.py --seeds 100 112                   # a second of a core for each log

Rows are kept in runs/process_noise and an interrupted study goes on; each run writes the summary of all there are.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from _kept import fits, keep
from particles import MODELS, logged
from scipy.stats import norm

import sipe_bayes as sipe
from sipe_bayes.core.files import write_text
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.inference.laplace.state_space.smoother import border
from sipe_bayes.inference.laplace.state_space.state import ChainOptimum
from sipe_bayes.inference.laplace.state_space.target import ChainFit
from sipe_bayes.likelihood.state_space.linearisation import eliminate_states, restricted

HERE = Path(__file__).parent
FILE = HERE / "runs" / "process_noise" / "rows.jsonl"
LENGTH, DRAWS, LEAST, FURTHEST = 0.2, 40, 0.5, 2.5  # of differences; draws; least curvature; furthest logarithm


def one_row(name: str, seed: int) -> dict[str, Any]:
    """z-scores of one log's truth, and by how much the noise's uncertainty widens each sd."""
    simulator, truth, log = logged(name, seed)
    estimator = sipe.get_estimator(simulator, "laplace", likelihood=sipe.StateSpace(), seed=seed)
    posterior = estimator.fit(log)
    assert estimator.state is not None
    optimum = max(estimator.state.search.optima, key=lambda one: one.evidence)
    assert isinstance(optimum, ChainOptimum)
    chain = estimator.bound(Trajectories.stack([log]))
    chain.budget = np.inf
    linear, noise, problem = ChainFit.at(chain, optimum).linearisation, optimum.noise, estimator.problem
    channels, count = len(noise.sd), len(noise.sd) + len(noise.process)
    hold = border(problem.quadratic_prior, optimum.theta, eliminate_states(linear, noise).gradient)
    power = estimator.options.tuning.state_space.noise.prior_power

    def at(logs: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Gradient of the noise's log posterior, and the normal in theta, for the noise times exp(logs)."""
        tried = replace(noise, sd=noise.sd * np.exp(logs[:channels]), process=noise.process * np.exp(logs[channels:]))
        _, by_sd, by_process = restricted(linear, tried, hold)
        solved = eliminate_states(linear, tried)
        gradient = np.concatenate([by_sd, by_process + power - tried.process / optimum.movement])
        return gradient, *problem.normal(optimum.theta, solved.precision, solved.gradient)

    sides = LENGTH * np.eye(count)
    curvature = np.stack([(at(-side)[0] - at(side)[0]) / (2 * LENGTH) for side in sides])
    values, axes = np.linalg.eigh(0.5 * (curvature + curvature.T))
    spread = (axes / np.maximum(values, LEAST)) @ axes.T
    drawn = np.random.default_rng(seed).multivariate_normal(np.zeros(count), spread, DRAWS).clip(-FURTHEST, FURTHEST)
    normals = [at(logs)[1:] for logs in drawn]
    means, covariances = np.array([m for m, _ in normals]), np.array([c for _, c in normals])
    held = np.sqrt(np.diag(at(np.zeros(count))[2]))
    wide = np.sqrt(np.diag(covariances.mean(0)) + means.var(0, ddof=1))
    return {
        "model": name,
        "seed": seed,
        "z": ((posterior.mean.numpy() - truth) / posterior.stddev.numpy()).round(3).tolist(),
        "wider": (wide / held).round(3).tolist(),
        "blocking": [str(f.code) for f in estimator.findings.blocking],
    }


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Of one model: coverage of 90 % intervals, standard errors by logs."""
    limit, out = float(norm.ppf(0.95)), dict[str, Any](logs=len(rows))
    wider = np.array([r["wider"] for r in rows])
    for name, z in (("held", np.array([r["z"] for r in rows])), ("widened", np.array([r["z"] for r in rows]) / wider)):
        each = (np.abs(z) < limit).mean(1)
        out[f"coverage_90_{name}"] = round(float(each.mean()), 3)
        out[f"standard_error_{name}"] = round(float(each.std(ddof=1) / np.sqrt(len(each))), 3)
        out[f"mean_squared_z_{name}"] = round(float((z**2).mean()), 2)
    out["mean_z"] = np.mean([r["z"] for r in rows], axis=0).round(2).tolist()
    out["wider"] = [float(f(wider).round(3)) for f in (np.min, np.median, np.max)]
    out["fits_with_blocking"] = sum(bool(r["blocking"]) for r in rows)
    return out


def main() -> None:
    names = list(MODELS)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--select", nargs="*", default=names, choices=names)
    parser.add_argument("--seeds", type=int, nargs=2, metavar=("FIRST", "END"), default=[100, 112])
    given = parser.parse_args()
    for seed in range(*given.seeds):
        for name in given.select:
            if not any({"model": name, "seed": seed}.items() <= row.items() for row in fits(FILE)):
                print(json.dumps(keep(FILE, one_row(name, seed))), flush=True)
    rows = fits(FILE)
    cells = {name: summary(mine) for name in names if len(mine := [r for r in rows if r["model"] == name]) > 1}
    table = {
        "command": "python examples/studies/process_noise.py --seeds FIRST END",
        "seeds": sorted({r["seed"] for r in rows}),
        "versions": {p: version(p) for p in ("mujoco", "numpy", "scipy")},
        "models": cells,
    }
    write_text(HERE / "results" / "process_noise.json", json.dumps(table, indent=2) + "\n")


if __name__ == "__main__":
    main()
