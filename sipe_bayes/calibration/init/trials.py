"""Short simulations of a log under one assumption after the other: which unit, sign, delay or order misses least.

Windows of a log are simulated from the state that its measurements tell. What a straight line in time explains of the
difference is taken out of each window, since that is what an inexact start leaves; the rest is compared with what such
a line leaves of the measurement itself. So a *miss* of 1 is no better than going on straight, in any unit. Samples that
are missing are bridged by straight lines, and windows with long gaps are not taken where others are.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace

import numpy as np

from sipe_bayes.core.arrays import FloatArray, IntArray
from sipe_bayes.core.rotations import bridged, written_near
from sipe_bayes.core.trajectory import Trajectory
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.likelihood import estimate_states, with_history
from sipe_bayes.simulation.simulator import Simulator
from sipe_bayes.simulation.tangents import moved

_WORST = 30.0
_BEST = 1e-3
_LONGEST = 60  # physics steps of a control step, beyond which a clock is not believed
_MOVES = 2.0  # times the noise, that a channel moves which is to be followed
_UNFOLLOWED = 0.8  # of a straight line's miss
_PAST = 500  # samples of commands before a window
_STEPS = 200  # physics steps, on average, of each window that is asked for


@dataclass(frozen=True)
class Assumption:
    """How columns are read.

    Args:
        observed: (O,) what each channel is multiplied by.
        driven: (A,) what each command is multiplied by.
        clock: what the clock is multiplied by.
        delay: control steps by which commands arrive later.
        channels: the column that each channel is read from.
        actuators: the column that each actuator is driven by.
        minus: pairs of channels, the second of which is taken off the first.
        zeros: (O,) SI, what is taken off each channel once it is multiplied; none where empty.
        rests: (A,) SI, the same of commands.
    """

    observed: tuple[float, ...]
    driven: tuple[float, ...]
    clock: float = 1.0
    delay: int = 0
    channels: tuple[int, ...] = ()
    actuators: tuple[int, ...] = ()
    minus: tuple[tuple[int, int], ...] = ()
    zeros: tuple[float, ...] = ()
    rests: tuple[float, ...] = ()

    @classmethod
    def as_given(cls, channels: int, actuators: int) -> Assumption:
        """All as the configuration has it."""
        return cls((1.0,) * channels, (1.0,) * actuators, 1.0, 0, tuple(range(channels)), tuple(range(actuators)))


@dataclass(frozen=True)
class Flight:
    """Windows under an assumption: states (W, S) at their starts, commands (W, L, A), measured (W, L+1, C), dt (W,)."""

    states: FloatArray
    commands: FloatArray
    measured: FloatArray
    dt: FloatArray

    @property
    def count(self) -> int:
        """W."""
        return len(self.states)

    def moved(self, simulator: Simulator, tangent: FloatArray) -> Flight:
        """With starts moved by tangents (W, 2 nv)."""
        if not tangent.any():
            return self
        rest = np.zeros((len(tangent), simulator.model.na))
        return replace(self, states=moved(simulator.model, self.states, np.concatenate([tangent, rest], axis=1)))


class Trial:
    """Windows of logs, and what simulations of them miss.

    Args:
        environment: the model, its unknowns that a fit may move, what the logs drive and measure.
        logs: in SI, as the configuration reads them.
        windows: how many are simulated of all logs together.
        share: how long they are, in terms of the time in which the motion goes to and fro.
    """

    def __init__(
        self,
        environment: MjcfEnvironment,
        logs: Sequence[Trajectory],
        windows: int,
        share: float,
    ) -> None:
        self.simulator = Simulator(environment, num_threads=1)
        self.logs = tuple(_bridged(log, environment.rotations) for log in logs)
        self.length = _length(self.logs, share)
        steps, _ = self.simulator.physics_steps(logs[0].dt)
        count = int(np.clip(_STEPS * windows / (self.length * steps), 6, windows))
        self.places = _places(logs, self.length, count)  # of the logs as they are: gaps count
        time = np.linspace(-1, 1, self.length + 1)
        self._line = np.linalg.qr(np.stack([np.ones_like(time), time], axis=1))[0]
        self._read: dict[Assumption, Flight] = {}
        self.given = Assumption.as_given(len(environment.channels), logs[0].actions.shape[1])

    @property
    def steps(self) -> int:
        """Physics steps of all windows once."""
        return sum(map(len, self.places)) * self.length * self.simulator.physics_steps(self.logs[0].dt)[0]

    @property
    def theta(self) -> FloatArray:
        """The unknowns as the model has them (N,)."""
        return np.clip(self.simulator.space.default_theta, 0.0, 1.0)

    def thinned(self, windows: int) -> Trial:
        """With so many windows at most, spread over those that it has."""
        count = sum(map(len, self.places))
        if count <= windows:
            return self
        kept = np.zeros(count, bool)
        kept[np.round(np.linspace(0, count - 1, windows)).astype(int)] = True
        parts = np.split(kept, np.cumsum([len(places) for places in self.places])[:-1])
        fewer = copy(self)
        fewer.places = [places[part] for places, part in zip(self.places, parts, strict=True)]
        fewer._read = {}
        return fewer

    def misses(self, assumptions: Sequence[Assumption], theta: FloatArray) -> FloatArray:
        """What simulations with theta (N,) miss of each assumption and channel (H, C); 1 is no better than a line."""
        flights = [self.flight(assumption) for assumption in assumptions]
        measured = np.stack([flight.measured for flight in flights])
        seen = self.seen(flights, np.tile(theta, (len(flights), 1)))
        left, whole = self.bent(measured - seen), self.bent(measured)
        misses = np.clip(spread_of(left) / np.maximum(spread_of(whole), 1e-12), _BEST, _WORST)
        return np.where(np.isfinite(seen).any(axis=(1, 2)), misses, _WORST)  # a line explains what was not simulated

    def missed(self, assumptions: Sequence[Assumption], theta: FloatArray) -> FloatArray:
        """The logarithm of what simulations with theta (N,) miss of each assumption in each window (H, W).

        Of all channels together; each window is compared with its own line, so that those with an impact count as well.
        """
        flights = [self.flight(assumption) for assumption in assumptions]
        measured = np.stack([flight.measured for flight in flights])
        seen = self.seen(flights, np.tile(theta, (len(flights), 1)))
        left, whole = ((self.bent(y) ** 2).mean(axis=2) for y in (measured - seen, measured))
        return 0.5 * followed(np.clip(left / np.maximum(whole, 1e-24), _BEST**2, _WORST))

    def unfollowed(self, assumption: Assumption, theta: FloatArray) -> dict[int, float]:
        """Channels that move, and that simulations with theta (N,) hardly follow, and what they miss, as ``misses``."""
        measured = self.flight(assumption).measured
        noise = np.sqrt(np.mean(np.diff(measured, 3, axis=1) ** 2, axis=(0, 1)) / 20)  # of white noise; rarely less
        moves = spread_of(self.bent(measured[None]))[0] > _MOVES * noise
        misses = self.misses([assumption], theta)[0]
        return {int(k): float(misses[k]) for k in np.flatnonzero(moves & (misses > _UNFOLLOWED))}

    def flight(self, assumption: Assumption) -> Flight:
        """What windows start from, are driven by and measured as."""
        key = replace(assumption, delay=0, driven=(), actuators=(), rests=())
        if key not in self._read:
            logs = [_read_as(log, assumption) for log in self.logs]
            states = [estimate_states(self.simulator, log, rows=s)[s] for log, s in zip(logs, self.places, strict=True)]
            cuts = [s[:, None] + np.arange(self.length + 1) for s in self.places]
            measured = np.concatenate([log.observations[cut] for log, cut in zip(logs, cuts, strict=True)])
            dt = np.concatenate([np.full(len(s), log.dt) for log, s in zip(logs, self.places, strict=True)])
            self._read[key] = Flight(np.concatenate(states), np.empty(0), measured, dt)
        commands, past = [], []
        for log, places in zip(self.logs, self.places, strict=True):
            actions = _driven_as(log, assumption)
            commands.append(actions[places[:, None] + np.arange(self.length)])
            skip = self.simulator.physics_steps(log.dt)[0]
            before = [actions[max(0, s - _PAST) : s] if s else actions[:1] for s in places]
            past += [np.repeat(rows, skip, axis=0) for rows in before]
        flight = self._read[key]
        begun = with_history(self.simulator, flight.states.copy(), past, flight.dt)
        return replace(flight, states=begun, commands=np.concatenate(commands))

    def seen(self, flights: Sequence[Flight], thetas: FloatArray) -> FloatArray:
        """What simulations give (H, W, L+1, C); NaN where a clock would make them endless, or they diverge."""
        count, dt = flights[0].count, np.concatenate([flight.dt for flight in flights])
        seen = np.full((len(dt), *flights[0].measured.shape[1:]), np.nan)
        run = dt <= _LONGEST * self.simulator.model.opt.timestep
        if run.any():
            actions = np.clip(np.concatenate([flight.commands for flight in flights])[run], -1e9, 1e9)
            initial = np.concatenate([flight.states for flight in flights])[run]
            theta = np.repeat(thetas, count, axis=0)[run]
            seen[run] = self.simulator.rollout(theta, actions, initial, dt[run], allow_outside=True).observations
        seen = seen.reshape(len(flights), count, *seen.shape[1:])
        measured = np.stack([flight.measured for flight in flights])
        return written_near(seen, measured, self.simulator.environment.rotations)

    def bent(self, values: FloatArray) -> FloatArray:
        """What a straight line leaves of windows (..., L+1, C); one that diverged leaves far more than any."""
        values = np.clip(np.nan_to_num(values, nan=1e6, posinf=1e6, neginf=-1e6), -1e6, 1e6)
        along = np.einsum("lk,...lc->...kc", self._line, values)
        return values - np.einsum("lk,...kc->...lc", self._line, along)


def followed(misses: FloatArray) -> FloatArray:
    """The logarithm of what is missed in all channels together (...) of misses (..., C).

    A channel that a line follows better than a simulation tells nothing, by however much: it may be noise alone.
    """
    return np.asarray(np.log(np.minimum(misses, 1.0)).sum(axis=-1))


def spread_of(values: FloatArray) -> FloatArray:
    """Root mean squares (H, C) of (H, W, L+1, C), of the middle window: those with an impact do not decide."""
    return np.asarray(np.median(np.sqrt((values**2).mean(axis=2)), axis=1))


def _bridged(log: Trajectory, triples: Sequence[tuple[int, int, int]]) -> Trajectory:
    """The log with missing samples put between their neighbours; channels without any stay as they are."""
    if np.isfinite(log.observations).all():
        return log
    observations, sample = log.observations.copy(), np.arange(len(log) + 1)
    for series in observations.T:
        known = np.isfinite(series)
        if known.any():
            series[:] = np.interp(sample, sample[known], series[known])
    for triple in map(list, triples):
        if np.isfinite(log.observations[:, triple]).all(-1).any():
            observations[:, triple] = bridged(log.observations[:, triple])
    return Trajectory(observations, log.actions, log.dt)


def _read_as(log: Trajectory, assumption: Assumption) -> Trajectory:
    observations = log.observations[:, list(assumption.channels)] * np.array(assumption.observed)
    observations -= np.array(assumption.zeros or 0.0)
    for one, other in assumption.minus:
        observations[:, one] -= observations[:, other]
    return Trajectory(observations, log.actions, log.dt * assumption.clock)


def _driven_as(log: Trajectory, assumption: Assumption) -> FloatArray:
    actions = log.actions[:, list(assumption.actuators)] * np.array(assumption.driven)
    actions -= np.array(assumption.rests or 0.0)
    late = min(assumption.delay, len(actions) - 1)
    return np.concatenate([np.repeat(actions[:1], late, axis=0), actions[: len(actions) - late]])


def _length(logs: Sequence[Trajectory], share: float) -> int:
    """Samples of a window: a share of the time in which the motion goes to and fro, whatever the unit of time."""
    spans = []
    for log in logs:
        for series in log.observations.T:
            known = series[np.isfinite(series)]
            if len(known) > 8 and np.ptp(known) > 0:
                smooth = np.convolve(known, np.ones(5) / 5, mode="valid")
                speed = np.sqrt(np.mean(np.gradient(smooth) ** 2))
                spans.append(2 * np.pi * float(smooth.std()) / max(float(speed), 1e-12))
    shortest = min(len(log) for log in logs)
    wanted = float(np.median(spans)) * share if spans else 30.0
    return int(np.clip(round(wanted), min(12, shortest), min(400, max(shortest // 3, min(12, shortest)))))


def _places(logs: Sequence[Trajectory], length: int, windows: int) -> list[IntArray]:
    """Where windows start in each log: spread over it, those in which most moves."""
    out = []
    each = max(2, windows // len(logs))
    for log in logs:
        starts = np.arange(0, len(log) - length + 1, max(1, length // 2))
        sizes = np.maximum(np.nanstd(log.observations, axis=0), 1e-12)
        cut = starts[:, None] + np.arange(length + 1)
        pieces = log.observations[cut]
        quarters = np.array_split(np.isfinite(pieces), 4, axis=1)
        whole = np.all([quarter.any(axis=1) for quarter in quarters], axis=(0, 2))
        moves = np.where(whole, np.nan_to_num(np.nanstd(pieces, axis=1) / sizes).sum(1), -1.0)
        if log.actions.shape[1]:
            spread = np.maximum(log.actions.std(axis=0), 1e-12)
            moves += (log.actions[cut[:, :-1]].std(axis=1) / spread).sum(1)
        chosen = np.sort(np.argsort(-moves, kind="stable")[: 2 * each])
        pick = np.unique(np.round(np.linspace(0, len(chosen) - 1, min(each, len(chosen)))).astype(int))
        out.append(starts[chosen[pick]])
    return out
