"""Do the intervals of six simulated machines hold the truth, and does every fit end? Truths and logs by seed.

    python examples/studies/shapes.py                           # 40 seeds of each machine: hours
    python examples/studies/shapes.py --machine drive --seeds 5

A servo with its own controller, a linear drive, a two-link arm, a free double pendulum, a four-legged machine with an
inertial unit and a thrown cube (`examples/servo`, `drive`, `arm`, `double_pendulum`, `quadruped`, `cube`): each seed
draws another truth within the bounds and simulates other logs, of which at most 20 are fitted as the configuration
says. Fits are kept one by one in runs/, so that an interrupted study goes on; the summaries go to results/. Coverage is
that of the 90 % intervals, pooled over parameters.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from _kept import fits, keep

from sipe_bayes.calibration.problem import method_of, prepare
from sipe_bayes.core.files import write_text

HERE = Path(__file__).parent
_FAR = 6.0  # sds of the posterior: the fit is elsewhere
_MOST_LOGS = 20  # of a machine: the cube has 40 tosses, which take twice as long
MACHINES = ("servo", "drive", "arm", "double_pendulum", "quadruped", "cube")


def one_fit(machine: str, seed: int) -> dict[str, Any]:
    """Make the logs of a seed, fit them, and record where the truth lies."""
    source = HERE.parent / machine
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        subprocess.run([sys.executable, source / "make.py", "--seed", str(seed), "--out", folder], check=True)
        for file in (*source.glob("*.xml"), source / "calibrate.toml"):
            shutil.copy(file, folder)
        problem = prepare(folder / "calibrate.toml")
        truth = json.loads((folder / "truth.json").read_text())
        method, begin = method_of(problem, None, seed, None), (time.monotonic(), time.process_time())
        posterior = method.fit(problem.train[:_MOST_LOGS])
    space = problem.environment.space
    theta = np.array([float(p.normalise(truth[p.name])) for p in space])
    low, high = posterior.quantile([0.05, 0.95]).numpy()
    return {
        "machine": machine,
        "seed": seed,
        "inside": ((low <= theta) & (theta <= high)).tolist(),
        "sds_off": ((posterior.mean.numpy() - theta) / posterior.stddev.numpy()).round(3).tolist(),
        "sd": posterior.stddev.tolist(),
        "findings": [str(item.code) for item in method.findings],
        "blocked": bool(method.findings.blocking),
        "rollouts": method.rollouts,
        "wall_s": round(time.monotonic() - begin[0], 1),
        "cpu_s": round(time.process_time() - begin[1], 1),
    }


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Coverage with its standard error clustered by fit, of those that converged, and what the fits took."""
    out = {}
    for machine in MACHINES:
        mine = [row for row in rows if row["machine"] == machine]
        ended = [np.mean(row["inside"]) for row in mine if not row["blocked"]]
        if mine:
            out[machine] = {
                "seeds": len(mine),
                "converged": len(ended),
                "refused": sorted({code for row in mine if row["blocked"] for code in row["findings"]}),
                "coverage": round(float(np.mean(ended)), 3) if ended else None,
                "standard_error": round(float(np.std(ended) / np.sqrt(len(ended))), 3) if ended else None,
                "seeds_far_off": [row["seed"] for row in mine if np.abs(row["sds_off"]).max() > _FAR],
                "median_rollouts": float(np.median([row["rollouts"] for row in mine])),
                "median_cpu_s": float(np.median([row["cpu_s"] for row in mine])),
            }
    return out


def main() -> None:
    """Fit what is not yet kept, print and write the summary."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--machine", choices=MACHINES, action="append")
    parser.add_argument("--seeds", type=int, default=40)
    given = parser.parse_args()
    path = Path("runs") / "shapes.jsonl"
    rows = fits(path)
    known = {(row["machine"], row["seed"]) for row in rows}
    for seed in range(1, given.seeds + 1):
        for machine in given.machine or MACHINES:
            if (machine, seed) not in known:
                rows.append(keep(path, one_fit(machine, seed)))
                print(json.dumps(rows[-1]), flush=True)
    results = summary(rows)
    print(json.dumps(results, indent=2))
    for machine, result in results.items():
        write_text(HERE / "results" / "shapes" / f"{machine}.json", json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
