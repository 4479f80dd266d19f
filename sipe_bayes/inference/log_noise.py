"""The noise of a machine's logs, which only a fit tells."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.inference.laplace import Laplace
from sipe_bayes.likelihood import Noise, Segments, StateSpace, observation_noise
from sipe_bayes.posterior import Posterior
from sipe_bayes.simulation.callable_simulator import CallableSimulator
from sipe_bayes.simulation.simulator import Simulator

NOISE_BUDGET = 2000  # rollouts of the fit: two modes of half a dozen parameters


@dataclass(frozen=True)
class LogNoise:
    """What a fit says of the noise.

    Args:
        noise: of all O channels: autoregressive, or that of the measurement with a ``StateSpace``.
        process: sd (D,) of the process noise with a ``StateSpace``, else none.
        rollouts: of the fit.
    """

    noise: Noise
    process: FloatArray
    rollouts: int


def process_noise(diagnostics: Mapping[str, object]) -> FloatArray:
    """Process noise sd (D,) of a fit with a ``StateSpace``, none of any other."""
    return np.array(diagnostics.get("process_noise", ()), float)


def noise_is_unknown(
    simulator: Simulator | CallableSimulator, likelihood: Segments | StateSpace, trajectories: Trajectories
) -> bool:
    """Whether these are logs of a machine, whose noise only a fit tells."""
    of_machine = isinstance(simulator, Simulator) and isinstance(likelihood, Segments)
    return of_machine and not trajectories.states_throughout


def fitted_noise(
    simulator: Simulator | CallableSimulator,
    likelihood: Segments | StateSpace,
    trajectories: Trajectories,
    prior: Posterior,
    theta: FloatArray | None = None,
    budget: int = NOISE_BUDGET,
) -> LogNoise:
    """Noise of logs by a fit of ``laplace``.

    Args:
        simulator: that the logs are fitted with.
        likelihood: how; ``Segments`` with autoregressive noise, whatever they say.
        trajectories: the logs.
        prior: of the fit.
        theta: (N,), where the fit begins, if known.
        budget: of the fit, in rollouts.
    """
    coloured = replace(likelihood, noise="ar1") if isinstance(likelihood, Segments) else likelihood
    fit = Laplace(simulator, likelihood=coloured, prior=prior, initial=theta, budget=budget)
    fit.fit(trajectories)
    noise = observation_noise(fit.diagnostics, trajectories, likelihood, simulator)
    return LogNoise(noise, process_noise(fit.diagnostics), fit.rollouts)
