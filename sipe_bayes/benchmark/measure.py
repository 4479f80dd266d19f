"""Measuring one cell of the benchmark: its log, its estimate, its scores, its record."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from sipe_bayes.benchmark import bank
from sipe_bayes.benchmark.cells import BASELINES, Cell
from sipe_bayes.benchmark.log import Log, one_step, recorded
from sipe_bayes.benchmark.measurement import POLICIES, Clock, Files, Measurement, entries
from sipe_bayes.benchmark.records import Look, Record, file_name, posterior_path
from sipe_bayes.core.findings import Findings
from sipe_bayes.diagnostics.scores import score
from sipe_bayes.envs.registry import make_task
from sipe_bayes.inference.amortised.prior_sampling import PriorSampling
from sipe_bayes.inference.base import Estimator
from sipe_bayes.inference.recorded import digest
from sipe_bayes.inference.registry import estimator_class, get_estimator
from sipe_bayes.posterior import Dirac, Posterior, prior
from sipe_bayes.simulation.simulator import Simulator


@dataclass(frozen=True)
class Shares:
    """Of an estimator's budget.

    Args:
        looks: where the history looks at an estimate.
        candidates: starting points of the methods that search a likelihood.
    """

    looks: tuple[float, ...] = (0.1, 0.25, 0.5)
    candidates: float = 0.1


SHARES = Shares()


class EstimateMeasurement(Measurement[Record]):
    """An estimator on the recorded trajectory of its cell, or on those of an agent that is trained meanwhile."""

    record_type = Record

    def blank(self, cell: Cell, command: str = "") -> Record:
        """See ``Measurement``."""
        about: Any = entries(cell, command)
        if not cell.with_policy:
            return Record(**about)
        from sipe_bayes.benchmark.transfer.study import agent_of

        return Record(**about, training=cell.training, agent=agent_of(cell).deviations())

    def trained_in(self, cell: Cell) -> str:
        """See ``Measurement``."""
        return f"{POLICIES}/{file_name(cell.id)}" if cell.with_policy else ""

    def measured(self, cell: Cell, record: Record, folder: Path) -> tuple[Record, Files, str]:
        """See ``Measurement``."""
        log = recorded(cell.task, cell.variant, cell.seed, cell.horizon, cell.split)
        simulator = Simulator(make_task(cell.task), 1, cell.device)
        if cell.estimator in BASELINES:
            record, space = replace(record, seconds=0.0, cpu_seconds=0.0), simulator.space
            posterior: Posterior = prior(space) if cell.estimator == "prior" else Dirac([0.5] * len(space), space)
        elif cell.with_policy:
            posterior, record = _with_policy(cell, record, simulator, folder / self.trained_in(cell))
        else:
            posterior, record = _estimated(cell, record, simulator, log, folder)
        scores = score(posterior, log.truth)
        before = [look for look in record.history if look.rollouts < record.rollouts]
        record = replace(
            record,
            history=[*before, Look(record.rollouts, scores.mean_accuracy, scores.mean_crps)],
            names=list(simulator.space.names),
            truth=log.truth.tolist(),
            mean=posterior.mean.tolist(),
            sd=posterior.stddev.tolist(),
            scores=scores,
            determined=None if log.determined is None or cell.with_policy else log.determined.tolist(),
            log="policy" if cell.with_policy else log.source,
            checksums={**record.checksums, "model": simulator.checksum(), "log": digest(log.trajectories)},
        )
        line = f"accuracy {scores.mean_accuracy:.3f}, CRPS {scores.mean_crps:.3f}"
        line += "" if record.seconds is None else f", {record.seconds:.1f} s"
        return record, ((str(posterior_path(Path(), cell.id)), netcdf(posterior, cell.seed)),), line


ESTIMATES = EstimateMeasurement()


def _estimator(cell: Cell, simulator: Simulator, **settings: object) -> Estimator:
    if estimator_class(cell.estimator).searches:
        settings |= {"candidates": int(SHARES.candidates * cell.budget), "likelihood": one_step(simulator)}
    every: Any = {**settings, **cell.settings}
    return get_estimator(simulator, cell.estimator, budget=cell.budget, seed=cell.seed, **every)


def _estimated(cell: Cell, record: Record, simulator: Simulator, log: Log, folder: Path) -> tuple[Posterior, Record]:
    """Step by step; the looks at the estimate along the way cost the method nothing and change nothing."""
    shares = issubclass(estimator_class(cell.estimator), PriorSampling)
    simulations = folder / bank.FOLDER
    estimator = _estimator(cell, simulator, **({"cache": simulations} if shares else {}))
    clock, history, simulated = Clock(), list[Look](), 0.0
    if isinstance(estimator, PriorSampling):
        simulated = _simulated(estimator, cell, log, simulations)
    looks = [] if shares else [share * cell.budget for share in SHARES.looks]
    while not estimator.ended:
        clock.time(lambda: estimator.update_parameter_estimate(log.trajectories))
        if looks and estimator.rollouts >= looks[0] and not estimator.ended:
            looks = [share for share in looks if share > estimator.rollouts]
            history += _look(estimator, log)
    posterior = clock.time(lambda: estimator.get_parameter_estimate(log.trajectories))
    return posterior, replace(
        record,
        seconds=clock.seconds,
        cpu_seconds=clock.cpu_seconds,
        rollouts=estimator.rollouts,
        warnings=list(estimator.warnings),
        history=history,
        simulation_cpu_seconds=simulated,
    )


def _simulated(estimator: PriorSampling, cell: Cell, log: Log, folder: Path) -> float:
    """See that the simulations which the method shares with others are there; the CPU seconds that they took."""
    simulations, clock = estimator.prior_simulations(log.trajectories), Clock()
    clock.time(lambda: simulations.first(cell.budget))
    return bank.cost(folder, simulations.key) or clock.cpu_seconds


def _look(estimator: Estimator, log: Log) -> list[Look]:
    """At the estimate, if there is one yet; the estimator stays as it is."""
    before = list(estimator.findings)
    try:
        scores = score(estimator.get_parameter_estimate(log.trajectories), log.truth)
    except ValueError:  # too early
        return []
    finally:
        estimator.findings = Findings(before)
    return [Look(estimator.rollouts, scores.mean_accuracy, scores.mean_crps)]


def _with_policy(cell: Cell, record: Record, simulator: Simulator, folder: Path) -> tuple[Posterior, Record]:
    from sipe_bayes.benchmark.transfer.study import agent_of, demonstrations_of
    from sipe_bayes.rl.policy_in_the_loop import CHECKPOINT, train_in_the_loop

    fresh, clock = not (folder / CHECKPOINT).exists(), Clock()
    estimator = _estimator(cell, simulator)
    result = clock.time(
        lambda: train_in_the_loop(
            estimator,
            cell.variant,
            cell.training,
            trajectory_steps=cell.horizon,
            settings=agent_of(cell),
            demonstrations=demonstrations_of(cell, simulator, estimator.prior),
            folder=folder,
            resume=True,
        )
    )
    return result.posterior, replace(
        record,
        seconds=clock.seconds if fresh else None,
        cpu_seconds=clock.cpu_seconds if fresh else None,
        rollouts=result.history[-1].rollouts,
        warnings=list(result.warnings),
        history=[Look(row.rollouts, row.accuracy) for row in result.history],
        converged=result.converged,
        solved_reference=result.solved_reference,
    )


def netcdf(posterior: Posterior, seed: int) -> bytes:
    """A posterior's netCDF, the same bytes for the same posterior."""
    return posterior.netcdf(generator=torch.Generator().manual_seed(seed))
