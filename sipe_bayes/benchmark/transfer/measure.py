"""Measuring one cell of the transfer: its randomisation, its agent's training, and what the agent earns in the target."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from sipe_bayes.benchmark.cells import Cell
from sipe_bayes.benchmark.executors.work import Done
from sipe_bayes.benchmark.frame import Files, blank, failed, measured
from sipe_bayes.benchmark.measure import CHECKPOINTS, POLICIES
from sipe_bayes.benchmark.records import Record, file_name, posterior_path, record_path
from sipe_bayes.benchmark.transfer.study import (
    DEFAULT,
    EPISODES,
    POINT_EPISODES,
    POINTS,
    PRIOR,
    TRUTH,
    TransferRecord,
    agent_of,
    demonstrations_of,
    estimate_of,
    trained_as,
)
from sipe_bayes.core.parameters import ParameterSpace
from sipe_bayes.envs.registry import make_task
from sipe_bayes.posterior import Dirac, Particles, Posterior, prior
from sipe_bayes.rl.randomization import Randomization
from sipe_bayes.simulation.simulator import Simulator

_ROUNDING = 1e-6  # in theta, of the values that a record keeps
_DIGITS = 12  # of a mean, whose last ones depend on the number of threads
_TARGET_SEED = 4_000_000  # of the target's episodes: other ones than those that a policy is kept by


def run(cell: Cell, folder: Path, command: str) -> Done:
    """Measure a cell. folder: of the results; the estimate is read from it, and the training keeps its checkpoint there."""
    spent = f"{_trained_in(cell)}/{CHECKPOINTS}"
    return measured(blank_record(cell, command), lambda record: _measured(cell, record, folder), spent)


def _trained_in(cell: Cell) -> str:
    """The folder of a cell's training, in that of the results."""
    return f"{POLICIES}/{file_name(trained_as(cell).id)}"


def died(cell: Cell, folder: Path, command: str, why: str) -> Done:
    """What a cell comes to whose process does not live to tell."""
    return failed(blank_record(cell, command), why)


def blank_record(cell: Cell, command: str) -> TransferRecord:
    """A cell's record before it is measured."""
    own = {"setting": cell.id.split("/")[2], "training": cell.training, "agent": agent_of(cell).deviations()}
    return blank(TransferRecord, cell, command, **own)


def randomization(cell: Cell, folder: Path) -> Randomization:
    """What the episodes of a cell's training draw; raises ValueError where its estimate is not there, failed, or is over other
    parameters than the environment's."""
    task, values = make_task(cell.task), dict(cell.values)
    posterior: Posterior
    if cell.estimator == TRUTH:
        posterior = Dirac(task.theta(cell.variant), task.space)
    elif cell.estimator == PRIOR:
        posterior = prior(task.space)
    elif cell.estimator == DEFAULT:
        posterior = Dirac(task.theta("default"), task.space)
    else:
        posterior = _estimated(cell, folder, task.space)
    if "point" in values:
        posterior = Dirac(posterior.mean.round(decimals=_DIGITS), task.space)
    if "particles" in values:
        drawn = posterior.sample((int(values["particles"]),), generator=torch.Generator().manual_seed(cell.seed))
        posterior = Particles(drawn, task.space)
    if "wider" in values and bool((posterior.stddev > 1e-9).any()):  # a point has nothing to widen
        posterior = posterior.wider(values["wider"])
    return Randomization(posterior, values.get("observation_noise", 0.0), int(values.get("action_delay", 0)))


def _estimated(cell: Cell, folder: Path, space: ParameterSpace) -> Particles:
    """The draws of a benchmark's cell."""
    import xarray

    estimate = estimate_of(cell)
    assert estimate is not None
    path = record_path(folder, estimate.id)
    if not path.is_file():
        raise ValueError(f"{path}: no such estimate; `sipe transfer run` measures it first")
    record = Record.read(path)
    if not record.done:
        why = (record.traceback or "?").strip().splitlines()[-1]
        raise ValueError(f"the estimate {record.id} failed ({why}); mend it and run again with --retry-failed")
    with xarray.open_dataset(posterior_path(folder, estimate.id), group="posterior", engine="h5netcdf") as data:
        found = {str(name): np.asarray(data[name], float).reshape(-1) for name in data.data_vars}
    if set(found) != set(space.names):
        raise ValueError(
            f"{record.id}: is a posterior over {', '.join(found)}, and {cell.task} has {', '.join(space.names)}; measure it again"
        )
    theta = space.normalise(np.stack([found[name] for name in space.names], -1))
    if np.abs(theta - 0.5).max() > 0.5 + _ROUNDING:
        name = space.names[int(np.abs(theta - 0.5).max(0).argmax())]
        raise ValueError(
            f"{record.id}: has draws of {name} outside the bounds that {cell.task} has now; measure it again"
        )
    return Particles(theta.clip(0.0, 1.0), space)


def _measured(cell: Cell, record: TransferRecord, folder: Path) -> tuple[TransferRecord, Files, str]:
    from sipe_bayes.models.policy import load_policy
    from sipe_bayes.rl import evaluation
    from sipe_bayes.rl.loop_run import solves
    from sipe_bayes.rl.train import COUNTS, choose, read_curve, train

    began = time.process_time()
    task, own = make_task(cell.task), folder / _trained_in(cell)
    drawn, every = randomization(cell, folder), max(cell.training // POINTS, task.episode_steps)
    simulator, truth = Simulator(task, num_threads=1), task.theta(cell.variant)
    fresh = not own.exists()
    policy = train(
        *(task, cell.training, cell.seed, own, agent_of(cell)),
        resume=True,
        randomization=drawn,
        demonstrations=demonstrations_of(cell, simulator, drawn.posterior),
        evaluate_every=every,
        evaluation_episodes=POINT_EPISODES,
        checkpoint_every=every,
    )

    def earned(policy: Any, episodes: int, action_noise: float | None = None) -> dict[str, Any]:
        return evaluation.evaluate(policy, simulator, episodes, _TARGET_SEED, truth, action_noise=action_noise)

    rows, curve = read_curve(own), []
    for step, own_return, *_ in rows:
        there = earned(load_policy(own / "policies" / f"{step}.safetensors", task.name), POINT_EPISODES)
        row = {"step": step, "own_return": own_return, "target_return": there["mean"]}
        curve.append({**row, "target_success": there["success_rate"]})
    kept = choose(rows, cell.training)["expert"]
    (mine,) = [row for row in rows if row[0] == kept]
    found, counts = earned(policy, EPISODES), json.loads((own / COUNTS).read_text(encoding="utf-8"))
    rate = "" if found["success_rate"] is None else f", success {found['success_rate']:.2f}"
    line = f"return {found['mean']:.1f} in the target{rate}, {rows[-1][4]:.0f} s"
    record = replace(
        record,
        seconds=rows[-1][4],
        names=list(task.space.names),
        truth=truth.tolist(),
        mean=drawn.posterior.mean.tolist(),
        sd=drawn.posterior.stddev.tolist(),
        checksums={**record.checksums, "model": simulator.checksum(), "randomization": drawn.fingerprint},
        evaluation=found,
        random=earned(evaluation.random(task, cell.seed), EPISODES, 0.0),
        curve=curve,
        kept=kept,
        converged=solves(task, mine[1], mine[3]),
        solved_reference=solves(task, found["mean"], found["success_rate"]),
        redrawn=counts["redrawn"],
        diverged=counts["diverged"],
        cpu_seconds=time.process_time() - began if fresh else None,
    )
    return record, (), line
