"""Pendulums that count what is really simulated, and one that breaks in part of its prior."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.simulation.simulator import Simulator
from tests.problems.pendulums import pendulum

TRUTH = [0.6, 0.05]


class Counting(Simulator):
    """Counts the lanes and the control steps that are really simulated."""

    def __init__(self) -> None:
        super().__init__(pendulum().environment, num_threads=1)
        self.lanes = self.steps = 0

    def rollout(self, theta: Any, *args: Any, **settings: Any) -> Trajectories:
        made = super().rollout(theta, *args, **settings)
        self.lanes += len(made)
        self.steps += len(made) * (made.observations.shape[1] - 1)
        return made


class Breaking(Counting):
    """Diverges where the rod is heavier than three tenths of its range, and counts that too."""

    def __init__(self) -> None:
        super().__init__()
        self.broken = 0

    def rollout(self, theta: Any, *args: Any, **settings: Any) -> Trajectories:
        made = super().rollout(theta, *args, **settings)
        bad = np.broadcast_to(np.atleast_2d(theta)[:, 0] > 0.3, (len(made),))
        self.broken += int(bad.sum())
        return replace(made, valid=made.valid & ~bad[:, None])
