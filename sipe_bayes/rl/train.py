"""Training DDPG on the batched engine: interruptible, resumable bit for bit, every number on disk.

A policy is kept at every evaluation. ``suboptimal.safetensors`` is the one kept first at or after half of the steps;
``expert.safetensors`` the one of the highest mean return among those after it, since DDPG does not end on its best.
It is chosen by few episodes, so its return there flatters it: a card evaluates it on others. Under a randomisation these episodes run in
simulators drawn from it, the same ones at every evaluation, undisturbed: nothing is chosen by what the agent does anywhere else.

The folder holds ``curve.csv``, a TensorBoard log, ``policies/``, at the end ``counts.json`` (steps, updates, theta drawn anew because no
model can have them, diverged simulations, and which run this was), and ``checkpoint/``: networks, targets, optimisers,
normaliser, every random generator and the lanes' states in one safetensors file, with the replay buffer beside it. The
checkpoint names its buffer, and both are written before the previous ones go, so an interruption leaves a whole pair.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sipe_bayes.core.checkpoint import State, load_state, save_state
from sipe_bayes.core.files import replacing, to_json, write_text
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.envs.registry import make_task
from sipe_bayes.envs.task import Task
from sipe_bayes.models.policy import Policy, load_policy
from sipe_bayes.rl.evaluation import evaluate
from sipe_bayes.rl.randomization import Draws, Randomization
from sipe_bayes.rl.settings import Settings
from sipe_bayes.rl.trainer import Trainer
from sipe_bayes.simulation.simulator import Simulator

Report = Callable[[str, int, int], None]
"""Called with a line of text, the steps taken and those to take."""

CHECKPOINT = "checkpoint/state.safetensors"
COUNTS = "counts.json"
CURVE = ("step", "return_mean", "return_sd", "success_rate", "wall_seconds", "updates_per_second")
_LATER = ("cloning", "end_hopeless")  # settings without which earlier runs go on
_EVALUATION_SEED = 2_000_000  # of the curve's starts: other ones than a card's


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
    evaluate_every: int = 5_000,
    evaluation_episodes: int = 10,
    checkpoint_every: int = 25_000,
    threads: int = 1,
    device: str = "cpu",
    report: Report | None = None,
) -> Policy:
    """Train for ``steps`` control steps and return the expert; see the module for what ``folder`` holds then.

    randomization: what each episode draws; without one all run in the published model. device: where the networks learn, "cpu" or
    "cuda"; a run may go on on the other. resume: go on from the folder's checkpoint, if it has one, also with more ``steps`` than
    before; the result is that of an uninterrupted run; one that is finished is read. Raises ValueError for arguments out of range, and for
    a folder that holds another run or, without ``resume``, any.
    """
    task = make_task(task) if isinstance(task, str) else task
    settings = settings or Settings()
    least = {"steps": steps, "evaluate_every": evaluate_every, "evaluation_episodes": evaluation_episodes}
    for name, value in {**least, "checkpoint_every": checkpoint_every}.items():
        if value < 1:
            raise ValueError(f"{name}: expected at least 1, got {value}")
    if seed < 0:
        raise ValueError(f"seed: expected at least 0, got {seed}")
    folder = Path(folder)
    if (folder / CHECKPOINT).is_file() and not resume:
        raise ValueError(
            f"--out {folder}: holds a run already; add --resume to go on with it, or choose another folder"
        )
    trainer = Trainer(task, settings, seed, randomization, demonstrations, threads, device)
    described = {
        "task": task.name,
        "model": trainer.simulator.checksum(),
        "seed": seed,
        "settings": {k: v for k, v in settings.to_dict().items() if v or k not in _LATER},
        "drawn": randomization is not None and randomization.fingerprint,
        "demonstrations": checksum(demonstrations),
        "evaluate_every": evaluate_every,
        "evaluation_episodes": evaluation_episodes,
    }
    fingerprint = hashlib.sha256(json.dumps(described, sort_keys=True).encode()).hexdigest()
    if resume and _finished(folder, fingerprint, steps):
        return load_policy(folder / "expert.safetensors", task.name)
    log = _Log(folder, evaluation_episodes, randomization)
    if resume and (folder / CHECKPOINT).is_file():
        log.load(trainer, fingerprint)
    log.begin(trainer)
    while trainer.steps < steps:
        before = trainer.steps
        trainer.advance()
        if trainer.steps // evaluate_every > before // evaluate_every or before < steps <= trainer.steps:
            log.evaluate(trainer)
        if trainer.steps // checkpoint_every > before // checkpoint_every or before < steps <= trainer.steps:
            log.save(trainer, fingerprint)
        if report is not None and trainer.steps // 100 > before // 100:
            report(log.line(trainer), trainer.steps, steps)
    return log.finish(trainer, steps, fingerprint)


class _Log:
    """What a run writes: the curve, the TensorBoard log, the policies and the checkpoint."""

    def __init__(self, folder: Path, episodes: int, randomization: Randomization | None) -> None:
        from torch.utils.tensorboard import SummaryWriter

        self._folder, self._episodes, self._board = folder, episodes, SummaryWriter
        self._randomization = randomization
        self._theta: NDArray[np.float64] | None = None
        self._writer: Any = None
        self._evaluator: Simulator | None = None
        self.rows: list[list[float | None]] = []
        self._spent = 0.0  # seconds of earlier parts of the run
        self._kept = (folder / CHECKPOINT).parent
        for made in (self._kept, folder / "policies"):
            made.mkdir(parents=True, exist_ok=True)

    def begin(self, trainer: Trainer) -> None:
        self._began, self._first = time.perf_counter(), trainer.steps
        self._last = (self._began, trainer.agent.updates)
        self._writer = self._board(self._folder / "tensorboard", purge_step=trainer.steps)

    def seconds(self) -> float:
        return self._spent + time.perf_counter() - self._began

    def line(self, trainer: Trainer) -> str:
        rate = (trainer.steps - self._first) / (time.perf_counter() - self._began)
        earned = f"return {self.rows[-1][1]:.0f}, " if self.rows else ""
        return f"{trainer.task.name}: {earned}{rate:.0f} steps/s"

    def evaluate(self, trainer: Trainer) -> None:
        policy, now = trainer.policy(), time.perf_counter()
        rate = (trainer.agent.updates - self._last[1]) / (now - self._last[0])
        self._evaluator = self._evaluator or Simulator(trainer.task, trainer.simulator.num_threads)
        if self._randomization is not None and self._theta is None:
            draws = Draws(self._evaluator, self._randomization.posterior)
            self._theta = draws(np.random.default_rng(_EVALUATION_SEED), self._episodes)
        found = evaluate(policy, self._evaluator, self._episodes, _EVALUATION_SEED, self._theta)
        policy.save(self._policy(trainer.steps))
        measured = (found["mean"], found["sd"], found["success_rate"], self.seconds(), rate)
        self.rows.append([trainer.steps, *measured])
        self._write_curve()
        for name, value in zip(CURVE[1:], measured, strict=True):
            if value is not None:
                self._writer.add_scalar(name, value, trainer.steps)
        self._writer.flush()
        self._last = (time.perf_counter(), trainer.agent.updates)

    def save(self, trainer: Trainer, fingerprint: str) -> None:
        name = f"replay-{trainer.steps}.npz"
        trainer.replay.save(self._kept / name)
        run = {"replay": name, "curve": json.dumps(self.rows), "seconds": self.seconds()}
        save_state(self._folder / CHECKPOINT, {**trainer.state(), **run}, fingerprint)
        for path in (*self._kept.glob("replay-*.npz"), *self._kept.glob(".replay-*")):  # also what an interruption left
            if path.name != name:
                path.unlink()

    def load(self, trainer: Trainer, fingerprint: str) -> None:
        state = load_state(self._folder / CHECKPOINT, State, fingerprint)
        trainer.replay.load(self._kept / Path(state["replay"]).name)
        trainer.restore(state)
        self.rows, self._spent = json.loads(state["curve"]), float(state["seconds"])
        self._write_curve()

    def finish(self, trainer: Trainer, steps: int, fingerprint: str) -> Policy:
        """Copy the two agents to their names, and say what it took."""
        self._writer.close()
        chosen = choose(self.rows, steps)
        for name, step in chosen.items():
            with replacing(self._folder / f"{name}.safetensors") as temporary:
                shutil.copyfile(self._policy(step), temporary)
        counts = {
            "steps": trainer.steps,
            "updates": trainer.agent.updates,
            "redrawn": 0 if trainer.draws is None else trainer.draws.redrawn,
            "diverged": trainer.simulator.diverged,
            "asked": steps,
            "fingerprint": fingerprint,
        }
        write_text(self._folder / COUNTS, to_json(counts) + "\n")
        return load_policy(self._folder / "expert.safetensors", trainer.task.name)

    def _policy(self, step: float) -> Path:
        return self._folder / "policies" / f"{int(step)}.safetensors"

    def _write_curve(self) -> None:
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(CURVE)
        writer.writerows(self.rows)
        write_text(self._folder / "curve.csv", text.getvalue())


def _finished(folder: Path, fingerprint: str, steps: int) -> bool:
    """Whether the folder holds the end of this very run, be its checkpoint there or not."""
    try:
        counts = json.loads((folder / COUNTS).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return bool((counts.get("fingerprint"), counts.get("asked")) == (fingerprint, steps))


def choose(rows: list[list[Any]], steps: int) -> dict[str, int]:
    """The steps of the two agents, of a curve's rows."""
    second = [row for row in rows if 2 * row[0] >= steps]
    best = max(second[1:] or second, key=lambda row: row[1])
    return {"suboptimal": int(second[0][0]), "expert": int(best[0])}


def read_curve(folder: Path) -> list[list[Any]]:
    """The rows of a finished run's curve; None where a number is missing."""
    with (folder / "curve.csv").open(encoding="utf-8", newline="") as file:
        _, *rows = csv.reader(file)
    return [[int(step), *(float(x) if x else None for x in rest)] for step, *rest in rows]


def checksum(given: Trajectories | None) -> str:
    """Of demonstrations, "" without any."""
    if given is None:
        return ""
    digest = hashlib.sha256(given.observations.tobytes())
    for part in (given.actions, given.rewards):
        digest.update(b"" if part is None else part.tobytes())
    return digest.hexdigest()
