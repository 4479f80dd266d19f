"""A column of a log with a flipped sign or in another unit: tried before any physics is blamed.

Where the plain model leaves much of a channel unexplained, each channel that moves and each command is multiplied by
-1, 180 / pi, 1000 and their inverses, and the model fitted again. For a channel y, p(y) = |f|^n p(f y), n its samples.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sipe_bayes.core.arrays import BoolArray, FloatArray
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.likelihood.noise import noise_level
from sipe_bayes.likelihood.windows import Windows

_DEGREES = 180 / math.pi
FACTORS = (-1.0, _DEGREES, 1 / _DEGREES, 1000.0, 0.001)


@dataclass(frozen=True)
class Column:
    """A column that is to be multiplied by a factor.

    Args:
        name: of the channel or the actuator.
        command: whether it is a command.
        factor: that makes it what the model expects.
    """

    name: str
    command: bool
    factor: float

    @property
    def sentence(self) -> str:
        """What it is."""
        kind = "command of" if self.command else "measurement"
        words = {
            -1.0: "the opposite sign",
            _DEGREES: "radians where the model's unit is reached by degrees",
            1 / _DEGREES: "degrees that were read as radians",
            1000.0: "a unit a thousand times too large",
            0.001: "a unit a thousand times too small",
        }
        return f"the {kind} {self.name} has {words[self.factor]}: multiply it by {self.factor:.6g}"


def moving(windows: Windows) -> BoolArray:
    """The channels (C,) that show more than noise: what rests has neither sign nor unit.

    By five standard errors of a variance of white noise, and at least by a fifth, for the noise is an estimate.
    """
    noise = noise_level(windows.trajectories, windows.settings, windows.simulator)[windows.channels]
    chance = 5 * np.sqrt(2 / np.maximum(windows.observed.sum(axis=(0, 1)), 1))
    return np.asarray(windows.spread**2 > noise**2 * (1 + np.maximum(chance, 0.2)))


def unexplained(windows: Windows, sd: FloatArray, shown: BoolArray) -> float:
    """The largest share of a channel's spread that the residuals' sd (C,) is, of those that are ``shown`` to move."""
    return float((sd[shown] / windows.spread[shown]).max()) if shown.any() else 0.0


def choices(channels: Sequence[str], actuators: Sequence[str]) -> Iterator[Column]:
    """Every one of these columns with every factor."""
    for name in channels:
        yield from (Column(name, False, factor) for factor in FACTORS)
    for name in actuators:
        yield from (Column(name, True, factor) for factor in FACTORS)


def corrected(logs: Trajectories, columns: Sequence[Column], actuators: Sequence[str]) -> Trajectories:
    """The logs with columns multiplied."""
    observations, actions = logs.observations.copy(), logs.actions.copy()
    for column in columns:
        if column.command:
            actions[..., list(actuators).index(column.name)] *= column.factor
        else:
            observations[..., list(logs.channels).index(column.name)] *= column.factor
    return replace(logs, observations=observations, actions=actions)


def log_jacobian(logs: Trajectories, columns: Sequence[Column]) -> float:
    """Log of the density of the logs over that of the corrected ones: n log |f| of every channel."""
    total = 0.0
    for column in columns:
        if not column.command:
            samples = logs.observations[..., list(logs.channels).index(column.name)]
            total += int(np.isfinite(samples).sum()) * math.log(abs(column.factor))
    return total
