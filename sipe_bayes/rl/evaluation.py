"""What a policy earns: episodes in batched lanes, and the card that goes with an agent's file.

The card of ``<name>.safetensors`` is ``<name>.json``: the command, the seed and the steps that made it, what it deviates in,
and an evaluation with its standard errors, next to those of a policy that does nothing and of one that acts at random.
"""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sipe_bayes.core.files import replacing, to_json, write_text
from sipe_bayes.datasets import acting
from sipe_bayes.envs.registry import make_task
from sipe_bayes.envs.task import Task
from sipe_bayes.models.policy import Controller, load_policy
from sipe_bayes.simulation.episodes import Episodes
from sipe_bayes.simulation.simulator import Simulator

FloatArray = NDArray[np.float64]

AGENTS = Path(__file__).parents[1] / "data" / "agents"
EPISODES = 100
_SEED = 1_000_000  # of a check's starts: other ones than a card's


def evaluate(
    policy: Controller,
    task: str | Task | Simulator,
    episodes: int = EPISODES,
    seed: int = 0,
    theta: FloatArray | None = None,
    variant: str = "default",
    action_noise: float | None = None,
) -> dict[str, Any]:
    """``episodes`` episodes, a lane for each, lane i seeded with [seed, i].

    theta: (N,) or (episodes, N), default the variant's. action_noise: sd of Gaussian noise on the actions, default
    ``acting.action_noise``: without it the episodes of a task that always starts alike would be one. Returns mean, sd and
    standard_error of the undiscounted return, success_rate (done at an episode's last step) and its success_error, None where
    only the return counts, the number of episodes, and that of diverged ones. Raises ValueError for a policy of other sizes.
    """
    task = make_task(task) if isinstance(task, str) else task
    simulator = task if isinstance(task, Simulator) else Simulator(task, 1)
    if not isinstance(simulator.environment, Task):
        raise ValueError("task: expected a simulator of one of `sipe envs`, as only those have rewards")
    if episodes < 1:
        raise ValueError(f"episodes: expected at least 1, got {episodes}")
    given = simulator.environment.theta(variant) if theta is None else np.asarray(theta, float)
    generators = [np.random.default_rng([seed, i]) for i in range(episodes)]
    lanes = Episodes(simulator, given, generators, allow_outside=True)
    environment = simulator.environment
    sd = acting.action_noise(environment) if action_noise is None else action_noise
    noise = [np.random.default_rng([seed, i, 1]) for i in range(episodes)] if sd else []
    low, high, size = environment.action_low, environment.action_high, environment.num_actions
    step, running = lanes.first(), np.ones(episodes, bool)
    returns, success, diverged = np.zeros(episodes), np.zeros(episodes, bool), np.zeros(episodes, bool)
    while running.any():
        actions = policy(step.observations)
        if noise:
            actions = np.clip(actions + sd * np.stack([rng.standard_normal(size) for rng in noise]), low, high)
        step = lanes.step(actions)
        returns[running] += step.rewards[running]
        ended = running & (step.terminated | step.truncated)
        diverged |= running & ~step.valid
        if step.success is not None:
            success[ended] = step.success[ended]
        running &= ~ended
    measured = step.success is not None
    rate = float(success.mean()) if measured else None
    return {
        "episodes": episodes,
        "seed": seed,
        "mean": float(returns.mean()),
        "sd": float(returns.std(ddof=min(1, episodes - 1))),
        "standard_error": float(returns.std(ddof=min(1, episodes - 1)) / math.sqrt(episodes)),
        "success_rate": rate,
        "success_error": None if rate is None else math.sqrt(rate * (1 - rate) / episodes),
        "diverged": int(diverged.sum()),
    }


def idle(task: Task) -> Controller:
    """Does nothing: the middle of the action range."""
    middle = (task.action_low + task.action_high) / 2
    return lambda observations: np.full((len(observations), task.num_actions), middle)


def random(task: Task, seed: int = 0) -> Controller:
    """Uniformly random actions."""
    rng = np.random.default_rng(seed)
    return lambda observations: rng.uniform(task.action_low, task.action_high, (len(observations), task.num_actions))


_WITHOUT_SENSE: dict[str, Callable[[Task], Controller]] = {"idle": idle, "random": random}


def beside(task: Task, episodes: int = EPISODES) -> dict[str, dict[str, Any]]:
    """What a policy that does nothing and one that acts at random earn: ``idle`` and ``random`` of a card."""
    return {name: evaluate(make(task), task, episodes, action_noise=0.0) for name, make in _WITHOUT_SENSE.items()}


def write_card(
    path: Path, task: Task, facts: dict[str, Any], others: dict[str, dict[str, Any]], episodes: int = EPISODES
) -> dict[str, Any]:
    """Evaluate the agent in the file ``path``, write its card beside it and return that. others: ``beside`` of the task."""
    card = {
        "task": task.name,
        **facts,
        "evaluation": evaluate(load_policy(path, task.name), task, episodes),
        **others,
        "solved_at": {"measure": task.solved.measure, "threshold": task.solved.threshold},
    }
    write_text(path.with_suffix(".json"), to_json(card, indent=2))
    return card


def install(folder: Path, into: Path = AGENTS) -> list[Path]:
    """Copy the pair of agents that a run left in ``folder``, with their cards, to where a task's agents are looked for; returns
    the agents' files."""
    pairs = []
    for name in ("expert", "suboptimal"):
        path = folder / f"{name}.safetensors"
        policy = load_policy(path)
        if not path.with_suffix(".json").is_file():
            raise FileNotFoundError(f"{path}: has no card {name}.json; let `sipe train --resume` finish")
        pairs.append((path, into / f"{policy.task}-{name}.safetensors"))
    into.mkdir(parents=True, exist_ok=True)
    for path, there in pairs:
        for suffix in (".json", ".safetensors"):  # an agent never without its card
            with replacing(there.with_suffix(suffix)) as temporary:
                shutil.copyfile(path.with_suffix(suffix), temporary)
    return [there for _, there in pairs]


def check_agents(folder: Path = AGENTS, episodes: int = EPISODES) -> Iterator[dict[str, Any]]:
    """For each agent in ``folder`` with a card: agent, card and found evaluations, and ``agrees``: whether the returns, and
    the success rates where there are any, lie within two standard errors of their difference."""
    files = sorted(folder.glob("*.safetensors"))
    if not files:
        raise FileNotFoundError(f"{folder}: no agents; train one with `sipe train`")
    for path in files:
        try:
            card = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
            stated = card["evaluation"]
        except (OSError, ValueError, KeyError) as error:
            raise ValueError(f"{path}: its card {path.stem}.json cannot be read ({error}); make it again") from None
        policy = load_policy(path)
        found = evaluate(policy, policy.task, episodes, _SEED)
        yield {"agent": path.stem, "task": policy.task, "card": stated, "found": found, "agrees": _agree(stated, found)}


def _agree(stated: dict[str, Any], found: dict[str, Any]) -> bool:
    agrees = True
    for value, error in (("mean", "standard_error"), ("success_rate", "success_error")):
        if found[value] is not None:
            bound = 2 * math.hypot(stated[error], found[error])
            agrees &= abs(stated[value] - found[value]) <= bound + 1e-9 * abs(stated[value])
    return agrees
