"""Gymnasium faces of the engine: ``gymnasium.make("sipe/FetchPush-v0")`` and ``gymnasium.make_vec``.

The ids are registered when this module is imported: by ``import gymnasium, sipe_bayes`` in this order, by
``gymnasium.register_envs(sipe_bayes.simulation.gym)`` in any. The vector environment is the engine itself, all
sub-environments in one native call, not a loop of processes. ``info`` holds ``valid``, and where a task has them
``success``, ``achieved_goal`` and ``desired_goal``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray
from sipe_bayes.envs.registry import TASKS, make_task
from sipe_bayes.envs.task import Task
from sipe_bayes.simulation.episodes import Episodes, Step
from sipe_bayes.simulation.rendering import Picture, Pose, Stage
from sipe_bayes.simulation.simulator import Simulator

Space = gymnasium.Space[FloatArray]
Info = dict[str, object]
"""Gymnasium's ``info`` and ``options``: whatever goes with a step or a reset, by name."""

for _name in TASKS:
    gymnasium.register(
        f"sipe/{_name}-v0",
        entry_point="sipe_bayes.simulation.gym:SipeEnv",
        vector_entry_point="sipe_bayes.simulation.gym:SipeVectorEnv",
        kwargs={"task": _name},
    )


def make(name: str, variant: str = "default") -> SipeEnv:
    """A task as a Gymnasium environment with its engine; raises ValueError for an unknown task or variant."""
    return SipeEnv(name, variant)


def make_vec(name: str, num_envs: int, variant: str = "default", num_threads: int | None = None) -> SipeVectorEnv:
    """A task as a Gymnasium vector environment on the batch engine.

    Args:
        name: the task's.
        num_envs: how many sub-environments.
        variant: whose parameters they have.
        num_threads: native threads; default the processor's cores.

    Raises:
        ValueError: for an unknown task, with the nearest name, an unknown variant, or no sub-environment.
    """
    return SipeVectorEnv(name, num_envs, variant, num_threads)


def _spaces(task: Task) -> tuple[Space, Space]:
    """Observation and action space."""
    size = (len(task.channels),)
    observation: Space = gymnasium.spaces.Box(-np.inf, np.inf, size, np.float64)
    action = gymnasium.spaces.Box(task.action_low, task.action_high, (task.num_actions,), np.float32)
    return observation, cast(Space, action)


def _info(step: Step) -> dict[str, FloatArray | BoolArray]:
    """What a step says besides observation, reward and end, for all sub-environments."""
    info = {
        "valid": step.valid,
        "success": step.success,
        "achieved_goal": step.achieved_goals,
        "desired_goal": step.goals,
    }
    return {key: value for key, value in info.items() if value is not None}


def _checked(options: Info | None, known: tuple[str, ...]) -> Info:
    unknown = sorted(set(options or {}) - set(known))
    if unknown:
        raise ValueError(f"options: no {unknown[0]!r}; expected any of {', '.join(known)}")
    return options or {}


class _Face:
    """What both faces share: a task, its engine, and episodes, which begin with the first reset."""

    task: Task
    simulator: Simulator
    _episodes: Episodes | None = None

    def compute_reward(self, achieved: FloatArray, goals: FloatArray, info: object = None) -> FloatArray:
        """Rewards (...,) of achieved and desired goals (..., G), for hindsight relabelling."""
        return self.task.goal_reward(np.asarray(achieved), np.asarray(goals))

    def _give(self, chosen: IntArray, theta: FloatArray) -> None:
        """Checked theta (n, N) to the chosen sub-environments (n,); raises ValueError for unphysical values."""
        if self._episodes is None:
            for row in np.unique(theta, axis=0):
                self.simulator.written(row)
        else:
            self._episodes.allow_outside = True
            self._episodes.set_theta(chosen, theta)

    def _begin(self, theta: FloatArray, generators: list[np.random.Generator], fresh: BoolArray) -> Step:
        """Begin episodes, at first all of them."""
        if self._episodes is None:
            self._episodes = Episodes(self.simulator, theta, generators, allow_outside=True)
        else:
            self._episodes.generators = generators
            self._episodes.begin(fresh)
        return self._episodes.first()

    def _advance(self, actions: FloatArray) -> Step:
        if self._episodes is None:
            raise ValueError("step: nothing has begun yet; call reset first")
        return self._episodes.step(actions)


class SipeEnv(_Face, gymnasium.Env[FloatArray, FloatArray]):
    """A task as a single environment.

    ``set_parameters(theta)`` changes the simulator at once, ``reset(options={"theta": ...})`` from the new episode on.

    Args:
        task: its name, or the task.
        variant: whose parameters it has.
        render_mode: ``"rgb_array"`` for pictures, which want a backend of OpenGL (``simulation.rendering``).

    Raises:
        ValueError: for an unknown task, variant or mode.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}  # noqa: RUF012 (Gymnasium declares it so)
    picture_size: int = 480  # pixels
    _stage: tuple[bytes, Stage] | None = None  # with the theta that it shows

    def __init__(self, task: str | Task, variant: str = "default", render_mode: str | None = None) -> None:
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode: expected 'rgb_array' or None, got {render_mode!r}")
        self.render_mode = render_mode
        self.task = make_task(task) if isinstance(task, str) else task
        self.theta = self.task.theta(variant)
        self.simulator = Simulator(self.task, num_threads=1)
        self.metadata = {**self.metadata, "render_fps": max(1, round(1 / self.simulator.dt))}
        self.observation_space, self.action_space = _spaces(self.task)

    def render(self) -> Picture | None:
        """A picture (480, 480, 3) of the present state; None without a ``render_mode``.

        Raises:
            ValueError: before the first ``reset``.
            RuntimeError: where no backend of OpenGL is there.
        """
        if self.render_mode is None:
            return None
        if self._episodes is None:
            raise ValueError("render: nothing has begun yet; call reset first")
        theta = self._episodes.theta[0].tobytes()
        if self._stage is None or self._stage[0] != theta:
            self.close()
            model = self._episodes.models[0]
            tracks = any(model.camera(i).name == "track" for i in range(model.ncam))
            camera = "track" if tracks else None
            stage = Stage(model, self.picture_size, self.picture_size, camera)
            stage.frame(self._episodes.states, room=2.0)
            self._stage = theta, stage
        return self._stage[1].draw([Pose(self._episodes.states[0])])

    def close(self) -> None:
        """Give OpenGL's context back."""
        if self._stage is not None:
            self._stage[1].close()
            self._stage = None

    def set_parameters(self, theta: FloatArray, allow_outside: bool = False) -> None:
        """Give the simulator parameters.

        Args:
            theta: (N,).
            allow_outside: whether it may leave [0, 1].

        Raises:
            ValueError: for another shape, NaN, or values outside that are not allowed.
        """
        theta = self.simulator.check_theta(theta, allow_outside, 1)
        self._give(np.zeros(1, int), theta)
        self.theta = theta[0]

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[FloatArray, Info]:
        """Begin an episode.

        Args:
            seed: of the starting states and goals; default goes on with the generator.
            options: ``theta`` (N,), and ``allow_outside`` where it may leave [0, 1].
        """
        super().reset(seed=seed)
        options = _checked(options, ("theta", "allow_outside"))
        if "theta" in options:
            self.set_parameters(cast(FloatArray, options["theta"]), bool(options.get("allow_outside", False)))
        return self._single(self._begin(self.theta, [self.np_random], np.ones(1, bool)))

    def step(self, action: FloatArray) -> tuple[FloatArray, float, bool, bool, Info]:
        """One control step with an action (A,); raises ValueError before the first ``reset``."""
        step = self._advance(np.asarray(action, float)[None])
        observation, info = self._single(step)
        return observation, float(step.rewards[0]), bool(step.terminated[0]), bool(step.truncated[0]), info

    @staticmethod
    def _single(step: Step) -> tuple[FloatArray, Info]:
        info = {key: value[0] for key, value in _info(step).items()}
        return step.observations[0], {k: bool(v) if v.dtype == bool else v for k, v in info.items()}


class SipeVectorEnv(_Face, VectorEnv[FloatArray, FloatArray, FloatArray]):
    """Sub-environments of a task, all in one native call a step. Autoreset: NEXT_STEP.

    Args:
        task: its name, or the task.
        num_envs: how many.
        variant: whose parameters they have.
        num_threads: native threads; default the processor's cores.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 (Gymnasium declares it so)
        "render_modes": [],
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self, task: str | Task, num_envs: int = 1, variant: str = "default", num_threads: int | None = None
    ) -> None:
        if num_envs < 1:
            raise ValueError(f"num_envs: expected at least 1, got {num_envs}")
        self.task = make_task(task) if isinstance(task, str) else task
        self.theta = np.tile(self.task.theta(variant), (num_envs, 1))
        self.simulator, self.num_envs = Simulator(self.task, num_threads), num_envs
        self.single_observation_space, self.single_action_space = _spaces(self.task)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._generators: list[np.random.Generator] = []

    def set_parameters(
        self, theta: FloatArray, lanes: IntArray | BoolArray | None = None, allow_outside: bool = False
    ) -> None:
        """Give sub-environments their parameters.

        Args:
            theta: (n, N) or (N,).
            lanes: which of them, n numbers or a mask (B,); default all.
            allow_outside: whether theta may leave [0, 1].

        Raises:
            ValueError: for what does not fit; nothing is changed then.
        """
        chosen = self._chosen("lanes", lanes)
        theta = self.simulator.check_theta(theta, allow_outside, len(chosen))
        self._give(chosen, theta)
        self.theta[chosen] = theta

    def _chosen(self, name: str, chosen: IntArray | BoolArray | None) -> IntArray:
        """Numbers of sub-environments given as numbers or as a mask; raises ValueError."""
        given = np.arange(self.num_envs) if chosen is None else np.asarray(chosen)
        if given.dtype == bool and given.shape == (self.num_envs,):
            return np.flatnonzero(given)
        whole = given.ndim == 1 and np.issubdtype(given.dtype, np.integer)
        if not whole or (len(given) and not 0 <= given.min() <= given.max() < self.num_envs):
            raise ValueError(
                f"{name}: expected a mask ({self.num_envs},) or numbers of sub-environments below {self.num_envs}, got "
                f"{given.tolist()}"
            )
        return given.astype(np.int64)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Info | None = None
    ) -> tuple[FloatArray, Info]:
        """Begin episodes.

        Args:
            seed: one for each, or one for the first, from which the others count up; default goes on.
            options: ``reset_mask`` (B,) to begin anew in n sub-environments only, and for those ``theta`` (n, N) or
                (N,) with ``allow_outside``.
        """
        options = _checked(options, ("theta", "allow_outside", "reset_mask"))
        chosen = self._chosen("reset_mask", cast(BoolArray | None, options.get("reset_mask")))
        seeds = self._seeds(seed)
        if "theta" in options:
            self.set_parameters(cast(FloatArray, options["theta"]), chosen, bool(options.get("allow_outside", False)))
        if not self._generators:
            self._generators = [np.random.default_rng(s) for s in seeds]
        elif seed is not None:
            for i in chosen:
                self._generators[i] = np.random.default_rng(seeds[i])
        step = self._begin(self.theta, self._generators, np.isin(np.arange(self.num_envs), chosen))
        return step.observations, self._marked(step)

    def _seeds(self, seed: int | Sequence[int | None] | None) -> list[int | None]:
        """One seed for each: seed, seed + 1, ... of one number."""
        if seed is None:
            return [None] * self.num_envs
        if isinstance(seed, int | np.integer):
            return [int(seed) + i for i in range(self.num_envs)]
        if len(seed) != self.num_envs:
            raise ValueError(f"seed: expected one number or {self.num_envs}, got {len(seed)}")
        return [None if s is None else int(s) for s in seed]

    def step(  # type: ignore[override]  # Gymnasium's type has floats where it wants truth values
        self, actions: FloatArray
    ) -> tuple[FloatArray, FloatArray, BoolArray, BoolArray, Info]:
        """One control step of all with actions (B, A); raises ValueError before the first ``reset``."""
        step = self._advance(actions)
        return step.observations, step.rewards, step.terminated, step.truncated, self._marked(step)

    def _marked(self, step: Step) -> Info:
        """Gymnasium's form: with every entry those that it holds for."""
        info = _info(step)
        return {**info, **{f"_{key}": np.ones(self.num_envs, bool) for key in info}}
