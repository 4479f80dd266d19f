"""What a policy earns: episodes in a batch, and the card that goes with an agent's file.

The card of ``<name>.safetensors`` is ``<name>.json``: the command, the seed and the steps that made it, what it
deviates in, and an evaluation with its standard errors, next to those of a policy that does nothing and of one that
acts at random.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from pydantic import TypeAdapter

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.files import read_json, reading, replacing, to_json, write_text
from sipe_bayes.core.validation import whole
from sipe_bayes.datasets import acting
from sipe_bayes.datasets.demonstrations import AGENT_FILES
from sipe_bayes.envs.registry import make_task
from sipe_bayes.envs.task import Task
from sipe_bayes.models.policy import Controller, load_policy
from sipe_bayes.simulation.episodes import Episodes
from sipe_bayes.simulation.simulator import Simulator


@dataclass(frozen=True)
class Starts:
    """Episodes of a card, and the seeds of starting states, which differ between purposes.

    Args:
        episodes: of a card.
        card: its seed.
        check: of a card's check.
        curve: of a learning curve.
        loop: of the history of a policy in the loop.
        target: of the transfer's target.
    """

    episodes: int = 100
    card: int = 0
    check: int = 1_000_000
    curve: int = 2_000_000
    loop: int = 3_000_000
    target: int = 4_000_000


STARTS = Starts()


@dataclass(frozen=True)
class Evaluation:
    """What a policy earned.

    Args:
        episodes: how many.
        seed: of their starts.
        mean: of the undiscounted return.
        sd: of it.
        standard_error: of the mean.
        success_rate: share that is done at the last step; None where only the return counts.
        success_error: its standard error.
        diverged: episodes whose simulation diverged.
    """

    episodes: int
    seed: int
    mean: float
    sd: float
    standard_error: float
    success_rate: float | None = None
    success_error: float | None = None
    diverged: int = 0


def evaluate(
    policy: Controller,
    task: str | Task | Simulator,
    episodes: int = STARTS.episodes,
    seed: int = STARTS.card,
    theta: FloatArray | None = None,
    variant: str = "default",
    action_noise: float | None = None,
) -> Evaluation:
    """Run episodes side by side, episode i seeded with [seed, i].

    Args:
        policy: actions (B, A) of observations (B, O).
        task: its name, the task, or a simulator of one.
        episodes: how many.
        seed: of the starts.
        theta: (N,) or (episodes, N), default the variant's.
        variant: of the task.
        action_noise: sd of Gaussian noise on the actions, default ``acting.action_noise``: without it the episodes of a
            task that always starts alike would be one.

    Raises:
        ValueError: for a policy of other sizes, or a simulator of no task.
    """
    task = make_task(task) if isinstance(task, str) else task
    simulator = task if isinstance(task, Simulator) else Simulator(task, 1)
    environment = simulator.environment
    if not isinstance(environment, Task):
        raise ValueError("task: expected a simulator of one of `sipe envs`, as only those have rewards")
    whole("episodes", episodes)
    given = environment.theta(variant) if theta is None else np.asarray(theta, float)
    batch = Episodes(simulator, given, [np.random.default_rng([seed, i]) for i in range(episodes)], allow_outside=True)
    sd = acting.action_noise(environment) if action_noise is None else action_noise
    noise = [np.random.default_rng([seed, i, 1]) for i in range(episodes)] if sd else []
    low, high, size = environment.action_low, environment.action_high, environment.num_actions
    step, running = batch.first(), np.ones(episodes, bool)
    returns, success, diverged = np.zeros(episodes), np.zeros(episodes, bool), np.zeros(episodes, bool)
    while running.any():
        # act, with noise where every episode would be the same one
        actions = policy(step.observations)
        if noise:
            actions = np.clip(actions + sd * np.stack([rng.standard_normal(size) for rng in noise]), low, high)
        step = batch.step(actions)
        # count what the running episodes earned, and how those that are over ended
        returns[running] += step.rewards[running]
        ended = running & (step.terminated | step.truncated)
        diverged |= running & ~step.valid
        if step.success is not None:
            success[ended] = step.success[ended]
        running &= ~ended
    rate = None if step.success is None else float(success.mean())
    spread = float(returns.std(ddof=min(1, episodes - 1)))
    return Evaluation(
        episodes=episodes,
        seed=seed,
        mean=float(returns.mean()),
        sd=spread,
        standard_error=float(spread / math.sqrt(episodes)),
        success_rate=rate,
        success_error=None if rate is None else math.sqrt(rate * (1 - rate) / episodes),
        diverged=int(diverged.sum()),
    )


def idle(task: Task) -> Controller:
    """Does nothing: the middle of the action range."""
    middle = (task.action_low + task.action_high) / 2
    return lambda observations: np.full((len(observations), task.num_actions), middle)


def random(task: Task, seed: int = 0) -> Controller:
    """Uniformly random actions of a generator of one's own."""
    rng = np.random.default_rng(seed)
    return lambda observations: rng.uniform(task.action_low, task.action_high, (len(observations), task.num_actions))


_REFERENCES: dict[str, Callable[[Task], Controller]] = {"idle": idle, "random": random}


def references(task: Task, episodes: int = STARTS.episodes) -> dict[str, Evaluation]:
    """What a policy that does nothing and one that acts at random earn: ``idle`` and ``random`` of a card."""
    return {name: evaluate(make(task), task, episodes, action_noise=0.0) for name, make in _REFERENCES.items()}


def write_card(
    path: Path,
    task: Task,
    facts: Mapping[str, object],
    others: Mapping[str, Evaluation],
    episodes: int = STARTS.episodes,
) -> Evaluation:
    """Evaluate an agent and write its card beside it.

    Args:
        path: the agent's file.
        task: what it does.
        facts: what else the card says, such as command and seed.
        others: ``references`` of the task.
        episodes: of the evaluation.

    Returns:
        The card's evaluation.
    """
    evaluation = evaluate(load_policy(path, task.name), task, episodes)
    card = {
        "task": task.name,
        **facts,
        "evaluation": asdict(evaluation),
        **{name: asdict(other) for name, other in others.items()},
        "solved_at": {"measure": task.solved.measure, "threshold": task.solved.threshold},
    }
    write_text(path.with_suffix(".json"), to_json(card, indent=2))
    return evaluation


def read_card(path: Path) -> Evaluation:
    """The evaluation on the card beside an agent's file; raises ValueError for one that is missing or damaged."""
    card, what, remedy = path.with_suffix(".json"), f"the card of {path.name}", "make it again"
    plain = read_json(card, what, remedy)
    with reading(card, what, remedy):
        return TypeAdapter(Evaluation).validate_python(plain["evaluation"])


def install(folder: Path, into: Path = AGENT_FILES) -> list[Path]:
    """Copy the pair of agents that a run left, with their cards, to where a task's agents are looked for.

    Args:
        folder: of the run.
        into: where they are looked for.

    Returns:
        The agents' files.

    Raises:
        FileNotFoundError: for a run that is not finished.
    """
    pairs = []
    for name in ("expert", "suboptimal"):
        path = folder / f"{name}.safetensors"
        policy = load_policy(path)
        if not path.with_suffix(".json").is_file():
            raise FileNotFoundError(f"{path}: has no card {name}.json; let `sipe train --resume` finish")
        pairs.append((path, into / f"{policy.task}-{name}.safetensors"))
    into.mkdir(parents=True, exist_ok=True)
    for path, copy in pairs:
        for suffix in (".json", ".safetensors"):  # an agent never without its card
            with replacing(copy.with_suffix(suffix)) as temporary:
                shutil.copyfile(path.with_suffix(suffix), temporary)
    return [copy for _, copy in pairs]


@dataclass(frozen=True)
class CardCheck:
    """An agent's card against a new evaluation.

    Args:
        agent: its file's name.
        card: what the card says.
        now: what it earns now, from other starts.
    """

    agent: str
    card: Evaluation
    now: Evaluation

    @property
    def agrees(self) -> bool:
        """Whether returns, and success rates if any, lie within two standard errors of their difference."""
        card, now = self.card, self.now
        pairs = [(card.mean, card.standard_error, now.mean, now.standard_error)]
        if now.success_rate is not None:
            assert card.success_rate is not None
            pairs.append((card.success_rate, card.success_error or 0.0, now.success_rate, now.success_error or 0.0))
        return all(abs(a - b) <= 2 * math.hypot(s, t) + 1e-9 * abs(a) for a, s, b, t in pairs)


def check_agents(folder: Path = AGENT_FILES, episodes: int = STARTS.episodes) -> Iterator[CardCheck]:
    """Evaluate each agent in a folder anew.

    Raises:
        FileNotFoundError: for a folder without agents.
        ValueError: for a card that is missing or damaged.
    """
    files = sorted(folder.glob("*.safetensors"))
    if not files:
        raise FileNotFoundError(f"{folder}: no agents; train one with `sipe train`")
    for path in files:
        card, policy = read_card(path), load_policy(path)
        yield CardCheck(path.stem, card, evaluate(policy, policy.task, episodes, STARTS.check))
