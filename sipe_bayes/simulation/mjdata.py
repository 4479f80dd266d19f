"""Control steps between which MjData itself is read, for derived quantities that no sensor returns.

``mujoco.rollout`` gives states and sensordata. Some published observations hold more: contact forces from
mj_rnePostConstraint, or what a Runge-Kutta step leaves at its last stage, where sensors are not computed. Here every
thread owns one MjData and takes one lane after the other; MuJoCo runs without Python's lock, so that reading costs a few
microseconds a lane and control step.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS


def fields_size(data: Any, fields: Sequence[str]) -> int:
    """How many numbers (D) the arrays ``fields`` of an MjData hold together."""
    return sum(getattr(data, name).size for name in fields)


def forward(models: list[Any], datas: list[Any], fields: Sequence[str], states: FloatArray) -> FloatArray:
    """The ``fields`` (B, D) of states (B, S) after mj_forward without control and mj_rnePostConstraint."""
    derived = np.empty((len(states), fields_size(datas[0], fields)))

    def work(data: Any, lanes: Any) -> None:
        read = _reader(data, fields)
        for lane in lanes:
            _forward(models[lane], data, states[lane])
            read(derived[lane])

    _share(datas, len(states), work)
    return derived


def advance(
    models: list[Any],
    datas: list[Any],
    fields: Sequence[str],
    skip: int,
    controls: FloatArray,
    start: FloatArray,
    first: bool = True,
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """States (B, T+1, S), ``fields`` (B, T+1, D) and which samples (B, T+1) no warning of MuJoCo had come before, of
    controls (B, T, U) held for ``skip`` physics steps each. ``first``: whether the fields of sample 0 are wanted, which
    are those of ``forward``; NaN otherwise. After a warning a lane repeats its last state.
    """
    batch, horizon = controls.shape[:2]
    states = np.empty((batch, horizon + 1, start.shape[1]))
    derived = np.full((batch, horizon + 1, fields_size(datas[0], fields)), np.nan)
    clean = np.ones((batch, horizon + 1), bool)

    def work(data: Any, lanes: Any) -> None:
        read, warnings, control = _reader(data, fields), data.warning.number, data.ctrl
        for lane in lanes:
            model, row, fresh = models[lane], states[lane], derived[lane]
            row[0] = start[lane]
            if first:
                _forward(model, data, row[0])
                read(fresh[0])
            mujoco.mj_setState(model, data, row[0], _STATE)
            warnings[:] = 0
            for t in range(horizon):
                control[:] = controls[lane, t]
                mujoco.mj_step(model, data, skip)
                mujoco.mj_rnePostConstraint(model, data)
                mujoco.mj_getState(model, data, row[t + 1], _STATE)
                read(fresh[t + 1])
                if np.count_nonzero(warnings):
                    row[t + 2 :], fresh[t + 2 :], clean[lane, t + 1 :] = row[t + 1], fresh[t + 1], False
                    break

    _share(datas, batch, work)
    return states, derived, clean


def _forward(model: Any, data: Any, state: FloatArray) -> None:
    mujoco.mj_setState(model, data, np.ascontiguousarray(state), _STATE)
    data.ctrl[:] = 0
    mujoco.mj_forward(model, data)
    mujoco.mj_rnePostConstraint(model, data)


def _reader(data: Any, fields: Sequence[str]) -> Callable[[FloatArray], None]:
    """Copies the fields into a row (D,)."""
    views = [getattr(data, name).reshape(-1) for name in fields]
    ends = np.cumsum([view.size for view in views]).tolist()
    parts = [(slice(end - view.size, end), view) for end, view in zip(ends, views, strict=True)]

    def read(row: FloatArray) -> None:
        for where, view in parts:
            row[where] = view

    return read


def _share(datas: list[Any], count: int, work: Callable[[Any, Any], None]) -> None:
    """Run ``work`` once for each MjData, in this thread and others; together they take the lanes 0 to ``count``."""
    lanes = iter(range(count))  # each thread takes the next one, which Python's lock makes one operation
    others = datas[1:count]
    if not others:
        work(datas[0], lanes)
        return
    with ThreadPoolExecutor(len(others)) as threads:
        running = [threads.submit(work, data, lanes) for data in others]
        work(datas[0], lanes)
    for thread in running:
        thread.result()
