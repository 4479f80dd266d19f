"""Where windows start as logs measure it, seen through the sensors that a theta claims."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np

from sipe_bayes.core.arrays import FloatArray, IntArray
from sipe_bayes.envs.sensing import Sensing, delayed
from sipe_bayes.inference.laplace.options import GrowingTuning
from sipe_bayes.inference.laplace.windows.growing_windows import tells_starts, told_starts
from sipe_bayes.likelihood.starts.estimates import are_states, estimate_states, velocity_columns
from sipe_bayes.likelihood.windows import Windows
from sipe_bayes.simulation.tangents import tangents


def measured_starts(windows: Windows, theta: FloatArray, near: FloatArray | None = None) -> FloatArray:
    """Starts (B, W, D) of theta (B, N): what was measured there, as theta claims the sensors' bias, scale and delay.

    Of bodies that tumble those of ``near`` (N,) serve all, default each theta its own; and so do delays. A filter is
    taken for a delay as long as its time constant.
    """
    if tells_starts(windows) and windows.trajectories.states is None:
        own = [told_starts(windows, at, GrowingTuning()) for at in (theta if near is None else near[None])]
        return np.broadcast_to(np.stack(own), (len(theta), *own[0].shape))
    simulator, model = windows.simulator, windows.simulator.model
    starts = np.tile(windows.no_starts(), (len(theta), 1, 1))
    states, tangent = simulator.environment.state_columns(model), _tangents(model)
    columns = {channel: tangent[column] for channel, column in enumerate(states) if column in tangent}
    if are_states(simulator, windows.trajectories.states):
        return starts
    own_values = simulator.space.values(theta)
    late_values = simulator.space.values(np.broadcast_to(theta if near is None else near, theta.shape))
    for number in np.unique(windows.log):
        mine = np.flatnonzero(windows.log == number)
        name = windows.names[mine[0]]
        late = [simulator.environment.sensing(values, name) for values in late_values]
        starts[:, mine] = _earlier(windows, mine, late)
        for b, values in enumerate(own_values):
            sensing = simulator.environment.sensing(values, name)
            for channel, column in columns.items():
                bias, scale, place = sensing.bias[channel], sensing.scale[channel], states[channel]
                if scale != 1.0 and scale:
                    reference = windows.reference[mine, place]
                    measured = reference + starts[b, mine, column]
                    starts[b, mine, column] = (measured - bias) / scale - reference
                elif bias:
                    starts[b, mine, column] -= bias
    return starts


def _earlier(windows: Windows, own: IntArray, sensing: Sequence[Sensing]) -> FloatArray:
    """Starts (B, w, D) of one log's windows (w,), as B sensings say how late its samples are."""
    log, simulator = windows.trajectories[int(windows.log[own[0]])], windows.simulator
    out: dict[bytes, FloatArray] = {}
    for one in sensing:
        late = one.delay + one.filter
        if late.tobytes() not in out and late.any():
            y = np.stack([_bridged(column) for column in log.observations.T], axis=-1)
            y = delayed(y[None], -late[None, None] / log.dt, simulator.environment.rotations)[0]
            known = np.where(np.isfinite(log.observations).any(0), y, np.nan)
            earlier = estimate_states(simulator, replace(log, observations=known))
            begin = earlier[windows.start[own]]
            out[late.tobytes()] = tangents(simulator.model, begin, windows.reference[own])
            out[late.tobytes()][:, windows.filters.numbers] = 0.0  # no sensor tells of a filter of commands
        out.setdefault(late.tobytes(), windows.no_starts()[own])
    return np.stack([out[(one.delay + one.filter).tobytes()] for one in sensing])


def _bridged(series: FloatArray) -> FloatArray:
    """A channel (T+1,) whose missing samples lie on lines; zeros without any."""
    seen = np.flatnonzero(np.isfinite(series))
    return np.interp(np.arange(len(series)), seen, series[seen]) if len(seen) else np.zeros(len(series))


def _tangents(model: mujoco.MjModel) -> dict[int, int]:
    """Column of the physics state -> column of a start, but of a quaternion's numbers."""
    columns = {1 + model.nq + dof: model.nv + dof for dof in range(model.nv)}
    return columns | {position: velocity - 1 - model.nq for position, velocity in velocity_columns(model).items()}
