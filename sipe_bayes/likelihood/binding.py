"""What a likelihood's settings make of a simulator and its logs: ``Windows``, or the ``Chain`` of a ``StateSpace``."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import ClassVar, overload

import numpy as np

from sipe_bayes.core.arrays import BoolArray, FloatArray
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.likelihood.sequences import sequences
from sipe_bayes.likelihood.settings import Segments, StateSpace, check_seen, fitted_channels
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


class CallableWindows(Windows):
    """A function's x as windows: W observed x, L = 2 samples of which the second counts, D = 0 start unknowns."""

    has_parts: ClassVar[bool] = False  # fn is called for all x at once

    def __init__(self, settings: Segments, simulator: CallableSimulator, trajectories: Trajectories) -> None:
        self.simulator = simulator  # type: ignore[assignment]
        self.trajectories, self.settings = trajectories, settings
        self.rollouts, self.budget, self.short = 0, math.inf, False
        size = len(simulator.environment.channels)
        if trajectories.observations.shape[2] != size or trajectories.actions.shape[1:] != (1, 0):
            raise ValueError(
                f"trajectories: expected an x ({size},), got observations {trajectories.observations.shape}"
            )
        self.channels, self.rotations = fitted_channels(simulator.environment.channels, settings.fit), ()
        self.scales = np.arange(len(self.channels))
        count = len(trajectories)
        self.log, self.start, self.stride = np.arange(count), np.zeros(count, int), np.ones(count, int)
        self.steps, self.lead = self.stride, np.zeros((count, len(self.channels)), int)
        self.begin = self.lead
        self.dt, self.names, self.goals = trajectories.dt, list(trajectories.names), None
        self.owned = np.tile([False, True], (count, 1))
        self.measured = trajectories.observations[:, :, self.channels]
        self.compared = np.repeat(self.owned[:, :, None], len(self.channels), -1)
        self.observed = self.compared & np.isfinite(self.measured)
        unseen = [n for n, seen in zip(self.fitted, self.observed.any(axis=(0, 1)), strict=True) if not seen]
        if unseen:
            raise ValueError(
                f"x: {', '.join(unseen)} is NaN; leave it out of fn and of x, or compare the others, Segments(fit=...)"
            )
        self.actions = trajectories.actions
        self.sequences = sequences(self.observed, np.tile([0, 1], (count, 1)), self.log, self.dt)
        self.reference, self.num_start, self.weak_precision = np.zeros((count, 0)), 0, np.zeros(0)
        self.measured_precision, self.physics_steps, self.impacts = np.zeros(0), count, False

    @property
    def starts_measured(self) -> bool:
        """There are none."""
        return True

    def least_steps(self, theta: FloatArray) -> FloatArray:
        """Zero (N,): fn is smooth as far as is known."""
        return np.zeros(self.num_theta)

    def states(self, theta: FloatArray, starts: FloatArray) -> FloatArray:
        """The starts (..., W, 0) themselves."""
        return starts

    def predict(self, theta: FloatArray, starts: FloatArray, in_float64: bool = False) -> tuple[FloatArray, BoolArray]:
        """As of ``Windows``: what ``fn`` gives as the second sample."""
        batch, count = len(theta), len(self.trajectories)
        self.spend(batch)
        made = self.simulator.replay(theta, self.trajectories).observations
        predicted = made.reshape(batch, count, 2, -1)[..., self.channels]
        return predicted, np.asarray(np.isfinite(predicted).all(axis=(1, 2, 3)))
