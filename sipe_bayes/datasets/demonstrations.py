"""Demonstrations of a benchmark task: trajectories of an agent in an environment of known or hidden parameters.

``sipe.demonstrations(env, type="expert")``. In this order:

1. a trajectory set that is stored (``sipe_bayes.datasets.trajectory_sets``), where it was made with these parameters
   and seed and is as large as asked for;
2. a simulation of the agent, whose file is looked for in ``sipe_bayes/datasets/agents``, at these parameters; type
   "random" needs none;
3. where there is no such agent, an excitation policy stands in, and a UserWarning says so.

How each of them acts is described in ``sipe_bayes.datasets.acting``.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Protocol, TypeGuard

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.core.validation import one_of, whole
from sipe_bayes.datasets import acting, trajectory_sets
from sipe_bayes.datasets.acting import AGENTS, SPLITS, Agent, Behaviour, Recording, Split
from sipe_bayes.datasets.trajectory_sets import COUNT, SetName, TrajectorySetError
from sipe_bayes.envs.registry import make_task
from sipe_bayes.envs.task import VARIANTS, Task, Variant
from sipe_bayes.simulation.simulator import Simulator


class Wrapped(Protocol):
    """A Gymnasium environment of ``sipe.make``, vectorised or not."""

    @property
    def unwrapped(self) -> object:
        """The environment within all wrappers."""


Environment = str | Task | Simulator | Wrapped
"""A task's name, the task, its simulator, or a Gymnasium environment of this library."""

AGENT_FILES = Path(__file__).parent / "agents"
_ROBOTS = {  # tasks that share the agent of another: what is unknown differs, the robot does not
    "HalfCheetahJoints": "HalfCheetahLinks",
    "HalfCheetahAllJoints": "HalfCheetahLinks",
    "HumanoidJoints": "HumanoidLinks",
}


class NoAgentWarning(UserWarning):
    """An excitation policy stands in for an agent that is not installed."""


def demonstrations(
    env: Environment,
    type: Agent = "expert",
    split: Split = "reference",
    variant: Variant | None = None,
    *,
    count: int = COUNT,
    seed: int = 0,
    steps: int | None = None,
    noise: float | FloatArray = 0.0,
    noise_seed: int = 0,
    folder: str | Path | None = None,
) -> Trajectories:
    """Trajectories of an agent, with states and rewards; the same arguments give the same ones, fewer begin alike.

    Args:
        env: a task's name, a Task, a Simulator of one, or a Gymnasium environment of ``sipe.make``.
        type: expert, suboptimal or random.
        split: reference, validation or test; they differ in starting states and actions.
        variant: the parameters, by default the published model's; a Gymnasium environment has its own, and then a
            variant that differs from them is refused.
        count: how many.
        seed: of starting states and actions.
        steps: control steps, default an episode or its first 250.
        noise: white noise on the observations, its sd as a share of each channel's spread over these trajectories, or
            (O,) in each channel's unit. Noisy trajectories hold neither states nor rewards, which would give the truth
            away.
        noise_seed: its own.
        folder: read what `sipe data generate --out` wrote there, and nothing else.

    Raises:
        ValueError: for what has no starting states or is not in ``folder``.
        TrajectorySetError: for a damaged file.
        RuntimeError: where a simulation diverges.
    """
    one_of("type", type, AGENTS)
    one_of("split", split, SPLITS)
    simulator, theta = _placed(env, variant)
    task = simulator.task
    horizon = default_steps(task) if steps is None else whole("steps", steps)
    asked = Recording(split, whole("count", count), seed, horizon)
    recorded = _stored(simulator, theta, type, asked, trajectory_sets.shipped() if folder is None else Path(folder))
    if recorded is None and folder is not None:
        raise TrajectorySetError(
            f"folder {folder}: holds no {type} {split} set of {task.name} with these parameters, seed {seed}, and at "
            f"least {count} trajectories of {horizon} steps; make it with `sipe data generate`, or leave folder out"
        )
    if recorded is None:
        behaviour = behaviour_of(task, type)
        if behaviour is None:
            warnings.warn(
                f"demonstrations: no {type} agent of {task.name} is installed; an excitation policy was used instead",
                NoAgentWarning,
                stacklevel=_caller(),
            )
            behaviour = acting.excitation(task, simulator.dt)
        recorded, _ = acting.simulate(simulator, theta, behaviour, asked)
    return _noisy(recorded, noise, noise_seed)


def default_steps(task: Task, longest: int = 250) -> int:
    """Control steps of a trajectory where none are asked for, ``longest`` of a task whose episodes are longer."""
    return min(task.episode_steps, longest)


def behaviour_of(task: Task, type: Agent) -> Behaviour | None:
    """How an agent acts, None where it is not installed; raises PolicyError for a file that is no such policy."""
    if type == "random":
        return acting.random(task)
    file = agent_file(task.name, type)
    if file is None:
        return None
    from sipe_bayes.models.policy import PolicyError, load_policy

    policy = load_policy(file)
    sizes, expected = (policy.observation_size, policy.action_size), (len(task.channels), task.num_actions)
    if sizes != expected:
        raise PolicyError(
            f"{file}: expected {expected[0]} observations and {expected[1]} actions for {task.name}, got {sizes[0]} "
            f"and {sizes[1]}; train it anew with `sipe train`"
        )
    return acting.agent(task, policy, type)


def agent_file(task: str, type: str) -> Path | None:
    """The file of a task's agent, or None where it is not installed."""
    path = AGENT_FILES / f"{_ROBOTS.get(task, task)}-{type}.safetensors"
    return path if path.is_file() else None


def _placed(env: Environment, variant: Variant | None) -> tuple[Simulator, FloatArray]:
    """The simulator of ``env`` and the parameters (N,) asked for."""
    simulator, theta = simulator_of(env)
    task = simulator.environment
    if not isinstance(task, Task):
        raise ValueError(
            f"env: {task.__class__.__name__} has no starting states; record logs, or take a task of `sipe envs`"
        )
    own = not isinstance(env, str | Task | Simulator)  # those stand for the published model
    if own and variant is None:
        return simulator, theta
    wanted = task.theta(variant or "default")
    if own and not np.array_equal(theta, wanted):
        raise ValueError(
            f"variant: env has parameters other than those of {variant!r}; leave variant out, or give the name "
            f"{task.name!r}"
        )
    return simulator, wanted


def _stored(
    simulator: Simulator, theta: FloatArray, type: Agent, asked: Recording, folder: Path
) -> Trajectories | None:
    """What a folder of trajectory sets holds of it, or None."""
    task = simulator.task
    for variant in VARIANTS:
        name = SetName(task.name, variant, asked.split, type)
        if np.array_equal(theta, task.theta(variant)):
            entry = trajectory_sets.entry_of(folder, name, simulator)
            enough = entry is not None and asked.count <= entry.count and asked.steps <= entry.steps
            if entry is not None and enough and entry.seed == asked.seed:
                return trajectory_sets.read(folder, name, simulator, asked.count, asked.steps)
    return None


def _noisy(recorded: Trajectories, noise: float | FloatArray, seed: int) -> Trajectories:
    """With white noise on the observations, from a generator for each trajectory."""
    level, size = np.asarray(noise, float), recorded.observations.shape[-1]
    if level.shape not in ((), (size,)) or not (np.isfinite(level) & (level >= 0)).all():
        raise ValueError(f"noise: expected one number or ({size},), none below zero, got {noise!r}")
    if not level.any():
        return recorded
    sd = level * recorded.observations.std((0, 1)) if level.ndim == 0 else level
    shape = recorded.observations.shape[1:]
    drawn = [np.random.default_rng([seed, i]).standard_normal(shape) for i in range(len(recorded))]
    return replace(recorded, observations=recorded.observations + sd * np.stack(drawn), states=None, rewards=None)


def _caller() -> int:
    """The stack level, from ``demonstrations``, of the first line outside the package: a warning belongs to it."""
    package, frame, level = str(Path(__file__).parents[1]), sys._getframe(1), 1
    while frame.f_back is not None and frame.f_code.co_filename.startswith(package):
        frame, level = frame.f_back, level + 1
    return level


def simulator_of(env: Environment) -> tuple[Simulator, FloatArray]:
    """The simulator of an environment, and the theta (N,) that it stands for.

    Args:
        env: see ``Environment``.

    Raises:
        TypeError: for anything else.
        ValueError: for a vectorised environment whose parameters differ.
    """
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
        raise ValueError(
            "env: its parameters differ between sub-environments; give them one theta, or take sipe.make(...)"
        )
    return simulator, rows[0]


def is_environment(given: object) -> TypeGuard[Environment]:
    """Whether ``given`` is what ``simulator_of`` takes, and not trajectories."""
    return isinstance(given, str | Task | Simulator) or hasattr(given, "unwrapped")


class Given:
    """Trajectories as an estimator is given them, time after time.

    The same objects give the same Trajectories, and an environment stands for its reference demonstrations, recorded
    once for each theta.
    """

    def __init__(self) -> None:
        self._key: tuple[object, ...] = ()
        self._batch: Trajectories | None = None

    def stack(self, given: object, anew: bool = False) -> Trajectories:
        """Trajectories as a batch.

        Args:
            given: one, several, or an environment.
            anew: read recorded ones again, as their arrays may have changed.

        Raises:
            ValueError: for anything else.
        """
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

    def _kept(self, key: tuple[object, ...], make: Callable[[], Trajectories]) -> Trajectories:
        same = len(key) == len(self._key) and all(_same(a, b) for a, b in zip(key, self._key, strict=True))
        if self._batch is None or not same:
            self._batch, self._key = make(), key
        return self._batch


def _identity(env: Environment) -> tuple[object, ...]:
    """What tells an environment from others; the parameters of a Gymnasium environment may change."""
    if isinstance(env, str | Task | Simulator):
        return (env,)
    return (env.unwrapped, np.asarray(getattr(env.unwrapped, "theta", 0.0), float).tobytes())


def _same(a: object, b: object) -> bool:
    return a is b or (isinstance(a, str | bytes) and type(a) is type(b) and bool(a == b))
