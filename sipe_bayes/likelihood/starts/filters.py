"""Where filters of commands are at the start of a window, under theta, and what commands came before it.

A first-order filter is driven by commands alone, and a log holds them: whatever the machine does, where its filter is
follows from the time constant and the commands before. Only where it was as the log began is not known, and of that
ever less is left in windows that begin later. So the number of a start that tells of a filter counts by this share, and
a lag costs its windows nothing but the first. Before the log its first command is held.

Deviations:

- Filters that firmware steps by its own clock are not followed: each window's is unknown, about the last command.
- What is left of the log's beginning does not know a filter's limits.
- Where MuJoCo integrates by RK4, a late command is taken as it is where a physics step begins.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.signal

from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.envs.internal.states import filtered_commands, kept_by_filter
from sipe_bayes.envs.laws.firmware import firmware_of
from sipe_bayes.simulation.simulator import Simulator

_LONGEST, _FORGOTTEN = 2000, 10.0  # commands, longer than any delay; time constants after which a filter has forgotten


@dataclass(frozen=True)
class _Driven:
    """What drives the F filters of a log: commands (T, F), ``skip`` to a control step, each for ``timestep`` s."""

    commands: FloatArray
    timestep: float
    skip: int
    name: str | None


class FilterStarts:
    """Of W windows, where the filters of commands start.

    Args:
        simulator: of the model.
        trajectories: the logs.
        states: (W, S), references of the starts.
        log: (W,), of each window.
        start: (W,) control steps, of each.
        known: (W,) whose filters are recorded.
    """

    def __init__(
        self,
        simulator: Simulator,
        trajectories: Trajectories,
        states: FloatArray,
        log: IntArray,
        start: IntArray,
        known: BoolArray | bool,
    ) -> None:
        model, environment = simulator.model, simulator.environment
        sampled = {one.actuator for one in firmware_of(model)}  # these act once a tick
        self._filters = [] if np.all(known) else [one for one in filtered_commands(model) if one[0] not in sampled]
        self._model = copy.copy(model) if self._filters else model
        self._environment, self._space = environment, simulator.space
        self._log, self._start, self._known = log, start, np.broadcast_to(known, len(log))
        self._driven: dict[int, _Driven] = {}
        names: Sequence[str | None] = trajectories.names or [None] * len(trajectories)
        columns = [int(model.actuator_ctrladr[actuator]) for actuator, _ in self._filters]
        for k in np.unique(log).tolist() if self._filters else []:
            skip, timestep = simulator.physics_steps(float(trajectories.dt[k]))
            actions = trajectories.actions[k, : start[log == k].max() + 1]
            commands = environment.control(model, states[int(np.argmax(log == k))], actions)[:, columns]
            self._driven[k] = _Driven(np.repeat(commands, skip, axis=0), timestep, skip, names[k])

    @property
    def numbers(self) -> IntArray:
        """Which numbers of a start tell of filters."""
        return np.array([column - 1 - self._model.nq + self._model.nv for _, column in self._filters], np.int64)

    def follow(self, starts: FloatArray, windows: IntArray) -> None:
        """Set numbers of starts (..., W, D) to zero, in place, where commands before the windows tell of filters."""
        later = np.flatnonzero(self._start[windows] > 0)
        for number in self.numbers:
            starts[..., later, number] = 0.0

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
        model, values, numbers = self._model, self._space.values(theta), self.numbers
        # no target writes a filter's limits
        done: dict[tuple[int, int, float, float], tuple[FloatArray, FloatArray]] = {}
        for k in np.unique(self._log[windows]).tolist():
            own = np.flatnonzero((self._log[windows] == k) & ~self._known[windows])
            for b in range(len(states)):
                self._environment.write(model, values[b], self._driven[k].name)
                for f, (actuator, column) in enumerate(self._filters):
                    key = (k, f, float(model.actuator_dynprm[actuator, 0]), float(model.actuator_delay[actuator]))
                    if key not in done:
                        done[key] = self._reached(k, f, self._start[windows[own]])
                    reached, left = done[key]
                    states[b, own, column] = reached + left * starts[b, own, numbers[f]]
        return states

    def _reached(self, k: int, f: int, start: IntArray) -> tuple[FloatArray, FloatArray]:
        """Where filter f of log k is at control steps (w,), and what is left of where it was as the log began."""
        model, driven, actuator = self._model, self._driven[k], self._filters[f][0]
        kept, commands = kept_by_filter(model, actuator, driven.timestep), driven.commands[:, f]
        steps = np.arange(len(commands)) - float(model.actuator_delay[actuator]) / driven.timestep
        if not model.actuator_history[actuator, 1]:  # no interpolation
            steps = np.floor(steps + 1e-9)
        late = np.interp(steps, np.arange(len(commands)), commands)
        if model.actuator_ctrllimited[control := int(model.actuator_ctrladr[actuator])]:
            late = np.clip(late, *model.actuator_ctrlrange[control])
        place, begin = start * driven.skip, float(late[0])
        reached: FloatArray = scipy.signal.lfilter([1 - kept], [1, -kept], late, zi=[kept * begin])[0]
        low, high = model.actuator_actrange[actuator] if model.actuator_actlimited[actuator] else (-np.inf, np.inf)
        if reached.min() < low or reached.max() > high:
            now = begin = float(np.clip(begin, low, high))
            for step, command in enumerate(late):
                now = reached[step] = min(max(kept * now + (1 - kept) * command, low), high)
        return np.append(begin, reached)[place].astype(np.float64), np.asarray(kept**place, np.float64)


def past_commands(
    simulator: Simulator, trajectories: Trajectories, log: IntArray, start: IntArray, dt: FloatArray
) -> list[FloatArray]:
    """The commands before each start, one row a physics step; before the log its first command.

    Of starts at samples ``start`` (W,) of the logs ``log`` (W,), whose control steps take ``dt`` (W,) seconds.
    """
    slowest = max(
        (float(simulator.model.actuator_dynprm[k, 0]) for k, _ in filtered_commands(simulator.model)), default=0
    )
    longest = np.minimum(np.maximum(np.ceil(_FORGOTTEN * slowest / dt), 1), _LONGEST).astype(np.int64)
    if simulator.model.nhistory:
        longest[:] = _LONGEST
    past = []
    for k, first, seconds, most in zip(log, start, dt, longest, strict=True):
        skip = simulator.physics_steps(float(seconds))[0]
        rows = trajectories.actions[k, max(0, first - most) : first]
        past.append(np.repeat(rows, skip, axis=0) if len(rows) else trajectories.actions[k, :1])
    return past


def with_history(
    simulator: Simulator,
    states: FloatArray,
    past: list[FloatArray],
    dt: FloatArray,
    steps: IntArray | int = 0,
    recorded: BoolArray | bool = False,
) -> FloatArray:
    """States (W, S) with the ``past_commands`` that delayed actuators and filters remember; dt (W,) in seconds.

    They are at time zero, or, where firmware has a clock, ``steps`` (W,) control steps after its start. What filters
    remember is in states that are recorded (W,).
    """
    columns = [column for _, column in filtered_commands(simulator.model)]
    own = states[:, columns].copy()
    states[:, 0] = steps * dt if simulator.engine.firmware else 0.0
    timestep = np.array([simulator.physics_steps(float(seconds))[1] for seconds in dt])
    begun = simulator.environment.history(simulator.model, states, past, timestep)
    begun[:, columns] = np.where(np.reshape(recorded, (-1, 1)), own, begun[:, columns])
    return begun
