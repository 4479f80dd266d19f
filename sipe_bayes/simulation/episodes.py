"""Closed loop: all simulations of a task take a control step at a time, and begin anew where their episode ended.

Autoreset is Gymnasium's ``NEXT_STEP``: the step in which an episode ends returns its last observation, the next step
ignores the simulation's action, begins a new episode and returns its first observation with reward 0. Every simulation
has its own generator, so what happens in it depends neither on the others nor on their number. One that diverges ends
its episode with ``valid`` False, its last good observation and reward 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray
from sipe_bayes.envs.task import Transition
from sipe_bayes.simulation.base import Simulated
from sipe_bayes.simulation.device import Batch


@dataclass(frozen=True)
class Step:
    """What a control step returned for B simulations.

    Args:
        observations: (B, O).
        rewards: (B,).
        terminated: (B,), whether the task ended the episode.
        truncated: (B,), whether its time did.
        valid: (B,), False where the simulation diverged.
        success: (B,), or None where only the return counts.
        goals: (B, G) or None.
        achieved_goals: (B, G) or None.
    """

    observations: FloatArray
    rewards: FloatArray
    terminated: BoolArray
    truncated: BoolArray
    valid: BoolArray
    success: BoolArray | None
    goals: FloatArray | None
    achieved_goals: FloatArray | None


class Episodes:
    """B simulations of a simulator's task.

    Args:
        simulator: whose task and engine.
        theta: (B, N), or (N,) for all.
        generators: one for each simulation, for starting states and goals.
        allow_outside: whether theta may leave [0, 1].
        end_hopeless: end episodes where ``Task.hopeless`` says so.

    Raises:
        ValueError: for an environment that is no task, no generator, more simulations than a GPU has room for, or wrong
            theta.
    """

    def __init__(
        self,
        simulator: Simulated,
        theta: FloatArray,
        generators: Sequence[np.random.Generator],
        allow_outside: bool = False,
        end_hopeless: bool = False,
    ) -> None:
        task = simulator.task
        if not len(generators):
            raise ValueError("count: expected at least 1, got 0")
        self.task, self.simulator, self.count = task, simulator, len(generators)
        self.generators, self.allow_outside, self.end_hopeless = list(generators), allow_outside, end_hopeless
        self._skip, timestep = simulator.physics_steps(simulator.dt)
        room = None if simulator.device == "cpu" else simulator.runs.most(1, self._skip)
        if room is not None and self.count > room:
            raise ValueError(f"count: {simulator.device} has room for {room} simulations at a time, got {self.count}")
        self._timesteps = np.full(self.count, timestep)
        self._pool, self._slots = simulator.runs.pool(), np.zeros(self.count, int)
        self.theta = simulator.check_theta(theta, allow_outside, self.count)
        self._write(np.arange(self.count))
        derived = simulator.engine.derived_size if task.needs_derived else 0
        self.states = np.zeros((self.count, simulator.state_size))
        self.goals = np.zeros((self.count, task.goal_size)) if task.goal_size else None
        self.derived = np.zeros((self.count, derived)) if task.needs_derived else None
        self.observations = np.zeros((self.count, len(task.channels)))
        self.elapsed = np.zeros(self.count, int)
        self.over = np.ones(self.count, bool)
        self.begin(self.over)

    @property
    def models(self) -> list[mujoco.MjModel]:
        """One for each simulation, with its parameters; on the processor."""
        return self._pool.models(self._slots)

    def set_theta(self, chosen: IntArray, theta: FloatArray) -> None:
        """Give simulations their parameters, which hold from the next physics step on.

        Args:
            chosen: (n,), which of them.
            theta: (n, N) or (N,).

        Raises:
            ValueError: for theta of another shape, outside, or unphysical; nothing is changed then.
        """
        before = self.theta.copy()
        self.theta[chosen] = self.simulator.check_theta(theta, self.allow_outside, len(chosen))
        try:
            self._write(chosen)
        except ValueError:
            self.theta = before
            self._write(chosen)
            raise

    def _write(self, chosen: IntArray) -> None:
        """Into one slot where all simulations are alike, else into one for each; raises ValueError where unphysical."""
        alone = self.simulator.runs.own_slots or (self.theta != self.theta[0]).any()
        slots = np.arange(self.count) if alone else np.zeros(self.count, int)
        changed = chosen if np.array_equal(slots, self._slots) else np.arange(self.count)
        self._slots, changed = slots, changed if alone else changed[:1]
        self._pool.put(slots[changed], self.theta[changed], self._timesteps[changed], [None] * len(changed))
        physical = self._pool.physical(slots[changed])
        if not physical.all():
            self.simulator.check_physical(self.theta[changed][~physical][0])

    def begin(self, chosen: BoolArray) -> None:
        """Begin a new episode in the marked simulations (B,)."""
        indices = np.flatnonzero(chosen)
        if not len(indices):
            return
        for i in indices:
            states, goals = self.task.initial_states(self.generators[i], 1)
            self.states[i] = states[0]
            if self.goals is not None and goals is not None:
                self.goals[i] = goals[0]
        states, goals = self.states[indices], None if self.goals is None else self.goals[indices]
        derived = None
        if self.derived is not None:
            derived = self.simulator.runs.sensors(self._pool, self._slots[indices], states)
            self.derived[indices] = derived
        self.observations[indices] = self.task.observe(self.simulator.model, states, derived, goals)
        self.elapsed[indices], self.over[indices] = 0, False

    def first(self) -> Step:
        """The step that a reset stands for."""
        success = np.zeros(self.count, bool) if self._has_success else None
        ended = np.zeros((2, self.count), bool)
        return self._step(np.zeros(self.count), ended[0], ended[1], np.ones(self.count, bool), success)

    def step(self, actions: FloatArray) -> Step:
        """One control step of all simulations.

        Args:
            actions: (B, A).

        Raises:
            ValueError: for another shape, or NaN.
        """
        actions = np.asarray(actions, float)
        if actions.shape != (self.count, self.task.num_actions):
            raise ValueError(f"actions: expected ({self.count}, {self.task.num_actions}), got {actions.shape}")
        if not np.isfinite(actions).all():
            raise ValueError("actions: expected finite numbers, got NaN or infinity; check the policy's output")
        if not self.over.any():
            rewards, terminated, valid, success = self._advance(None, actions)
            self.elapsed += 1
            self.simulator.control_steps += self.count
            truncated = (self.elapsed >= self.task.episode_steps) & ~terminated
        else:
            rewards, terminated, truncated, valid, success = self._step_some(actions)
        self.over = terminated | truncated
        return self._step(rewards, terminated, truncated, valid, success if self._has_success else None)

    def _step_some(self, actions: FloatArray) -> tuple[FloatArray, BoolArray, BoolArray, BoolArray, BoolArray | None]:
        """A control step of those whose episode goes on; the others begin anew."""
        fresh = self.over.copy()
        rewards, success = np.zeros(self.count), np.zeros(self.count, bool)
        terminated, valid = np.zeros(self.count, bool), np.ones(self.count, bool)
        going = np.flatnonzero(~fresh)
        if len(going):
            rewards[going], terminated[going], valid[going], succeeded = self._advance(going, actions[going])
            if self._has_success:
                success[going] = succeeded
        self.elapsed[going] += 1
        self.simulator.control_steps += len(going)
        truncated = (self.elapsed >= self.task.episode_steps) & ~terminated & ~fresh
        self.begin(fresh)
        return rewards, terminated, truncated, valid, success

    def _advance(
        self, chosen: IntArray | None, actions: FloatArray
    ) -> tuple[FloatArray, BoolArray, BoolArray, BoolArray | None]:
        """Rewards, terminated, valid and success of the ``chosen`` simulations, None for all."""
        task = self.task
        index: slice | IntArray = slice(None) if chosen is None else chosen
        before = self.states[index]
        goals = None if self.goals is None else self.goals[index]
        old = None if self.derived is None else self.derived[index]
        given = Batch(self._pool, self._slots[index], self._skip, self._timesteps[index], actions[:, None], before)
        states, derived, valid = self.simulator.runs.advance(given, first=False)
        after, new = states[:, 1], None if derived is None else derived[:, 1]
        valid = np.asarray(valid.all(1))
        observations = task.observe(self.simulator.model, after, new, goals)
        transition = Transition(before, old, actions, after, new, goals)
        rewards, terminated, success = task.reward(transition), task.terminated(transition), task.success(transition)
        if self.end_hopeless:
            terminated = terminated | task.hopeless(after)
        if not valid.all():
            column = valid[:, None]
            after = np.where(column, after, before)
            observations = np.where(column, observations, self.observations[index])
            new = None if new is None or old is None else np.where(column, new, old)
            rewards, terminated = np.where(valid, rewards, 0.0), terminated | ~valid
            success = None if success is None else success & valid
            self.simulator.diverged += int((~valid).sum())
        self.states[index], self.observations[index] = after, observations
        if self.derived is not None:
            self.derived[index] = new
        return rewards, terminated, valid, success

    @property
    def _has_success(self) -> bool:
        return self.task.solved.measure != "return"

    def _step(
        self,
        rewards: FloatArray,
        terminated: BoolArray,
        truncated: BoolArray,
        valid: BoolArray,
        success: BoolArray | None,
    ) -> Step:
        goals = None if self.goals is None else self.goals.copy()
        achieved = self.task.achieved_goals(self.states, self.derived)
        return Step(self.observations.copy(), rewards, terminated, truncated, valid, success, goals, achieved)
