"""The one batch engine: many parameter values, many lanes, native threads, on ``mujoco.rollout``.

Every model runs with MuJoCo's warm start disabled, so the state is Markov: a lane's bits depend on its own theta,
start and actions alone, whatever the threads, the batch or what ran before. A rollout that diverges is data: MuJoCo
resets such a lane, which shows as a time that stalls; ``valid`` is False from the first such sample on.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from typing import Any

import mujoco
import mujoco.rollout
import numpy as np
from numpy.typing import NDArray

from sipe_bayes.envs.base import Environment
from sipe_bayes.parameters import ParameterSpace
from sipe_bayes.trajectory import Trajectories

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_CHUNK = 2**24  # numbers of state and sensor output held at once, 128 MiB
_TIME_TOLERANCE = 0.5  # of a physics step


class Simulator:
    """Simulates an Environment for batches of theta.

    num_threads: native threads; default the processor's cores. ``rollouts`` counts control steps simulated over the
    horizon of the recorded logs by whoever uses the engine; ``warnings`` counts lanes that diverged.
    """

    def __init__(self, environment: Environment, num_threads: int | None = None) -> None:
        if num_threads is not None and num_threads < 1:
            raise ValueError(f"num_threads: expected at least 1, got {num_threads}")
        self.environment = environment
        self.num_threads = num_threads or os.cpu_count() or 1
        self.model = self._new_model()
        self.diverged = 0
        self.control_steps = 0
        self._pool: list[Any] = []
        self._keys: list[bytes] = []
        self._scratch = mujoco.MjData(self.model)
        self._datas = [mujoco.MjData(self.model) for _ in range(self.num_threads)]
        self._physical: list[bool] = []

    @property
    def space(self) -> ParameterSpace:
        return self.environment.space

    @property
    def state_size(self) -> int:
        """S: the numbers of MuJoCo's full physics state."""
        return int(mujoco.mj_stateSize(self.model, mujoco.mjtState.mjSTATE_FULLPHYSICS))

    def default_state(self) -> FloatArray:
        """State (S,) after a reset of the default model."""
        data, state = mujoco.MjData(self.model), np.empty(self.state_size)
        mujoco.mj_getState(self.model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        return state

    def physics_steps(self, dt: float) -> tuple[int, float]:
        """How many physics steps make one control step of ``dt`` seconds, and how long each is; never longer than the
        model's own."""
        steps = max(1, math.ceil(dt / self.model.opt.timestep - 1e-3))
        return steps, dt / steps

    def rollout(
        self,
        theta: FloatArray,
        actions: FloatArray,
        initial_state: FloatArray,
        dt: FloatArray | float | None = None,
        logs: Sequence[str | None] | None = None,
        allow_outside: bool = False,
    ) -> Trajectories:
        """Open loop, whole horizon.

        theta (B, N), actions (B, T, A) and initial_state (B, S), each also with B = 1 for all lanes; dt: seconds per
        control step, (B,) or one number, default the model's timestep; logs: the log that each lane belongs to, for
        parameters that differ between logs. Returns Trajectories with observations, states and ``valid``.
        Raises ValueError for shapes that do not fit, theta outside the unit cube or numbers that are not finite.
        """
        theta, actions, initial_state = self._check(theta, actions, initial_state, allow_outside)
        batch = max(len(theta), len(actions), len(initial_state))
        theta, actions, initial_state = (
            np.broadcast_to(a, (batch, *a.shape[1:])) for a in (theta, actions, initial_state)
        )
        dts = np.broadcast_to(np.asarray(self.model.opt.timestep if dt is None else dt, float), (batch,))
        names = list(logs) if logs is not None else [None] * batch
        steps, timesteps = (np.array(x) for x in zip(*(self.physics_steps(float(d)) for d in dts), strict=True))
        lanes, biases = self._models(theta, timesteps, names)
        horizon = actions.shape[1]
        states = np.empty((batch, horizon + 1, self.state_size))
        observations = np.empty((batch, horizon + 1, len(self.environment.channels)))
        for skip in np.unique(steps):
            group = np.flatnonzero(steps == skip)
            width = (horizon * int(skip) + 1) * (self.state_size + self.model.nsensordata + self.model.nu)
            size = max(self.num_threads, _CHUNK // width)
            for chunk in np.array_split(group, math.ceil(len(group) / size)):
                self._run(chunk, int(skip), lanes, actions, initial_state, states, observations)
        observations += biases[:, None]
        expected = initial_state[:, :1] + np.arange(horizon + 1) * dts[:, None]
        on_time = np.abs(states[:, :, 0] - expected) < _TIME_TOLERANCE * timesteps[:, None]
        good = on_time & np.isfinite(states).all(-1) & self._lane_physical(lanes)[:, None]
        valid = np.logical_and.accumulate(good, axis=1)
        self.diverged += int((~valid[:, -1]).sum())
        self.control_steps += batch * horizon
        length = np.full(batch, horizon)
        return Trajectories(observations, actions, dts, length, valid, states, (), self.environment.channels)

    def _check(
        self, theta: FloatArray, actions: FloatArray, initial_state: FloatArray, allow_outside: bool
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        theta = np.atleast_2d(self.space.check_shape(theta))
        if not allow_outside and not ((theta >= 0) & (theta <= 1)).all():
            raise ValueError(
                f"theta: expected values in [0, 1], got {theta.min():.4g} to {theta.max():.4g}; "
                "clip them, or pass allow_outside=True"
            )
        actions = np.asarray(actions, float)
        if actions.ndim == 2:
            actions = actions[None]
        if actions.ndim != 3 or actions.shape[-1] != self.environment.num_actions or not actions.shape[0]:
            raise ValueError(f"actions: expected (B, T, {self.environment.num_actions}), got {actions.shape}")
        if not np.isfinite(actions).all():
            raise ValueError("actions: expected finite numbers, got NaN or infinity; mask or hold them first")
        initial_state = np.atleast_2d(np.asarray(initial_state, float))
        if initial_state.shape[-1] != self.state_size:
            raise ValueError(f"initial_state: expected (B, {self.state_size}), got {initial_state.shape}")
        sizes = {len(theta), len(actions), len(initial_state)} - {1}
        if len(sizes) > 1:
            raise ValueError(
                f"batch sizes differ: theta {len(theta)}, actions {len(actions)}, initial_state {len(initial_state)}"
            )
        return theta, actions, initial_state

    def _new_model(self) -> Any:
        model = self.environment.compile()
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_WARMSTART
        return model

    def _models(
        self, theta: FloatArray, timesteps: FloatArray, logs: Sequence[str | None]
    ) -> tuple[NDArray[np.int64], FloatArray]:
        """Which pooled model each lane uses, written in place, and the lanes' sensor bias (B, O)."""
        lanes, index, biases = np.empty(len(theta), int), {}, []
        for lane, row in enumerate(theta):
            key = row.tobytes() + float(timesteps[lane]).hex().encode() + str(logs[lane]).encode()
            if key not in index:
                index[key] = len(index)
                values = self.space.values(row)
                self._write(index[key], key, values, float(timesteps[lane]), logs[lane])
                biases.append(self.environment.bias(values, logs[lane]))
            lanes[lane] = index[key]
        return lanes, np.stack(biases)[lanes]

    def _write(self, slot: int, key: bytes, values: FloatArray, timestep: float, log: str | None) -> None:
        if slot == len(self._pool):
            self._pool.append(self._new_model())
            self._keys.append(b"")
            self._physical.append(False)
        if self._keys[slot] == key:
            return
        model = self._pool[slot]
        self._physical[slot] = self.environment.write(model, values, log)
        model.opt.timestep = timestep
        if self._physical[slot] and self.environment.needs_constants:
            mujoco.mj_setConst(model, self._scratch)
        self._keys[slot] = key

    def _lane_physical(self, lanes: NDArray[np.int64]) -> BoolArray:
        return np.array(self._physical)[lanes]

    def _run(
        self,
        chunk: NDArray[np.int64],
        skip: int,
        lanes: NDArray[np.int64],
        actions: FloatArray,
        initial_state: FloatArray,
        states: FloatArray,
        observations: FloatArray,
    ) -> None:
        """Simulate the lanes of ``chunk`` and fill their rows of states and observations."""
        environment = self.environment
        physical = chunk[self._lane_physical(lanes[chunk])]
        states[chunk], observations[chunk] = np.nan, np.nan
        if not len(physical):
            return
        start = initial_state[physical]
        controls = np.repeat(environment.control(self.model, start, actions[physical]), skip, axis=1)
        if environment.needs_derived:  # one more step: sensordata belongs to the state before it
            controls = np.concatenate([controls, controls[:, -1:]], axis=1)
        out, sensors = mujoco.rollout.rollout(
            [self._pool[k] for k in lanes[physical]],
            self._datas,
            initial_state=start,
            control=controls,
            skip_checks=False,
            persistent_pool=True,
        )
        kept = np.concatenate([start[:, None], out[:, skip - 1 : actions.shape[1] * skip : skip]], axis=1)
        derived = sensors[:, ::skip][:, : actions.shape[1] + 1] if environment.needs_derived else None
        states[physical] = kept
        observations[physical] = environment.observe(self.model, kept, derived)
