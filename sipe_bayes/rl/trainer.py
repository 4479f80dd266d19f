"""An agent at work: copies of a task that act, remember and learn, in small steps that can be stopped and gone on with.

They are stepped together, and the updates of the steps taken follow. Each episode may run under its own theta,
noise and delay (``sipe_bayes.rl.randomization``).
"""

from __future__ import annotations

import copy
import json
from dataclasses import dataclass, replace

import numpy as np
import torch

from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.envs.task import Task
from sipe_bayes.models.policy import Policy
from sipe_bayes.rl.ddpg import Agent, AgentState
from sipe_bayes.rl.randomization import DisturbancesState, Draws, Randomization
from sipe_bayes.rl.replay import Batch, Replay
from sipe_bayes.rl.settings import Settings
from sipe_bayes.simulation.episodes import Episodes, Step
from sipe_bayes.simulation.simulator import Simulator


@dataclass(frozen=True)
class EpisodesState:
    """Where L episodes are: the arrays of ``Episodes``, None for what the task does not have."""

    theta: FloatArray
    states: FloatArray
    goals: FloatArray | None
    observations: FloatArray
    elapsed: IntArray
    derived: FloatArray | None
    over: BoolArray


@dataclass(frozen=True)
class TrainerState:
    """Everything but the replay buffer.

    Args:
        agent: networks and optimisers.
        episodes: where they are.
        steps: control steps taken.
        owed: updates that are due.
        diverged: simulations so far.
        redrawn: theta so far.
        generators: as JSON.
        disturbances: None where there are none.
    """

    agent: AgentState
    episodes: EpisodesState
    steps: int
    owed: float
    diverged: int
    redrawn: int
    generators: tuple[str, ...]
    disturbances: DisturbancesState | None


class Trainer:
    """An agent, its replay buffer and the environments that it acts in. ``steps`` counts their control steps together.

    Args:
        task: what it learns.
        settings: how.
        seed: of weights, starts, actions and batches.
        randomization: what each episode draws; without one it runs in the published model.
        demonstrations: trajectories with rewards, from which ``settings.demonstration_share`` of each batch is taken.
        threads: of the simulation.
        device: that is simulated, remembered and learnt on, as ``Simulator`` has them.
        policy: that the actor begins as; it acts in place of random actions, and the shift and scale of its
            observations stay.

    Raises:
        ValueError: for settings that do not fit the task or the policy, demonstrations without a share of them, or a
            task that the device can not simulate.
    """

    def __init__(
        self,
        task: Task,
        settings: Settings,
        seed: int = 0,
        randomization: Randomization | None = None,
        demonstrations: Trajectories | None = None,
        threads: int = 1,
        device: str = "cpu",
        policy: Policy | None = None,
    ) -> None:
        if bool(settings.demonstration_share) != (demonstrations is not None):
            raise ValueError(
                f"demonstration_share: {settings.demonstration_share} with demonstrations "
                f"{'missing' if demonstrations is None else 'given'}; give both or neither"
            )
        if settings.end_hopeless and type(task).hopeless is Task.hopeless:
            raise ValueError(f"end_hopeless: expected a task that knows when it is lost, got {task.name}; leave it out")
        self.task, self.settings = task, settings
        streams = np.random.SeedSequence(seed).spawn(5 + settings.lanes)
        initial, self._noise, self._picks, self._draws, *starts, last = (np.random.default_rng(s) for s in streams)
        size = len(task.channels)
        self._device = "cpu" if device == "warp:cpu" else device  # torch's name of it
        self.agent = Agent(size, task.num_actions, task.action_low, task.action_high, settings, initial, self._device)
        self._begun = policy is not None
        if policy is not None:
            self.agent.begin(policy)
        self.replay = self._buffer(settings.capacity, settings.lanes)
        self._shown = None if demonstrations is None else self._demonstrated(demonstrations)
        self.simulator = Simulator(task, threads, device)
        self.episodes = Episodes(self.simulator, task.theta("default"), starts, True, settings.end_hopeless)
        self.draws = None if randomization is None else Draws(self.simulator, randomization.posterior)
        self._disturbances = None
        if randomization is not None and randomization.disturbs:
            middle = np.full(task.num_actions, (task.action_low + task.action_high) / 2)
            self._disturbances = randomization.disturbances(settings.lanes, size, task.goal_size, middle, last)
        if randomization is not None:
            every = np.ones(settings.lanes, bool)
            self._redraw(every)
            self.episodes.begin(every)
        self.replay.begin(self._observed(self.episodes.first()))
        self.steps, self._owed = 0, 0.0

    def advance(self) -> None:
        """One control step of every environment and the updates that go with it."""
        settings, fresh = self.settings, self.episodes.over.copy()
        actions = self._actions()
        self._redraw(fresh)
        sent = actions if self._disturbances is None else self._disturbances.delayed(actions, fresh)
        step = self._observed(self.episodes.step(sent))
        self.replay.add(actions, step)
        if self.agent.normaliser is not None and not self._begun:
            self.agent.normaliser.update(step.observations)
        taken = int((~fresh).sum())
        self.steps += taken
        if self.steps >= settings.start_steps:
            self._owed += taken * settings.updates_per_step
            while self._owed >= 1:
                self.agent.update(self._batch(), self.steps >= settings.actor_waits)
                self._owed -= 1

    def policy(self) -> Policy:
        """What has been learnt so far."""
        return self.agent.policy(self.task.name, self.task.goal_size)

    def state(self) -> TrainerState:
        """Everything but the replay buffer, from which ``restore`` goes on bit for bit."""
        return TrainerState(
            agent=self.agent.state(),
            episodes=copy.deepcopy(self._episodes_state()),
            steps=self.steps,
            owed=self._owed,
            diverged=self.simulator.diverged,
            redrawn=0 if self.draws is None else self.draws.redrawn,
            generators=tuple(json.dumps(g.bit_generator.state) for g in self._generators()),
            disturbances=None if self._disturbances is None else self._disturbances.state(),
        )

    def restore(self, state: TrainerState) -> None:
        """Go on from what ``state`` gave."""
        self.agent.restore(state.agent)
        self.episodes.set_theta(np.arange(self.settings.lanes), state.episodes.theta)
        for name, array in vars(self._episodes_state()).items():
            if array is not None:
                array[...] = getattr(state.episodes, name)
        for generator, kept in zip(self._generators(), state.generators, strict=True):
            generator.bit_generator.state = json.loads(kept)
        self.steps, self._owed = state.steps, state.owed
        self.simulator.diverged = state.diverged
        if self.draws is not None:
            self.draws.redrawn = state.redrawn
        if self._disturbances is not None and state.disturbances is not None:
            self._disturbances.restore(state.disturbances)

    def _generators(self) -> list[np.random.Generator]:
        return [self._noise, self._picks, self._draws, *self.episodes.generators]

    def _episodes_state(self) -> EpisodesState:
        """The arrays themselves."""
        at = self.episodes
        return EpisodesState(at.theta, at.states, at.goals, at.observations, at.elapsed, at.derived, at.over)

    def _actions(self) -> FloatArray:
        """(L, A): random ones at first, where there is no policy to begin as, then the actor's with noise."""
        settings, task = self.settings, self.task
        size = (settings.lanes, task.num_actions)
        if self.steps < settings.start_steps and not self._begun:
            return self._noise.uniform(task.action_low, task.action_high, size)
        half = (task.action_high - task.action_low) / 2
        actions = self.agent.act((self._disturbances or self.episodes).observations)
        actions += settings.exploration * half * self._noise.standard_normal(size)
        if settings.random_share:
            chosen = self._noise.random(size[0]) < settings.random_share
            actions[chosen] = self._noise.uniform(task.action_low, task.action_high, (int(chosen.sum()), size[1]))
        return np.clip(actions, task.action_low, task.action_high)

    def _redraw(self, fresh: BoolArray) -> None:
        chosen = np.flatnonzero(fresh)
        if self.draws is not None and len(chosen):
            self.episodes.set_theta(chosen, self.draws(self._draws, len(chosen)))
            if self._disturbances is not None:
                self._disturbances.begin(fresh)

    def _observed(self, step: Step) -> Step:
        """A step as the agent observes it."""
        if self._disturbances is None:
            return step
        return replace(step, observations=self._disturbances.noisy(step.observations))

    def _batch(self) -> Batch:
        count = self.settings.batch
        if self._shown is None:
            return self.replay.sample(self._picks, count)
        shown = self.settings.demonstrated
        parts = [b.sample(self._picks, n) for b, n in ((self.replay, count - shown), (self._shown, shown)) if n]
        return Batch(*(torch.cat([getattr(p, name) for p in parts]) for name in Batch.__annotations__))

    def _buffer(self, capacity: int, num_envs: int) -> Replay:
        task, settings = self.task, self.settings
        if capacity // num_envs <= task.episode_steps:
            raise ValueError(
                f"capacity: expected room for more than an episode of {task.episode_steps} steps in each of {num_envs} "
                f"environments, got {capacity}"
            )
        goals, reward = task.goal_size, task.goal_reward if task.goal_size else None
        k = settings.hindsight if goals else 0
        size = (len(task.channels), task.num_actions)
        return Replay(*size, capacity, num_envs, settings.discount, settings.n_step, goals, k, reward, self._device)

    def _demonstrated(self, given: Trajectories) -> Replay:
        batch, horizon = given.actions.shape[:2]
        buffer = self._buffer(batch * (max(horizon, self.task.episode_steps) + 1), batch)
        achieved = None
        if self.task.goal_size:
            if given.states is None:
                raise ValueError("demonstrations: expected states, to know which goals were reached, got none")
            achieved = self.task.achieved_goals(given.states, None)
        buffer.add_trajectories(given, achieved)
        return buffer
