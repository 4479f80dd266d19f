"""States along recorded logs: where windows start, as recorded or as the measurements tell, and moved by tangents.

A tangent is (dq (nv), dv (nv), dact (na)).
"""

from __future__ import annotations

import mujoco
import numpy as np
import scipy.signal

from sipe_bayes.core.arrays import FloatArray, IntArray
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.simulation.callable_simulator import CallableSimulator
from sipe_bayes.simulation.simulator import Simulator

STATE_STEP = 1e-5  # rad or m, rad/s or m/s: finite differences by a state


def estimate_states(simulator: Simulator, trajectory: Trajectory) -> FloatArray:
    """A first guess of the states (T+1, S) along a log: recorded ones, else measured ones.

    Measured coordinates are smoothed by local quadratics over 60 ms, missing samples bridged, unmeasured velocities
    the slopes of the positions; what no channel measures stays at the model's reset state. The search starts here,
    and so do the windows of held-out logs.
    """
    if trajectory.states is not None:
        return trajectory.states
    model, states = simulator.model, np.tile(simulator.default_state(), (len(trajectory) + 1, 1))
    columns = simulator.environment.state_columns(model)
    measured: dict[int, FloatArray] = {}
    for channel, column in enumerate(columns):
        series = trajectory.observations[:, channel]
        finite = np.flatnonzero(np.isfinite(series))
        if column is not None and len(finite):
            measured[column] = np.interp(np.arange(len(series)), finite, series[finite])
    for joint in range(model.njnt):
        if int(model.jnt_type[joint]) in (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)):
            position, velocity = 1 + int(model.jnt_qposadr[joint]), 1 + model.nq + int(model.jnt_dofadr[joint])
            if position in measured and velocity not in measured:
                states[:, velocity] = smoothed(measured[position], trajectory.dt, 1)
    if measured:
        states[:, list(measured)] = smoothed(np.stack(list(measured.values()), axis=1), trajectory.dt)
    return states


def first_states(simulator: Simulator | CallableSimulator, trajectories: Trajectories) -> FloatArray:
    """Starting states (R, S) of R recorded trajectories: recorded, else estimated from the measurements."""
    if isinstance(simulator, CallableSimulator):
        return np.empty((len(trajectories), 0))
    return np.stack([estimate_states(simulator, t)[0] for t in trajectories])


def smoothed(series: FloatArray, dt: float, derivative: int = 0) -> FloatArray:
    """Local quadratics over 60 ms, at least 5 samples, of a series (T+1, ...); derivative 1: their slopes in time."""
    span = min(max(5, 2 * round(0.06 / dt / 2) + 1), len(series) - (len(series) + 1) % 2)
    if span < 3:
        return np.gradient(series, dt, axis=0) if derivative else series
    return scipy.signal.savgol_filter(series, span, 2, deriv=derivative, delta=dt, axis=0)


def moved(model: mujoco.MjModel, states: FloatArray, tangent: FloatArray) -> FloatArray:
    """States (..., S) moved by tangents (..., 2 nv + na); either may have fewer leading dimensions."""
    shape = np.broadcast_shapes(states.shape[:-1], tangent.shape[:-1])
    out = np.broadcast_to(states, (*shape, states.shape[-1])).copy()
    tangent = np.broadcast_to(tangent, (*shape, tangent.shape[-1]))
    nq, nv = model.nq, model.nv
    if nq == nv:
        out[..., 1 : 1 + nq] += tangent[..., :nv]
    else:
        flat, turns = out.reshape(-1, out.shape[-1]), tangent.reshape(-1, tangent.shape[-1])
        for state, turn in zip(flat, turns, strict=True):
            position = state[1 : 1 + nq].copy()
            mujoco.mj_integratePos(model, position, np.ascontiguousarray(turn[:nv]), 1.0)
            state[1 : 1 + nq] = position
    out[..., 1 + nq : 1 + nq + nv + model.na] += tangent[..., nv:]
    return out


def past_commands(
    simulator: Simulator, trajectories: Trajectories, log: IntArray, start: IntArray, dt: FloatArray
) -> list[FloatArray]:
    """The commands before each start, one row a physics step; before the log its first command.

    Of starts at samples ``start`` (W,) of the logs ``log`` (W,), whose control steps take ``dt`` (W,) seconds.
    """
    past = []
    for k, first, seconds in zip(log, start, dt, strict=True):
        skip = simulator.physics_steps(float(seconds))[0]
        rows = trajectories.actions[k, max(0, first - 2000) : first]  # longer than any actuator's delay
        past.append(np.repeat(rows, skip, axis=0) if len(rows) else trajectories.actions[k, :1])
    return past


def with_history(simulator: Simulator, states: FloatArray, past: list[FloatArray], dt: FloatArray) -> FloatArray:
    """States (W, S) at time zero, with the ``past_commands`` that delayed actuators remember; dt (W,) in seconds."""
    states[:, 0] = 0.0
    timestep = np.array([simulator.physics_steps(float(seconds))[1] for seconds in dt])
    return simulator.environment.history(simulator.model, states, past, timestep)
