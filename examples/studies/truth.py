"""C2ST against exact posterior draws of a linear-Gaussian problem with five parameters, two of them correlated.

    python examples/studies/truth.py [--budget 10000] [--seeds 3]

`npe` and `bayessim` on x = M theta + noise, `laplace` and `mcmc` on four carts in MuJoCo
(tests/problems/linear_gaussian.py).
2,000 draws each; 0.5 is perfect, the bar 0.60.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from _c2st import c2st

import sipe_bayes as sipe
from sipe_bayes.core.files import write_text
from sipe_bayes.posterior import Particles, Posterior

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parents[1]))
METHODS: dict[str, dict[str, Any]] = {
    "laplace": {},
    "mcmc": {"effective": 10_000},
    "npe": {"embedding": "none"},
    "bayessim": {},
}


def independent(posterior: Posterior, diagnostics: dict[str, Any]) -> torch.Tensor:
    """Up to 2,000 draws.

    Of chains, whose repeats a classifier would tell at once, every n-th state, n the autocorrelation time in steps.
    """
    if not isinstance(posterior, Particles) or posterior.chains is None:
        return posterior.sample((2000,), generator=torch.Generator().manual_seed(0))
    every = math.ceil(diagnostics["mixing"]["autocorrelation_steps"])
    thinned = posterior.theta.reshape(posterior.chains, -1, len(posterior.space))[:, ::every].reshape(
        -1, len(posterior.space)
    )
    return thinned[:: math.ceil(len(thinned) / 2000)]


def main() -> None:
    from tests.problems.linear_gaussian import carts_problem, function_problem

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--budget", type=int, default=10_000)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--out", type=Path, default=HERE / "results" / "truth.json")
    given = parser.parse_args()
    rows = []
    for name, settings in METHODS.items():
        for seed in range(given.seeds):
            problem = carts_problem if name in ("laplace", "mcmc") else function_problem
            simulator, log, exact, likelihood = problem()
            begin = time.process_time()
            estimator = sipe.get_estimator(
                simulator, name, budget=given.budget, seed=seed, likelihood=likelihood, **settings
            )
            posterior = estimator.fit(log)
            seconds = time.process_time() - begin
            draws = independent(posterior, estimator.diagnostics)
            reference = exact.sample((len(draws),), generator=torch.Generator().manual_seed(100 + seed))
            row = {
                "method": name,
                "seed": seed,
                "c2st": round(c2st(Particles(draws, exact.space), reference, seed=seed), 4),
                "draws": len(draws),
                "rollouts": estimator.rollouts,
                "cpu_seconds": round(seconds, 1),
            }
            rows.append(row)
            print(json.dumps(row), flush=True)
    command = f"python examples/studies/truth.py --budget {given.budget} --seeds {given.seeds}"
    versions = {p: version(p) for p in ("mujoco", "torch", "sbi", "numpy")}
    write_text(given.out, json.dumps({"command": command, "versions": versions, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
