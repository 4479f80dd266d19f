"""What a likelihood's settings make of a simulator and its logs: ``Windows``, or the ``Chain`` of a ``StateSpace``."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import overload

from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.likelihood.callable_windows import CallableWindows
from sipe_bayes.likelihood.settings import Segments, StateSpace, check_seen
from sipe_bayes.likelihood.starts.estimates import contacts_of
from sipe_bayes.likelihood.state_space.chain import Chain
from sipe_bayes.likelihood.state_space.indirect_positions import indirect_positions
from sipe_bayes.likelihood.windows import Windows, meets_impacts
from sipe_bayes.simulation.callable_simulator import CallableSimulator
from sipe_bayes.simulation.contacts import may_touch
from sipe_bayes.simulation.simulator import Simulator

BoundLikelihood = Windows
"""Logs bound to ``Segments``: simulated (``predict``, ``residuals``), linearised, and their noise and initial states
estimated or integrated out of the linear model (``estimate_noise``, ``eliminate``, ``log_density``)."""
BoundStates = Chain
"""Logs bound to a ``StateSpace``."""


@overload
def bind(likelihood: Segments, simulator: Simulator | CallableSimulator, trajectories: Trajectories) -> Windows: ...
@overload
def bind(likelihood: StateSpace, simulator: Simulator | CallableSimulator, trajectories: Trajectories) -> Chain: ...
@overload
def bind(
    likelihood: Segments | StateSpace, simulator: Simulator | CallableSimulator, trajectories: Trajectories
) -> Windows | Chain: ...
def bind(
    likelihood: Segments | StateSpace, simulator: Simulator | CallableSimulator, trajectories: Trajectories
) -> Windows | Chain:
    """Hold the trajectories against the simulator: Windows of ``Segments``, or the Chain of a ``StateSpace``.

    Raises:
        ValueError: for logs or simulators that do not fit.
    """
    if isinstance(likelihood, StateSpace):
        return _chain(likelihood, simulator, trajectories)
    if isinstance(simulator, CallableSimulator):
        return CallableWindows(likelihood, simulator, trajectories)
    windows = Windows(likelihood, simulator, trajectories)
    check_seen(windows.fitted, windows.observed.any(axis=(0, 1)))
    return windows


def _chain(settings: StateSpace, simulator: Simulator | CallableSimulator, trajectories: Trajectories) -> Chain:
    if not isinstance(simulator, Simulator):
        raise ValueError("likelihood: StateSpace needs a MuJoCo simulator with states; use sipe.Segments")
    if simulator.environment.memory_size and settings.starts == "estimated":
        raise ValueError(
            f"likelihood: StateSpace looks for no controller's memory, as {type(simulator.environment).__name__} has "
            "one, in measurements; use starts='recorded', or sipe.Segments"
        )
    chain = Chain(settings, simulator, trajectories)
    chain.place(*indirect_positions(chain, chain.reference, chain.measured_directly))
    return chain


def _wants_state_space(simulator: Simulator, logs: Sequence[Trajectory]) -> bool:
    """Whether bodies strike or slip along logs, and a ``StateSpace`` can be had: without memory, all sensors prompt."""
    environment = simulator.environment
    if not logs or environment.memory_size or not may_touch(simulator.model):
        return False
    if (environment.remembers > min(log.dt for log in logs)).any():
        return False
    return meets_impacts(simulator, contacts_of(simulator, logs))


def default_likelihood(
    simulator: Simulator | CallableSimulator, trajectories: Iterable[Trajectory] = ()
) -> Segments | StateSpace:
    """Segments of half a second, or a ``StateSpace`` for logs along which bodies strike or slip, where it can be had.

    Of a function white noise of the sd that it states, zero where it makes its own.
    """
    if not isinstance(simulator, CallableSimulator):
        logs = [replace(log, states=None) for log in trajectories]
        return StateSpace() if _wants_state_space(simulator, logs) else Segments()
    sd = simulator.noise_sd or (0.0,) * len(simulator.environment.channels)
    return Segments(None, noise="white", noise_sd=sd, starts="recorded")
