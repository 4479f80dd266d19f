"""Does ``mcmc`` mix within its default budget, and what are its moves worth beside emcee's default?

    python examples/studies/mixing.py                     # half an hour
    python examples/studies/mixing.py --logs 0            # the table of what there is

Logs of 100 control steps at truths drawn from the prior, 1 % noise, ``StateSpace``, as in ``sipe check``. Each is
sampled by ``mcmc`` as it is by default, which stops at an R-hat of 1.01 and 400 effective draws, and by the stretch
move, emcee's default, on the same target from the same places with as many rollouts. R-hat and effective draws (the
fewer of bulk and tails, the worst parameter) are ArviZ's; seconds are those of the CPU, the ``laplace`` fit that comes
first included. Every chain is one line in runs/, results/mixing.json holds the table.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from _kept import fits, keep

from sipe_bayes.calibration.check import simulated_log
from sipe_bayes.calibration.study import study_of_task
from sipe_bayes.core.files import write_text
from sipe_bayes.inference.mcmc import MCMC, MCMCState

if TYPE_CHECKING:
    import emcee

HERE = Path(__file__).parent
RUNS, RESULT = HERE / "runs" / "mixing.jsonl", HERE / "results" / "mixing.json"
TASKS = ("Pendulum", "HalfCheetahLinks")


class Stretched(MCMC):
    """``mcmc`` by emcee's default move, to the end of its budget."""

    def moves(self, state: MCMCState) -> list[tuple[emcee.moves.Move, float]]:
        """The stretch of J. Goodman, J. Weare 2010."""
        import emcee

        return [(emcee.moves.StretchMove(), 1.0)]


def measured(task: str, number: int, kind: type[MCMC], budget: int | None) -> dict[str, Any]:
    """One log's chains."""
    study = study_of_task(task, "mcmc", steps=100, noise=0.01, budget=budget, refits=0, seed=0, threads=1)
    _, log = simulated_log(study, number)
    options = {} if kind is MCMC else {"mixed": 1.0 + 1e-9}
    method = kind(
        study.estimator.simulator, budget=budget, seed=number, likelihood=study.estimator.likelihood, **options
    )
    began = time.process_time()
    method.fit(log)
    seconds = time.process_time() - began
    mixing = method.diagnostics["mixing"]
    return {
        "task": task,
        "log": number,
        "moves": "mcmc" if kind is MCMC else "stretch",
        "rollouts": method.rollouts,
        "seconds": round(seconds, 1),
        **{key: round(float(mixing[key]), 4) for key in ("rhat", "ess", "acceptance")},
        "findings": sorted({str(item.code) for item in method.findings}),
    }


def table(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """One row for each task and kind of moves."""
    out = []
    for task in TASKS:
        for moves in ("mcmc", "stretch"):
            part = [row for row in rows if row["task"] == task and row["moves"] == moves]
            if not part:
                continue
            rhat, ess, seconds = (np.array([row[key] for row in part]) for key in ("rhat", "ess", "seconds"))
            out.append(
                {
                    "task": task,
                    "moves": moves,
                    "logs": len(part),
                    "mixed_to_1.01": int((rhat <= 1.01).sum()),
                    "rhat_median": round(float(np.median(rhat)), 3),
                    "rhat_worst": round(float(rhat.max()), 3),
                    "effective_draws": round(float(np.median(ess))),
                    "effective_draws_per_second": round(float(np.median(ess / seconds)), 1),
                    "rollouts": round(float(np.median([row["rollouts"] for row in part]))),
                }
            )
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--logs", type=int, default=10)
    given = parser.parse_args()
    rows = fits(RUNS)
    for task in TASKS:
        for number in range(given.logs):
            budget = None
            for kind in (MCMC, Stretched):
                moves = "mcmc" if kind is MCMC else "stretch"
                row = next((r for r in rows if (r["task"], r["log"], r["moves"]) == (task, number, moves)), None)
                if row is None:
                    row = keep(RUNS, measured(task, number, kind, budget))
                    rows.append(row)
                    print({key: row[key] for key in ("task", "log", "moves", "rhat", "ess", "seconds")}, flush=True)
                budget = int(row["rollouts"])
    write_text(
        RESULT, json.dumps({"command": "python examples/studies/mixing.py", "table": table(rows)}, indent=1) + "\n"
    )
    for line in table(rows):
        print(line)


if __name__ == "__main__":
    main()
