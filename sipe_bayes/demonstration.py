"""Demonstrations of a benchmark task: trajectories of an agent in an environment of known or hidden parameters.

``sipe.demonstrations(env, type="expert")``. An agent's file is looked for in ``sipe_bayes/data/agents``. Where there is none,
an excitation policy stands in, and a UserWarning says so, from the task's own starting states: the task's ``excitation``
where it has one (Fetch: the hand moves the object), else smooth random actions, open loop. For each action a sum of five sines between 0.1 and 2 Hz with random frequencies, phases and shares of an amplitude
of 0.8 of the action's half range, so that its bounds are kept. Such a trajectory shows the dynamics, not the task: an arm may
miss its object, a robot may fall, and it goes on after that, all ``episode_steps`` long.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from sipe_bayes.envs.registry import make_task
from sipe_bayes.envs.task import Task
from sipe_bayes.simulator import Simulator
from sipe_bayes.trajectory import Trajectories, Trajectory

FloatArray = NDArray[np.float64]
Agent = Literal["expert", "suboptimal"]
Split = Literal["reference", "validation", "test"]

AGENTS = ("expert", "suboptimal")
SPLITS = ("reference", "validation", "test")
COUNT = 2  # trajectories where none is asked for
_FOLDER = Path(__file__).parent / "data" / "agents"
_SINES, _SLOWEST, _FASTEST, _AMPLITUDE = 5, 0.1, 2.0, 0.8  # number, Hz, Hz, of half the action's range


def demonstrations(
    env: Any,
    type: Agent = "expert",
    split: Split = "reference",
    *,
    count: int = COUNT,
    seed: int = 0,
    steps: int | None = None,
) -> Trajectories:
    """``count`` trajectories of ``steps`` control steps, default an episode, with states and rewards.

    env: a task's name, a Task, a Simulator of one, or a Gymnasium environment of ``sipe.make`` (its parameters decide the
    dynamics; the others' are the published model's). type: expert or suboptimal. split: reference, validation or test;
    they differ in starting states and actions. The same arguments give the same trajectories. Raises ValueError for what has no
    starting states, and RuntimeError where a simulation diverges.
    """
    for name, value, known in (("type", type, AGENTS), ("split", split, SPLITS)):
        if value not in known:
            raise ValueError(f"{name}: expected one of {', '.join(known)}, got {value!r}")
    simulator, theta = simulator_of(env)
    task = simulator.environment
    if not isinstance(task, Task):
        raise ValueError(
            f"env: {task.__class__.__name__} has no starting states; record logs, or take a task of `sipe envs`"
        )
    horizon = task.episode_steps if steps is None else steps
    if count < 1 or horizon < 1:
        raise ValueError(f"count and steps: expected at least 1 of each, got {count} and {horizon}")
    if agent_file(task.name, type) is not None:
        raise NotImplementedError(
            f"type: the agent {agent_file(task.name, type)} cannot be read by this version; upgrade"
        )
    warnings.warn(
        f"demonstrations: no {type} agent of {task.name} is installed; an excitation policy was used instead",
        UserWarning,
        stacklevel=_caller(),
    )
    return _excited(simulator, task, theta, split, count, seed, horizon)


def _caller() -> int:
    """The stack level, from ``demonstrations``, of the first line outside the package: a warning belongs to it."""
    package, frame, level = str(Path(__file__).parent), sys._getframe(1), 1
    while frame.f_back is not None and frame.f_code.co_filename.startswith(package):
        frame, level = frame.f_back, level + 1
    return level


def agent_file(task: str, type: str) -> Path | None:
    """The file of a task's agent, or None where it is not installed."""
    path = _FOLDER / f"{task}-{type}.safetensors"
    return path if path.is_file() else None


def simulator_of(env: Any) -> tuple[Simulator, FloatArray]:
    """The simulator of a task's name, a Task, a Simulator or a Gymnasium environment of this library, and the theta (N,) that
    it stands for; raises TypeError for anything else."""
    if isinstance(env, str):
        env = make_task(env)
    if isinstance(env, Task):
        env = Simulator(env)
    if isinstance(env, Simulator):
        return env, env.space.default_theta
    inner = getattr(env, "unwrapped", env)
    simulator, theta = getattr(inner, "simulator", None), np.asarray(getattr(inner, "theta", np.nan), float)
    if not isinstance(simulator, Simulator):
        raise TypeError(
            f"env: expected a task's name, a Task, a Simulator or sipe.make(...), got {env.__class__.__name__}"
        )
    rows = np.atleast_2d(theta)
    if (rows != rows[0]).any():
        raise ValueError("env: its lanes differ in their parameters; give them one theta, or take sipe.make(...)")
    return simulator, rows[0]


def is_environment(given: Any) -> bool:
    """Whether ``given`` is what ``simulator_of`` takes, and not trajectories."""
    return isinstance(given, str | Task | Simulator) or hasattr(given, "unwrapped")


class Given:
    """Trajectories as an estimator is given them, time after time: the same objects give the same Trajectories, and an
    environment stands for its reference demonstrations, recorded once for each theta."""

    def __init__(self) -> None:
        self._key: tuple[Any, ...] = ()
        self._batch: Trajectories | None = None

    def stack(self, given: Any, anew: bool = False) -> Trajectories:
        """The trajectories of ``given``: one, several, or an environment. anew: read recorded ones again, as their arrays may
        have changed."""
        if isinstance(given, Trajectories):
            return given
        if is_environment(given):
            return self._kept(_identity(given), lambda: demonstrations(given))
        items = (given,) if isinstance(given, Trajectory) else tuple(given) if isinstance(given, list | tuple) else ()
        if not isinstance(given, Trajectory | list | tuple) or not all(isinstance(item, Trajectory) for item in items):
            raise ValueError(
                f"trajectories: expected a Trajectory, several, or an environment, got {type(given).__name__}; make "
                "sipe.Trajectory(observations (T+1, O), actions (T, A), dt)"
            )
        self._key = () if anew else self._key
        return self._kept(items, lambda: Trajectories.stack(items))

    def _kept(self, key: tuple[Any, ...], make: Callable[[], Trajectories]) -> Trajectories:
        same = len(key) == len(self._key) and all(_same(a, b) for a, b in zip(key, self._key, strict=True))
        if self._batch is None or not same:
            self._batch, self._key = make(), key
        return self._batch


def _identity(env: Any) -> tuple[Any, ...]:
    """What tells an environment from others; the parameters of a Gymnasium environment may change."""
    if isinstance(env, str | Task | Simulator):
        return (env,)
    return (env.unwrapped, np.asarray(getattr(env.unwrapped, "theta", 0.0), float).tobytes())


def _same(a: Any, b: Any) -> bool:
    return a is b or (isinstance(a, str | bytes) and type(a) is type(b) and bool(a == b))


def _excited(
    simulator: Simulator, task: Task, theta: FloatArray, split: str, count: int, seed: int, steps: int
) -> Trajectories:
    """Each trajectory has a generator of its own, so that more of them begin with the same ones."""
    actions, states, goals = [], [], []
    for i in range(count):
        rng = np.random.default_rng([seed, SPLITS.index(split), i])
        state, goal = task.initial_states(rng, 1)
        states.append(state[0])
        goals.append(None if goal is None else goal[0])
        actions.append(_exciting_actions(simulator, theta, state, goal, steps, rng))
    targets = None if goals[0] is None else np.stack([g for g in goals if g is not None])
    rows = np.tile(theta, (count, 1))
    motion = simulator.rollout(rows, np.stack(actions), np.stack(states), allow_outside=True, goals=targets)
    if not motion.valid.all():
        raise RuntimeError(
            f"demonstrations: {int((~motion.valid[:, -1]).sum())} of {count} simulations of {task.name} diverged; "
            "take another seed, or fewer steps"
        )
    return replace(motion, names=tuple(f"{split}_{i}" for i in range(count)))


def _exciting_actions(
    simulator: Simulator,
    theta: FloatArray,
    state: FloatArray,
    goal: FloatArray | None,
    steps: int,
    rng: np.random.Generator,
) -> FloatArray:
    """Actions (T, A) from a starting state (1, S): the task's own excitation, in closed loop, or smooth ones."""
    task = simulator.environment
    assert isinstance(task, Task)
    actions = smooth_actions(task, simulator.dt, steps, rng)
    for t in range(steps):
        still = np.zeros((1, 1, task.num_actions))
        seen = simulator.rollout(theta, still, state, allow_outside=True, goals=goal).observations[:, 0]
        chosen = task.excitation(seen, rng)
        if chosen is None:
            return actions
        actions[t] = chosen[0]
        moved = simulator.rollout(theta, actions[None, t : t + 1], state, allow_outside=True, goals=goal).states
        assert moved is not None
        state = moved[:, 1]
    return actions


def smooth_actions(task: Task, dt: float, steps: int, rng: np.random.Generator) -> FloatArray:
    """The excitation policy's actions (T, A), within the task's bounds."""
    shape = (task.num_actions, _SINES)
    frequency = np.exp(rng.uniform(np.log(_SLOWEST), np.log(_FASTEST), shape))
    phase, share = rng.uniform(0, 2 * np.pi, shape), rng.dirichlet(np.ones(_SINES), task.num_actions)
    time = np.arange(steps)[:, None, None] * dt
    wave = (share * np.sin(2 * np.pi * frequency * time + phase)).sum(-1)
    centre, half = (task.action_low + task.action_high) / 2, (task.action_high - task.action_low) / 2
    return np.asarray(centre + _AMPLITUDE * half * wave)
