"""The iterations of policy in the loop, as ``sipe_bayes.rl.policy_in_the_loop`` describes them, in memory."""

from __future__ import annotations

import hashlib
import json
from collections import deque
from dataclasses import asdict, dataclass, field

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.findings import Code, Findings
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.core.validation import whole
from sipe_bayes.datasets.demonstrations import default_steps
from sipe_bayes.envs.task import Task
from sipe_bayes.inference.base import Estimator
from sipe_bayes.inference.search.base import Search
from sipe_bayes.models.policy import Policy
from sipe_bayes.posterior import Posterior
from sipe_bayes.rl.evaluation import STARTS, evaluate
from sipe_bayes.rl.randomization import Randomization
from sipe_bayes.rl.settings import Settings
from sipe_bayes.rl.train import REPORTED, Report, checksum
from sipe_bayes.rl.trainer import Trainer
from sipe_bayes.simulation.simulator import Simulator


@dataclass(frozen=True)
class Update:
    """A row of the history, N parameters.

    Args:
        update: its number, from 1.
        step: of the training.
        rollouts: of the estimator so far.
        reference_rollouts: trajectories taken from the reference so far.
        accuracy: 1 - |mean - truth|, mean over parameters: reported, never used.
        least_accuracy: of the worst parameter.
        simulation_return: of the policy, in simulators drawn from the estimate.
        simulation_success: None where only the return counts.
        reference_return: of the policy, in the reference.
        reference_success: None where only the return counts.
        redrawn: theta so far that no model can have.
        diverged: simulations so far.
        failure: why the update gave no estimate, in which case the one before stays.
        mean: of the estimate (N,).
        sd: of the estimate (N,).
    """

    update: int
    step: int
    rollouts: int
    reference_rollouts: int
    accuracy: float
    least_accuracy: float
    simulation_return: float
    simulation_success: float | None
    reference_return: float
    reference_success: float | None
    redrawn: int
    diverged: int
    failure: str | None
    mean: tuple[float, ...]
    sd: tuple[float, ...]


@dataclass(frozen=True)
class Plan:
    """How a run goes; see ``train_in_the_loop``.

    Raises:
        ValueError: for numbers out of range.
    """

    steps: int
    updates: int
    trajectories: int
    trajectory_steps: int | None
    evaluation_episodes: int
    settings: Settings

    def __post_init__(self) -> None:
        for name in ("steps", "updates", "trajectories", "evaluation_episodes"):
            whole(name, getattr(self, name))

    def horizon(self, task: Task) -> int:
        """Control steps of a trajectory; raises ValueError where no episode can begin in an update."""
        asked = self.trajectory_steps
        steps = default_steps(task) if asked is None else whole("trajectory_steps", asked)
        if steps > task.episode_steps:
            raise ValueError(f"trajectory_steps: expected at most an episode's {task.episode_steps}, got {steps}")
        least = (task.episode_steps + steps + 1) * self.settings.lanes
        if self.steps // self.updates < least:
            raise ValueError(
                f"steps: {self.steps} in {self.updates} updates are too few for an episode to begin in each, expected "
                f"{least} for each; raise steps, or take fewer updates"
            )
        return steps


@dataclass(frozen=True)
class LoopResult:
    """What a run came to.

    Args:
        policy: the last one.
        posterior: the last estimate.
        history: a row for each update.
        converged: whether the last policy solves simulators drawn from the last estimate.
        solved_reference: whether it solves the reference.
        warnings: the last estimate's, and what failed on the way.
    """

    policy: Policy
    posterior: Posterior
    history: tuple[Update, ...]
    converged: bool
    solved_reference: bool
    warnings: tuple[str, ...]


@dataclass
class _Begun:
    """The beginning of an episode: state (S,), goal (G,) or None, and actions (A,) so far."""

    state: FloatArray
    goal: FloatArray | None
    actions: list[FloatArray] = field(default_factory=list)


class _Recorder:
    """Advances a trainer and keeps the first actions of its latest episodes that came so far or ended."""

    def __init__(self, trainer: Trainer, count: int, steps: int) -> None:
        self._trainer, self._steps = trainer, steps
        self._running: dict[int, _Begun] = {}
        self.episodes: deque[_Begun] = deque(maxlen=count)

    def advance(self) -> None:
        at, replay = self._trainer.episodes, self._trainer.replay
        for env in np.flatnonzero(at.elapsed == 0).tolist():
            goal = None if at.goals is None else at.goals[env].copy()
            self._running[env] = _Begun(at.states[env].copy(), goal)
        self._trainer.advance()
        row = (replay.head - 1) % replay.rows
        for env, begun in list(self._running.items()):
            begun.actions.append(replay.actions[row, env].double().cpu().numpy())
            if len(begun.actions) == self._steps or replay.ends[row, env] >= 0:
                self.episodes.append(self._running.pop(env))


class LoopRun:
    """The state of a run: the trainer, the estimator, what theta are drawn from, and the history.

    Args:
        estimator: a fresh one on a simulator of a task.
        reference: a variant's name, or theta (N,).
        plan: how it goes.
        threads: of the simulation.
        demonstrations: that the agent learns from besides.
        policy: that the agent begins as.

    Raises:
        ValueError: for an estimator that is not fresh, another reference, and a plan or policy that does not fit.
    """

    def __init__(
        self,
        estimator: Estimator,
        reference: str | FloatArray,
        plan: Plan,
        threads: int,
        demonstrations: Trajectories | None = None,
        policy: Policy | None = None,
    ) -> None:
        self.task = task = _task(estimator)
        self.truth = task.theta(reference) if isinstance(reference, str) else _theta(task, reference)
        self.plan, self.horizon = plan, plan.horizon(task)
        self.estimator, self.budget = estimator, estimator.budget
        described = {
            "task": task.name,
            "estimator": estimator.settings(),
            "reference": self.truth.tolist(),
            **asdict(plan),
            "settings": plan.settings.described(),
            **({} if demonstrations is None else {"demonstrations": checksum(demonstrations)}),
            **({} if policy is None else {"policy": policy.checksum}),
        }
        self.fingerprint = hashlib.sha256(json.dumps(described, sort_keys=True, default=repr).encode()).hexdigest()
        self.simulator = Simulator(task, threads)  # of the reference and of evaluations
        self.posterior: Posterior = estimator.prior
        self.spent = self.reference_rollouts = 0
        self.idle = False  # a search that is over
        self.history: list[Update] = []
        drawn = Randomization(self.posterior)
        self.trainer = Trainer(task, plan.settings, estimator.seed, drawn, demonstrations, threads, policy=policy)
        assert self.trainer.draws is not None
        self.draw = self.trainer.draws

    def iterate(self, report: Report | None) -> None:
        """Train, estimate, and add a row to the history."""
        # the agent acts and learns
        recorder = _Recorder(self.trainer, self.plan.trajectories, self.horizon)
        until = self.plan.steps * (len(self.history) + 1) // self.plan.updates
        while self.trainer.steps < until:
            before = self.trainer.steps
            recorder.advance()
            if report is not None and self.trainer.steps // REPORTED > before // REPORTED:
                report(f"{self.task.name}: update {len(self.history)}", self.trainer.steps, self.plan.steps)
        # the estimator spends its share of the budget
        allowed = self.budget * (len(self.history) + 1) // self.plan.updates - self.spent
        failure = None
        if allowed > 0 and not self.idle:
            failure = self._estimate(list(recorder.episodes), allowed)
        self.history.append(self._row(failure))

    def result(self) -> LoopResult:
        """What the run came to after its last update."""
        last = self.history[-1]
        failures = [f"update {row.update}: {row.failure}" for row in self.history if row.failure]
        return LoopResult(
            policy=self.trainer.policy(),
            posterior=self.posterior,
            history=tuple(self.history),
            converged=solves(self.task, last.simulation_return, last.simulation_success),
            solved_reference=solves(self.task, last.reference_return, last.reference_success),
            warnings=(*dict.fromkeys(self.estimator.warnings), *failures),
        )

    def _estimate(self, episodes: list[_Begun], allowed: int) -> str | None:
        """Update the estimate with ``allowed`` rollouts; returns why there is none."""
        recorded = self._replayed(episodes)
        try:
            if not recorded:
                raise ValueError("every trajectory of the reference diverged at once")
            given = Trajectories.stack(recorded)
            if isinstance(self.estimator, Search):
                self._searched(self.estimator, given, allowed)
            else:
                self._fitted(given, allowed)
        except ValueError as error:
            if not self.history:
                raise ValueError(
                    f"{error} (the first of {self.plan.updates} updates, with {allowed} rollouts)"
                ) from None
            return str(error)
        return None

    def _searched(self, estimator: Search, given: Trajectories, allowed: int) -> None:
        """Steps of a search, until it has spent ``allowed`` more rollouts or is over."""
        until = self.spent + allowed
        estimator.findings = Findings()  # those of earlier estimates are over
        while self.spent < until and not self.idle:
            estimator.update_parameter_estimate(given)
            self.idle = estimator.rollouts == self.spent
            self.spent = estimator.rollouts
        self.posterior = estimator.get_parameter_estimate(given)
        self.draw.source = self.posterior if estimator.proposal is None else estimator.proposal

    def _fitted(self, given: Trajectories, allowed: int) -> None:
        """A new fit with a budget of ``allowed`` rollouts; what it leaves is for the next one."""
        self.estimator.budget = allowed
        try:
            self.posterior = self.draw.source = self.estimator.fit(given)
        finally:
            self.estimator.budget = self.budget
            self.spent += self.estimator.rollouts
        self.estimator.findings.drop(Code.TRAINED_ANEW)  # as at every update, whether interrupted before or not

    def _replayed(self, episodes: list[_Begun]) -> list[Trajectory]:
        """What the reference does from the episodes' starting states with their actions, as far as it is valid."""
        replayed = []
        for begun in episodes:
            actions = np.stack(begun.actions)[None]
            made = self.simulator.rollout(self.truth, actions, begun.state, allow_outside=True, goals=begun.goal)
            valid = int(made.valid[0].sum()) - 1
            if valid > 0:
                replayed.append(made[0].slice(0, valid))
        self.reference_rollouts += len(episodes)
        return replayed

    def _row(self, failure: str | None) -> Update:
        policy, count = self.trainer.policy(), self.plan.evaluation_episodes
        rng = np.random.default_rng([self.estimator.seed, 1 + len(self.history)])
        inside = evaluate(policy, self.simulator, count, STARTS.loop, theta=self.draw(rng, count))
        outside = evaluate(policy, self.simulator, count, STARTS.loop, theta=self.truth)
        mean, sd = self.posterior.mean.numpy(), self.posterior.stddev.numpy()
        accuracy = 1 - np.abs(mean - self.truth)
        return Update(
            update=len(self.history) + 1,
            step=self.trainer.steps,
            rollouts=self.spent,
            reference_rollouts=self.reference_rollouts,
            accuracy=float(accuracy.mean()),
            least_accuracy=float(accuracy.min()),
            simulation_return=inside.mean,
            simulation_success=inside.success_rate,
            reference_return=outside.mean,
            reference_success=outside.success_rate,
            redrawn=self.draw.redrawn,
            diverged=self.trainer.simulator.diverged,
            failure=failure,
            mean=tuple(mean.tolist()),
            sd=tuple(sd.tolist()),
        )


def solves(task: Task, mean_return: float, success_rate: float | None) -> bool:
    """Whether a policy solves a task."""
    measured = mean_return if task.solved.measure == "return" else success_rate
    return measured is not None and measured >= task.solved.threshold


def _task(estimator: Estimator) -> Task:
    """The task of a fresh estimator; raises ValueError for anything else."""
    task = estimator.simulator.environment if isinstance(estimator, Estimator) else None
    if not isinstance(task, Task):
        raise ValueError(
            f"estimator: expected one on a task of `sipe envs`, got {estimator!r}; make sipe.get_estimator(task, name)"
        )
    if estimator.snapshot is not None or estimator.checkpoint is not None:
        raise ValueError(
            "estimator: expected a fresh one without a checkpoint of its own; give a folder to the run instead"
        )
    return task


def _theta(task: Task, reference: FloatArray) -> FloatArray:
    theta = task.space.check_shape(reference)
    if theta.ndim != 1 or not np.isfinite(theta).all():
        raise ValueError(f"reference: expected a variant's name or {len(task.space)} finite numbers, got {reference!r}")
    return theta
