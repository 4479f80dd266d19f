"""Closed loop: all lanes of a task take a control step at a time, and begin anew where their episode ended.

Autoreset is Gymnasium's ``NEXT_STEP``: the step in which an episode ends returns its last observation, the next step
ignores the lane's action, begins a new episode and returns its first observation with reward 0. Every lane has its own
generator, so what happens in it depends neither on the other lanes nor on their number. A lane that diverges ends its
episode with ``valid`` False, its last good observation and reward 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from sipe_bayes.core.parameters import ParameterSpace
from sipe_bayes.envs.base import Environment
from sipe_bayes.envs.task import Task, Transition
from sipe_bayes.simulation.engine import Engine

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True)
class Step:
    """What a control step returned for B lanes: observations (B, O), rewards (B,), terminated, truncated and valid (B,);
    success (B,) or None where only the return counts; goals and achieved_goals (B, G) or None."""

    observations: FloatArray
    rewards: FloatArray
    terminated: BoolArray
    truncated: BoolArray
    valid: BoolArray
    success: BoolArray | None
    goals: FloatArray | None
    achieved_goals: FloatArray | None


class Stepped(Protocol):
    """What closed loop needs of a simulator."""

    model: Any
    engine: Engine
    environment: Environment
    diverged: int
    control_steps: int

    @property
    def space(self) -> ParameterSpace: ...

    @property
    def dt(self) -> float: ...

    @property
    def state_size(self) -> int: ...

    def physics_steps(self, dt: float) -> tuple[int, float]: ...

    def check_theta(self, theta: FloatArray, allow_outside: bool, lanes: int | None = None) -> FloatArray: ...

    def check_physical(self, theta: FloatArray) -> None: ...

    def written(self, theta: FloatArray, model: Any = None) -> Any: ...


class Episodes:
    """B lanes of a simulator's task. theta (B, N); generators: one for each lane, for starting states and goals. end_hopeless: end
    episodes where ``Task.hopeless`` says so."""

    def __init__(
        self,
        simulator: Stepped,
        theta: FloatArray,
        generators: Sequence[np.random.Generator],
        allow_outside: bool = False,
        end_hopeless: bool = False,
    ) -> None:
        task = simulator.environment
        if not isinstance(task, Task):
            raise ValueError(
                f"reset: {type(task).__name__} has no starting states and no rewards; use rollout, or a task of `sipe envs`"
            )
        if not len(generators):
            raise ValueError("count: expected at least one lane, got 0")
        self.task, self.simulator, self.count = task, simulator, len(generators)
        self.generators, self.allow_outside, self.end_hopeless = list(generators), allow_outside, end_hopeless
        self._skip, self._timestep = simulator.physics_steps(simulator.dt)
        self.theta = np.full((self.count, len(simulator.space)), np.nan)
        self._models: list[Any] = [None] * self.count
        self.set_theta(np.arange(self.count), theta)
        derived = simulator.engine.derived_size if task.needs_derived else 0
        self._timesteps = np.full(self.count, self._timestep)
        self.states = np.zeros((self.count, simulator.state_size))
        self.goals = np.zeros((self.count, task.goal_size)) if task.goal_size else None
        self._derived = np.zeros((self.count, derived)) if task.needs_derived else None
        self.observations = np.zeros((self.count, len(task.channels)))
        self.elapsed = np.zeros(self.count, int)
        self._over = np.ones(self.count, bool)
        self.begin(self._over)

    def set_theta(self, lanes: NDArray[np.int64], theta: FloatArray) -> None:
        """Give ``lanes`` (L,) the parameters theta (L, N) or (N,); they hold from the next physics step on."""
        rows = self.simulator.check_theta(theta, self.allow_outside, len(lanes))
        groups: dict[bytes, list[int]] = {}
        for index, row in enumerate(rows):
            groups.setdefault(row.tobytes(), []).append(index)
        for group in groups.values():  # all of them before any lane is touched
            self.simulator.check_physical(rows[group[0]])
        chosen = lanes.tolist()
        kept = {id(m) for lane, m in enumerate(self._models) if lane not in set(chosen)}
        free = {id(m): m for lane in chosen if (m := self._models[lane]) is not None and id(m) not in kept}
        spare = list(free.values())
        for group in groups.values():
            model = self.simulator.written(rows[group[0]], spare.pop() if spare else None)
            for index in group:
                self._models[chosen[index]], self.theta[chosen[index]] = model, rows[index]

    def begin(self, lanes: BoolArray) -> None:
        """Begin a new episode in the marked lanes (B,)."""
        chosen = np.flatnonzero(lanes)
        if not len(chosen):
            return
        for lane in chosen:
            states, goals = self.task.initial_states(self.generators[lane], 1)
            self.states[lane] = states[0]
            if self.goals is not None and goals is not None:
                self.goals[lane] = goals[0]
        states, goals = self.states[chosen], None if self.goals is None else self.goals[chosen]
        derived = None
        if self._derived is not None:
            derived = self.simulator.engine.sensors([self._models[k] for k in chosen], states)
            self._derived[chosen] = derived
        self.observations[chosen] = self.task.observe(self.simulator.model, states, derived, goals)
        self.elapsed[chosen], self._over[chosen] = 0, False

    def first(self) -> Step:
        """The step that a reset stands for."""
        success = None if self._no_success() else np.zeros(self.count, bool)
        ended = np.zeros((2, self.count), bool)
        return self._step(np.zeros(self.count), ended[0], ended[1], np.ones(self.count, bool), success)

    def step(self, actions: FloatArray) -> Step:
        """One control step of all lanes with actions (B, A); raises ValueError for other shapes or NaN."""
        actions = np.asarray(actions, float)
        if actions.shape != (self.count, self.task.num_actions):
            raise ValueError(f"actions: expected ({self.count}, {self.task.num_actions}), got {actions.shape}")
        if not np.isfinite(actions).all():
            raise ValueError("actions: expected finite numbers, got NaN or infinity; check the policy's output")
        fresh = self._over.copy()
        rewards, success = np.zeros(self.count), None if self._no_success() else np.zeros(self.count, bool)
        terminated, valid = np.zeros(self.count, bool), np.ones(self.count, bool)
        lanes: Any = slice(None) if not fresh.any() else np.flatnonzero(~fresh)
        if not fresh.all():
            result = self._advance(lanes, actions[lanes])
            rewards[lanes], terminated[lanes], valid[lanes] = result[:3]
            if success is not None:
                success[lanes] = result[3]
        self.elapsed[lanes] += 1
        self.simulator.control_steps += int((~fresh).sum())
        truncated = (self.elapsed >= self.task.episode_steps) & ~terminated & ~fresh
        self.begin(fresh)
        self._over = terminated | truncated
        return self._step(rewards, terminated, truncated, valid, success)

    def _advance(self, lanes: Any, actions: FloatArray) -> tuple[FloatArray, BoolArray, BoolArray, Any]:
        """Rewards, terminated, valid and success of the lanes that go on."""
        task, before = self.task, self.states[lanes]
        models = self._models if isinstance(lanes, slice) else [self._models[k] for k in lanes]
        goals = None if self.goals is None else self.goals[lanes]
        old = None if self._derived is None else self._derived[lanes]
        states, derived, sound = self.simulator.engine.advance(
            self._skip, models, self._timesteps[lanes], actions[:, None], before, first=False
        )
        after, new = states[:, 1], None if derived is None else derived[:, 1]
        good = np.asarray(sound[:, 0] & sound[:, 1])
        observations = task.observe(self.simulator.model, after, new, goals)
        transition = Transition(before, old, actions, after, new, goals)
        rewards, terminated, success = task.reward(transition), task.terminated(transition), task.success(transition)
        if self.end_hopeless:
            terminated = terminated | task.hopeless(after)
        if not good.all():
            after, observations = (
                np.where(good[:, None], after, before),
                np.where(good[:, None], observations, self.observations[lanes]),
            )
            new = None if new is None or old is None else np.where(good[:, None], new, old)
            rewards, terminated = np.where(good, rewards, 0.0), terminated | ~good
            success = None if success is None else success & good
            self.simulator.diverged += int((~good).sum())
        self.states[lanes], self.observations[lanes] = after, observations
        if self._derived is not None:
            self._derived[lanes] = new
        return rewards, terminated, good, success

    def _no_success(self) -> bool:
        return self.task.solved.measure == "return"

    def _step(
        self,
        rewards: FloatArray,
        terminated: BoolArray,
        truncated: BoolArray,
        valid: BoolArray,
        success: BoolArray | None,
    ) -> Step:
        goals = None if self.goals is None else self.goals.copy()
        achieved = self.task.achieved_goals(self.states, self._derived)
        return Step(self.observations.copy(), rewards, terminated, truncated, valid, success, goals, achieved)
