"""Amortised posteriors, mended by a fifth of the simulations (``calibration=0.2``) and as they are.

    python examples/studies/held_back.py                                 # hours; goes on after an interruption
    python examples/studies/held_back.py --select Pendulum/bayessim
    python examples/studies/held_back.py --select none                   # the table of what there is

As ``sbc.py``: one demonstration's commands and start, 100 control steps, 1 % noise, 2,000 simulations (of which a fifth
mends or none does), then 400 logs at truths from the prior. Ranks are uniform where the smallest p-value over N
parameters is at least .05 / N. The interval score is that of 90 % intervals in theta, the mean over the parameters:
width, plus 20 times what the truth lies outside. results/held_back.json holds the table.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from sipe_bayes.calibration.check import RESULT, run
from sipe_bayes.calibration.study import study_of_task
from sipe_bayes.core.files import to_json, write_text
from sipe_bayes.inference import get_estimator

HERE = Path(__file__).parent
RUNS, TABLE = HERE / "runs" / "held_back", HERE / "results" / "held_back.json"
TASKS, METHODS, SHARES = ("Pendulum", "HalfCheetahLinks"), ("bayessim", "npe"), (0.0, 0.2)
BUDGET, LOGS = 2000, 400


def measure(task: str, method: str, share: float) -> None:
    """Run a cell, or go on with it."""
    study = study_of_task(task, method, steps=100, noise=0.01, budget=BUDGET, refits=0, seed=0, threads=1)
    plain = study.estimator
    estimator = get_estimator(
        plain.simulator, method, budget=BUDGET, seed=0, likelihood=plain.likelihood, calibration=share
    )
    outcome = run(replace(study, estimator=estimator), LOGS, RUNS / f"{task}-{method}-{share:g}")
    print(f"{share:g}: {outcome.sentence()}", flush=True)


def row(task: str, method: str, share: float) -> dict[str, Any] | None:
    """What a cell came to; None where it was not run."""
    path = RUNS / f"{task}-{method}-{share:g}" / RESULT
    if not path.is_file():
        return None
    result = json.loads(path.read_text(encoding="utf-8"))
    parameters, sharpness = result["parameters"], result["sharpness"].values()
    smallest = min(p["p_ranks"] for p in parameters)
    return {
        "task": task,
        "estimator": method,
        "calibration": share,
        "logs": result["truths"],
        "smallest_p_of_ranks": smallest,
        "uniform": smallest >= 0.05 / len(parameters),
        "tarp_p": result["tarp"]["p"],
        "coverage_90": round(result["coverage_90"], 4),
        "standard_error": round(result["standard_error"], 4),
        "interval_score": round(sum(s["interval_score"] for s in sharpness) / len(parameters), 4),
        "contraction": round(sum(s["contraction"] for s in sharpness) / len(parameters), 3),
        "seconds": result["seconds"],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--select", default="", help="only cells whose TASK/METHOD begins so")
    given = parser.parse_args()
    cells = [(task, method, share) for task in TASKS for method in METHODS for share in SHARES]
    for cell in cells:
        if f"{cell[0]}/{cell[1]}".startswith(given.select):
            measure(*cell)
    rows = [made for made in (row(*cell) for cell in cells) if made is not None]
    write_text(TABLE, to_json({"command": "python examples/studies/held_back.py", "table": rows}, indent=1) + "\n")
    for made in rows:
        print(made)


if __name__ == "__main__":
    main()
