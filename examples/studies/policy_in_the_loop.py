"""Policy in the loop on the paper's nine environments: estimates while an agent is trained where they are believed.

    python examples/studies/policy_in_the_loop.py run     # every cell not there yet; goes on after an interruption
    python examples/studies/policy_in_the_loop.py run --select Door/simopt --seeds 3
    python examples/studies/policy_in_the_loop.py run --start scratch --steps 150000 --budget 1000 --updates 10
    python examples/studies/policy_in_the_loop.py table   # results/policy_in_the_loop.json and .md of the cells made

A cell is task/method/seed. The reference is the in-distribution variant; each update takes one trajectory from it, of
the benchmark's length. The paper's rule: a seed counts only if its policy solves the environment, here simulators drawn
from the last estimate (see ``sipe_bayes.rl.policy_in_the_loop``); the seeds that do are counted, and all are shown.

From scratch a short training solves nothing. So the agent begins as the shipped expert of its robot, which was trained
in the published model, with the settings of its card but for what ``agent`` says: a deviation from the paper. The
reference differs from the published model by .1 to .4 of the range in every parameter, and the shipped expert does not
solve it everywhere (column "expert as shipped").
"""

from __future__ import annotations

import argparse
import fcntl
import itertools
import json
import os
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch

import sipe_bayes as sipe
from sipe_bayes.benchmark.cells import Cell
from sipe_bayes.benchmark.transfer.study import settings as small_agent
from sipe_bayes.core.files import to_json, write_text
from sipe_bayes.datasets.demonstrations import agent_file
from sipe_bayes.datasets.trajectory_sets import TASKS
from sipe_bayes.diagnostics.scores import score
from sipe_bayes.models.policy import load_policy
from sipe_bayes.posterior import Dirac, Posterior, prior
from sipe_bayes.rl.evaluation import STARTS, evaluate
from sipe_bayes.rl.policy_in_the_loop import train_in_the_loop
from sipe_bayes.rl.settings import Settings

HERE = Path(__file__).parent
RUNS = HERE / "runs" / "policy_in_the_loop"
KEPT = HERE / "results" / "policy_in_the_loop.json"
VARIANT = "in_distribution"
SHARE, CLONING, WAITS, SHOWN = 0.25, 100.0, 3, 40
METHODS: dict[str, tuple[str, dict[str, Any]]] = {
    "simopt": ("simopt", {}),
    "adr": ("adr", {}),
    "maml": ("maml", {}),
    "simopt, learned reward": ("simopt", {"reward": "learned"}),
    "adr, learned reward": ("adr", {"reward": "learned"}),
}


@dataclass(frozen=True)
class Size:
    """What a task's control steps cost decides: those of a training, copies stepped together, evaluated episodes."""

    steps: int
    lanes: int
    episodes: int


SIZES = {
    "Fetch": Size(steps=2_400, lanes=4, episodes=10),
    "Relocate": Size(steps=2_400, lanes=2, episodes=5),
    "Door": Size(steps=2_400, lanes=2, episodes=5),
    "HalfCheetah": Size(steps=6_000, lanes=1, episodes=5),
    "Humanoid": Size(steps=2_400, lanes=1, episodes=1),
}


@dataclass(frozen=True)
class Budget:
    """Of a cell; ``steps`` None for the task's own."""

    start: str
    steps: int | None
    rollouts: int
    updates: int

    def folder(self, task: str, method: str, seed: int) -> Path:
        name = f"{self.start}-{self.steps or 'short'}-{self.rollouts}-{self.updates}"
        return RUNS / name / f"{task}-{method.replace(', ', '-').replace(' ', '_')}-{seed}"


def size(task: str) -> Size:
    return next(size for name, size in SIZES.items() if task.startswith(name))


def agent(task: str, steps: int) -> Settings:
    """As the expert's card has it, but: no demonstrations, a smaller step, and the critic a fifth of the steps ahead."""
    file = agent_file(task, "expert")
    assert file is not None
    settings = json.loads(file.with_suffix(".json").read_text(encoding="utf-8"))["deviations"]
    lanes = size(task).lanes
    settings |= {"demonstration_share": SHARE, "cloning": CLONING, "learning_rate": 3e-4, "lanes": lanes}
    settings |= {"start_steps": steps // 10, "actor_waits": steps // WAITS, "capacity": 2 * steps + 5_000}
    return Settings(**settings)


def run_cell(budget: Budget, task: str, method: str, seed: int) -> None:
    """Run or go on with a cell and write its ``cell.json``."""
    simulator = sipe.Simulator(sipe.make_task(task), num_threads=1)
    name, settings = METHODS[method]
    estimator = sipe.get_estimator(simulator, name, budget=budget.rollouts, seed=seed, **settings)
    out, begin, cpu = budget.folder(task, method, seed), time.perf_counter(), time.process_time()
    resumed = (out / "checkpoint" / "state.safetensors").exists()
    steps, expert = budget.steps or size(task).steps, budget.start == "expert"
    result = train_in_the_loop(
        estimator,
        VARIANT,
        steps,
        updates=budget.updates,
        trajectory_steps=Cell(task, name).horizon,
        settings=agent(task, steps) if expert else small_agent(simulator.task, steps),
        demonstrations=sipe.demonstrations(task, "expert", count=5 if task.startswith("Humanoid") else SHOWN)
        if expert
        else None,
        policy=load_policy(agent_file(task, "expert") or "") if expert else None,
        evaluation_episodes=size(task).episodes,
        folder=out,
        resume=True,
    )
    record = {
        "task": task,
        "method": method,
        "seed": seed,
        "start": budget.start,
        "steps": steps,
        "budget": budget.rollouts,
        "updates": budget.updates,
        "episodes": size(task).episodes,
        "cpu_seconds": None if resumed else round(time.process_time() - cpu, 1),
        "converged": result.converged,
        "solved_reference": result.solved_reference,
        "scores": scored(task, result.posterior),
        "warnings": result.warnings,
        "history": [asdict(row) for row in result.history],
    }
    write_text(out / "cell.json", to_json(record))
    accuracy = record["scores"]["mean_accuracy"]
    print(
        f"{task}/{method}/{seed}: accuracy {accuracy:.3f}, {record['converged']}, "
        f"{time.process_time() - cpu:.0f} CPU s, {time.perf_counter() - begin:.0f} s",
        flush=True,
    )


def scored(task: str, posterior: Posterior) -> dict[str, Any]:
    return score(posterior, sipe.make_task(task).theta(VARIANT)).to_dict()


@contextmanager
def claimed(out: Path) -> Iterator[bool]:
    """Whether the cell is this process's own: several may share the work, and one that ends sets its cell free."""
    out.mkdir(parents=True, exist_ok=True)
    with (out / ".lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            yield False
            return
        yield True


def run(budget: Budget, seeds: int, select: str) -> None:
    torch.set_num_threads(1)
    for seed, task, method in itertools.product(range(seeds), TASKS, METHODS):
        if select in f"{task}/{method}/{seed}":
            with claimed(out := budget.folder(task, method, seed)) as mine:
                if mine and not (out / "cell.json").exists():
                    run_cell(budget, task, method, seed)
                    for part in ("checkpoint", "policy.safetensors"):  # large, and the cell is over
                        path = out / part
                        shutil.rmtree(path) if path.is_dir() else path.unlink()


def shipped(task: str) -> dict[str, Any]:
    """What the shipped expert does in simulators drawn from the prior, and in the reference, as it is."""
    environment = sipe.make_task(task)
    simulator, policy = sipe.Simulator(environment, num_threads=1), load_policy(agent_file(task, "expert") or "")
    count = 50 if not task.startswith("Humanoid") else 5
    drawn = np.random.default_rng(0).uniform(size=(count, len(environment.space)))
    inside, outside = (
        evaluate(policy, simulator, count, STARTS.loop, theta=theta) for theta in (drawn, environment.theta(VARIANT))
    )
    return {"prior": asdict(inside), "reference": asdict(outside)}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=("run", "table"))
    parser.add_argument("--start", choices=("expert", "scratch"), default="expert", help="what the agent begins as")
    parser.add_argument("--steps", type=int, help="control steps of a cell's training, default the task's own")
    parser.add_argument("--budget", type=int, default=300, help="rollouts of a cell's estimator")
    parser.add_argument("--updates", type=int, default=2, help="of the estimate")
    parser.add_argument("--seeds", type=int, default=3, help="how many")
    parser.add_argument("--select", default="", help="part of task/method/seed")
    given = parser.parse_args()
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    if given.command == "run":
        run(Budget(given.start, given.steps, given.budget, given.updates), given.seeds, given.select)
    else:
        table()
