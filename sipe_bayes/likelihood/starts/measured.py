"""Where segments start as the log measures it: seen through the sensors of theta, and how exactly that is known."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import mujoco
import numpy as np

from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray
from sipe_bayes.core.smoothing import filled, smoothed
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.envs.sensing import Sensing, delayed
from sipe_bayes.likelihood.starts.estimates import are_states, estimate_states, velocity_columns
from sipe_bayes.simulation.simulator import Simulator
from sipe_bayes.simulation.tangents import tangents


@dataclass
class MeasuredStarts:
    """Initial states of the segments of logs, as the sensors of a theta see them.

    Args:
        simulator: of the model.
        trajectories: the logs.
        numbers: of the coordinates of a start that follow from commands, which no sensor tells.
    """

    simulator: Simulator
    trajectories: Trajectories
    numbers: IntArray
    _earlier: dict[tuple[int, bytes], FloatArray] = field(default_factory=dict)

    def offsets(self, theta: FloatArray, log: IntArray, start: IntArray, reference: FloatArray) -> FloatArray | None:
        """Tangents (B, W, D) from the reference to what theta's sensors say was measured; None where nothing differs.

        A filter is taken for a delay of its time constant.

        Args:
            theta: (B, N).
            log: (W,), of each segment.
            start: (W,), its first sample.
            reference: (W, S), states that exact sensors would tell.
        """
        environment, model = self.simulator.environment, self.simulator.model
        if not environment.sensed or are_states(self.simulator, self.trajectories.states):
            return None
        states, tangent = environment.state_columns(model), tangent_columns(model)
        columns = {c: tangent[column] for c, column in enumerate(states) if column in tangent}
        values, out = self.simulator.space.values(theta), np.zeros((len(theta), len(log), 2 * model.nv + model.na))
        names = self.trajectories.names or [None] * len(self.trajectories)
        for number in np.unique(log).tolist():
            mine = np.flatnonzero(log == number)
            for b, row in enumerate(values):
                sensing = environment.sensing(row, names[number])
                begin = self._at_delay(number, sensing)
                if begin is not None:
                    out[b, mine] = tangents(model, begin[start[mine]], reference[mine])
                    out[b][np.ix_(mine, self.numbers)] = 0.0
                for channel, column in columns.items():
                    bias, scale = sensing.bias[channel], sensing.scale[channel]
                    if scale not in (0.0, 1.0):
                        at = reference[mine, states[channel]]
                        out[b, mine, column] = (at + out[b, mine, column] - bias) / scale - at
                    elif bias:
                        out[b, mine, column] -= bias
        return out

    def _at_delay(self, number: int, sensing: Sensing) -> FloatArray | None:
        """States (T+1, S) along a log whose samples come as late as ``sensing`` says; None without a delay."""
        late = sensing.delay + sensing.filter
        if not late.any():
            return None
        key = number, late.tobytes()
        if key not in self._earlier:
            log = self.trajectories[number]
            moved = delayed(
                filled(log.observations)[None], -late[None, None] / log.dt, self.simulator.environment.rotations
            )[0]
            known = np.where(np.isfinite(log.observations).any(0), moved, np.nan)
            if len(self._earlier) >= 256:  # a search asks for a few at a time
                self._earlier.clear()
            self._earlier[key] = estimate_states(self.simulator, replace(log, observations=known))
        return self._earlier[key]


def measurement_sd(simulator: Simulator, trajectories: Trajectories) -> tuple[FloatArray, BoolArray]:
    """Sd (2 nv + na,) with which smoothed measurements tell coordinates, and which are slopes of others.

    Three times the root mean square by which local quadratics over twice as many samples differ from the usual ones:
    that holds noise and what smoothing bends, also at the ends of a log. Infinite where nothing measures a coordinate.
    """
    model = simulator.model
    states, tangent = simulator.environment.state_columns(model), tangent_columns(model)
    square, count = np.zeros(2 * model.nv + model.na), np.zeros(2 * model.nv + model.na)
    slopes = np.zeros(len(count), bool)
    rates = velocity_columns(model)
    measured = {column: c for c, column in enumerate(states) if column in tangent}
    for log in trajectories if len(measured) else ():
        series = filled(log.observations)
        if len(series) < 10:
            continue
        for column, channel in measured.items():
            if not np.isfinite(log.observations[:, channel]).any():
                continue
            rows = [(tangent[column], 0)]
            if column in rates and rates[column] not in measured:
                rows.append((tangent[rates[column]], 1))
            for coordinate, derivative in rows:
                usual = smoothed(series[:, channel], log.dt, derivative)
                wide = smoothed(series[:, channel], log.dt, derivative, wider=2)
                rounding = _quantum(series[:, channel]) / np.sqrt(12) / (log.dt if derivative else 1.0)
                square[coordinate] += float(((usual - wide) ** 2).sum()) + len(series) * (0.25 * rounding) ** 2
                count[coordinate] += len(series)
                slopes[coordinate] = derivative == 1
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(count > 0, 3 * np.sqrt(square / count), np.inf), slopes


def _quantum(series: FloatArray) -> float:
    """The smallest step between two samples (T+1,): the resolution of an encoder."""
    steps = np.abs(np.diff(series))
    return float(steps[steps > 0].min()) if (steps > 0).any() else 0.0


def tangent_columns(model: mujoco.MjModel) -> dict[int, int]:
    """Column of the physics state -> coordinate of a start, but of a quaternion's numbers."""
    columns = {1 + model.nq + dof: model.nv + dof for dof in range(model.nv)}
    return columns | {position: velocity - 1 - model.nq for position, velocity in velocity_columns(model).items()}
