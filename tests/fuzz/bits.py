"""Does every estimator give the same bits, whatever runs beside it and in whichever order?

    python -m tests.fuzz.bits --name laplace

Each fits two logs of a pendulum in a process of its own: on one thread and on two (of the simulations, and of torch),
with the rollouts of every batch in their own order, reversed and shuffled, with two values of PYTHONHASHSEED, and in
two processes at once. What is compared are 200 draws, the mean and the sd of the posterior, all bits of them.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import logging
import os
import shlex
import subprocess
import sys
import time
import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sipe_bayes.core.files import to_json, write_text
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.inference import ESTIMATORS, get_estimator
from sipe_bayes.simulation.simulator import Simulator
from tests.problems.pendulums import log, pendulum
from tests.problems.quick import FORM

ROOT = Path(__file__).parents[2]
RESULT = ROOT / "examples" / "studies" / "results" / "same_bits.json"
BUDGET = 150


@dataclass(frozen=True)
class Way:
    """How the estimators run.

    Args:
        threads: of the simulator.
        torch_threads: of torch, in each operation.
        order: of the rollouts of a batch: "own", "reversed" or "shuffled".
        hash_seed: PYTHONHASHSEED.
        beside: other processes that do the same at the same time.
    """

    threads: int = 1
    torch_threads: int = 1
    order: str = "own"
    hash_seed: int = 0
    beside: int = 0


WAYS = {
    "alone": Way(),
    "two simulator threads": Way(threads=2),
    "two torch threads": Way(torch_threads=2),
    "rollouts reversed": Way(order="reversed"),
    "rollouts shuffled": Way(order="shuffled"),
    "another hash seed": Way(hash_seed=1),
    "two processes at once": Way(beside=1),
}


class Ordered(Simulator):
    """A pendulum whose batches are simulated in another order, and come back in theirs."""

    def __init__(self, threads: int = 1, order: str = "own") -> None:
        super().__init__(pendulum().environment, num_threads=threads)
        self.order, self.chance = order, np.random.default_rng(0)

    def rollout(self, theta: Any, actions: Any, initial_state: Any, *rest: Any, **settings: Any) -> Trajectories:
        given = (np.atleast_2d(theta), np.asarray(actions), np.atleast_2d(initial_state))
        given = (given[0], given[1] if given[1].ndim == 3 else given[1][None], given[2])
        batch = max(map(len, given))
        order = {"own": np.arange(batch), "reversed": np.arange(batch)[::-1]}.get(self.order)
        order = self.chance.permutation(batch) if order is None else order
        dt, logs, *others = (*rest, *[None] * (2 - len(rest)))
        dt, logs = settings.pop("dt", dt), settings.pop("logs", logs)
        dt = dt if dt is None or np.ndim(dt) == 0 else np.asarray(dt)[order]
        logs = None if logs is None else [logs[k] for k in order]
        moved = [values if len(values) == 1 else values[order] for values in given]
        made = super().rollout(*moved, dt, logs, *others, **settings)
        back = np.argsort(order)
        fields = ("observations", "actions", "dt", "length", "valid", "states")
        return replace(made, **{name: getattr(made, name)[back] for name in fields})


def bits(name: str, way: Way, budget: int | None = None) -> str:
    """What a fit comes to, as a digest; with ``budget`` by the methods' own settings."""
    import torch

    torch.set_num_threads(way.torch_threads)
    logs = [log(pendulum(), [0.6, 0.05], 1, "a", steps=120), log(pendulum(), [0.6, 0.05], 2, "b", steps=90)]
    logs[0].observations[20:40] = np.nan
    estimator = get_estimator(Ordered(way.threads, way.order), name, seed=3, **_settings(name, budget))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        posterior = estimator.fit(logs)
        draws = posterior.sample((200,), generator=torch.Generator().manual_seed(0))
    digest = hashlib.sha256()
    for part in (draws, posterior.mean, posterior.stddev):
        digest.update(np.ascontiguousarray(part.numpy()).tobytes())
    return digest.hexdigest()[:16]


def _settings(name: str, budget: int | None) -> dict[str, Any]:
    return {"budget": BUDGET, **FORM.get(name, {})} if budget is None else {"budget": budget}


def every(way: str, names: list[str], budget: int | None = None) -> dict[str, str]:
    """The digests of all estimators, in a process of its own."""
    chosen = WAYS[way]
    threads = str(max(chosen.threads, chosen.torch_threads))
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONHASHSEED": str(chosen.hash_seed)}
    words = [sys.executable, "-m", "tests.fuzz.bits", "--way", way, *(w for name in names for w in ("--name", name))]
    words += [] if budget is None else ["--budget", str(budget)]
    processes = [
        subprocess.Popen(words, env={**environment, "OMP_NUM_THREADS": threads}, stdout=subprocess.PIPE, text=True)
        for _ in range(1 + chosen.beside)
    ]
    answers = [json.loads(process.communicate()[0].splitlines()[-1]) for process in processes]
    return {
        name: answers[0][name] if all(a[name] == answers[0][name] for a in answers) else "differs" for name in names
    }


def main() -> int:
    """Print a row for each estimator; exit code 1 where bits differ from those of a process that runs alone."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--name", action="append", choices=list(ESTIMATORS), help="again for several; default all")
    parser.add_argument("--way", choices=list(WAYS), help="this one alone, as JSON")
    parser.add_argument(
        "--budget", type=int, help="rollouts, with the methods' own settings; default few, and quick ones"
    )
    parser.add_argument("--out", type=Path, default=RESULT)
    given = parser.parse_args()
    names = given.name or list(ESTIMATORS)
    if given.way:
        logging.disable(logging.WARNING)
        print(json.dumps({name: bits(name, WAYS[given.way], given.budget) for name in names}))
        return 0
    digests, began = dict[str, dict[str, str]](), time.perf_counter()
    for way in WAYS:
        digests[way] = every(way, names, given.budget)
        differing = [name for name in names if digests[way][name] != digests["alone"][name]]
        print(f"{way:24}{', '.join(differing) or 'the same bits'}", flush=True)
    differing = {name: [way for way in WAYS if digests[way][name] != digests["alone"][name]] for name in names}
    import torch

    about = {
        "command": shlex.join(["python", "-m", "tests.fuzz.bits", *sys.argv[1:]]),
        "torch": torch.__version__,
        "ways": list(WAYS),
    }
    write_text(given.out, to_json({**about, "differing": differing}, indent=1))
    print(f"{len(names)} estimators, {sum(map(bool, differing.values()))} differ, {time.perf_counter() - began:.0f} s")
    return any(differing.values())


if __name__ == "__main__":
    sys.exit(main())
