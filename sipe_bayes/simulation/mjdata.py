"""Control steps between which MjData itself is read, for derived quantities that no sensor returns.

``mujoco.rollout`` gives states and sensordata. Some published observations hold more: contact forces from
mj_rnePostConstraint, or what a Runge-Kutta step leaves at its last stage, where sensors are not computed. Here every
thread owns one MjData and takes one simulation after the other; MuJoCo runs without Python's lock, so that reading
costs a few microseconds a simulation and control step.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import mujoco
import numpy as np

from sipe_bayes.core.arrays import BoolArray, FloatArray

_STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS

Models = Sequence[mujoco.MjModel]


@dataclass(frozen=True)
class Fields:
    """Arrays of MjData that are read, D numbers together.

    Args:
        names: of the arrays.
        datas: one for each thread.
    """

    names: Sequence[str]
    datas: Sequence[mujoco.MjData]

    @property
    def size(self) -> int:
        """D."""
        return sum(getattr(self.datas[0], name).size for name in self.names)

    def forward(self, models: Models, states: FloatArray) -> FloatArray:
        """The fields (B, D) of states (B, S) after mj_forward without control and mj_rnePostConstraint."""
        derived = np.empty((len(states), self.size))

        def work(data: mujoco.MjData, batch: Iterator[int]) -> None:
            read = self._reader(data)
            for i in batch:
                _forward(models[i], data, states[i])
                read(derived[i])

        self._share(len(states), work)
        return derived

    def advance(
        self, models: Models, skip: int, controls: FloatArray, start: FloatArray, first: bool = True
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Control steps of B simulations; after a warning of MuJoCo one repeats its last state.

        Args:
            models: one for each simulation.
            skip: physics steps for which a control is held.
            controls: (B, T, U).
            start: states (B, S).
            first: whether the fields of sample 0 are wanted, which are those of ``forward``; NaN otherwise.

        Returns:
            States (B, T+1, S), fields (B, T+1, D) and which samples (B, T+1) no warning had come before.
        """
        batch_size, horizon = controls.shape[:2]
        states = np.empty((batch_size, horizon + 1, start.shape[1]))
        derived = np.full((batch_size, horizon + 1, self.size), np.nan)
        clean = np.ones((batch_size, horizon + 1), bool)

        def work(data: mujoco.MjData, batch: Iterator[int]) -> None:
            read, warnings, control = self._reader(data), data.warning.number, data.ctrl
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

        self._share(batch_size, work)
        return states, derived, clean

    def _reader(self, data: mujoco.MjData) -> Callable[[FloatArray], None]:
        """Copies the fields into a row (D,)."""
        views = [getattr(data, name).reshape(-1) for name in self.names]
        ends = np.cumsum([view.size for view in views]).tolist()
        parts = [(slice(end - view.size, end), view) for end, view in zip(ends, views, strict=True)]

        def read(row: FloatArray) -> None:
            for where, view in parts:
                row[where] = view

        return read

    def _share(self, count: int, work: Callable[[mujoco.MjData, Iterator[int]], None]) -> None:
        """Run ``work`` once for each MjData, in this thread and others; together they take 0 to ``count``."""
        batch = iter(range(count))  # each thread takes the next one, which Python's lock makes one operation
        others = self.datas[1:count]
        if not others:
            work(self.datas[0], batch)
            return
        with ThreadPoolExecutor(len(others)) as threads:
            running = [threads.submit(work, data, batch) for data in others]
            work(self.datas[0], batch)
        for thread in running:
            thread.result()


def _forward(model: mujoco.MjModel, data: mujoco.MjData, state: FloatArray) -> None:
    mujoco.mj_setState(model, data, np.ascontiguousarray(state), _STATE)
    data.ctrl[:] = 0
    mujoco.mj_forward(model, data)
    mujoco.mj_rnePostConstraint(model, data)
