"""Does ``mcmc`` mix within its default budget, what are its moves worth, and what are ``laplace``'s intervals worth?

    python examples/studies/mixing.py                     # an hour
    python examples/studies/mixing.py laplace             # one of the two parts, moves or laplace
    python examples/studies/mixing.py --logs 0            # the table of what there is

Logs of 100 control steps at truths drawn from the prior, 1 % noise, ``StateSpace``, as in ``sipe check``. Each is
sampled by ``mcmc`` as it is by default, which stops at an R-hat of 1.01 and 400 effective draws, and by the stretch
move, emcee's default, on the same target from the same places with as many rollouts. R-hat and effective draws (the
fewer of bulk and tails, the worst parameter) are ArviZ's; seconds are those of the CPU, the ``laplace`` fit that comes
first included.

laplace: the logs of the half-cheetah, and each of the three of the real pendulum as its configuration has it, by
``laplace`` and by ``mcmc`` with as many rollouts as an R-hat of 1.01 and 2,000 effective draws need. Of each parameter
the sd and the width of the 90 % interval of ``laplace``, in those of the chains, and how far its mean is from theirs,
in their sds. C2ST is the accuracy with which a classifier tells draws of the two apart; ``halves`` is what it comes to
between one half of the walkers and the other.

Every fit is one line in runs/, results/mixing.json holds the tables.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from _c2st import c2st
from _kept import fits, keep

import sipe_bayes as sipe
from sipe_bayes.calibration.check import simulated_log
from sipe_bayes.calibration.config import load_config
from sipe_bayes.calibration.study import study_of_task
from sipe_bayes.core.files import write_text
from sipe_bayes.inference.mcmc import MCMC, MCMCState
from sipe_bayes.posterior import Particles

if TYPE_CHECKING:
    import emcee

HERE = Path(__file__).parent
RUNS, RESULT = HERE / "runs" / "mixing.jsonl", HERE / "results" / "mixing.json"
INTERVALS = HERE / "runs" / "laplace_intervals.jsonl"
TASKS = ("Pendulum", "HalfCheetahLinks")
REAL = HERE.parent / "simple_pendulum" / "calibrate.toml"
REAL_TASK = "the real pendulum"
REAL_LOGS = ("ddp", "direct_collocation", "pd__system_identification")
ENOUGH = {"budget": 2_000_000, "effective": 2_000}


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


def intervals(task: str, number: int) -> dict[str, Any]:
    """``laplace`` held against chains that have mixed, on one log."""
    settings: dict[str, Any]
    if task in TASKS:
        study = study_of_task(task, "mcmc", steps=100, noise=0.01, budget=None, refits=0, seed=0, threads=1)
        _, log = simulated_log(study, number)
        simulator = study.estimator.simulator
        settings = {"likelihood": study.estimator.likelihood}
    else:
        config, chosen = load_config(REAL), REAL_LOGS[number]
        logs = tuple(
            one.model_copy(update={"use": "train", "window": None}) for one in config.logs if one.name == chosen
        )
        problem = sipe.prepare(config.model_copy(update={"logs": logs}), 1)
        simulator, log, settings = problem.simulator, problem.train, {"likelihood": problem.likelihood}
        settings["prior"] = problem.prior
    laplace = sipe.get_estimator(simulator, "laplace", seed=number, **settings)
    chains = sipe.get_estimator(simulator, "mcmc", seed=number, **settings, **ENOUGH)
    began = time.process_time()
    local = laplace.fit(log)
    middle = time.process_time()
    sampled = chains.fit(log)
    ended = time.process_time()
    assert isinstance(sampled, Particles)
    ranges = [np.diff(posterior.quantile([0.05, 0.95]).numpy(), axis=0)[0] for posterior in (local, sampled)]
    walkers = sampled.theta.reshape(sampled.chains, -1, len(simulator.space))
    halves = [half.reshape(-1, half.shape[-1]).numpy() for half in (walkers[::2], walkers[1::2])]
    mixing = chains.diagnostics["mixing"]
    return {
        "task": task,
        "log": number,
        "names": list(simulator.space.names),
        "sd": (local.stddev / sampled.stddev).tolist(),
        "width": (ranges[0] / ranges[1]).tolist(),
        "centre": ((local.mean - sampled.mean) / sampled.stddev).tolist(),
        "c2st": c2st(local, sampled.theta.numpy()),
        "halves": c2st(Particles(halves[0], simulator.space), halves[1]),
        "rollouts": {"laplace": laplace.rollouts, "mcmc": chains.rollouts},
        "seconds": {"laplace": round(middle - began, 1), "mcmc": round(ended - middle, 1)},
        **{key: round(float(mixing[key]), 4) for key in ("rhat", "ess", "linearisation_error")},
        "findings": sorted({str(item.code) for item in laplace.findings}),
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


def intervals_table(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """One row for each task: medians, and the least and largest, over parameters and logs."""
    out = []
    for task in dict.fromkeys(row["task"] for row in rows):
        part = [row for row in rows if row["task"] == task]
        sd, width, centre = (np.concatenate([row[key] for row in part]) for key in ("sd", "width", "centre"))
        out.append(
            {
                "task": task,
                "logs": len(part),
                "sd_ratio": _spread(sd),
                "width_ratio": _spread(width),
                "centre_in_sds": _spread(np.abs(centre)),
                "c2st": _spread(np.array([row["c2st"] for row in part])),
                "c2st_of_halves": _spread(np.array([row["halves"] for row in part])),
                "rhat_worst": max(row["rhat"] for row in part),
                "effective_draws": _spread(np.array([row["ess"] for row in part])),
                "rollouts": {k: _spread(np.array([row["rollouts"][k] for row in part])) for k in ("laplace", "mcmc")},
                "cpu_seconds": {k: _spread(np.array([row["seconds"][k] for row in part])) for k in ("laplace", "mcmc")},
            }
        )
    return out


def _spread(values: np.ndarray) -> dict[str, float]:
    return {"median": round(float(np.median(values)), 3), "least": round(float(values.min()), 3)} | {
        "largest": round(float(values.max()), 3)
    }


def moves_part(logs: int) -> list[dict[str, Any]]:
    """What is not there yet of the first part, and its table."""
    rows = fits(RUNS)
    for task in TASKS:
        for number in range(logs):
            budget = None
            for kind in (MCMC, Stretched):
                moves = "mcmc" if kind is MCMC else "stretch"
                row = next((r for r in rows if (r["task"], r["log"], r["moves"]) == (task, number, moves)), None)
                if row is None:
                    row = keep(RUNS, measured(task, number, kind, budget))
                    rows.append(row)
                    print({key: row[key] for key in ("task", "log", "moves", "rhat", "ess", "seconds")}, flush=True)
                budget = int(row["rollouts"])
    return table(rows)


def laplace_part(logs: int) -> list[dict[str, Any]]:
    """What is not there yet of the second part, and its table."""
    rows = fits(INTERVALS)
    for task, count in ((REAL_TASK, len(REAL_LOGS)), ("HalfCheetahLinks", 10)):
        for number in range(min(logs, count)):
            if not any((row["task"], row["log"]) == (task, number) for row in rows):
                row = keep(INTERVALS, intervals(task, number))
                rows.append(row)
                print(
                    {key: row[key] for key in ("task", "log", "sd", "centre", "c2st", "rhat", "rollouts")}, flush=True
                )
    return intervals_table(rows)


PARTS = {"moves": ("table", moves_part), "laplace": ("intervals", laplace_part)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", nargs="?", choices=[*PARTS], help="default both")
    parser.add_argument("--logs", type=int, default=10)
    given = parser.parse_args()
    kept = json.loads(RESULT.read_text()) if RESULT.exists() else {}
    kept["command"] = "python examples/studies/mixing.py"
    for name in [given.part] if given.part else PARTS:
        key, part = PARTS[name]
        kept[key] = part(given.logs) or kept.get(key, [])
        write_text(RESULT, json.dumps(kept, indent=1) + "\n")
        for line in kept[key]:
            print(line)


if __name__ == "__main__":
    main()
