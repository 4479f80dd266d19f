"""Policy in the loop: an agent is trained in the simulators that an estimator believes in, and teaches the estimator.

B. Mehta, A. Handa, D. Fox, F. Ramos 2020, "A User's Guide to Calibrating Robotics Simulators", sections 3.2 and 3.3
(https://arxiv.org/abs/2011.08985). A run of ``steps`` control steps has ``updates`` iterations; in each

1. the agent (``sipe_bayes.rl.ddpg``) acts and learns for ``steps / updates`` control steps. Every episode has a theta
   of its own, drawn from the prior at first, then from the estimator's ``proposal`` where it has one (simopt's
   Gaussian), else from its posterior. The transitions fill the replay buffer;
2. the actions of the ``trajectories`` latest of these episodes, the noise of exploration included, are replayed from
   the same starting states in the reference environment, whose theta is hidden from the estimator;
3. the estimator gets the reference's trajectories, and spends its budget up to the share of the training that is done.

What a method does with other trajectories each time follows from what its state holds:

- The searches (simopt, adr, cem, also with learned rewards) keep a distribution over theta and begin a new pool of
  simulations: they take as many steps as their share of the budget wants.
- Everything else conditions on simulations of the actions in hand (npe, bayessim, abc, regression, maml, bayesopt) or
  on their residuals (laplace, mcmc). Such a state says nothing of another experiment, so these are fitted anew to the
  present trajectories with what is left of the budget so far. No trajectory counts twice, and an estimate knows the
  latest ones only. The trajectories hold the reference's states, noise-free: ``Segments(dt, noise="white",
  starts="recorded")`` spares laplace and mcmc the search for windows' starts.

Two budgets: the estimator's counts its simulations as always; ``reference_rollouts`` counts the trajectories taken from
the reference. Training, and the evaluations of the history, which nothing is chosen by, belong to neither.

Convergence, the paper's: a seed counts only if its policy solves the environment (``Task.solved``). The paper does not
say which of them. Here it is the one that the policy was trained in, simulators drawn from the last estimate: to ask
for the reference would count a seed because its estimate is good, and with it its accuracy. What the last policy does
in the reference stands beside it.

A theta that is outside the cube or unphysical is drawn anew and counted (``redrawn``). One whose simulation diverges
ends its episode, the next has another theta, and that is counted too (``diverged``).

Deviations:

- The reference replays the simulated episode's actions, where the paper lets the policy choose its own there ("control
  for starting states" alone): the methods that compare states need equal actions.
- Of an episode its first ``trajectory_steps`` are used, not the whole.
- How often the estimator is updated, and the pace of its budget, are not in the paper.
- Where a ``policy`` is given the agent begins as it, where the paper trains from scratch: a short training solves
  nothing otherwise, and whoever calibrates a simulator has a policy that works in the nominal one.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Generic, TypeVar

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.checkpoint import SearchState, Snapshot, load_state, save_state
from sipe_bayes.core.files import to_json, write_text
from sipe_bayes.core.findings import Finding, Findings
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.inference.base import Estimator
from sipe_bayes.inference.search.base import Search
from sipe_bayes.models.policy import Policy
from sipe_bayes.posterior import load_posterior
from sipe_bayes.rl.loop_run import LoopResult, LoopRun, Plan, Update
from sipe_bayes.rl.settings import Settings
from sipe_bayes.rl.train import CHECKPOINT as CHECKPOINT
from sipe_bayes.rl.train import Report, write_table
from sipe_bayes.rl.trainer import TrainerState

S = TypeVar("S", bound=SearchState)


def train_in_the_loop(
    estimator: Estimator,
    reference: str | FloatArray = "default",
    steps: int = 100_000,
    *,
    updates: int = 10,
    trajectories: int = 1,
    trajectory_steps: int | None = None,
    settings: Settings | None = None,
    demonstrations: Trajectories | None = None,
    policy: Policy | None = None,
    evaluation_episodes: int = 10,
    folder: str | Path | None = None,
    resume: bool = False,
    threads: int = 1,
    report: Report | None = None,
) -> LoopResult:
    """Train a policy while an estimator runs; see the module.

    Args:
        estimator: a fresh one on a simulator of a task, such as ``sipe.get_estimator("Pendulum", "simopt",
            budget=1000)``; it brings prior, budget and seed, and is the run's own from then on.
        reference: a variant's name or theta (N,), which may lie outside [0, 1].
        steps: control steps.
        updates: iterations.
        trajectories: taken from the reference for each.
        trajectory_steps: of each, default an episode or its first 250.
        settings: how the agent learns.
        demonstrations: trajectories with rewards, from which ``settings.demonstration_share`` of each batch is taken;
            given with a share alone.
        policy: that the agent begins as, such as one that works in the published model; ``settings`` are to have its
            layers, and ``actor_waits``.
        evaluation_episodes: of the policy, in the simulators and in the reference, at each update.
        folder: where ``history.csv``, ``result.json``, ``policy.safetensors``, ``posterior`` and a checkpoint, written
            at each update, are kept.
        resume: go on from there, to the result of an undisturbed run.
        threads: of the simulation.
        report: is told how far it is.

    Raises:
        ValueError: for arguments out of range, a folder that holds another run or, without ``resume``, any; and where
            the first update gives no estimate.
    """
    plan = Plan(steps, updates, trajectories, trajectory_steps, evaluation_episodes, settings or Settings())
    run = LoopRun(estimator, reference, plan, threads, demonstrations, policy)
    kept = None if folder is None else _Folder(Path(folder), run, resume)
    while len(run.history) < updates:
        run.iterate(report)
        if kept is not None:
            kept.save(run)
    result = run.result()
    if kept is not None:
        kept.finish(run, result)
    return result


@dataclass(frozen=True)
class LoopState(Generic[S]):
    """A run between two iterations.

    Args:
        trainer: as it was.
        search: as it was; None of a method that is fitted anew.
        history: so far.
        findings: of the last estimate.
        spent: rollouts of the estimator.
        reference_rollouts: trajectories taken from the reference.
        idle: whether the search is over.
    """

    trainer: TrainerState
    search: Snapshot[S] | None
    history: tuple[Update, ...]
    findings: tuple[Finding, ...]
    spent: int
    reference_rollouts: int
    idle: bool


class _Folder:
    """What a run keeps on disk.

    The checkpoint's replay buffer and posteriors are written before it, and those of the one before go after it: an
    interruption leaves a whole set.
    """

    def __init__(self, folder: Path, run: LoopRun, resume: bool) -> None:
        self._folder, self._kept = folder, (folder / CHECKPOINT).parent
        begun = (folder / CHECKPOINT).is_file()
        if begun and not resume:
            raise ValueError(
                f"folder {folder}: holds a run already; pass resume=True to go on, or choose another folder"
            )
        self._kept.mkdir(parents=True, exist_ok=True)
        if begun:
            self._load(run)

    def save(self, run: LoopRun) -> None:
        number = len(run.history)
        run.trainer.replay.save(self._kept / f"replay-{number}.npz")
        run.posterior.save(self._kept / f"posterior-{number}")
        run.draw.source.save(self._kept / f"proposal-{number}")
        state = LoopState(
            trainer=run.trainer.state(),
            search=run.estimator.snapshot if isinstance(run.estimator, Search) else None,
            history=tuple(run.history),
            findings=tuple(run.estimator.findings),
            spent=run.spent,
            reference_rollouts=run.reference_rollouts,
            idle=run.idle,
        )
        save_state(self._folder / CHECKPOINT, state, run.fingerprint)
        for path in self._kept.iterdir():  # also what an interruption left
            if path.name != Path(CHECKPOINT).name and not path.stem.endswith(f"-{number}"):
                path.unlink()
        *plain, _, _ = (field.name for field in fields(Update))  # and a column for each parameter's mean and sd
        names = [*plain, *(f"{kind}_{name}" for kind in ("mean", "sd") for name in run.task.space.names)]
        rows = ([*(getattr(row, key) for key in plain), *row.mean, *row.sd] for row in run.history)
        write_table(self._folder / "history.csv", names, rows)

    def finish(self, run: LoopRun, result: LoopResult) -> None:
        result.policy.save(self._folder / "policy.safetensors")
        result.posterior.save(self._folder / "posterior")
        plain = {
            "task": run.task.name,
            "estimator": run.estimator.name,
            "seed": run.estimator.seed,
            "budget": run.budget,
            "reference": run.truth.tolist(),
            "converged": result.converged,
            "solved_reference": result.solved_reference,
            "solved_at": {"measure": run.task.solved.measure, "threshold": run.task.solved.threshold},
            "warnings": list(result.warnings),
            "history": [asdict(update) for update in result.history],
        }
        write_text(self._folder / "result.json", to_json(plain, indent=1))

    def _load(self, run: LoopRun) -> None:
        kind = LoopState[run.estimator.state_type]  # type: ignore[name-defined]
        state = load_state(self._folder / CHECKPOINT, kind, run.fingerprint)
        number = len(state.history)
        run.history = list(state.history)
        run.trainer.replay.load(self._kept / f"replay-{number}.npz")
        run.trainer.restore(state.trainer)
        run.posterior = load_posterior(self._kept / f"posterior-{number}")
        run.draw.source = load_posterior(self._kept / f"proposal-{number}")
        run.spent, run.reference_rollouts, run.idle = state.spent, state.reference_rollouts, state.idle
        if isinstance(run.estimator, Search) and state.search is not None:
            run.estimator.go_on_from(state.search)
            run.estimator.rollouts = run.spent
        run.estimator.findings = Findings(state.findings)
