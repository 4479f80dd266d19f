"""Demonstrations for ``sipe train --demonstrations``: whole episodes that end in success, made by command and seed.

Attempt i acts with a generator of its own, so the same seed gives the same demonstrations and fewer of them begin
alike. What fails is left out, and counted. A file ``NAME.npz`` of trajectories has ``NAME.json`` beside it, which says
how it was made and goes onto the card of an agent that learnt from it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from sipe_bayes.core.arrays import BoolArray
from sipe_bayes.core.files import read_json, to_json, write_text
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.core.validation import whole
from sipe_bayes.envs.registry import make_task
from sipe_bayes.envs.tasks.adroit import Adroit
from sipe_bayes.rl import planning, scripted
from sipe_bayes.rl.planning import Report
from sipe_bayes.rl.randomization import Draws
from sipe_bayes.rl.scripted import Demonstrator
from sipe_bayes.simulation.episodes import Episodes
from sipe_bayes.simulation.simulator import Simulator

_KEY = 4  # of the generators: other ones than those of trajectory sets, evaluations and training


@dataclass(frozen=True)
class Facts:
    """How a file of demonstrations was made.

    Args:
        task: that they show.
        command: that made them.
        seed: of the attempts.
        by: "scripted controller" or "open-loop plan".
        count: how many there are.
        attempts: how many were tried for them.
        return_mean: that they earn.
        iterations: of the search for a plan; None without one.
        score: of the plan.
    """

    task: str
    command: str
    seed: int
    by: str
    count: int
    attempts: int
    return_mean: float
    iterations: int | None = None
    score: float | None = None


@dataclass(frozen=True)
class Demonstrations:
    """Episodes that succeeded, and how many were tried for them."""

    trajectories: Trajectories
    attempts: int

    @property
    def return_mean(self) -> float:
        """What they earn on average."""
        rewards = self.trajectories.rewards
        assert rewards is not None
        return float(rewards.sum(1).mean())


def make(
    task: str, count: int, seed: int, path: Path, command: str = "", threads: int = 1, report: Report | None = None
) -> Facts:
    """Write demonstrations of a task, and the facts about them beside the file.

    A plan that is searched lies beside it as well, and another call goes on with it.

    Args:
        task: which.
        count: episodes that succeed.
        seed: of the attempts.
        path: an npz file.
        command: that asked for them.
        threads: of the simulation.
        report: is told how far a search is.

    Raises:
        ValueError: for a task that nothing demonstrates.
    """
    if task not in (known := (*scripted.TASKS, *planning.OUTLINES)):
        raise ValueError(f"task {task}: expected one of {', '.join(known)}; others learn without demonstrations")
    made = make_task(task)
    simulator = Simulator(made, threads)
    path.parent.mkdir(parents=True, exist_ok=True)
    by, iterations, score = "scripted controller", None, None
    if isinstance(made, Adroit):
        plan = planning.plan(simulator, seed, checkpoint=path.with_suffix(".plan"), report=report)
        act = planning.demonstrator(made, plan)
        by, iterations, score = "open-loop plan", plan.iterations, plan.score
    else:
        act = scripted.demonstrator(made)
    shown = demonstrate(simulator, act, count, seed)
    made_of = len(shown.trajectories), shown.attempts, shown.return_mean
    facts = Facts(task, command, seed, by, *made_of, iterations, score)
    shown.trajectories.save(path)
    plain = {name: value for name, value in asdict(facts).items() if value is not None}
    write_text(path.with_suffix(".json"), to_json(plain, indent=2))
    return facts


def facts_of(path: Path) -> dict[str, object]:
    """What lies beside a file of demonstrations; its name alone where nothing does.

    Raises:
        ValueError: for a file beside it that cannot be read.
    """
    beside = path.with_suffix(".json")
    if not beside.exists():
        return {"file": path.name}
    return {"file": path.name, **read_json(beside, "facts of demonstrations", "make them again, or delete it")}


def demonstrate(
    simulator: Simulator, act: Demonstrator, count: int, seed: int = 0, draws: Draws | None = None, patience: int = 10
) -> Demonstrations:
    """The first successful episodes.

    Args:
        simulator: of the task.
        act: how they are done.
        count: how many.
        seed: of the attempts.
        draws: parameters of each episode; without them the published ones.
        patience: attempts for each demonstration, at most.

    Raises:
        ValueError: for arguments out of range.
        RuntimeError: where too few attempts succeed.
    """
    whole("count", count)
    whole("seed", seed, 0)
    kept: dict[int, Trajectory] = {}
    tried = 0
    while len(kept) < count:
        if tried >= patience * count:
            raise RuntimeError(f"count: {len(kept)} of {tried} attempts succeeded, expected {count}; ask for fewer")
        batch, succeeded = record(simulator, act, range(tried, tried + count), seed, draws)
        kept |= {tried + i: batch[i] for i in np.flatnonzero(succeeded).tolist()}
        tried += count
    chosen = sorted(kept)[:count]
    return Demonstrations(Trajectories.stack(kept[i] for i in chosen), chosen[-1] + 1)


def record(
    simulator: Simulator, act: Demonstrator, attempts: Sequence[int], seed: int = 0, draws: Draws | None = None
) -> tuple[Trajectories, BoolArray]:
    """An episode for each attempt.

    Args:
        simulator: of the task.
        act: how it is done.
        attempts: their numbers (B,).
        seed: of all.
        draws: parameters of each episode; without them the published ones.

    Returns:
        The episodes, and which (B,) ended in success without diverging.
    """
    task = simulator.task
    rngs = [np.random.default_rng([seed, attempt, 0, _KEY]) for attempt in attempts]
    theta, count = task.theta("default"), len(rngs)
    if draws is not None:
        theta = np.concatenate([draws(np.random.default_rng([seed, attempt, 1, _KEY]), 1) for attempt in attempts])
    batch = Episodes(simulator, theta, rngs, allow_outside=True)
    horizon, success, valid = task.episode_steps, np.zeros(count, bool), np.ones((count, task.episode_steps + 1), bool)
    observations, states, actions, rewards = [batch.observations.copy()], [batch.states.copy()], [], []
    for t in range(horizon):
        chosen = np.clip(act(observations[-1], t, rngs), task.action_low, task.action_high)
        actions.append(chosen.astype(np.float32).astype(float))
        step = batch.step(actions[-1])
        observations.append(step.observations)
        states.append(batch.states.copy())
        rewards.append(step.rewards)
        valid[:, t + 1] = valid[:, t] & step.valid
        if step.success is not None:
            success = step.success
    episodes = Trajectories(
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
    return episodes, success & valid[:, -1]
