"""Native runs of written models: open loop on ``mujoco.rollout``, control step by control step, or lane by lane.

All three give the states of the samples, what an Environment derives from them, and which samples are sound. MuJoCo's own
messages are held back meanwhile: nothing on the terminal, no MUJOCO_LOG.TXT.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import mujoco
import mujoco.rollout
import numpy as np
from numpy.typing import NDArray

from sipe_bayes.envs.base import Environment
from sipe_bayes.simulation import mjdata as by_lane

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_TIME_TOLERANCE = 0.5  # of a physics step
_FORCES = int(mujoco.mjtDisableBit.mjDSBL_CONTACT) | int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
HUGE = float(mujoco.mjMAXVAL)  # beyond it MuJoCo takes a number for a diverged one


class _Quiet:
    """Holds MuJoCo's process-wide log back while any thread is inside; no callback, so no wait for the
    GIL."""

    def __init__(self) -> None:
        self._lock, self._inside, self._before = threading.Lock(), 0, mujoco.MjLogConfig.get()

    @contextmanager
    def __call__(self) -> Iterator[None]:
        with self._lock:
            if not self._inside:
                self._before, silent = mujoco.MjLogConfig.get(), mujoco.MjLogConfig.get()
                silent.logto_console = silent.logto_file = False
                silent.set()
            self._inside += 1
        try:
            yield
        finally:
            with self._lock:
                self._inside -= 1
                if not self._inside:
                    self._before.set()


quiet = _Quiet()


class Engine:
    """Runs models that are like ``model``, on native threads. physics_size: numbers of MuJoCo's full physics state."""

    def __init__(self, environment: Environment, model: Any, num_threads: int) -> None:
        self.environment, self.model = environment, model
        self.physics_size = int(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
        self._threads = mujoco.rollout.Rollout(nthread=num_threads if num_threads > 1 else 0)
        self._datas = [mujoco.MjData(model) for _ in range(num_threads)]

    @property
    def derived_size(self) -> int:
        """D: the numbers of ``derived``, sensordata or MjData's own."""
        fields = self.environment.data_fields
        return by_lane.fields_size(self._datas[0], fields) if fields else int(self.model.nsensordata)

    def advance(
        self,
        skip: int,
        models: list[Any],
        timesteps: FloatArray,
        actions: FloatArray,
        start: FloatArray,
        first: bool = True,
    ) -> tuple[FloatArray, FloatArray | None, BoolArray]:
        """States (B, T+1, S), sensordata aligned as the environment has it (B, T+1, D) or None, and which samples
        (B, T+1) are sound, of lanes with ``models`` and ``skip`` physics steps a control step. Without ``first`` the
        derived quantities of sample 0 may be missing."""
        with quiet():
            if self.environment.data_fields:
                return self._by_lane(skip, models, timesteps, actions, start, first)
            run = self._stepwise if self.environment.stepwise else self._open_loop
            return run(skip, models, timesteps, actions, start)

    def _open_loop(
        self, skip: int, models: list[Any], timesteps: FloatArray, actions: FloatArray, start: FloatArray
    ) -> tuple[FloatArray, FloatArray | None, BoolArray]:
        """States (B, T+1, S), sensordata aligned with them (B, T+1, D) and which samples are sound."""
        environment, horizon = self.environment, actions.shape[1]
        controls = np.repeat(environment.control(self.model, start, actions), skip, axis=1)
        # A reset sets the time to 0, so a first step from time 0 that fails ends on time: only the next one
        # shows it. Sensordata belongs to the state before the step, so the last sample's comes with the next
        # step as well.
        aligned = environment.needs_derived and not environment.derived_late
        if aligned or (horizon * skip == 1 and not start[:, 0].all()):
            controls = np.concatenate([controls, controls[:, -1:]], axis=1)
        out, sensors = self._native(models, start, controls)
        states = np.concatenate([start[:, None], out[:, skip - 1 : horizon * skip : skip]], axis=1)
        derived = None
        if aligned:
            derived = sensors[:, ::skip][:, : horizon + 1]
        elif environment.needs_derived:
            derived = np.concatenate([sensors[:, :1], sensors[:, skip - 1 : horizon * skip : skip]], axis=1)
        return states, derived, _sound(states, out, skip, timesteps[:, None], aligned)

    def _stepwise(
        self, skip: int, models: list[Any], timesteps: FloatArray, actions: FloatArray, start: FloatArray
    ) -> tuple[FloatArray, FloatArray | None, BoolArray]:
        """The same for an environment whose control depends on the state."""
        environment, horizon, own = self.environment, actions.shape[1], self.physics_size
        states = np.empty((len(start), horizon + 1, start.shape[1]))
        derived = np.empty((len(start), horizon + 1, self.model.nsensordata)) if environment.needs_derived else None
        sound = np.ones((len(start), horizon + 1), bool)
        states[:, 0] = start
        if derived is not None:
            derived[:, 0] = self.sensors(models, start)
        sound[:, 0] = (np.abs(start) <= HUGE).all(1)
        for t in range(horizon):
            begin = np.ascontiguousarray(states[:, t, :own])
            control = environment.control(self.model, states[:, t], actions[:, t])
            out, _ = self._native(models, begin, np.repeat(control[:, None], skip, axis=1))
            ends = np.stack([begin, out[:, -1]], axis=1)
            sound[:, t : t + 2] &= _sound(ends, out, skip, timesteps[:, None], False)
            after = environment.settle(self.model, out[:, -1])
            before = out[:, -2] if skip > 1 else begin
            seen = self.sensors(models, environment.probe(self.model, before, after))
            states[:, t + 1, :own], states[:, t + 1, own:] = after, environment.remember(seen)
            if derived is not None:
                derived[:, t + 1] = seen
        return states, derived, sound

    def _by_lane(
        self,
        skip: int,
        models: list[Any],
        timesteps: FloatArray,
        actions: FloatArray,
        start: FloatArray,
        first: bool,
    ) -> tuple[FloatArray, FloatArray | None, BoolArray]:
        """The same for an environment that reads MjData itself."""
        environment = self.environment
        controls = environment.control(self.model, start, actions)
        states, derived, clean = by_lane.advance(
            models, self._datas, environment.data_fields, skip, controls, start, first
        )
        return states, derived, clean & _sound(states, states[:, 1:], 1, skip * timesteps[:, None], False)

    def sensors(self, models: list[Any], states: FloatArray) -> FloatArray:
        """Sensordata (B, D) of states (B, S), without control."""
        if self.environment.data_fields:
            with quiet():
                return by_lane.forward(models, self._datas, self.environment.data_fields, states)
        width = mujoco.mj_stateSize(self.model, self.environment.control_spec)
        own = np.ascontiguousarray(states[:, : self.physics_size])
        flags = int(self.model.opt.disableflags)
        try:
            for model in models:
                model.opt.disableflags = flags | _FORCES if self.environment.kinematic else flags
            with quiet():
                return np.asarray(self._native(models, own, np.zeros((len(states), 1, width)))[1][:, 0])
        finally:
            for model in models:
                model.opt.disableflags = flags

    def _native(self, models: list[Any], start: FloatArray, controls: FloatArray) -> tuple[FloatArray, FloatArray]:
        """States (B, P, S) and sensordata (B, P, D) of physics steps with controls (B, P, U)."""
        batch, steps = controls.shape[:2]
        out = np.empty((batch, steps, self.physics_size))
        read = self.environment.needs_derived or self.environment.stepwise
        sensors = np.empty((batch, steps, self.model.nsensordata)) if read else None
        self._threads.rollout(
            models,
            self._datas,
            np.ascontiguousarray(start),
            np.ascontiguousarray(controls),
            control_spec=self.environment.control_spec,
            skip_checks=True,
            nstep=steps,
            state=out,
            sensordata=sensors,
        )
        return out, np.empty((batch, steps, 0)) if sensors is None else sensors


def _sound(kept: FloatArray, out: FloatArray, skip: int, timestep: FloatArray, derived: bool) -> BoolArray:
    """Which samples ``kept`` (B, T+1, S) of the physics steps ``out`` (B, P, S) are neither reset, repeated
    nor huge; with ``derived`` the step that filled their sensordata must have been as well."""
    count = kept.shape[1]
    expected = kept[:, :1, 0] + np.arange(count) * skip * timestep
    sound = (np.abs(kept[..., 0] - expected) < _TIME_TOLERANCE * timestep) & (np.abs(kept) <= HUGE).all(-1)
    after = out[:, ::skip][:, :count]  # the physics step that follows sample 0, 1, ...
    sound &= _not_repeated(kept, after)
    if derived:
        sound &= np.abs(after[..., 0] - expected - timestep) < _TIME_TOLERANCE * timestep
        sound &= _not_repeated(after, out[:, 1::skip])
    return sound


def _not_repeated(states: FloatArray, following: FloatArray) -> BoolArray:
    """Which ``states`` (B, T, S) differ from those ``following`` them, as far as there are any."""
    different = np.ones(states.shape[:2], bool)
    number = min(states.shape[1], following.shape[1])
    different[:, :number] = following[:, :number, 0] != states[:, :number, 0]
    if not different.all():
        different[:, :number] |= (following[:, :number] != states[:, :number]).any(-1)
    return different
