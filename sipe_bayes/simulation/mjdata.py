"""Control steps between which MjData itself is read, for derived quantities that no sensor returns.

``mujoco.rollout`` gives states and sensordata. Some published observations hold more: contact forces from
mj_rnePostConstraint, or what a Runge-Kutta step leaves at its last stage, where sensors are not computed. Here every
thread owns one MjData and takes one simulation after the other; MuJoCo runs without Python's lock, so that reading
costs a few microseconds a simulation and control step.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor

import mujoco
import numpy as np

from sipe_bayes.core.arrays import BoolArray, FloatArray

_STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS

Models = Sequence[mujoco.MjModel]
Datas = Sequence[mujoco.MjData]


def fields_size(data: mujoco.MjData, fields: Sequence[str]) -> int:
    """How many numbers (D) the arrays ``fields`` of an MjData hold together."""
    return sum(getattr(data, name).size for name in fields)


def forward(models: Models, datas: Datas, fields: Sequence[str], states: FloatArray) -> FloatArray:
    """What MjData holds after mj_forward without control and mj_rnePostConstraint.

    Args:
        models: one for each of B simulations.
        datas: one for each thread.
        fields: MjData's arrays that are read.
        states: (B, S).

    Returns:
        The fields, (B, D).
    """
    derived = np.empty((len(states), fields_size(datas[0], fields)))

    def work(data: mujoco.MjData, batch: Iterator[int]) -> None:
        read = _reader(data, fields)
        for i in batch:
            _forward(models[i], data, states[i])
            read(derived[i])

    _share(datas, len(states), work)
    return derived


def advance(
    models: Models,
    datas: Datas,
    fields: Sequence[str],
    skip: int,
    controls: FloatArray,
    start: FloatArray,
    first: bool = True,
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Control steps of B simulations; after a warning of MuJoCo one repeats its last state.

    Args:
        models: one for each simulation.
        datas: one for each thread.
        fields: MjData's arrays that are read after each control step.
        skip: physics steps for which a control is held.
        controls: (B, T, U).
        start: states (B, S).
        first: whether the fields of sample 0 are wanted, which are those of ``forward``; NaN otherwise.

    Returns:
        States (B, T+1, S), fields (B, T+1, D) and which samples (B, T+1) no warning had come before.
    """
    batch_size, horizon = controls.shape[:2]
    states = np.empty((batch_size, horizon + 1, start.shape[1]))
    derived = np.full((batch_size, horizon + 1, fields_size(datas[0], fields)), np.nan)
    clean = np.ones((batch_size, horizon + 1), bool)

    def work(data: mujoco.MjData, batch: Iterator[int]) -> None:
        read, warnings, control = _reader(data, fields), data.warning.number, data.ctrl
        for i in batch:
            model, row, row_derived = models[i], states[i], derived[i]
            row[0] = start[i]
            if first:
                _forward(model, data, row[0])
                read(row_derived[0])
            mujoco.mj_setState(model, data, row[0], _STATE)
            warnings[:] = 0
            for t in range(horizon):
                control[:] = controls[i, t]
                mujoco.mj_step(model, data, skip)
                mujoco.mj_rnePostConstraint(model, data)
                mujoco.mj_getState(model, data, row[t + 1], _STATE)
                read(row_derived[t + 1])
                if np.count_nonzero(warnings):
                    row[t + 2 :], row_derived[t + 2 :], clean[i, t + 1 :] = row[t + 1], row_derived[t + 1], False
                    break

    _share(datas, batch_size, work)
    return states, derived, clean


def _forward(model: mujoco.MjModel, data: mujoco.MjData, state: FloatArray) -> None:
    mujoco.mj_setState(model, data, np.ascontiguousarray(state), _STATE)
    data.ctrl[:] = 0
    mujoco.mj_forward(model, data)
    mujoco.mj_rnePostConstraint(model, data)


def _reader(data: mujoco.MjData, fields: Sequence[str]) -> Callable[[FloatArray], None]:
    """Copies the fields into a row (D,)."""
    views = [getattr(data, name).reshape(-1) for name in fields]
    ends = np.cumsum([view.size for view in views]).tolist()
    parts = [(slice(end - view.size, end), view) for end, view in zip(ends, views, strict=True)]

    def read(row: FloatArray) -> None:
        for where, view in parts:
            row[where] = view

    return read


def _share(datas: Datas, count: int, work: Callable[[mujoco.MjData, Iterator[int]], None]) -> None:
    """Run ``work`` once for each MjData, in this thread and others; together they take 0 to ``count``."""
    batch = iter(range(count))  # each thread takes the next one, which Python's lock makes one operation
    others = datas[1:count]
    if not others:
        work(datas[0], batch)
        return
    with ThreadPoolExecutor(len(others)) as threads:
        running = [threads.submit(work, data, batch) for data in others]
        work(datas[0], batch)
    for thread in running:
        thread.result()
