"""A column of a log with a flipped sign or in another unit: tried before any physics is blamed.

Where the plain model leaves much of a channel unexplained, each channel that moves and each command is multiplied by
-1, 180 / pi, 1000 and their inverses, and the model fitted again, the least explained columns first and signs before
units, as far as a share of the budget goes. A factor is only right where it explains the channel: where the model lacks
much, a wrong one fits better than none. For a channel y, p(y) = |f|^n p(f y), n its samples that are fitted.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sipe_bayes.core.arrays import BoolArray, FloatArray
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.envs.laws.bound import driven_joint
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.likelihood import BoundLikelihood, noise_level

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


def moving(windows: BoundLikelihood) -> BoolArray:
    """The channels (C,) that show more than noise: what rests has neither sign nor unit.

    By five standard errors of a variance of white noise, and at least by a fifth, for the noise is an estimate.
    """
    noise = noise_level(windows.trajectories, windows.settings, windows.simulator)[windows.channels]
    chance = 5 * np.sqrt(2 / np.maximum(windows.observed.sum(axis=(0, 1)), 1))
    return np.asarray(windows.spread**2 > noise**2 * (1 + np.maximum(chance, 0.2)))


def unexplained(windows: BoundLikelihood, sd: FloatArray, shown: BoolArray) -> dict[str, float]:
    """The share of a channel's spread that the residuals' sd (C,) is, by name of those that are ``shown`` to move."""
    names = np.array(windows.fitted)[shown].tolist()
    return dict(zip(names, (sd[shown] / windows.spread[shown]).tolist(), strict=True))


def channels_of(environment: MjcfEnvironment) -> dict[tuple[str, bool], tuple[str, ...]]:
    """The channels that tell a column, by its name and whether it is a command: of that its joint's, else all."""
    model, targets = environment.compile(), {c.label: c.target for c in environment.measurements}
    out: dict[tuple[str, bool], tuple[str, ...]] = {(name, False): (name,) for name in environment.channels}
    for actuator in environment.actuators:
        joint = driven_joint(model, model.actuator(actuator).id)
        site = f"joint:{model.joint(joint).name}." if joint >= 0 else None
        own = tuple(name for name, target in targets.items() if site is not None and target.startswith(site))
        out[actuator, True] = own or tuple(environment.channels)
    return out


def is_explained(
    windows: BoundLikelihood, sd: FloatArray, shown: BoolArray, column: Column, own: Sequence[str], most: float
) -> bool:
    """Whether beyond noise no more than a share of a column's ``own`` channels is left, of those that move.

    The residuals' sd (C,) is that with the column corrected, ``windows`` have the logs as they were.
    """
    noise = noise_level(windows.trajectories, windows.settings, windows.simulator)[windows.channels]
    corrected = np.array([name == column.name and not column.command for name in windows.fitted])
    beyond = np.maximum((sd / np.where(corrected, abs(column.factor), 1.0)) ** 2 - noise**2, 0.0)
    share = unexplained(windows, np.sqrt(beyond), shown)
    return max((share[name] for name in own if name in share), default=0.0) < most


def choices(channels: Mapping[tuple[str, bool], Sequence[str]], share: Mapping[str, float]) -> list[Column]:
    """Every channel given and every command with every factor, what promises most first.

    A column promises more the less is explained of it, of a command of the channels of the joint that it drives; and a
    factor the earlier it stands in ``FACTORS``: from one column to the next as much as from one factor to the next.

    Args:
        channels: ``channels_of``.
        share: of each channel that may be wrong, how much of its spread is unexplained.
    """
    promise = {
        (name, command): max((share[c] for c in own if c in share), default=0.0)
        for (name, command), own in channels.items()
        if command or name in share
    }
    ranked = enumerate(sorted(promise, key=lambda column: -promise[column]))
    every = [(rank + k, Column(*column, factor)) for rank, column in ranked for k, factor in enumerate(FACTORS)]
    return [column for _, column in sorted(every, key=lambda item: item[0])]


def corrected(logs: Trajectories, columns: Sequence[Column], actuators: Sequence[str]) -> Trajectories:
    """The logs with columns multiplied."""
    observations, actions = logs.observations.copy(), logs.actions.copy()
    for column in columns:
        if column.command:
            actions[..., list(actuators).index(column.name)] *= column.factor
        else:
            observations[..., list(logs.channels).index(column.name)] *= column.factor
    return replace(logs, observations=observations, actions=actions)


def log_jacobian(windows: BoundLikelihood, column: Column) -> float:
    """Log of the density of a channel as given over that of the corrected one, n log |f| of n samples that are fitted.

    Of long logs these are not all (``Segments.seconds``).
    """
    if column.command or column.name not in windows.fitted:
        return 0.0
    samples = windows.observed[..., list(windows.fitted).index(column.name)]
    return int(samples.sum()) * math.log(abs(column.factor))
