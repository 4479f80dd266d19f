"""Measuring one cell of the transfer: randomisation, the agent's training, and what it earns in the target."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from sipe_bayes.benchmark.cells import Cell
from sipe_bayes.benchmark.measurement import POLICIES, Files, Measurement, entries
from sipe_bayes.benchmark.records import Record, file_name, posterior_path, record_path
from sipe_bayes.benchmark.transfer.study import (
    DEFAULT,
    PRIOR,
    SIZES,
    TRUTH,
    Point,
    TransferRecord,
    agent_of,
    demonstrations_of,
    estimate_of,
    trained_as,
)
from sipe_bayes.core.parameters import ParameterSpace
from sipe_bayes.envs.registry import make_task
from sipe_bayes.models.policy import Controller, load_policy
from sipe_bayes.posterior import Dirac, Particles, Posterior, prior
from sipe_bayes.rl import evaluation, train
from sipe_bayes.rl.loop_run import solves
from sipe_bayes.rl.randomization import Randomization
from sipe_bayes.simulation.simulator import Simulator

_ROUNDING = 1e-6  # in theta, of the values that a record keeps
_DIGITS = 12  # of a mean, whose last ones depend on the number of threads


def randomization(cell: Cell, folder: Path) -> Randomization:
    """What the episodes of a cell's training draw.

    Raises:
        ValueError: where the estimate is not there, failed, or is over other parameters than the environment's.
    """
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
        posterior = posterior.wider(float(values["wider"]))
    noise, delay = float(values.get("observation_noise", 0.0)), int(values.get("action_delay", 0))
    return Randomization(posterior, noise, delay)


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
        raise ValueError(
            f"the estimate {record.id} failed ({record.failure}); mend it and run again with --retry-failed"
        )
    with xarray.open_dataset(posterior_path(folder, estimate.id), group="posterior", engine="h5netcdf") as data:
        values = {str(name): np.asarray(data[name], float).reshape(-1) for name in data.data_vars}
    if set(values) != set(space.names):
        raise ValueError(
            f"{record.id}: is a posterior over {', '.join(values)}, and {cell.task} has {', '.join(space.names)}; "
            "measure it again"
        )
    theta = space.normalise(np.stack([values[name] for name in space.names], -1))
    if np.abs(theta - 0.5).max() > 0.5 + _ROUNDING:
        name = space.names[int(np.abs(theta - 0.5).max(0).argmax())]
        raise ValueError(
            f"{record.id}: has draws of {name} outside the bounds that {cell.task} has now; measure it again"
        )
    return Particles(theta.clip(0.0, 1.0), space)


class AgentMeasurement(Measurement[TransferRecord]):
    """An agent that is trained under its cell's randomisation and evaluated in the target."""

    record_type = TransferRecord

    def blank(self, cell: Cell, command: str = "") -> TransferRecord:
        """See ``Measurement``."""
        about: Any = {**entries(cell, command), "setting": cell.label}
        return TransferRecord(**about, training=cell.training, agent=agent_of(cell).deviations())

    def trained_in(self, cell: Cell) -> str:
        """See ``Measurement``."""
        return f"{POLICIES}/{file_name(trained_as(cell).id)}"

    def needs(self, cell: Cell) -> Cell | None:
        """See ``Measurement``."""
        return estimate_of(cell)

    def alike(self, cell: Cell) -> Cell:
        """See ``Measurement``."""
        return trained_as(cell)

    def measured(self, cell: Cell, record: TransferRecord, folder: Path) -> tuple[TransferRecord, Files, str]:
        """See ``Measurement``."""
        began = time.process_time()
        task, own, drawn = make_task(cell.task), folder / self.trained_in(cell), randomization(cell, folder)
        simulator, truth = Simulator(task, num_threads=1), task.theta(cell.variant)
        fresh, every = not own.exists(), max(cell.training // SIZES.points, task.episode_steps)
        # train it, or read what another cell trained
        policy = train.train(
            *(task, cell.training, cell.seed, own, agent_of(cell)),
            resume=True,
            randomization=drawn,
            demonstrations=demonstrations_of(cell, simulator, drawn.posterior),
            evaluate_every=every,
            evaluation_episodes=SIZES.point_episodes,
            checkpoint_every=every,
        )

        # what it earns in the target, in the end and on the way
        def earned(policy: Controller, episodes: int, noise: float | None = None) -> evaluation.Evaluation:
            seed = evaluation.STARTS.target
            return evaluation.evaluate(policy, simulator, episodes, seed, truth, action_noise=noise)

        rows, curve = train.read_curve(own), []
        for row in rows:
            at = earned(load_policy(own / "policies" / f"{row.step}.safetensors", task.name), SIZES.point_episodes)
            curve.append(Point(row.step, row.return_mean, at.mean, at.success_rate))
        kept = train.choose(rows, cell.training)["expert"]
        (own_row,) = [row for row in rows if row.step == kept]
        in_target, counts = earned(policy, SIZES.episodes), train.read_counts(own)
        rate = "" if in_target.success_rate is None else f", success {in_target.success_rate:.2f}"
        seconds = rows[-1].wall_seconds
        record = replace(
            record,
            seconds=seconds,
            names=list(task.space.names),
            truth=truth.tolist(),
            mean=drawn.posterior.mean.tolist(),
            sd=drawn.posterior.stddev.tolist(),
            checksums={**record.checksums, "model": simulator.checksum(), "randomization": drawn.fingerprint},
            evaluation=in_target,
            random=earned(evaluation.random(task, cell.seed), SIZES.episodes, 0.0),
            curve=curve,
            kept=kept,
            converged=solves(task, own_row.return_mean, own_row.success_rate),
            solved_reference=solves(task, in_target.mean, in_target.success_rate),
            redrawn=counts.redrawn,
            diverged=counts.diverged,
            cpu_seconds=time.process_time() - began if fresh else None,
        )
        return record, (), f"return {in_target.mean:.1f} in the target{rate}, {seconds:.0f} s"


AGENTS = AgentMeasurement()
