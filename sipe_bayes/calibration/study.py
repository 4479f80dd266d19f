"""What ``sipe check`` checks: an estimator on an experiment, of a benchmark task or of a configuration."""

from __future__ import annotations

import json
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sipe_bayes.calibration.problem import method_of, prepare
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.datasets.demonstrations import demonstrations
from sipe_bayes.envs.registry import make_task
from sipe_bayes.inference import get_estimator
from sipe_bayes.inference.base import Estimator
from sipe_bayes.inference.log_noise import fitted_noise
from sipe_bayes.inference.recalibrated import Recalibrated
from sipe_bayes.inference.recorded import digest
from sipe_bayes.inference.registry import estimator_class
from sipe_bayes.likelihood import Noise, Segments, StateSpace
from sipe_bayes.simulation.simulator import Simulator

_VERSION = 2  # of what a fit's file holds: each fit has a seed of its own
_NOISE_BUDGET = 5000  # rollouts of the fit that finds a configuration's noise


@dataclass(frozen=True)
class Study:
    """What is checked.

    Args:
        name: of the model.
        estimator: of which only settings count.
        trajectories: the experiment, whose commands and starts are simulated.
        noise: (O,) of the sensors.
        refits: those of Recalibrated(estimator), or 0 for the estimator itself.
        seed: of truths, noise and fits.
        process: (D,) sd of process noise; none or empty without.
    """

    name: str
    estimator: Estimator
    trajectories: Trajectories
    noise: Noise
    refits: int = 0
    seed: int = 0
    process: FloatArray | None = None

    @property
    def method(self) -> str:
        """In words."""
        name = self.estimator.name
        return f"Recalibrated({name}, refits={self.refits})" if self.refits else name

    @property
    def cost(self) -> tuple[int, int]:
        """Rollouts of training once, and of each fit, at most."""
        once = self.estimator.budget if self.estimator.amortised else 0
        if self.refits:
            whole_fit = Recalibrated(self.estimator, refits=self.refits).cost(self.trajectories)
            return once, whole_fit - once
        return once, 0 if once else self.estimator.budget

    def identity(self) -> dict[str, object]:
        """What tells a check from others, as plain data."""
        process = [] if self.process is None else self.process.tolist()
        return {
            "version": _VERSION,
            "model": self.name,
            "method": self.method,
            "seed": self.seed,
            "log": digest(self.trajectories),
            "noise": {"sd": self.noise.sd.tolist(), "tau": self.noise.tau.tolist(), "process": process},
            "settings": json.loads(json.dumps(self.estimator.settings(), default=str)),
        }


def study_of_task(
    name: str,
    estimator: str,
    *,
    steps: int,
    noise: float,
    budget: int | None,
    refits: int,
    seed: int,
    threads: int | None,
    device: str = "cpu",
) -> Study:
    """A benchmark task: one demonstration's commands and start.

    The methods that search use ``StateSpace``, where the controller has a memory with the recorded start; without noise
    single control steps of recorded states.

    Args:
        name: of the task.
        estimator: of the method.
        steps: control steps of the log.
        noise: sd of white noise, as a share of each channel's spread.
        budget: rollouts of each fit; default the estimator's.
        refits: of ``Recalibrated``, or 0.
        seed: of log, truths, noise and fits.
        threads: native ones; default all cores.
        device: that it simulates on, as ``Simulator`` has them.
    """
    simulator = Simulator(make_task(name), threads, device)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        log = demonstrations(simulator.on_processor, count=1, seed=seed, steps=steps)
    sd = noise * log.observations[0].std(0)
    searches = estimator_class(estimator).searches
    likelihood: Segments | StateSpace
    if searches and noise:
        likelihood = StateSpace(starts="recorded" if simulator.environment.memory_size else "estimated")
    else:
        known = None if searches else tuple(sd.tolist())
        likelihood = Segments(simulator.dt, noise="white", starts="recorded", noise_sd=known)
    method = get_estimator(simulator, estimator, budget=budget, seed=seed, likelihood=likelihood)
    return Study(name, method, log, Noise(sd, np.zeros(len(sd))), refits, seed)


def study_of_config(
    path: Path,
    estimator: str,
    *,
    budget: int | None,
    refits: int,
    seed: int,
    threads: int | None,
    device: str = "cpu",
) -> Study:
    """The model, commands, starts and prior of a configuration, with the noise that ``laplace`` finds in its logs.

    That is autoregressive, or with a ``StateSpace`` white, and process noise.

    Args:
        path: of the TOML file.
        estimator: of the method.
        budget: rollouts of each fit; default the configuration's, then the estimator's.
        refits: of ``Recalibrated``, or 0.
        seed: of truths, noise and fits.
        threads: native ones; default all cores.
        device: that it simulates on, as ``Simulator`` has them.
    """
    problem = prepare(path, threads, device)
    method = method_of(problem, estimator, seed, budget)
    fitted = fitted_noise(problem.simulator, problem.likelihood, problem.train, problem.prior, budget=_NOISE_BUDGET)
    return Study(str(path), method, problem.train, fitted.noise, refits, seed, fitted.process)
