"""A CallableSimulator's x as windows, for methods written for trajectories: one sample, no start to estimate."""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np

from sipe_bayes.core.arrays import BoolArray, FloatArray
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.likelihood.sequences import sequences
from sipe_bayes.likelihood.settings import Segments, fitted_channels
from sipe_bayes.likelihood.windows import Windows
from sipe_bayes.simulation.callable_simulator import CallableSimulator


class CallableWindows(Windows):
    """As ``windows.Windows``: W observed x, L = 2 samples of which the second counts, D = 0 start unknowns."""

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
