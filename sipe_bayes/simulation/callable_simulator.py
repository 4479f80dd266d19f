"""Any Python function in MuJoCo's place: ``sipe.CallableSimulator(fn, space)``.

``estimator.fit(x)`` takes an observed x (D,). To the estimators an x is a trajectory of one step without actions, from
zeros to x.
"""

from __future__ import annotations

import hashlib
import inspect
import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, cast

import numpy as np
from numpy.typing import ArrayLike

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import ParameterSpace
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.core.validation import whole

Function = Callable[..., ArrayLike]
"""``fn(values (B, N)) -> x (B, D)``, with a generator as well where it is noisy."""


@dataclass(frozen=True)
class CallableEnvironment:
    """What a CallableSimulator observes: names of the D channels."""

    channels: tuple[str, ...]
    num_actions: int = 0
    rotations: ClassVar[tuple[tuple[int, int, int], ...]] = ()


class CallableSimulator:
    """Simulates by ``fn(values (B, N)) -> x (B, D)``, or noisy: ``fn(values, generator) -> x``.

    Values are physical; x is NaN where a simulation failed. A noisy fn takes a numpy Generator, its only source of
    randomness, as its second argument without a default, or as the one called ``generator`` or ``rng``; other arguments
    with defaults are left alone. Each theta has a generator of its own, from ``seed`` and theta, so that the same theta
    give the same x.

    Args:
        fn: the function.
        space: its parameters.
        likelihood: sd of independent normal noise about fn's x, one number or (D,); ``laplace`` and ``mcmc`` need it,
            and the others add that noise to what they simulate.
        seed: of a noisy fn.
        name: tells functions apart in checkpoints and caches; default the qualified name of a module's function. Any
            other fn (a lambda, a local function, a partial, an object) shares its own with others and needs one there.

    Raises:
        ValueError: for an fn of another form, or arguments that do not fit.
    """

    failure: ClassVar[str] = "made fn return NaN or infinity"  # what is said of simulations that are not valid

    def __init__(
        self,
        fn: Function,
        space: ParameterSpace,
        likelihood: ArrayLike | None = None,
        *,
        seed: int = 0,
        name: str | None = None,
    ) -> None:
        if not isinstance(space, ParameterSpace):
            raise ValueError(
                f"space: expected a ParameterSpace, got {type(space).__name__}; sipe.ParameterSpace([...])"
            )
        if not callable(fn):
            raise ValueError(
                f"fn: expected a function fn(values (B, {len(space)})) -> x (B, D), got a {type(fn).__name__}"
            )
        self.fn, self.space, self.seed = fn, space, whole("seed", seed, 0)
        if name is not None and (not isinstance(name, str) or not name):
            raise ValueError(f"name: expected a text that tells fn from other functions, got {name!r}")
        self.name = name or _own_name(fn)
        self._generator = _generator_parameter(fn)
        self.noisy = self._generator is not None
        if self.noisy and likelihood is not None:
            raise ValueError(
                "likelihood: the noise is either fn's own or normal with these sds; give fn(values) -> x without noise"
            )
        size = self._call(space.values(space.default_theta)[None], np.random.default_rng(self.seed)).shape[1]
        self.environment = CallableEnvironment(tuple(f"x{j}" for j in range(size)))
        self.noise_sd = None if likelihood is None else self._sds(likelihood, size)

    def _sds(self, likelihood: ArrayLike, size: int) -> tuple[float, ...]:
        try:
            sd = np.asarray(likelihood, float)
        except (TypeError, ValueError):
            sd = np.empty(0)
        if sd.shape not in ((), (size,)) or not ((sd > 0) & np.isfinite(sd)).all():
            raise ValueError(f"likelihood: expected one sd above zero or ({size},) of them, got {likelihood!r}")
        return tuple(np.broadcast_to(sd, (size,)).tolist())

    def checksum(self) -> str:
        """SHA-256 of the name, the form and the seed: a changed function wants another name."""
        plain = (self.name, self.environment.channels, self.noisy, self.noise_sd, self.seed)
        return hashlib.sha256(repr(plain).encode()).hexdigest()

    def trajectory(self, x: object) -> Trajectory:
        """An observed x as estimators see it.

        Args:
            x: (D,); NaN where it was not observed.

        Raises:
            ValueError: for another shape, infinity, or an x of which nothing was observed.
        """
        size = len(self.environment.channels)
        try:
            values = np.asarray(cast(ArrayLike, x), float)
        except (TypeError, ValueError):
            raise ValueError(f"x: expected numbers ({size},), as fn returns, got a {type(x).__name__}") from None
        if values.shape != (size,):
            raise ValueError(f"x: expected shape ({size},), as fn returns, got {values.shape}")
        if np.isinf(values).any() or not np.isfinite(values).any():
            raise ValueError(f"x: expected finite numbers, NaN where one is missing, got {values.tolist()}")
        return Trajectory(
            np.stack([np.zeros(size), values]), np.zeros((1, 0)), 1.0, name="x", channels=self.environment.channels
        )

    def wave(self, horizon: int) -> int:
        """As ``Simulator.wave``: it does not matter."""
        return 1

    def replay(self, theta: FloatArray, trajectories: Trajectories, starts: FloatArray | None = None) -> Trajectories:
        """As ``Simulator.replay`` of theta (B, N) and R observed x: B * R trajectories of one step; no starts."""
        theta, count = np.atleast_2d(np.asarray(theta, float)), len(trajectories)
        if trajectories.actions.shape[1:] != (1, 0):
            raise ValueError(f"trajectories: expected an x ({len(self.environment.channels)},), got a trajectory")
        noisy = self.noisy
        x = self._drawn(theta, count) if noisy else np.repeat(self._call(self.space.values(theta)), count, axis=0)
        batch = len(x)
        observations = np.stack([np.zeros_like(x), x], axis=1)
        valid = np.stack([np.ones(batch, bool), np.isfinite(x).all(1)], axis=1)
        return Trajectories(
            observations,
            np.zeros((batch, 1, 0)),
            np.ones(batch),
            np.ones(batch, int),
            valid,
            None,
            tuple(trajectories.names) * len(theta),
            self.environment.channels,
        )

    def _drawn(self, theta: FloatArray, count: int) -> FloatArray:
        rows = []
        for row in theta:
            digest = hashlib.sha256(np.ascontiguousarray(row).tobytes()).digest()[:8]
            rng = np.random.default_rng([self.seed, int.from_bytes(digest, "little")])
            rows.append(self._call(np.tile(self.space.values(row), (count, 1)), rng))
        return np.concatenate(rows)

    def _call(self, values: FloatArray, rng: np.random.Generator | None = None) -> FloatArray:
        try:
            x = np.asarray(self._evaluated(values, rng), float)
        except (IndexError, TypeError, ValueError) as error:
            raise ValueError(
                f"fn: expected fn(values (B, {len(self.space)})) -> x (B, D), a row for each theta, values[:, 0] the "
                f"first parameter; with values {values.shape} it raised {type(error).__name__}: {error}"
            ) from error
        if x.ndim != 2 or len(x) != len(values) or not math.prod(x.shape):
            raise ValueError(
                f"fn: expected x ({len(values)}, D) for values {values.shape}, a row for each theta, got shape "
                f"{x.shape}"
            )
        return x

    def _evaluated(self, values: FloatArray, rng: np.random.Generator | None) -> ArrayLike:
        if self._generator is None:
            return self.fn(values)
        return self.fn(values, **{self._generator: rng}) if self._generator else self.fn(values, rng)


def _own_name(fn: Function) -> str:
    """Module, or script, and name of a module's function, which no other has; "" of anything else."""
    name, module = getattr(fn, "__qualname__", ""), getattr(fn, "__module__", None) or ""
    home = sys.modules.get(module)
    place = getattr(home, "__file__", "") if module == "__main__" else module
    return f"{place}.{name}" if place and getattr(home, name, None) is fn else ""


def _generator_parameter(fn: Function) -> str | None:
    """Where fn takes a generator: the parameter's name, "" for the second place, None if it takes none."""
    try:
        parameters = list(inspect.signature(fn).parameters.values())[1:]
    except (TypeError, ValueError):  # written in C, without a signature
        return None
    for parameter in parameters:
        if parameter.name in ("generator", "rng") and parameter.kind is not parameter.POSITIONAL_ONLY:
            return parameter.name
    places = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    return "" if any(p.kind in places and p.default is p.empty for p in parameters) else None
