"""Coverage of `laplace` on StateSpace from no process noise to much, and what the noise's own uncertainty adds.

The models of `particles.py`, whose logs of 40 control steps have measurement noise and a share of their process noise,
both inferred. "held" is the normal with the noise held at its estimate, "averaged" what the fit gives
(`noise_average`). Truths are uniform in [0.2, 0.8]^N.

    python examples/studies/process_noise.py --seeds 100 140                   # half a second of a core for each log

Rows are kept in runs/process_noise and an interrupted study goes on; each run writes the summary of all there are.
"""

from __future__ import annotations

import argparse
import json
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from _kept import ensure, fits
from particles import MODELS, logged
from scipy.stats import norm

import sipe_bayes as sipe
from sipe_bayes.core.files import write_text
from sipe_bayes.inference.laplace.state_space.state import ChainOptimum
from sipe_bayes.inference.laplace.strategy import distinct, mixture

HERE = Path(__file__).parent
FILE = HERE / "runs" / "process_noise" / "rows.jsonl"


def one_row(name: str, seed: int, share: float) -> dict[str, Any]:
    """z-scores of one log's truth, and by how much the noise's uncertainty widens each sd."""
    simulator, truth, log = logged(name, seed, share)
    estimator = sipe.get_estimator(simulator, "laplace", likelihood=sipe.StateSpace(), seed=seed)
    posterior = estimator.fit(log)
    assert estimator.state is not None
    optima = distinct(estimator.state.search.optima)
    assert all(isinstance(one, ChainOptimum) for one in optima)
    held = mixture([one.as_linearised for one in optima if isinstance(one, ChainOptimum)], simulator.space)
    z = {
        which: ((one.mean.numpy() - truth) / one.stddev.numpy()).round(3).tolist()
        for which, one in (("held", held), ("averaged", posterior))
    }
    return {
        "model": name,
        "seed": seed,
        "share": share,
        "z": z,
        "wider": (posterior.stddev / held.stddev).numpy().round(3).tolist(),
        "blocking": [str(f.code) for f in estimator.findings.blocking],
    }


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Of one model and share: coverage of 90 % intervals, standard errors by logs."""
    limit, out = float(norm.ppf(0.95)), dict[str, Any](logs=len(rows))
    wider = np.array([r["wider"] for r in rows])
    for name in ("held", "averaged"):
        z = np.array([r["z"][name] for r in rows])
        each = (np.abs(z) < limit).mean(1)
        out[f"coverage_90_{name}"] = round(float(each.mean()), 3)
        out[f"standard_error_{name}"] = round(float(each.std(ddof=1) / np.sqrt(len(each))), 3)
        out[f"mean_squared_z_{name}"] = round(float((z**2).mean()), 2)
    out["mean_z"] = np.mean([r["z"]["averaged"] for r in rows], axis=0).round(2).tolist()
    out["wider"] = [float(f(wider).round(3)) for f in (np.min, np.median, np.max)]
    out["fits_with_blocking"] = sum(bool(r["blocking"]) for r in rows)
    return out


def main() -> None:
    names = list(MODELS)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--select", nargs="*", default=names, choices=names)
    parser.add_argument("--seeds", type=int, nargs=2, metavar=("FIRST", "END"), default=[100, 140])
    parser.add_argument("--shares", type=float, nargs="*", default=[0.0, 0.1, 0.3, 1.0], help="of the process noise")
    given = parser.parse_args()
    for seed in range(*given.seeds):
        for name, share in ((name, share) for name in given.select for share in given.shares):
            ensure(FILE, {"model": name, "seed": seed, "share": share}, partial(one_row, name, seed, share))
    cells: dict[str, list[dict[str, Any]]] = {}
    for row in fits(FILE):
        cells.setdefault(f"{row['model']}, {row['share']:g}", []).append(row)
    table = {
        "command": "python examples/studies/process_noise.py --seeds FIRST END",
        "seeds": sorted({r["seed"] for r in fits(FILE)}),
        "versions": {p: version(p) for p in ("mujoco", "numpy", "scipy")},
        "models": {cell: summary(rows) for cell, rows in cells.items() if len(rows) > 1},
    }
    write_text(HERE / "results" / "process_noise.json", json.dumps(table, indent=2) + "\n")


if __name__ == "__main__":
    main()
