"""Where filters of commands are at the start of a window, under theta.

A first-order filter is driven by commands alone, and a log holds them: whatever the machine does, where its filter is
follows from the time constant and the commands before. Only where it was as the log began is not known, and of that
ever less is left in windows that begin later. So the number of a start that tells of a filter counts by this share, and
a lag costs its windows nothing but the first.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence

import numpy as np

from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray
from sipe_bayes.envs.internal.states import filtered_command, filtered_commands, kept_by_filter
from sipe_bayes.simulation.simulator import Simulator


class FilterStarts:
    """Of W windows, where the filters of commands start.

    Args:
        simulator: of the model.
        states: (W, S), references of the starts.
        past: the commands (P, A) before each window, one row a physics step.
        age: (W,) seconds since the log began.
        dt: (W,) seconds of a control step.
        names: of the windows' logs.
        known: (W,) whose filters are recorded.
    """

    def __init__(
        self,
        simulator: Simulator,
        states: FloatArray,
        past: list[FloatArray],
        age: FloatArray,
        dt: FloatArray,
        names: Sequence[str | None],
        known: BoolArray | bool,
    ) -> None:
        model, self._environment, self._space = simulator.model, simulator.environment, simulator.space
        self._filters = [] if np.all(known) else filtered_commands(model)
        self._model = copy.copy(model) if self._filters else model
        self._age, self._names = age, list(names)
        self._timestep = [simulator.physics_steps(float(seconds))[1] for seconds in dt]
        self._known = np.broadcast_to(known, len(states))
        self._controls: list[FloatArray] = []
        if self._filters:
            control = simulator.environment.control
            self._controls = [control(model, state, before) for state, before in zip(states, past, strict=True)]

    @property
    def numbers(self) -> IntArray:
        """Which numbers of a start tell of filters."""
        return np.array([column - 1 - self._model.nq + self._model.nv for _, column in self._filters], np.int64)

    def put(self, states: FloatArray, theta: FloatArray, starts: FloatArray, windows: IntArray) -> FloatArray:
        """States (B, W, S) with the filters where they are under theta (B, N), in place.

        Args:
            states: of the windows' starts.
            theta: of each of the B.
            starts: (B, W, D), of which those of filters count by what is left of the log's beginning.
            windows: (W,) their numbers.
        """
        if not self._filters:
            return states
        model, done = self._model, dict[tuple[str | None, float, float, int], tuple[FloatArray, FloatArray]]()
        logs = sorted({self._names[w] for w in windows}, key=str) if self._environment.by_log else [None]
        for log in logs:
            own = np.array([log is None or self._names[w] == log for w in windows]) & ~self._known[windows]
            for b, values in enumerate(self._space.values(theta)):
                self._environment.write(model, values, log)
                for (actuator, column), number in zip(self._filters, self.numbers, strict=True):
                    key = (
                        log,
                        float(model.actuator_dynprm[actuator, 0]),
                        float(model.actuator_delay[actuator]),
                        actuator,
                    )
                    if key not in done:
                        done[key] = self._reached(actuator, windows[own])
                    reached, left = done[key]
                    states[b, own, column] = reached + left * starts[b, own, number]
        return states

    def _reached(self, actuator: int, windows: IntArray) -> tuple[FloatArray, FloatArray]:
        """Where a filter is as each window starts, and what is left of where it was as its log began."""
        model, control = self._model, int(self._model.actuator_ctrladr[actuator])
        reached, left = [], []
        for w in windows:
            step = self._timestep[w]
            reached.append(filtered_command(model, actuator, self._controls[w][:, control], step))
            left.append(kept_by_filter(model, actuator, step) ** round(self._age[w] / step))
        return np.array(reached), np.array(left)
