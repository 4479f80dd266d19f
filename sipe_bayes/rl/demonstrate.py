"""Demonstrations for ``sipe train --demonstrations``: whole episodes that end in success, made by command and seed.

Attempt i acts with a generator of its own, so the same seed gives the same demonstrations and fewer of them begin alike. What fails
is left out, and counted. A file ``NAME.npz`` of trajectories has ``NAME.json`` beside it, which says how it was made and
goes onto the card of an agent that learnt from it.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sipe_bayes.core.files import to_json, write_text
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.envs.registry import make_task
from sipe_bayes.envs.task import Task
from sipe_bayes.envs.tasks.adroit import Adroit
from sipe_bayes.rl import planning, scripted
from sipe_bayes.rl.planning import Report
from sipe_bayes.rl.randomization import Draws
from sipe_bayes.rl.scripted import Demonstrator
from sipe_bayes.simulation.episodes import Episodes
from sipe_bayes.simulation.simulator import Simulator

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_KEY = 4  # of the generators: other ones than those of trajectory sets, evaluations and training
_PATIENCE = 10  # attempts for each demonstration, at most


@dataclass(frozen=True)
class Demonstrations:
    """Episodes that succeeded, and how many were tried for them."""

    trajectories: Trajectories
    attempts: int

    @property
    def facts(self) -> dict[str, Any]:
        rewards = self.trajectories.rewards
        assert rewards is not None
        return {
            "count": len(self.trajectories),
            "attempts": self.attempts,
            "return_mean": float(rewards.sum(1).mean()),
        }


def make(
    task: str, count: int, seed: int, path: Path, command: str = "", threads: int = 1, report: Report | None = None
) -> dict[str, Any]:
    """Write demonstrations of a task to ``path``, an npz file, and the facts that it returns beside it; a plan that is searched
    lies beside it as well, and another call goes on with it. Raises ValueError for a task that nothing demonstrates."""
    if task not in (known := (*scripted.TASKS, *planning.OUTLINES)):
        raise ValueError(f"task {task}: expected one of {', '.join(known)}; others learn without demonstrations")
    made, facts = make_task(task), {"task": task, "command": command, "seed": seed}
    simulator = Simulator(made, threads)
    path.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(made, Adroit):
        found = planning.plan(simulator, seed, checkpoint=path.with_suffix(".plan"), report=report)
        act = planning.demonstrator(made, found)
        facts |= {"by": "open-loop plan", "iterations": found.iterations, "score": found.score}
    else:
        act, facts = scripted.demonstrator(made), {**facts, "by": "scripted controller"}
    shown = demonstrate(simulator, act, count, seed)
    facts |= shown.facts
    shown.trajectories.save(path)
    write_text(path.with_suffix(".json"), to_json(facts, indent=2))
    return facts


def facts_of(path: Path) -> dict[str, Any]:
    """What lies beside a file of demonstrations; its name alone where nothing does."""
    beside = path.with_suffix(".json")
    try:
        found = json.loads(beside.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return {"file": path.name}
    except ValueError as error:
        raise ValueError(
            f"--demonstrations {beside}: cannot be read ({error}); make them again, or delete it"
        ) from None
    return {"file": path.name, **found}


def demonstrate(
    simulator: Simulator, act: Demonstrator, count: int, seed: int = 0, draws: Draws | None = None
) -> Demonstrations:
    """The first ``count`` successful episodes, each at parameters of its own from ``draws``, without them at the published ones;
    raises ValueError for arguments out of range, and RuntimeError where too few attempts succeed."""
    if count < 1 or seed < 0:
        raise ValueError(f"count and seed: expected at least 1 and 0, got {count} and {seed}")
    kept: dict[int, Trajectory] = {}
    tried = 0
    while len(kept) < count:
        if tried >= _PATIENCE * count:
            raise RuntimeError(f"count: {len(kept)} of {tried} attempts succeeded, expected {count}; ask for fewer")
        batch, succeeded = record(simulator, act, range(tried, tried + count), seed, draws)
        kept |= {tried + i: batch[i] for i in np.flatnonzero(succeeded).tolist()}
        tried += count
    chosen = sorted(kept)[:count]
    return Demonstrations(Trajectories.stack(kept[i] for i in chosen), chosen[-1] + 1)


def record(
    simulator: Simulator, act: Demonstrator, attempts: Sequence[int], seed: int = 0, draws: Draws | None = None
) -> tuple[Trajectories, BoolArray]:
    """An episode for each of the ``attempts`` (B), and which (B,) ended in success without diverging."""
    task = simulator.environment
    assert isinstance(task, Task)
    rngs = [np.random.default_rng([seed, attempt, 0, _KEY]) for attempt in attempts]
    theta, count = task.theta("default"), len(rngs)
    if draws is not None:
        theta = np.concatenate([draws(np.random.default_rng([seed, attempt, 1, _KEY]), 1) for attempt in attempts])
    lanes = Episodes(simulator, theta, rngs, allow_outside=True)
    horizon, success, valid = task.episode_steps, np.zeros(count, bool), np.ones((count, task.episode_steps + 1), bool)
    observations, states, actions, rewards = [lanes.observations.copy()], [lanes.states.copy()], [], []
    for t in range(horizon):
        chosen = np.clip(act(observations[-1], t, rngs), task.action_low, task.action_high)
        actions.append(chosen.astype(np.float32).astype(float))
        step = lanes.step(actions[-1])
        observations.append(step.observations)
        states.append(lanes.states.copy())
        rewards.append(step.rewards)
        valid[:, t + 1] = valid[:, t] & step.valid
        if step.success is not None:
            success = step.success
    found = Trajectories(
        np.stack(observations, 1),
        np.stack(actions, 1),
        np.full(count, simulator.dt),
        np.full(count, horizon),
        valid,
        np.stack(states, 1),
        tuple(f"demonstration_{attempt}" for attempt in attempts),
        task.channels,
        np.stack(rewards, 1),
    )
    return found, success & valid[:, -1]
