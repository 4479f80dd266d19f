"""How trajectories are compared with simulations: the settings of a likelihood, and what a budget raises."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Real
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from sipe_bayes.core.arrays import BoolArray, FloatArray
from sipe_bayes.core.trajectory import Trajectories

if TYPE_CHECKING:
    from sipe_bayes.simulation.callable_simulator import CallableSimulator
    from sipe_bayes.simulation.simulator import Simulator


def check_settings(starts: object, fit: object, noise_sd: object, zero: bool = True) -> None:
    """Raise ValueError where what both likelihoods take is wrong; zero: whether an sd may be zero."""
    if starts not in ("estimated", "recorded"):
        raise ValueError(f"starts: expected 'estimated' or 'recorded', got {starts!r}")
    if fit is not None and (
        not isinstance(fit, tuple | list | np.ndarray) or not len(fit) or not all(isinstance(n, str) for n in fit)
    ):
        raise ValueError(f"fit: expected names of channels, such as ('angle',), got {fit!r}; None for all")
    if noise_sd is None:
        return
    if not isinstance(noise_sd, tuple | list | np.ndarray):
        raise ValueError(
            f"noise_sd: expected one sd for each channel, None where unknown, got {noise_sd!r}; such as (0.01, None)"
        )
    least, words = (0.0, "not below") if zero else (1e-300, "above")
    for sd in noise_sd:
        if sd is not None and not (isinstance(sd, Real) and least <= float(sd) < math.inf):
            raise ValueError(f"noise_sd: expected finite sds {words} zero, got {sd!r}; None where unknown")


@dataclass(frozen=True)
class Segments:
    """Multiple shooting with white or autoregressive noise.

    Args:
        window: seconds, or None for each log as one window.
        noise: "ar1", "white", or "sandwich" (the optimum of white noise with the width of "ar1"; ``laplace`` only).
        fit: names of the channels whose residuals count, default all.
        noise_sd: given sd per channel in its unit, None where estimated.
        windows: (name, seconds) of logs for which ``window`` is another.
        starts: "estimated" with theta, or "recorded": the trajectories' states are exact (they come from a simulator)
            and each window predicts the samples after its start; ``window`` = dt then compares single control steps.
        seconds: of all logs together that count at most: blocks of windows spread over them, None for all.
        late: (channel, seconds) by which segments are simulated and compared later, as if its sensor came so late: for
            models that are compared on the same samples, some with a late sensor and some without.

    Raises:
        ValueError: for any other setting.
    """

    window: float | None = 0.5
    noise: str = "ar1"
    fit: tuple[str, ...] | None = None
    noise_sd: tuple[float | None, ...] | None = None
    windows: tuple[tuple[str, float | None], ...] = ()
    starts: str = "estimated"
    seconds: float | None = None
    late: tuple[tuple[str, float], ...] = ()

    def __post_init__(self) -> None:
        if self.noise not in ("ar1", "white", "sandwich"):
            raise ValueError(f"noise: expected 'ar1', 'white' or 'sandwich', got {self.noise!r}")
        if any(w is not None and not w > 0 for w in (self.window, *dict(self.windows).values())):
            raise ValueError(f"window: expected seconds above zero, or None for whole logs, got {self.window}")
        if self.seconds is not None and not self.seconds > 0:
            raise ValueError(f"seconds: expected a time above zero, or None for all of the logs, got {self.seconds}")
        if any(not (isinstance(x, Real) and 0 <= float(x) < math.inf) for _, x in self.late):
            raise ValueError(f"late: expected names of channels with seconds not below zero, got {self.late!r}")
        check_settings(self.starts, self.fit, self.noise_sd)


@dataclass(frozen=True)
class StateSpace:
    """States unknown at every sample; measurement and process noise inferred. For ``laplace`` and ``mcmc``.

    Args:
        fit: names of the channels that count, default all.
        noise_sd: given sd per channel in its unit, None where it is inferred.
        starts: "estimated" with theta, or "recorded": the first of the trajectories' states is known. All other
            recorded states count for nothing.

    Raises:
        ValueError: for any other setting.
    """

    fit: tuple[str, ...] | None = None
    noise_sd: tuple[float | None, ...] | None = None
    starts: str = "estimated"
    noise: ClassVar[str] = "white"

    def __post_init__(self) -> None:
        check_settings(self.starts, self.fit, self.noise_sd, zero=False)


def chosen_channels(
    simulator: Simulator | CallableSimulator, trajectories: Trajectories, fit: tuple[str, ...] | None
) -> list[int]:
    """Which channels ``fit`` names, default all; raises ValueError for unknown ones and other sizes."""
    environment = simulator.environment
    names, measured = list(environment.channels), trajectories.observations.shape[2]
    if measured != len(names):
        raise ValueError(f"trajectories: expected observations of the {len(names)} channels {names}, got {measured}")
    commands = trajectories.actions.shape[2]
    if commands != environment.num_actions:
        raise ValueError(f"trajectories: expected {environment.num_actions} actions, got {commands}")
    return fitted_channels(names, fit)


def fitted_channels(names: Sequence[str], fit: tuple[str, ...] | None) -> list[int]:
    """Places among ``names`` of those in ``fit``, default all; raises ValueError for unknown ones."""
    fit = fit or tuple(names)
    unknown = [n for n in fit if n not in names]
    if unknown:
        raise ValueError(f"fit: unknown channels {unknown}; measured are {list(names)}")
    return [list(names).index(n) for n in fit]


def fitted_rotations(
    rotations: Sequence[tuple[int, int, int]], channels: list[int]
) -> tuple[tuple[int, int, int], ...]:
    """Places among the fitted ``channels`` of rotation vectors; raises ValueError where one is fitted in part."""
    groups = []
    for triple in rotations:
        fitted = [channels.index(c) for c in triple if c in channels]
        if len(fitted) not in (0, 3):
            raise ValueError("fit: an orientation's three numbers are fitted together or not at all; name all three")
        if fitted:
            groups.append((fitted[0], fitted[1], fitted[2]))
    return tuple(groups)


def check_seen(names: Sequence[str], seen: BoolArray) -> None:
    """Raise ValueError for a fitted channel without any sample; seen (C,)."""
    for name in np.array(names)[~seen]:
        raise ValueError(f"trajectories: the fitted channel {str(name)!r} has no sample at all; leave it out of `fit`")


def check_prompt(names: Sequence[str], remembers: FloatArray, dt: float) -> None:
    """Raise ValueError where channels (C,) tell of what was more than a control step ago."""
    for name, seconds in zip(names, remembers.tolist(), strict=True):
        if seconds > dt:
            raise ValueError(
                f"likelihood: StateSpace can not follow {name!r}, whose delay or filter may reach back {seconds:.3g} "
                f"s, more than a control step of {dt:.3g} s; use windows, Segments(), or narrower bounds"
            )
