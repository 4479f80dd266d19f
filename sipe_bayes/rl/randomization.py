"""Domain randomisation: every episode of an agent's training runs under parameters of its own, drawn from a posterior.

Uniform domain randomisation draws from the prior (J. Tobin et al. 2017, "Domain Randomization for Transferring Deep
Neural Networks from Simulation to the Real World", https://arxiv.org/abs/1703.06907; dynamics: X. B. Peng et al. 2018,
"Sim-to-Real Transfer of Robotic Control with Dynamics Randomization", https://arxiv.org/abs/1710.06537); B. Mehta, A.
Handa, D. Fox, F. Ramos 2020, "A User's Guide to Calibrating Robotics Simulators", Section 3.4
(https://arxiv.org/abs/2011.08985) draw from what an estimator found. Here both are a ``Posterior``: a Dirac trains in
one environment, of particles each is drawn by its weight, everything else is sampled.

A theta outside the cube of the environment's parameters, or one that no model can have, is drawn anew and counted.
Whether a simulation diverges shows in its course alone: it ends its episode, the next one draws again, and the engine
counts it.

Two further randomisations, of what a calibration does not say (Peng et al. have both): each episode draws a noise on
its observations and a delay of its actions.

Deviation: Peng's noise has one sd and his delay changes within an episode.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum, auto
from pathlib import Path
from typing import Any

import numpy as np
import torch

from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray
from sipe_bayes.core.files import read_json, reading
from sipe_bayes.core.parameters import Parameter, ParameterSpace
from sipe_bayes.core.seeding import torch_generator_from
from sipe_bayes.core.validation import whole
from sipe_bayes.posterior import GaussianMixture, Posterior, load_posterior
from sipe_bayes.simulation.simulator import Simulator

_ROUNDING = 1e-9  # in theta, from one space's bounds to another's
_POINT = 1e-12  # variance in theta of a normal that is a point


class Usable(StrEnum):
    """Which interval of a calibrated parameter may be used: the plain one, the wider one beside it, or none."""

    PLAIN = auto()
    WIDER = auto()
    NONE = auto()


@dataclass(frozen=True, eq=False)
class Randomization:
    """What an episode draws.

    Args:
        posterior: of its parameters.
        observation_noise: each episode's white noise has an sd uniform between 0 and this, one number or (O,) in the
            channels' units; one number leaves the desired goal alone.
        action_delay: control steps; each episode's delay is one of 0 to this many, all equally probable; until the
            first action arrives nothing is done.
        uncalibrated: parameters that are drawn from their prior, since no value of them may be used, and why.

    Raises:
        ValueError: for anything else.
    """

    posterior: Posterior
    observation_noise: float | FloatArray = 0.0
    action_delay: int = 0
    uncalibrated: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not isinstance(self.posterior, Posterior):
            raise ValueError(
                f"posterior: expected a Posterior, got a {type(self.posterior).__name__}; a point is "
                "sipe.Dirac(theta, space)"
            )
        whole("action_delay", self.action_delay, 0)
        noise = np.asarray(self.observation_noise, float)
        if noise.ndim > 1 or not np.isfinite(noise).all() or (noise < 0).any():
            raise ValueError(
                f"observation_noise: expected an sd of at least 0, or one for each channel, got "
                f"{self.observation_noise!r}"
            )

    @property
    def fingerprint(self) -> str:
        """The same for the same randomisation."""
        tensors, settings = self.posterior._state()
        noise = np.asarray(self.observation_noise, float)
        own = type(self.posterior).__name__, self.posterior.space.to_dict(), settings
        plain = [*own, noise.tolist(), int(self.action_delay)]
        digest = hashlib.sha256(json.dumps(plain, sort_keys=True, default=float).encode())
        for name in sorted(tensors):
            digest.update(name.encode() + tensors[name].contiguous().numpy().tobytes())
        return digest.hexdigest()

    @property
    def disturbs(self) -> bool:
        """Whether it does more than change parameters."""
        return bool(np.any(np.asarray(self.observation_noise, float))) or self.action_delay > 0

    def disturbances(
        self, num_envs: int, channels: int, goal_size: int, middle: FloatArray, generator: np.random.Generator
    ) -> Disturbances:
        """Noise and delay of episodes side by side.

        Args:
            num_envs: how many.
            channels: O.
            goal_size: of the desired goal, the last channels.
            middle: the idle action (A,).
            generator: of what is drawn.

        Raises:
            ValueError: for noise of another length.
        """
        noise = np.asarray(self.observation_noise, float)
        if noise.ndim == 0:
            noise = np.where(np.arange(channels) < channels - goal_size, noise, 0.0)
        if noise.shape != (channels,):
            raise ValueError(
                f"observation_noise: expected one number or {channels}, one for each channel, got {len(noise)}"
            )
        return Disturbances(noise, int(self.action_delay), num_envs, middle, generator)


def randomization(given: Posterior | Randomization) -> Randomization:
    """A posterior alone randomises the parameters alone."""
    return given if isinstance(given, Randomization) else Randomization(given)


def load_randomization(path: str | os.PathLike[str]) -> Randomization:
    """Read the ``domain_randomization.json`` of `sipe calibrate`.

    Its ``posterior`` names the saved posterior in the same folder, which is read. A file without that entry stands for
    its normal: ``mean`` and ``covariance`` in the parameters' units, cut off at ``low`` and ``high``. Parameters whose
    ``usable`` is "none" are ``uncalibrated``; a file of before there was such an entry has none.
    ``observation_noise`` and ``action_delay`` may be added to the file.

    Raises:
        FileNotFoundError: where there is none.
        ValueError: for a file that says something else.
    """
    file = Path(path)
    what, remedy = "a domain randomisation", "export it with `sipe calibrate`"
    plain: dict[str, Any] = read_json(file, what, remedy)
    with reading(file, what, remedy):
        more = {name: plain[name] for name in ("observation_noise", "action_delay") if name in plain}
        posterior = load_posterior(file.parent / str(plain["posterior"])) if "posterior" in plain else _normal(plain)
        rows = [row for row in plain.get("parameters", ()) if Usable(row.get("usable", "plain")) is Usable.NONE]
        return Randomization(posterior, **more, uncalibrated={str(row["name"]): str(row["reason"]) for row in rows})


def _normal(plain: dict[str, Any]) -> GaussianMixture:
    """The truncated normal of a file's parameters, in theta between its bounds."""
    rows = plain["parameters"]
    space = ParameterSpace(
        Parameter(row["name"], row["low"], row["high"], unit=row["unit"], targets=tuple(row["targets"])) for row in rows
    )
    width = np.array([p.high - p.low for p in space])
    mean = space.normalise(np.array([row["mean"] for row in rows], float))
    covariance = np.array(plain["covariance"], float) / width / width[:, None] + _POINT * np.eye(len(space))
    return GaussianMixture(torch.zeros(1), mean[None], covariance[None], space)


def check_names(posterior: Posterior, space: ParameterSpace, whose: str) -> None:
    """Raises ValueError, which names what differs, for a posterior over other parameters or units than a space's."""
    mine, theirs = posterior.space.names, space.names
    missing, unknown = [n for n in theirs if n not in mine], [n for n in mine if n not in theirs]
    if missing or unknown:
        what = [f"it lacks {', '.join(missing)}"] * bool(missing) + [f"it has {', '.join(unknown)}"] * bool(unknown)
        raise ValueError(
            f"posterior: is over other parameters than {whose}: {' and '.join(what)}; fit one to the environment's "
            f"{', '.join(theirs)}"
        )
    for p in space:
        unit = posterior.space[posterior.space.index(p.name)].unit
        if unit != p.unit:
            raise ValueError(f"posterior: {p.name} is in {unit!r}, and in {p.unit!r} in {whose}; use the same unit")


class Draws:
    """Theta of episodes that begin in a simulator; ``redrawn`` counts those that no model can have.

    Args:
        simulator: in which they begin.
        source: what is drawn from; it may be exchanged for another one over the same parameters.
        tries: times that theta are drawn anew.
    """

    def __init__(self, simulator: Simulator, source: Posterior, tries: int = 100) -> None:
        whose = getattr(simulator.environment, "name", type(simulator.environment).__name__)
        check_names(source, simulator.space, whose)
        self.source, self.redrawn, self._simulator, self._tries = source, 0, simulator, tries

    def __call__(self, rng: np.random.Generator, count: int) -> FloatArray:
        """Draw theta (count, N) that a model can have; raises ValueError where the source hardly has any."""
        drawn = np.empty((0, len(self._simulator.space)))
        for _ in range(self._tries):
            theta = sample(self.source, rng, count - len(drawn), self._simulator.space)
            possible = np.array([self._possible(row) for row in theta])
            self.redrawn += int((~possible).sum())
            drawn = np.concatenate([drawn, theta[possible]])
            if len(drawn) == count:
                return drawn
        raise ValueError(f"theta: {self._tries} draws of {self.source!r} gave no model; narrow the parameters' bounds")

    def _possible(self, theta: FloatArray) -> bool:
        try:
            self._simulator.check_physical(self._simulator.check_theta(theta, allow_outside=False))
        except ValueError:
            return False
        return True


def sample(source: Posterior, rng: np.random.Generator, count: int, space: ParameterSpace) -> FloatArray:
    """Draws of a posterior as theta of another space, by name and value where their order or bounds differ.

    Args:
        source: the posterior.
        rng: of the draws.
        count: how many.
        space: the other one.

    Returns:
        (count, N).
    """
    generator = torch_generator_from(rng)
    theta = np.asarray(source.sample((count,), generator=generator).numpy())
    if _scales(source.space) == _scales(space):
        return theta
    values = source.space.values(theta)[:, [source.space.index(name) for name in space.names]]
    moved = space.normalise(values)
    inside = (moved > -_ROUNDING) & (moved < 1 + _ROUNDING)
    return np.where(inside, moved.clip(0.0, 1.0), moved)


def _scales(space: ParameterSpace) -> list[tuple[str, float, float, str]]:
    return [(p.name, p.low, p.high, p.scale) for p in space]


@dataclass(frozen=True)
class DisturbancesState:
    """Between two steps.

    Args:
        observations: what was seen (L, O).
        share: of the greatest noise (L,).
        delays: control steps (L,).
        queue: actions on their way (L, D+1, A).
        generator: as JSON.
    """

    observations: FloatArray
    share: FloatArray
    delays: IntArray
    queue: FloatArray
    generator: str


@dataclass(eq=False)
class Disturbances:
    """The noise and the delay of L episodes side by side.

    Call ``begin`` for those that begin, ``noisy`` on every observation and ``delayed`` on every action.

    Args:
        noise: greatest sd (O,).
        delay: greatest, in control steps.
        num_envs: L.
        middle: the idle action (A,).
        generator: of what is drawn.
    """

    noise: FloatArray
    delay: int
    num_envs: int
    middle: FloatArray
    generator: np.random.Generator
    observations: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        self.observations = np.zeros((self.num_envs, len(self.noise)))
        self._share, self._delays = np.zeros(self.num_envs), np.zeros(self.num_envs, int)
        self._queue = np.tile(np.asarray(self.middle, float), (self.num_envs, self.delay + 1, 1))

    def begin(self, fresh: BoolArray) -> None:
        """Draw anew for the marked episodes (L,)."""
        count = int(fresh.sum())
        self._share[fresh] = self.generator.random(count)
        self._delays[fresh] = self.generator.integers(0, self.delay + 1, count)
        self._queue[fresh] = self.middle

    def noisy(self, observations: FloatArray) -> FloatArray:
        """What is seen of observations (L, O)."""
        white = self.generator.standard_normal(observations.shape)
        self.observations = observations + self._share[:, None] * self.noise * white
        return self.observations.copy()

    def delayed(self, actions: FloatArray, ignored: BoolArray) -> FloatArray:
        """What arrives when actions are sent.

        Args:
            actions: (L, A).
            ignored: episodes (L,) whose actions are none.
        """
        self._queue = np.roll(self._queue, 1, axis=1)
        self._queue[:, 0] = np.where(ignored[:, None], self.middle, actions)
        return self._queue[np.arange(self.num_envs), self._delays]

    def state(self) -> DisturbancesState:
        """From which ``restore`` goes on bit for bit."""
        generator = json.dumps(self.generator.bit_generator.state)
        seen, share = self.observations.copy(), self._share.copy()
        return DisturbancesState(seen, share, self._delays.copy(), self._queue.copy(), generator)

    def restore(self, state: DisturbancesState) -> None:
        """Go on from what ``state`` gave."""
        self.observations, self._share = state.observations.copy(), state.share.copy()
        self._delays, self._queue = state.delays.copy(), state.queue.copy()
        self.generator.bit_generator.state = json.loads(state.generator)
