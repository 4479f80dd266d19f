"""Native runs of written models: open loop on ``mujoco.rollout``, control step by control step, or on MjData itself.

All three give the states of the samples, what an Environment derives from them, and which samples are valid. MuJoCo's
own messages are held back meanwhile: nothing on the terminal, no MUJOCO_LOG.TXT.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import mujoco.rollout
import numpy as np

from sipe_bayes.core.arrays import BoolArray, FloatArray
from sipe_bayes.envs.base import Environment
from sipe_bayes.envs.foreign.quiet import quiet
from sipe_bayes.simulation.firmware_steps import FirmwareSteps
from sipe_bayes.simulation.law_steps import LawSteps, Models, Moved
from sipe_bayes.simulation.mjdata import Fields
from sipe_bayes.simulation.short_delays import ShortDelays

_TIME_TOLERANCE = 0.5  # of a physics step: a reset or a repeated sample is a whole one off
_FORCES = int(mujoco.mjtDisableBit.mjDSBL_CONTACT) | int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
_SHORT, _LEAST = 32, 30  # up to so many steps each thread takes one piece, of simulated steps that pay for waking it
HUGE = float(mujoco.mjMAXVAL)  # beyond it MuJoCo takes a number for a diverged one


class Run(NamedTuple):
    """T control steps of B simulations to come.

    Args:
        skip: physics steps of a control step.
        models: one for each simulation.
        timesteps: (B,) seconds of their physics steps.
        actions: (B, T, A).
        start: states (B, S) to begin at.
    """

    skip: int
    models: Sequence[mujoco.MjModel]
    timesteps: FloatArray
    actions: FloatArray
    start: FloatArray


class Motion(NamedTuple):
    """What happened in them.

    Args:
        states: (B, T+1, S).
        derived: (B, T+1, D), aligned as the environment has it, or None.
        valid: (B, T+1), which samples are neither reset, repeated nor huge.
    """

    states: FloatArray
    derived: FloatArray | None
    valid: BoolArray


class Engine:
    """Runs models that are like the environment's own, on native threads.

    Args:
        environment: what is simulated.
        model: its compiled model.
        num_threads: native threads.
    """

    def __init__(self, environment: Environment, model: mujoco.MjModel, num_threads: int) -> None:
        self.environment, self.model, self.num_threads = environment, model, num_threads
        self.physics_size = int(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
        self._threads = mujoco.rollout.Rollout(nthread=num_threads if num_threads > 1 else 0)
        self._alone = mujoco.rollout.Rollout(nthread=0)
        self._least = math.ceil(_LEAST / (1 + model.nv**2 / 40))  # 60 us, of 2 + nv^2 / 20 us each
        self._datas = [mujoco.MjData(model) for _ in range(num_threads)]
        self.laws = LawSteps(model, environment.control_spec)
        self.firmware = FirmwareSteps(model)
        self.short_delays = ShortDelays(model)
        self._fields = Fields(environment.data_fields, self._datas) if environment.data_fields else None

    @property
    def derived_size(self) -> int:
        """D: the numbers of ``derived``, sensordata or MjData's own."""
        return int(self.model.nsensordata) if self._fields is None else self._fields.size

    @property
    def reads_sensors(self) -> bool:
        """Whether sensordata is wanted with the states."""
        return self.environment.needs_derived or self.environment.stepwise

    @property
    def own_models(self) -> bool:
        """Whether each simulation needs a written model of its own, because laws write to it in every step."""
        return bool(self.laws.rubbing)

    def advance(self, run: Run, first: bool = True) -> Motion:
        """Simulate; without ``first`` the derived quantities of sample 0 may be missing."""
        with quiet:
            if self._fields is not None:
                controls = self.environment.control(self.model, run.start, run.actions)
                states, derived, clean = self._fields.advance(run.models, run.skip, controls, run.start, first)
                valid = _valid(states, states[:, 1:], 1, run.skip * run.timesteps[:, None], False)
                return Motion(states, derived, clean & valid)
            return self._stepwise(run) if self.environment.stepwise else self._open_loop(run)

    def inputs(self, run: Run) -> tuple[FloatArray, FloatArray]:
        """Starts (B, S), and controls (B, P, U) of all physics steps."""
        return run.start, np.repeat(self.environment.control(self.model, run.start, run.actions), run.skip, axis=1)

    def _open_loop(self, run: Run) -> Motion:
        skip, models, timesteps, actions, _ = run
        environment, horizon = self.environment, actions.shape[1]
        start, controls = self.inputs(run)
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
        return Motion(states, derived, _valid(states, out, skip, timesteps[:, None], aligned))

    def _stepwise(self, run: Run) -> Motion:
        """For an environment whose control depends on the state."""
        skip, models, timesteps, actions, start = run
        environment, horizon, size = self.environment, actions.shape[1], self.physics_size
        states = np.empty((len(start), horizon + 1, start.shape[1]))
        derived = np.empty((len(start), horizon + 1, self.model.nsensordata)) if environment.needs_derived else None
        valid = np.ones((len(start), horizon + 1), bool)
        states[:, 0] = start
        if derived is not None:
            derived[:, 0] = self.sensors(models, start)
        valid[:, 0] = (np.abs(start) <= HUGE).all(1)
        for t in range(horizon):
            # hold the control for the physics steps of a control step
            begin = np.ascontiguousarray(states[:, t, :size])
            control = environment.control(self.model, states[:, t], actions[:, t])
            out, _ = self._native(models, begin, np.repeat(control[:, None], skip, axis=1))
            ends = np.stack([begin, out[:, -1]], axis=1)
            valid[:, t : t + 2] &= _valid(ends, out, skip, timesteps[:, None], False)
            # what the environment edits afterwards, and what it remembers of the sensors
            after = environment.settle(self.model, out[:, -1])
            before = out[:, -2] if skip > 1 else begin
            sensors = self.sensors(models, environment.probe(self.model, before, after))
            states[:, t + 1, :size], states[:, t + 1, size:] = after, environment.remember(sensors)
            if derived is not None:
                derived[:, t + 1] = sensors
        return Motion(states, derived, valid)

    def sensors(self, models: Sequence[mujoco.MjModel], states: FloatArray) -> FloatArray:
        """Sensordata (B, D) of states (B, S) without control, a model for each."""
        if self._fields is not None:
            with quiet:
                return self._fields.forward(models, states)
        width = mujoco.mj_stateSize(self.model, self.environment.control_spec)
        own = np.ascontiguousarray(states[:, : self.physics_size])
        flags = int(self.model.opt.disableflags)
        try:
            for model in models:
                model.opt.disableflags = flags | _FORCES if self.environment.kinematic else flags
            with quiet:
                return np.asarray(self._native(models, own, np.zeros((len(states), 1, width)))[1][:, 0])
        finally:
            for model in models:
                model.opt.disableflags = flags

    def _native(self, models: Models, start: FloatArray, controls: FloatArray) -> Moved:
        """States (B, P, S) and sensordata (B, P, D) of P physics steps, with controls (B, P, U)."""
        spec, reads = self.environment.control_spec, self.reads_sensors
        if self.firmware:
            return self.firmware.advance(self._lawful, models, start, controls, spec, reads)
        return self._lawful(models, start, controls, spec, reads)

    def _lawful(self, models: Models, start: FloatArray, controls: FloatArray, spec: int, reads: bool) -> Moved:
        """As ``_native``, without firmware."""
        if self.laws:
            late = bool(self.short_delays) and self.short_delays.shares(models)[2].any()
            return self.laws.advance(self._punctual if late else self._steps, models, start, controls, reads)
        return self._punctual(models, start, controls, spec, reads)

    def _punctual(self, models: Models, start: FloatArray, controls: FloatArray, spec: int, reads: bool) -> Moved:
        """As ``_native``, without laws."""
        if self.short_delays:
            return self.short_delays.advance(self._steps, models, start, controls, spec, reads)
        return self._steps(models, start, controls, spec, reads)

    def _steps(self, models: Models, start: FloatArray, controls: FloatArray, spec: int, reads: bool) -> Moved:
        """As ``_native``, by ``mujoco.rollout`` alone, with delays as it knows them."""
        batch, steps = controls.shape[:2]
        out = np.empty((batch, steps, self.physics_size))
        sensors = np.empty((batch, steps, self.model.nsensordata)) if reads else None
        pieces = min(self.num_threads, batch * steps // self._least) if steps <= _SHORT else self.num_threads
        threads, datas = (self._threads, self._datas) if pieces > 1 else (self._alone, self._datas[:1])
        threads.rollout(
            models,
            datas,
            np.ascontiguousarray(start),
            np.ascontiguousarray(controls),
            control_spec=spec,
            skip_checks=True,
            nstep=steps,
            state=out,
            sensordata=sensors,
            chunk_size=math.ceil(batch / pieces) if pieces > 1 and steps <= _SHORT else None,
        )
        return out, np.empty((batch, steps, 0)) if sensors is None else sensors


def _valid(kept: FloatArray, out: FloatArray, skip: int, timestep: FloatArray, derived: bool) -> BoolArray:
    """Which samples ``kept`` (B, T+1, S) of the physics steps ``out`` (B, P, S) are neither reset, repeated nor huge.

    Where ``derived``, the step that filled a sample's sensordata must have been valid too.
    """
    count = kept.shape[1]
    expected = kept[:, :1, 0] + np.arange(count) * skip * timestep
    valid = np.abs(kept[..., 0] - expected) < _TIME_TOLERANCE * timestep
    size = np.abs(kept)
    if not size.max() <= HUGE:  # NaN as well
        valid &= (size <= HUGE).all(-1)
    after = out[:, ::skip][:, :count]  # the physics step that follows sample 0, 1, ...
    valid &= _not_repeated(kept, after)
    if derived:
        valid &= np.abs(after[..., 0] - expected - timestep) < _TIME_TOLERANCE * timestep
        valid &= _not_repeated(after, out[:, 1::skip])
    return np.asarray(valid)


def _not_repeated(states: FloatArray, following: FloatArray) -> BoolArray:
    """Which ``states`` (B, T, S) differ from those ``following`` them, as far as there are any."""
    different = np.ones(states.shape[:2], bool)
    number = min(states.shape[1], following.shape[1])
    different[:, :number] = following[:, :number, 0] != states[:, :number, 0]
    if not different.all():
        different[:, :number] |= (following[:, :number] != states[:, :number]).any(-1)
    return different
