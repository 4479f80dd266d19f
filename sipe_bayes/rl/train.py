"""Training DDPG on the batched engine: interruptible, resumable bit for bit (not on a card), every number on disk.

A policy is kept at every evaluation. ``suboptimal.safetensors`` is the one kept first at or after half of the steps;
``expert.safetensors`` the one of the highest mean return among those after it, since DDPG does not end on its best. It
is chosen by few episodes, so its return there flatters it: a card evaluates it on others. Under a randomisation these
episodes run in simulators drawn from it, the same ones at every evaluation, undisturbed: nothing is chosen by what the
agent does anywhere else.

The folder holds ``curve.csv``, a TensorBoard log, ``policies/``, at the end ``counts.json`` (steps, updates, theta
drawn anew because no model can have them, diverged simulations, and which run this was), and ``checkpoint/``: networks,
targets, optimisers, normaliser, random generators and the episodes' states in one safetensors file, with the replay
buffer beside it. The checkpoint names its buffer, and both are written before the previous ones go, so an interruption
leaves a whole pair.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import shutil
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, astuple, dataclass, fields
from pathlib import Path

import numpy as np
from pydantic import TypeAdapter

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.checkpoint import load_state, save_state
from sipe_bayes.core.files import read_json, read_text, reading, replacing, to_json, write_text
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.core.validation import whole
from sipe_bayes.envs.registry import make_task
from sipe_bayes.envs.task import Task
from sipe_bayes.models.policy import Policy, load_policy
from sipe_bayes.rl.evaluation import STARTS, evaluate
from sipe_bayes.rl.randomization import Draws, Randomization
from sipe_bayes.rl.settings import Settings
from sipe_bayes.rl.trainer import Trainer, TrainerState
from sipe_bayes.simulation.simulator import Simulator

Report = Callable[[str, int, int], None]
"""Called with a line of text, the steps taken and those to take."""

CHECKPOINT = "checkpoint/state.safetensors"
COUNTS = "counts.json"
REPORTED = 100  # control steps between two reports


@dataclass(frozen=True)
class CurvePoint:
    """A row of ``curve.csv``.

    Args:
        step: of the training.
        return_mean: of the evaluation.
        return_sd: of the evaluation.
        success_rate: None where only the return counts.
        wall_seconds: of the whole run so far.
        updates_per_second: since the row before.
    """

    step: int
    return_mean: float
    return_sd: float
    success_rate: float | None
    wall_seconds: float
    updates_per_second: float


@dataclass(frozen=True)
class Counts:
    """What a finished run came to.

    Args:
        steps: control steps taken.
        updates: of the networks.
        redrawn: theta that no model can have.
        diverged: simulations.
        asked: control steps that were to be taken.
        fingerprint: which run it was; empty of earlier versions.
    """

    steps: int
    updates: int
    redrawn: int
    diverged: int
    asked: int = 0
    fingerprint: str = ""


@dataclass(frozen=True)
class RunState:
    """A run between two steps: the trainer, the name of its replay buffer's file, the curve, and seconds so far."""

    trainer: TrainerState
    replay: str
    curve: tuple[CurvePoint, ...]
    seconds: float


@dataclass(frozen=True)
class Pace:
    """Control steps between points of the curve, episodes of a point, and control steps between checkpoints."""

    evaluate_every: int = 5_000
    evaluation_episodes: int = 10
    checkpoint_every: int = 25_000

    def __post_init__(self) -> None:
        for field in fields(self):
            whole(field.name, getattr(self, field.name))


PACE = Pace()


def train(
    task: str | Task,
    steps: int,
    seed: int,
    folder: Path,
    settings: Settings | None = None,
    *,
    resume: bool = False,
    randomization: Randomization | None = None,
    demonstrations: Trajectories | None = None,
    evaluate_every: int = PACE.evaluate_every,
    evaluation_episodes: int = PACE.evaluation_episodes,
    checkpoint_every: int = PACE.checkpoint_every,
    threads: int = 1,
    device: str = "cpu",
    report: Report | None = None,
) -> Policy:
    """Train an agent.

    Args:
        task: its name, or the task.
        steps: control steps.
        seed: the same one gives the same agent.
        folder: see the module for what it holds then.
        settings: how it learns.
        resume: go on from the folder's checkpoint, if it has one, also with more ``steps`` than before; the result is
            that of an uninterrupted run; one that is finished is read.
        randomization: what each episode draws; without one all run in the published model.
        demonstrations: trajectories with rewards, for ``settings.demonstration_share``.
        evaluate_every: control steps between points of the curve.
        evaluation_episodes: of each point.
        checkpoint_every: control steps between checkpoints.
        threads: of the simulation.
        device: what steps the environments and learns, as ``Simulator`` has them; evaluations are on the processor.
        report: is told how far it is.

    Returns:
        The expert.

    Raises:
        ValueError: for arguments out of range, and for a folder that holds another run or, without ``resume``, any.
    """
    task = make_task(task) if isinstance(task, str) else task
    settings, folder = settings or Settings(), Path(folder)
    pace = Pace(evaluate_every, evaluation_episodes, checkpoint_every)
    whole("steps", steps)
    whole("seed", seed, 0)
    if (folder / CHECKPOINT).is_file() and not resume:
        raise ValueError(
            f"--out {folder}: holds a run already; add --resume to go on with it, or choose another folder"
        )
    trainer = Trainer(task, settings, seed, randomization, demonstrations, threads, device)
    fingerprint = _fingerprint(trainer, seed, pace, randomization, demonstrations)
    if resume and _finished(folder, fingerprint, steps):
        return load_policy(folder / "expert.safetensors", task.name)
    log = _Log(folder, pace.evaluation_episodes, randomization)
    if resume and (folder / CHECKPOINT).is_file():
        log.load(trainer, fingerprint)
    log.begin(trainer)
    while trainer.steps < steps:
        before = trainer.steps
        trainer.advance()
        now, last = trainer.steps, before < steps <= trainer.steps
        if last or now // pace.evaluate_every > before // pace.evaluate_every:
            log.evaluate(trainer)
        if last or now // pace.checkpoint_every > before // pace.checkpoint_every:
            log.save(trainer, fingerprint)
        if report is not None and now // REPORTED > before // REPORTED:
            report(log.line(trainer), now, steps)
    return log.finish(trainer, steps, fingerprint)


def _fingerprint(
    trainer: Trainer, seed: int, pace: Pace, randomization: Randomization | None, demonstrations: Trajectories | None
) -> str:
    described = {
        "task": trainer.task.name,
        "model": trainer.simulator.checksum(),
        "seed": seed,
        "settings": trainer.settings.described(),
        "drawn": randomization is not None and randomization.fingerprint,
        "demonstrations": checksum(demonstrations),
        "evaluate_every": pace.evaluate_every,
        "evaluation_episodes": pace.evaluation_episodes,
    }
    return hashlib.sha256(json.dumps(described, sort_keys=True).encode()).hexdigest()


class _Log:
    """What a run writes: the curve, the TensorBoard log, the policies and the checkpoint."""

    def __init__(self, folder: Path, episodes: int, randomization: Randomization | None) -> None:
        self._folder, self._episodes, self._randomization = folder, episodes, randomization
        self._theta: FloatArray | None = None
        self._evaluator: Simulator | None = None
        self._curve: list[CurvePoint] = []
        self._spent = 0.0  # seconds of earlier parts of the run
        self._kept = (folder / CHECKPOINT).parent
        for made in (self._kept, folder / "policies"):
            made.mkdir(parents=True, exist_ok=True)

    def begin(self, trainer: Trainer) -> None:
        from torch.utils.tensorboard import SummaryWriter

        self._began, self._first = time.perf_counter(), trainer.steps
        self._last = (self._began, trainer.agent.updates)
        self._writer = SummaryWriter(self._folder / "tensorboard", purge_step=trainer.steps)

    def seconds(self) -> float:
        return self._spent + time.perf_counter() - self._began

    def line(self, trainer: Trainer) -> str:
        rate = (trainer.steps - self._first) / (time.perf_counter() - self._began)
        earned = f"return {self._curve[-1].return_mean:.0f}, " if self._curve else ""
        return f"{trainer.task.name}: {earned}{rate:.0f} steps/s"

    def evaluate(self, trainer: Trainer) -> None:
        policy, now = trainer.policy(), time.perf_counter()
        rate = (trainer.agent.updates - self._last[1]) / (now - self._last[0])
        self._evaluator = self._evaluator or Simulator(trainer.task, trainer.simulator.num_threads)
        if self._randomization is not None and self._theta is None:
            draws = Draws(self._evaluator, self._randomization.posterior)
            self._theta = draws(np.random.default_rng(STARTS.curve), self._episodes)
        earned = evaluate(policy, self._evaluator, self._episodes, STARTS.curve, self._theta)
        policy.save(self._policy(trainer.steps))
        point = CurvePoint(trainer.steps, earned.mean, earned.sd, earned.success_rate, self.seconds(), rate)
        self._curve.append(point)
        self._write_curve()
        for name, value in asdict(point).items():
            if name != "step" and value is not None:
                self._writer.add_scalar(name, value, point.step)
        self._writer.flush()
        self._last = (time.perf_counter(), trainer.agent.updates)

    def save(self, trainer: Trainer, fingerprint: str) -> None:
        name = f"replay-{trainer.steps}.npz"
        trainer.replay.save(self._kept / name)
        state = RunState(trainer.state(), name, tuple(self._curve), self.seconds())
        save_state(self._folder / CHECKPOINT, state, fingerprint)
        for path in (*self._kept.glob("replay-*.npz"), *self._kept.glob(".replay-*")):  # also what an interruption left
            if path.name != name:
                path.unlink()

    def load(self, trainer: Trainer, fingerprint: str) -> None:
        path = self._folder / CHECKPOINT
        state = load_state(path, RunState, fingerprint)
        trainer.replay.load(self._kept / Path(state.replay).name)
        with reading(path, "a checkpoint of this training", "delete it to start again"):
            trainer.restore(state.trainer)
        self._curve, self._spent = list(state.curve), state.seconds
        self._write_curve()

    def finish(self, trainer: Trainer, steps: int, fingerprint: str) -> Policy:
        """Copy the two agents to their names, and say what it took."""
        self._writer.close()
        for name, step in choose(self._curve, steps).items():
            with replacing(self._folder / f"{name}.safetensors") as temporary:
                shutil.copyfile(self._policy(step), temporary)
        redrawn = 0 if trainer.draws is None else trainer.draws.redrawn
        counts = Counts(trainer.steps, trainer.agent.updates, redrawn, trainer.simulator.diverged, steps, fingerprint)
        write_text(self._folder / COUNTS, to_json(asdict(counts)) + "\n")
        return load_policy(self._folder / "expert.safetensors", trainer.task.name)

    def _policy(self, step: int) -> Path:
        return self._folder / "policies" / f"{step}.safetensors"

    def _write_curve(self) -> None:
        names = [field.name for field in fields(CurvePoint)]
        write_table(self._folder / "curve.csv", names, map(astuple, self._curve))


def write_table(path: Path, names: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write a CSV file whose columns have names."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([names, *rows])
    write_text(path, text.getvalue())


def _finished(folder: Path, fingerprint: str, steps: int) -> bool:
    """Whether the folder holds the end of this very run, be its checkpoint there or not."""
    try:
        counts = read_counts(folder)
    except (OSError, ValueError):
        return False
    return (counts.fingerprint, counts.asked) == (fingerprint, steps)


def choose(curve: Sequence[CurvePoint], steps: int) -> dict[str, int]:
    """The steps of the agents "suboptimal" and "expert", of a run of ``steps``."""
    second = [point for point in curve if 2 * point.step >= steps]
    best = max(second[1:] or second, key=lambda point: point.return_mean)
    return {"suboptimal": second[0].step, "expert": best.step}


def read_curve(folder: Path) -> list[CurvePoint]:
    """The learning curve of a finished run."""
    path, what, remedy = folder / "curve.csv", "a learning curve", "train again"
    text = read_text(path, what, remedy)
    with reading(path, what, remedy):
        rows = [{key: value or None for key, value in row.items()} for row in csv.DictReader(text.splitlines())]
        return TypeAdapter(list[CurvePoint]).validate_python(rows)


def read_counts(folder: Path) -> Counts:
    """What a finished run came to; raises OSError or ValueError where it is not finished."""
    path, what, remedy = folder / COUNTS, "what a training came to", "train again"
    plain = read_json(path, what, remedy)
    with reading(path, what, remedy):
        return TypeAdapter(Counts).validate_python(plain)


def checksum(given: Trajectories | None) -> str:
    """Of demonstrations, "" without any."""
    if given is None:
        return ""
    digest = hashlib.sha256(given.observations.tobytes())
    for part in (given.actions, given.rewards):
        digest.update(b"" if part is None else part.tobytes())
    return digest.hexdigest()
