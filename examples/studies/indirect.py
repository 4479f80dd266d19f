"""Coverage of `laplace` with its default windows where nothing but cosine and sine tell an angle.

Gymnasium's pendulum, 200 control steps of 50 ms, truths uniform in [0.1, 0.9]^3, white noise of the given share of each
channel's spread, states withheld: every window's start is estimated. z is the error in sds; a silent miss is a fit with
a parameter more than five of its sds off and no blocking finding.

    python examples/studies/indirect.py        # two minutes of a core; --logs 4 for a look

Results: results/indirect.json
"""

from __future__ import annotations

import argparse
import json
from importlib.metadata import version
from pathlib import Path

import numpy as np

import sipe_bayes as sipe
from sipe_bayes.benchmark.measurement import source
from sipe_bayes.core.files import write_text
from sipe_bayes.core.findings import Severity
from sipe_bayes.datasets import acting

RESULTS = Path(__file__).parent / "results" / "indirect.json"
LEVELS, WINDOWS = (0.01, 0.05), {"half a second": sipe.Segments(), "the whole log": sipe.Segments(None)}


def one_fit(simulator: sipe.Simulator, level: float, likelihood: sipe.Segments, seed: int) -> dict[str, list[float]]:
    """Errors in sds, which intervals hold, and what blocks."""
    theta = np.random.default_rng([seed, 7]).uniform(0.1, 0.9, len(simulator.space))
    behaviour = acting.excitation(simulator.environment, simulator.dt)
    motion = acting.simulate(simulator, theta, behaviour, acting.Recording("reference", 1, seed, 200))[0][0]
    noise = np.random.default_rng([seed, round(1e4 * level)]).standard_normal(motion.observations.shape)
    noisy = motion.observations + level * motion.observations.std(axis=0) * noise
    estimator = sipe.get_estimator(simulator, "laplace", likelihood=likelihood, seed=seed)
    posterior = estimator.fit(sipe.Trajectory(noisy, motion.actions, motion.dt))
    low, high = posterior.quantile([0.05, 0.95]).numpy()
    blocked = any(item.severity is Severity.BLOCKING for item in estimator.findings)
    z = (posterior.mean.numpy() - theta) / posterior.stddev.numpy()
    return {"z": z.tolist(), "held": ((low <= theta) & (theta <= high)).tolist(), "blocked": [blocked]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--logs", type=int, default=40)
    given = parser.parse_args()
    simulator, cells = sipe.Simulator(sipe.make_task("Pendulum"), num_threads=1), {}
    for level in LEVELS:
        for name, likelihood in WINDOWS.items():
            fits = [one_fit(simulator, level, likelihood, seed) for seed in range(300, 300 + given.logs)]
            held, z = np.array([fit["held"] for fit in fits]), np.abs([fit["z"] for fit in fits]).max(1)
            blocked = np.array([fit["blocked"][0] for fit in fits], bool)
            cells[f"{level:.0%} noise, windows of {name}"] = cell = {
                "logs": given.logs,
                "coverage_90": round(float(held.mean()), 3),
                "standard_error": round(float(held.mean(1).std(ddof=1) / np.sqrt(given.logs)), 3),
                "rms_z": np.sqrt(np.square([fit["z"] for fit in fits]).mean(0)).round(2).tolist(),
                "worst_silent_z": round(float(z[~blocked].max(initial=0.0)), 1),
                "silent_misses": int(((z > 5) & ~blocked).sum()),
                "blocked": int(blocked.sum()),
            }
            print(level, name, json.dumps(cell), flush=True)
    table = {
        "command": f"python examples/studies/indirect.py --logs {given.logs}",
        "source": source(),
        "versions": {p: version(p) for p in ("mujoco", "numpy", "scipy")},
        "cells": cells,
    }
    write_text(RESULTS, json.dumps(table, indent=2) + "\n")


if __name__ == "__main__":
    main()
