"""Replicas of recorded trajectories: the same experiment simulated at a known theta, with the recording's noise.

Commands, sample times, starting states and missing samples are those of the recording; the noise is drawn anew, white
or first-order autoregressive in each channel, and where the recording has process noise, each state after a control
step is moved by some. The commands are replayed open loop: where a feedback law kept the machine on its course, a
replica at another theta leaves it, and what is inferred from replicas holds for short logs or small moves of theta
only.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
import scipy.signal

from sipe_bayes.core.arrays import BoolArray, FloatArray
from sipe_bayes.core.rotations import with_noise
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.likelihood.noise import Noise, noise_level
from sipe_bayes.likelihood.settings import Segments, StateSpace
from sipe_bayes.likelihood.starts.estimates import estimate_states, first_states
from sipe_bayes.likelihood.starts.filters import with_history
from sipe_bayes.simulation.callable_simulator import CallableSimulator
from sipe_bayes.simulation.simulator import Simulator
from sipe_bayes.simulation.tangents import moved


def observation_noise(
    diagnostics: Mapping[str, Sequence[float]],
    trajectories: Trajectories,
    likelihood: Segments | StateSpace,
    simulator: Simulator | CallableSimulator,
) -> Noise:
    """Noise of all O channels.

    As an estimator's ``diagnostics`` say (``noise_sd``, ``noise_tau``) of the channels that it fitted; ``noise_level``
    tells of the others, as white.
    """
    sd = noise_level(trajectories, likelihood, simulator)
    tau = np.zeros(len(sd))
    fitted = list(range(len(sd)))
    if likelihood.fit is not None and trajectories.channels:
        fitted = [trajectories.channels.index(name) for name in likelihood.fit]
    if len(diagnostics.get("noise_sd", ())) == len(fitted):
        sd[fitted], tau[fitted] = diagnostics["noise_sd"], diagnostics.get("noise_tau", np.zeros(len(fitted)))
    return Noise(sd, tau)


class Replicas:
    """Makes replicas.

    Args:
        simulator: what they are made with.
        trajectories: the recordings.
        noise: of the O channels.
        process: (D,), sd of the process noise in the tangent coordinates of ``StateSpace``, whose outliers are not
            repeated; default none.
    """

    def __init__(
        self,
        simulator: Simulator | CallableSimulator,
        trajectories: Trajectories,
        noise: Noise,
        process: FloatArray | None = None,
    ) -> None:
        self.simulator, self.trajectories, self.noise = simulator, trajectories, noise
        self.process = process if process is not None and process.any() else None
        self.starts = _starts(simulator, trajectories)

    def make(self, theta: FloatArray, rng: np.random.Generator) -> Trajectories | None:
        """One replica of every trajectory at theta (N,), with states where these have some; None where one diverges."""
        return self.many(theta[None], rng)[0]

    def many(self, theta: FloatArray, rng: np.random.Generator, estimated: bool = False) -> list[Trajectories | None]:
        """What ``make`` gives for several truths, simulated in one batch.

        Args:
            theta: (B, N).
            rng: of the noise.
            estimated: a replica starts where the recording's own start would lie if the replica's noise were what its
                estimate is off by, so that a recording is as far from its replicas as they are from one another.
        """
        noises = [self._noise(rng) for _ in theta]
        starts = np.concatenate([self.starts - self._misled(n) for n in noises]) if estimated else self.starts
        simulator, count = self.simulator, len(self.trajectories)
        motion = simulator.replay(theta, self.trajectories, starts)
        if self.process is not None:
            motion = self._shaken(motion, theta, rng)
        replicas = []
        for b, noise in enumerate(noises):
            rows = slice(b * count, (b + 1) * count)
            states = None if motion.states is None else motion.states[rows]
            seen = with_noise(motion.observations[rows], noise, simulator.environment.rotations)
            replicas.append(self._measured(seen, motion.valid[rows], states))
        return replicas

    def _shaken(self, motion: Trajectories, theta: FloatArray, rng: np.random.Generator) -> Trajectories:
        """The replayed ``motion`` again, control step by control step, with process noise after each."""
        simulator, log = self.simulator, self.trajectories
        assert isinstance(simulator, Simulator)
        assert self.process is not None
        assert motion.states is not None
        environment, batch = simulator.environment, len(theta)
        late = np.array([environment.derived_late and c is None for c in environment.state_columns(simulator.model)])
        thetas, dt = np.repeat(theta, len(log), axis=0), np.tile(log.dt, batch)
        names, goals = list(log.names or [None] * len(log)) * batch, environment.recorded_goals(log.observations[:, 0])
        goals = None if goals is None else np.tile(goals, (batch, 1))
        seen, states, valid = motion.observations.copy(), motion.states.copy(), motion.valid.copy()
        steps = states.shape[1] - 1
        for k in range(steps + 1):
            actions = np.tile(log.actions[:, min(k, steps - 1)], (batch, 1))[:, None]
            step = simulator.rollout(thetas, actions, states[:, k], dt, names, goals=goals)
            assert step.states is not None
            seen[:, k, ~late] = step.observations[:, 0, ~late]
            valid[:, k] &= step.valid[:, 0]
            if k < steps:
                white = rng.standard_normal((len(thetas), len(self.process)))
                ends = np.where(step.valid[:, 1, None], step.states[:, 1], states[:, 0])
                states[:, k + 1] = moved(simulator.model, ends, self.process * white)
                seen[:, k + 1, late] = step.observations[:, 1, late]
                valid[:, k + 1 :] &= step.valid[:, 1, None]
        inside = np.arange(steps + 1) <= motion.length[:, None]
        return replace(motion, observations=np.where(inside[..., None], seen, np.nan), states=states, valid=valid)

    def _measured(self, observations: FloatArray, valid: BoolArray, states: FloatArray | None) -> Trajectories | None:
        """Observations (R, T+1, O) where the recording has samples; None where one is not valid."""
        log = self.trajectories
        inside = np.arange(valid.shape[1]) <= log.length[:, None]
        if not (valid | ~inside).all():
            return None
        seen = np.where(np.isfinite(log.observations), observations, np.nan)
        items = []
        for k, recorded in enumerate(log):
            n = len(recorded) + 1
            own = None if recorded.states is None or states is None else states[k, :n]
            items.append(Trajectory(seen[k, :n], recorded.actions, recorded.dt, own, recorded.name, log.channels))
        return Trajectories.stack(items)

    def _noise(self, rng: np.random.Generator) -> FloatArray:
        """Noise (R, T+1, O) of every trajectory."""
        samples = self.trajectories.observations.shape[1]
        noise = np.stack([self._drawn(samples, float(dt), rng) for dt in self.trajectories.dt])
        if isinstance(self.simulator, CallableSimulator):
            noise[:, 0] = 0.0  # x is the second sample
        return noise

    def _misled(self, noise: FloatArray) -> FloatArray:
        """By how much (R, S) noise (R, T+1, O) on the recording moves the estimate of its start."""
        if isinstance(self.simulator, CallableSimulator) or self.trajectories.states is not None:
            return np.zeros_like(self.starts)
        moved = np.zeros_like(self.starts)
        for k, ((begin, before), own) in enumerate(zip(self._beginnings, noise, strict=True)):
            assert isinstance(self.simulator, Simulator)
            rotations = self.simulator.environment.rotations
            noisy = replace(begin, observations=with_noise(begin.observations, own[: len(begin) + 1], rotations))
            moved[k, : len(before)] = estimate_states(self.simulator, noisy)[0] - before
        return moved

    @cached_property
    def _beginnings(self) -> list[tuple[Trajectory, FloatArray]]:
        """The first moments of every recording, and the start that they tell."""
        assert isinstance(self.simulator, Simulator)
        beginnings = []
        for recorded in self.trajectories:
            steps = min(len(recorded), max(4, math.ceil(0.2 / recorded.dt)))  # more than the estimate depends on
            begin = Trajectory(recorded.observations[: steps + 1], recorded.actions[:steps], recorded.dt)
            beginnings.append((begin, estimate_states(self.simulator, begin)[0]))
        return beginnings

    def _drawn(self, count: int, dt: float, rng: np.random.Generator) -> FloatArray:
        """Noise (count, O) of samples dt seconds apart."""
        white = rng.standard_normal((count, len(self.noise.sd)))
        out = np.empty_like(white)
        for c, (sd, tau) in enumerate(zip(self.noise.sd, self.noise.tau, strict=True)):
            a = float(np.exp(-dt / tau)) if tau > 0 else 0.0
            scaled = white[:, c] * np.sqrt(1 - a**2)
            scaled[0] = white[0, c]
            out[:, c] = sd * scipy.signal.lfilter([1.0], [1.0, -a], scaled)
        return out


def _starts(simulator: Simulator | CallableSimulator, trajectories: Trajectories) -> FloatArray:
    """Starting states (R, S); where not recorded, a delayed actuator's commands before the log are its first ones."""
    starts = first_states(simulator, trajectories)
    if isinstance(simulator, CallableSimulator) or trajectories.states is not None:
        return starts
    return with_history(simulator, starts, [actions[:1] for actions in trajectories.actions], trajectories.dt)
