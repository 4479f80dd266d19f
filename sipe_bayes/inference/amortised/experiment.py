"""What a training depends on besides the estimator's settings: the experiment that its simulations replayed.

Simulations replay the actions of the log in hand from its starts, with its noise and without the samples that it
lacks. What they taught therefore holds for other logs of the same experiment, and for no others.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.simulation.callable_simulator import CallableSimulator
from sipe_bayes.simulation.simulator import Simulator

_ROUNDING = 1e-5  # of a number: what float32 and a few steps of arithmetic leave of two equal ones


@dataclass(frozen=True)
class Experiment:
    """An experiment, with what of the log in hand its simulations took over.

    Attributes:
        actions: (R, T, A), as replayed.
        length: (R,) control steps.
        dt: (R,) seconds of one.
        starts: starting states (R, S) where they were recorded, else (0, 0).
        first: (R, O), the log's first samples.
        lowest, highest: (R, O), the range of the simulations' first samples.
        goals: (R, G) of a task with goals, else (0, 0).
        names: of the logs where a parameter belongs to one of them, else none.
        measured: (R, T+1), whether all channels were.
        noise: (O,), sd that the simulations got.
    """

    actions: FloatArray
    length: IntArray
    dt: FloatArray
    starts: FloatArray
    first: FloatArray
    lowest: FloatArray
    highest: FloatArray
    goals: FloatArray
    names: tuple[str, ...]
    measured: BoolArray
    noise: FloatArray

    @classmethod
    def of(
        cls,
        simulator: Simulator | CallableSimulator,
        trajectories: Trajectories,
        noise: FloatArray,
        first: NDArray[np.floating],
    ) -> Experiment:
        """That of a log.

        Args:
            simulator: of it.
            trajectories: R, the log in hand.
            noise: (O,), sd.
            first: (n, R, O), the simulations' first samples.
        """
        states, none = trajectories.states, np.empty((0, 0))
        return cls(
            np.asarray(trajectories.actions, float),
            np.asarray(trajectories.length, np.int64),
            np.asarray(trajectories.dt, float),
            none if states is None else np.asarray(states[:, 0], float),
            np.asarray(trajectories.observations[:, 0], float),
            np.asarray(first.min(0), float),
            np.asarray(first.max(0), float),
            _goals(simulator, trajectories),
            _names(simulator, trajectories),
            measured(trajectories),
            noise,
        )

    def other(self, trajectories: Trajectories, noise: FloatArray) -> str | None:
        """What makes a log that of another experiment than the simulations; None where nothing does.

        Actions, lengths and seconds have to be equal. So have starting states where both are recorded; else the log's
        first samples must lie within the simulated ones' range, give or take three sds of the ``noise`` (O,):
        velocities do not show in them.
        """
        commands = self._other_commands(trajectories)
        if commands is not None or (len(self.starts) and trajectories.states is not None):
            return commands or self._other_states(trajectories)
        first, size = trajectories.observations[:, 0], np.maximum(np.abs(self.lowest), np.abs(self.highest))
        slack = THRESHOLDS.first_sample_sds * noise + _ROUNDING * (1 + size)
        return "starting states" if ((first < self.lowest - slack) | (first > self.highest + slack)).any() else None

    def other_form(
        self, simulator: Simulator | CallableSimulator, trajectories: Trajectories, noise: FloatArray
    ) -> str | None:
        """What makes a log one of another form than that which the training was for; None where nothing does.

        As ``other``, but first samples must be those of that log, give or take twice three sds of the noise. Goals and
        missing samples have to be the same, names where a parameter belongs to one of the logs, and no channel's
        ``noise`` (O,) may be more than twice the other's.
        """
        commands = self._other_commands(trajectories)
        if commands is not None:
            return commands
        if len(self.starts) and trajectories.states is not None:
            starts = self._other_states(trajectories)
        else:
            slack = 2 * THRESHOLDS.first_sample_sds * np.maximum(noise, self.noise) + _ROUNDING * (
                1 + np.abs(self.first)
            )
            far = np.abs(trajectories.observations[:, 0] - self.first) > slack
            starts = "starting states" if far.any() else None
        goals, ratio = _goals(simulator, trajectories), THRESHOLDS.noise_ratio
        same_goals = goals.shape == self.goals.shape and np.allclose(goals, self.goals, equal_nan=True)
        differs = {
            "goals": not same_goals,
            "names": _names(simulator, trajectories) != self.names,
            "missing samples": not np.array_equal(measured(trajectories), self.measured),
            "noise levels": bool(((noise > ratio * self.noise) | (self.noise > ratio * noise)).any()),
        }
        return starts or next((what for what, other in differs.items() if other), None)

    def _other_commands(self, trajectories: Trajectories) -> str | None:
        if not np.array_equal(self.length, trajectories.length):
            return "number or lengths"
        same_dt = np.allclose(self.dt, trajectories.dt, rtol=1e-9, atol=0)
        return None if same_dt and np.allclose(self.actions, trajectories.actions, rtol=1e-9) else "actions"

    def _other_states(self, trajectories: Trajectories) -> str | None:
        """Of logs that both hold states: noise may have been added to what was observed."""
        assert trajectories.states is not None
        same = np.allclose(self.starts[:, 1:], trajectories.states[:, 0, 1:], rtol=1e-6, atol=1e-6)
        return None if same else "starting states"


def measured(trajectories: Trajectories) -> BoolArray:
    """(R, T+1): samples of which all channels were measured."""
    return np.asarray(np.isfinite(trajectories.observations).all(-1))


def _goals(simulator: Simulator | CallableSimulator, trajectories: Trajectories) -> FloatArray:
    goals = None
    if isinstance(simulator, Simulator):
        goals = simulator.environment.recorded_goals(trajectories.observations[:, 0])
    return np.empty((0, 0)) if goals is None else np.asarray(goals, float)


def _names(simulator: Simulator | CallableSimulator, trajectories: Trajectories) -> tuple[str, ...]:
    loaded = isinstance(simulator, Simulator) and bool(simulator.environment.added)
    return tuple(trajectories.names) if loaded or any(p.log is not None for p in simulator.space) else ()
