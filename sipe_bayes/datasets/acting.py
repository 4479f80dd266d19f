"""How an agent, a random policy or an excitation policy acts in a task, and the trajectories that come of it.

Each trajectory has a random generator of its own, ``default_rng([seed, split, number, ...])``, so that more of them
begin with the same ones and splits are disjoint; expert, suboptimal and random ones have different ones as well. The
variants of a task share theirs: trajectory i of each starts alike, which pairs comparisons between variants.

- An agent acts on what it observes, in closed loop. It is deterministic: in a task that always starts from the same
  state (the Adroit hand's) all its trajectories would be one, so there its actions get Gaussian noise of 0.05 of the
  half range.
- The random policy draws every action anew, uniform between the bounds.
- The excitation policy is the task's own where it has one (Fetch: the hand moves the object), else smooth and open
  loop: for each action a sum of five sines between 0.1 and 2 Hz with random frequencies, phases and shares of an
  amplitude of 0.8 of the half range, so that the bounds are kept. It shows the dynamics, not the task.

Agents' and random actions are rounded to float32, in which trajectory sets keep them: what is stored is what was done.
Nothing ends an episode: a robot may fall and an arm may miss its object, and it goes on for the number of steps asked
for.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.envs.task import Task
from sipe_bayes.simulation.simulator import Simulator

Agent = Literal["expert", "suboptimal", "random"]
Split = Literal["reference", "validation", "test"]
Policy = Callable[[FloatArray], FloatArray]
"""Actions (B, A) of observations (B, O)."""

AGENTS: tuple[Agent, ...] = ("expert", "suboptimal", "random")
SPLITS: tuple[Split, ...] = ("reference", "validation", "test")


@dataclass(frozen=True)
class Excitation:
    """Smooth actions, and an agent's where every episode starts alike.

    Args:
        sines: of each action.
        slowest: of them, Hz.
        fastest: of them, Hz.
        amplitude: of their sum, of half the action's range.
        noise: sd of an agent's actions where every episode starts alike, of half the action's range.
    """

    sines: int = 5
    slowest: float = 0.1
    fastest: float = 2.0
    amplitude: float = 0.8
    noise: float = 0.05


EXCITATION = Excitation()


@dataclass(frozen=True)
class Behaviour:
    """What decides the actions.

    Args:
        plan: (steps, generator) -> (T, A) before the start.
        respond: (observations (1, O), the planned action (A,), generator) -> (A,), or None in open loop.
        key: what its generators are seeded with besides seed, split and number.
        single: whether actions are rounded to float32.
    """

    plan: Callable[[int, np.random.Generator], FloatArray]
    respond: Callable[[FloatArray, FloatArray, np.random.Generator], FloatArray] | None = None
    key: tuple[int, ...] = ()
    single: bool = True


def agent(task: Task, policy: Policy, type: Agent) -> Behaviour:
    """A deterministic policy's, one observation at a time: the bits do not depend on the number of trajectories."""
    low, high, size = task.action_low, task.action_high, task.num_actions
    noise = action_noise(task)
    return Behaviour(
        lambda steps, rng: noise * rng.standard_normal((steps, size)),
        lambda seen, planned, rng: np.clip(np.asarray(policy(seen), float)[0] + planned, low, high),
        _key(type),
    )


def random(task: Task) -> Behaviour:
    """Uniform actions, each step anew."""
    size = task.num_actions
    return Behaviour(
        lambda steps, rng: rng.uniform(task.action_low, task.action_high, (steps, size)), key=_key("random")
    )


def excitation(task: Task, dt: float) -> Behaviour:
    """The excitation policy's, with control steps of ``dt`` seconds."""

    def respond(seen: FloatArray, planned: FloatArray, rng: np.random.Generator) -> FloatArray:
        chosen = task.excitation(seen, rng)
        return planned if chosen is None else chosen[0]

    own = type(task).excitation is not Task.excitation
    return Behaviour(lambda steps, rng: smooth_actions(task, dt, steps, rng), respond if own else None, single=False)


def smooth_actions(task: Task, dt: float, steps: int, rng: np.random.Generator) -> FloatArray:
    """The open-loop excitation's actions (T, A) at control steps of ``dt`` seconds, within the task's bounds."""
    of = EXCITATION
    shape = (task.num_actions, of.sines)
    frequency = np.exp(rng.uniform(np.log(of.slowest), np.log(of.fastest), shape))
    phase, share = rng.uniform(0, 2 * np.pi, shape), rng.dirichlet(np.ones(of.sines), task.num_actions)
    time = np.arange(steps)[:, None, None] * dt
    wave = (share * np.sin(2 * np.pi * frequency * time + phase)).sum(-1)
    centre, half = (task.action_low + task.action_high) / 2, (task.action_high - task.action_low) / 2
    return np.asarray(centre + of.amplitude * half * wave)


@dataclass(frozen=True)
class Recording:
    """Which trajectories: of which split, how many, of which seed, and how many control steps each."""

    split: Split
    count: int
    seed: int
    steps: int


def simulate(
    simulator: Simulator, theta: FloatArray, behaviour: Behaviour, asked: Recording
) -> tuple[Trajectories, FloatArray | None]:
    """Trajectories of a behaviour.

    Args:
        simulator: of a task.
        theta: (N,).
        behaviour: how it acts.
        asked: which.

    Returns:
        The trajectories, and their goals (B, G) or None.

    Raises:
        RuntimeError: where a simulation diverges.
    """
    task, count = simulator.task, asked.count
    begin = [asked.seed, SPLITS.index(asked.split)]
    rngs = [np.random.default_rng([*begin, i, *behaviour.key]) for i in range(count)]
    drawn = [task.initial_states(rng, 1) for rng in rngs]
    states = np.concatenate([state for state, _ in drawn])
    given = [goal for _, goal in drawn if goal is not None]
    goals = np.concatenate(given) if given else None
    actions = np.stack([behaviour.plan(asked.steps, rng) for rng in rngs])
    if behaviour.respond is not None:
        actions = _closed_loop(simulator, theta, behaviour, states, goals, actions, rngs)
    elif behaviour.single:
        actions = _rounded(actions)
    motion = simulator.rollout(np.tile(theta, (count, 1)), actions, states, allow_outside=True, goals=goals)
    if not motion.valid.all():
        raise RuntimeError(
            f"demonstrations: {int((~motion.valid[:, -1]).sum())} of {count} simulations of {task.name} diverged; "
            "take another seed, or fewer steps"
        )
    return replace(motion, names=tuple(f"{asked.split}_{i}" for i in range(count))), goals


def _closed_loop(
    simulator: Simulator,
    theta: FloatArray,
    behaviour: Behaviour,
    states: FloatArray,
    goals: FloatArray | None,
    planned: FloatArray,
    rngs: list[np.random.Generator],
) -> FloatArray:
    """Actions (B, T, A) from starting states (B, S), control step by control step.

    The state is Markov: rolled out whole they give the same motion to the last bit.
    """
    respond, actions, rows = behaviour.respond, np.empty_like(planned), np.tile(theta, (len(states), 1))
    assert respond is not None
    seen = simulator.rollout(rows, np.zeros_like(planned[:, :1]), states, allow_outside=True, goals=goals).observations
    seen = seen[:, 0]
    for t in range(planned.shape[1]):
        chosen = [respond(o[None], p, rng) for o, p, rng in zip(seen, planned[:, t], rngs, strict=True)]
        actions[:, t] = _rounded(np.stack(chosen)) if behaviour.single else np.stack(chosen)
        moved = simulator.rollout(rows, actions[:, t : t + 1], states, allow_outside=True, goals=goals)
        assert moved.states is not None
        if not moved.valid.all():
            actions[:, t + 1 :] = 0.0  # the whole rollout will tell
            return actions
        states, seen = moved.states[:, 1], moved.observations[:, 1]
    return actions


def _rounded(actions: FloatArray) -> FloatArray:
    return actions.astype(np.float32).astype(np.float64)


def _key(type: Agent) -> tuple[int, ...]:
    """Never zero: NumPy seeds a sequence as if zeros followed it."""
    return (1 + AGENTS.index(type),)


def action_noise(task: Task) -> float:
    """Sd of the noise on a deterministic agent's actions: zero but where every episode starts alike."""
    first, second = (task.initial_states(np.random.default_rng(seed), 1) for seed in (0, 1))
    alike = all(a is b or np.array_equal(np.asarray(a), np.asarray(b)) for a, b in zip(first, second, strict=True))
    return EXCITATION.noise * (task.action_high - task.action_low) / 2 if alike else 0.0
