"""Measuring one cell: its log, its estimate, its scores, its record."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from sipe_bayes.benchmark import bank
from sipe_bayes.benchmark.cells import BASELINES, Cell
from sipe_bayes.benchmark.executors.work import Done
from sipe_bayes.benchmark.frame import Files, blank, failed, measured
from sipe_bayes.benchmark.log import Log, one_step, recorded
from sipe_bayes.benchmark.records import Record, file_name, posterior_path
from sipe_bayes.core.findings import Findings
from sipe_bayes.diagnostics.scores import score
from sipe_bayes.envs.registry import make_task
from sipe_bayes.inference.amortised.prior_sampling import PriorSampling
from sipe_bayes.inference.base import Estimator
from sipe_bayes.inference.recorded import digest
from sipe_bayes.inference.registry import estimator_class, get_estimator
from sipe_bayes.posterior import Dirac, Posterior, prior
from sipe_bayes.simulation.simulator import Simulator

POLICIES, CHECKPOINTS = "policies", "checkpoint"  # a checkpoint holds a replay buffer, which nothing needs at the end
_ALONG = (0.1, 0.25, 0.5)  # of the budget, where the history looks at an estimate
_CANDIDATES = 0.1  # of the budget: starting points of the methods that search a likelihood


@dataclass(frozen=True)
class _Found:
    """An estimate, what it cost and what was said; more: entries of the record."""

    posterior: Posterior
    seconds: float | None
    cpu_seconds: float | None
    rollouts: int
    warnings: list[str]
    history: list[dict[str, Any]]
    more: dict[str, Any]


def run(cell: Cell, folder: Path, command: str) -> Done:
    """Measure a cell. folder: of the results; read for simulations, and a training's checkpoints are kept in it. Where it is not there,
    as this is another machine, the cell makes what it needs for itself."""
    with at_hand(folder) as here:
        spent = f"{POLICIES}/{file_name(cell.id)}/{CHECKPOINTS}" if cell.with_policy else ""
        return measured(blank_record(cell, command), lambda record: _measured(cell, record, here), spent)


@contextmanager
def at_hand(folder: Path) -> Iterator[Path]:
    """The folder, or where it is not there an empty one for the time being."""
    if folder.is_dir():
        yield folder
    else:
        with tempfile.TemporaryDirectory() as instead:
            yield Path(instead)


def died(cell: Cell, folder: Path, command: str, why: str) -> Done:
    """What a cell comes to whose process does not live to tell."""
    return failed(blank_record(cell, command), why)


def blank_record(cell: Cell, command: str) -> Record:
    """A cell's record before it is measured."""
    if not cell.with_policy:
        return blank(Record, cell, command)
    from sipe_bayes.benchmark.transfer.study import agent_of

    return blank(Record, cell, command, training=cell.training, agent=agent_of(cell).deviations())


def _measured(cell: Cell, record: Record, folder: Path) -> tuple[Record, Files, str]:
    task = make_task(cell.task)
    log = recorded(cell.task, cell.variant, cell.seed, cell.horizon, cell.split)
    simulator = Simulator(task, num_threads=1)
    if cell.estimator in BASELINES:
        found = _baseline(cell, simulator)
    elif cell.with_policy:
        found = _with_policy(cell, simulator, folder)
    else:
        found = _estimated(cell, simulator, log, folder)
    posterior = found.posterior
    scores = score(posterior, log.truth)
    last = {"rollouts": found.rollouts, "mean_accuracy": scores.mean_accuracy, "mean_crps": scores.mean_crps}
    rows = [row for row in found.history if row["rollouts"] < found.rollouts]
    record = replace(
        record,
        seconds=found.seconds,
        cpu_seconds=found.cpu_seconds,
        rollouts=found.rollouts,
        warnings=found.warnings,
        names=list(simulator.space.names),
        truth=log.truth.tolist(),
        mean=posterior.mean.tolist(),
        sd=posterior.stddev.tolist(),
        scores=scores.to_dict(),
        determined=None if log.determined is None or cell.with_policy else log.determined.tolist(),
        history=[*rows, last],
        log="policy" if cell.with_policy else log.source,
        checksums={**record.checksums, "model": simulator.checksum(), "log": digest(log.trajectories)},
        **found.more,
    )
    line = f"accuracy {scores.mean_accuracy:.3f}, CRPS {scores.mean_crps:.3f}"
    line += "" if found.seconds is None else f", {found.seconds:.1f} s"
    return record, ((str(posterior_path(Path(), cell.id)), _netcdf(posterior, cell.seed)),), line


def _baseline(cell: Cell, simulator: Simulator) -> _Found:
    space = simulator.space
    posterior = prior(space) if cell.estimator == "prior" else Dirac(np.full(len(space), 0.5), space)
    return _Found(posterior, 0.0, 0.0, 0, [], [], {})


def _estimator(cell: Cell, simulator: Simulator, **settings: Any) -> Estimator:
    if estimator_class(cell.estimator).searches:
        settings.update(candidates=int(_CANDIDATES * cell.budget), likelihood=one_step(simulator))
    return get_estimator(simulator, cell.estimator, budget=cell.budget, seed=cell.seed, **settings, **cell.settings)


def _estimated(cell: Cell, simulator: Simulator, log: Log, folder: Path) -> _Found:
    """Step by step; the looks at the estimate along the way cost the method nothing and change nothing."""
    shares = issubclass(estimator_class(cell.estimator), PriorSampling)
    simulations = folder / bank.FOLDER
    estimator = _estimator(cell, simulator, **({"cache": simulations} if shares else {}))
    clock, history = _Clock(), []
    more: dict[str, Any] = {}
    if isinstance(estimator, PriorSampling):
        more["simulation_cpu_seconds"] = _simulated(estimator, cell, log, simulations)
    looks = [] if shares else [share * cell.budget for share in _ALONG]
    while not _over(estimator):
        clock.time(lambda: estimator.update_parameter_estimate(log.trajectories))
        if looks and estimator.rollouts >= looks[0] and not _over(estimator):
            looks = [share for share in looks if share > estimator.rollouts]
            history += _look(estimator, log)
    posterior = clock.time(lambda: estimator.get_parameter_estimate(log.trajectories))
    said = list(estimator.warnings)
    return _Found(posterior, clock.seconds, clock.cpu_seconds, estimator.rollouts, said, history, more)


def _simulated(estimator: PriorSampling, cell: Cell, log: Log, folder: Path) -> float:
    """See that the simulations which the method shares with others are there; the CPU seconds that they took, here or before."""
    simulations, clock = estimator.prior_simulations(log.trajectories), _Clock()
    clock.time(lambda: simulations.first(cell.budget))
    return bank.cost(folder, simulations.key) or clock.cpu_seconds


def _over(estimator: Estimator) -> bool:
    return estimator.ended


def _look(estimator: Estimator, log: Log) -> list[dict[str, Any]]:
    """A row of the history, if there is an estimate yet; the estimator stays as it is."""
    before = list(estimator.findings)
    try:
        scores = score(estimator.get_parameter_estimate(log.trajectories), log.truth)
    except ValueError:  # too early
        return []
    finally:
        estimator.findings = Findings(before)
    return [{"rollouts": estimator.rollouts, "mean_accuracy": scores.mean_accuracy, "mean_crps": scores.mean_crps}]


def _with_policy(cell: Cell, simulator: Simulator, folder: Path) -> _Found:
    from sipe_bayes.benchmark.transfer.study import agent_of, demonstrations_of
    from sipe_bayes.rl.policy_in_the_loop import CHECKPOINT, train_in_the_loop

    own = folder / POLICIES / file_name(cell.id)
    fresh, clock = not (own / CHECKPOINT).exists(), _Clock()
    estimator = _estimator(cell, simulator)
    found = clock.time(
        lambda: train_in_the_loop(
            estimator,
            cell.variant,
            cell.training,
            trajectory_steps=cell.horizon,
            settings=agent_of(cell),
            demonstrations=demonstrations_of(cell, simulator, estimator.prior),
            folder=own,
            resume=True,
        )
    )
    history: list[dict[str, Any]] = [
        {"rollouts": row["rollouts"], "mean_accuracy": row["accuracy"], "mean_crps": None} for row in found.history
    ]
    seconds, cpu = (clock.seconds, clock.cpu_seconds) if fresh else (None, None)
    more = {"converged": found.converged, "solved_reference": found.solved_reference}
    return _Found(found.posterior, seconds, cpu, history[-1]["rollouts"], list(found.warnings), history, more)


class _Clock:
    """Seconds and CPU seconds spent in what is timed."""

    def __init__(self) -> None:
        self.seconds = self.cpu_seconds = 0.0

    def time(self, call: Callable[[], Any]) -> Any:
        began, cpu = time.perf_counter(), time.process_time()
        try:
            return call()
        finally:
            self.seconds += time.perf_counter() - began
            self.cpu_seconds += time.process_time() - cpu


def _netcdf(posterior: Posterior, seed: int) -> bytes:
    """The bytes of the posterior's netCDF, the same for the same posterior."""
    data = posterior.to_inference_data(generator=torch.Generator().manual_seed(seed))
    for group in data.groups():
        data[group].attrs.pop("created_at", None)
    with tempfile.TemporaryDirectory() as made_in:
        path = Path(made_in) / "posterior.nc"
        data.to_netcdf(str(path), engine="h5netcdf")
        return path.read_bytes()
