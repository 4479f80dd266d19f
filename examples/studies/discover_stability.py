"""Does `sipe discover` say the same whatever the seed, the processor and a hundredth of the samples are?

    python examples/studies/discover_stability.py            # five logs, eight runs each; about an hour on two cores
    python examples/studies/discover_stability.py --logs pendulum simple_pendulum

Logs: three of the machines of discover.py with a planted effect of 10 % of the joint's usual force, and two real ones,
the simple pendulum's and those of the SO-101 arm (31 parameters; six kinds of extensions). Runs: three seeds,
one thread instead of two, two kernels of OpenBLAS, and twice without one sample of a hundred, chosen at random. Each
run is a process, since kernels are chosen when NumPy is loaded; it is one line in runs/, so an interrupted study goes
on. results/discover_stability.json holds the sets, and the share of runs with the set of the first run of their log.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from _kept import fits, keep
from discover import plain, recorded

import sipe_bayes as sipe
from sipe_bayes.core.files import write_text
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.structure import Restriction, Structures, discover

HERE = Path(__file__).parent
RUNS = HERE / "runs" / "discover_stability.jsonl"
PLANTED = {"pendulum": "dry_friction", "double": "delay", "slide": "spring"}
REAL = {"simple_pendulum": None, "so101": ("dry_friction", "stribeck", "gear_compliance", "spring", "lag", "cogging")}
KERNELS = "haswell", "sandybridge"
VARIANTS = {
    "seed 0": (0, 2, "", None),
    "seed 1": (1, 2, "", None),
    "seed 2": (2, 2, "", None),
    "one thread": (0, 1, "", None),
    **{f"kernel {kernel}": (0, 2, kernel, None) for kernel in KERNELS},
    "without 1 %, first": (0, 2, "", 0),
    "without 1 %, second": (0, 2, "", 1),
}
"""Of each run: seed, threads, OpenBLAS kernel, and the seed of the samples that are left out."""


def thinned(logs: Trajectories, seed: int) -> Trajectories:
    """The logs without one sample of a hundred of each channel."""
    rng, out = np.random.default_rng(seed), list[Trajectory]()
    for log in logs:
        missing = rng.random(log.observations.shape) < 0.01
        missing[0] = False
        out.append(replace(log, observations=np.where(missing, np.nan, log.observations), states=None))
    return Trajectories.stack(out)


def searched(name: str, seed: int, threads: int, without: int | None) -> Structures:
    """One search."""
    if name in PLANTED:
        simulator, logs = plain(name), recorded(name, PLANTED[name], 0.1, 0.0, 0)[0]
        logs = logs if without is None else thinned(logs, without)
        return discover(sipe.Simulator(simulator.environment, num_threads=threads), logs, seed=seed)
    file = "discover.toml" if name == "simple_pendulum" else "calibrate.toml"
    problem = sipe.prepare(HERE.parent / name / file, threads)
    logs = problem.train if without is None else thinned(problem.train, without)
    restriction = Restriction(only=REAL[name])
    held, prior, segments = problem.holdout, problem.prior, problem.segments
    return discover(
        problem.simulator,
        logs,
        holdout=held,
        prior=prior,
        likelihood=segments,
        restriction=restriction,
        seed=seed,
    )


def run(name: str, variant: str) -> None:
    """One run, as a line on the standard output."""
    seed, threads, _, without = VARIANTS[variant]
    begin = time.monotonic()
    structures = searched(name, seed, threads, without)
    row: dict[str, Any] = {"log": name, "variant": variant, "named": list(structures.best.labels)}
    row["set"] = [list(one.labels) for one in structures.supported]
    row["rollouts"], row["seconds"] = structures.rollouts, round(time.monotonic() - begin, 1)
    print(json.dumps(row))


def tables(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Shares of runs with the set, and with the written structure, of the first run of their log."""
    first = {r["log"]: r for r in rows if r["variant"] == next(iter(VARIANTS))}

    def same(row: dict[str, Any], key: str) -> bool:
        return sorted(map(sorted, row[key])) == sorted(map(sorted, first[row["log"]][key]))

    others = [r for r in rows if r["log"] in first and r is not first[r["log"]]]
    count = max(len(others), 1)
    return {
        "runs": len(others),
        "same set": sum(same(r, "set") for r in others) / count,
        "same structure written": sum(sorted(r["named"]) == sorted(first[r["log"]]["named"]) for r in others) / count,
        "rows": rows,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--logs", nargs="+", default=[*PLANTED, *REAL])
    parser.add_argument("--out", type=Path, default=RUNS)
    parser.add_argument("--one", nargs=2, help="a log and a variant: that run alone, here")
    given = parser.parse_args()
    if given.one:
        run(*given.one)
        return
    rows = fits(given.out)
    done = {(r["log"], r["variant"]) for r in rows}
    for name in given.logs:
        for variant, (_, threads, kernel, _) in VARIANTS.items():
            if (name, variant) in done:
                continue
            own = {"OMP_NUM_THREADS": str(threads), **({"OPENBLAS_CORETYPE": kernel} if kernel else {})}
            command = [sys.executable, __file__, "--one", name, variant]
            out = subprocess.run(command, env=os.environ | own, check=True, capture_output=True, text=True)
            rows.append(keep(given.out, json.loads(out.stdout.splitlines()[-1])))
            print(rows[-1], flush=True)
            write_text(HERE / "results" / "discover_stability.json", json.dumps(tables(rows), indent=1) + "\n")


if __name__ == "__main__":
    main()
