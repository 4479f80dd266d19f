"""Commands that come late by less than a physics step.

MuJoCo reads a delayed command before it stores the present one, so that any delay from above zero to one physics step
acts as a whole one. Beyond that it is interpolated between the steps, and so it is here below: what a delay does is
continuous down to none. Of commands u_k in steps of h seconds, a delay d < h lets u_k + d/h (u_{k-1} - u_k) act.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

import mujoco
import numpy as np

from sipe_bayes.core.arrays import BoolArray, FloatArray
from sipe_bayes.simulation.law_steps import Models, Moved, Steps

_WHOLE = 1 - 1e-9  # of a physics step: MuJoCo's own from here on


class _Buffer(NamedTuple):
    """The commands that an actuator remembers, in columns of the physics state.

    Args:
        actuator: which.
        control: column of the controls.
        stamped: their times.
        values: the commands.
    """

    actuator: int
    control: int
    stamped: slice
    values: slice

    @classmethod
    def of(cls, model: mujoco.MjModel, actuator: int) -> _Buffer:
        """Of a compiled model."""
        samples = int(model.actuator_history[actuator, 0])
        begin = 3 + model.nq + model.nv + model.na + int(model.actuator_historyadr[actuator])
        stamped, values = slice(begin, begin + samples), slice(begin + samples, begin + 2 * samples)
        return cls(actuator, int(model.actuator_ctrladr[actuator]), stamped, values)

    def newest(self, states: FloatArray) -> FloatArray:
        """The last command (B,) before states (B, S)."""
        newest = states[:, self.stamped].argmax(1)
        return np.asarray(states[np.arange(len(states)), self.values.start + newest])


def stored(
    states: FloatArray,
    stamped: slice,
    values: slice,
    times: FloatArray,
    commands: FloatArray,
    timestep: FloatArray,
) -> None:
    """Put into histories of states (B, P, S) the commands (B, P) that came at times (B, P).

    Args:
        states: changed.
        stamped: columns of the times that they remember.
        values: columns of the commands.
        times: seconds.
        commands: in their unit.
        timestep: (B,) seconds of a physics step.
    """
    begun, last = times[:, :1, None], times.shape[1] - 1
    step = (states[:, :, stamped] - begun) / timestep[:, None, None]
    new = np.take_along_axis(commands[:, None], np.clip(np.rint(step), 0, last).astype(int), axis=2)
    values_now = states[:, :, values]
    values_now[:] = np.where((step > -0.5) & (step < last + 0.5), new, values_now)


class ShortDelays:
    """Physics steps of a compiled model whose delays may be short; false where it has none.

    Of actuators with one control whose delay MuJoCo interpolates.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        late = (model.actuator_historyadr >= 0) & (model.actuator_history[:, 1] == 1) & (model.actuator_ctrlnum == 1)
        self._actuators = np.flatnonzero(late)
        self.buffers = [_Buffer.of(model, int(k)) for k in self._actuators]

    def __bool__(self) -> bool:
        return bool(self.buffers)

    def advance(
        self, steps: Steps, models: Models, start: FloatArray, controls: FloatArray, control_spec: int, reads: bool
    ) -> Moved:
        """States (B, P, S) and sensordata (B, P, D).

        Args:
            steps: takes the physics steps.
            models: one for each simulation; as before afterwards.
            start: (B, S).
            controls: (B, P, U).
            control_spec: of the controls.
            reads: whether sensordata is wanted.
        """
        timestep, share, short = self.shares(models)
        if not short.any():
            return steps(models, start, controls, control_spec, reads)
        inputs = controls.copy()
        for j, buffer in enumerate(self.buffers):
            here = np.flatnonzero(short[:, j])
            now = controls[here, :, buffer.control]
            before = np.concatenate([buffer.newest(start[here])[:, None], now[:, :-1]], axis=1)
            inputs[here, :, buffer.control] += share[here, j, None] * (before - now)
        with self._undelayed(list({id(model): model for model in models}.values())):
            states, sensors = steps(models, start, inputs, control_spec, reads)
        times = start[:, :1] + np.arange(controls.shape[1]) * timestep[:, None]
        for j, buffer in enumerate(self.buffers):
            here = np.flatnonzero(short[:, j])
            late, commands = states[here], controls[here, :, buffer.control]
            stored(late, buffer.stamped, buffer.values, times[here], commands, timestep[here])
            states[here] = late
        return states, sensors

    def shares(self, models: Sequence[mujoco.MjModel]) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Seconds (B,) of the models' physics steps, their delays (B, K) in steps, and which of these are short."""
        distinct = {id(model): model for model in models}
        rows = {key: (m.opt.timestep, *m.actuator_delay[self._actuators]) for key, m in distinct.items()}
        timestep, *delays = np.array([rows[id(model)] for model in models]).T
        share = np.stack(delays, axis=1) / timestep[:, None]
        return timestep, share, (share > 0) & (share < _WHOLE)

    @contextmanager
    def _undelayed(self, models: Sequence[mujoco.MjModel]) -> Iterator[None]:
        """Distinct models without their short delays."""
        before = [model.actuator_delay.copy() for model in models]
        try:
            for model in models:
                delay = model.actuator_delay[self._actuators]
                short = delay < _WHOLE * model.opt.timestep
                model.actuator_delay[self._actuators] = np.where(short, 0.0, delay)
            yield
        finally:
            for model, delay in zip(models, before, strict=True):
                model.actuator_delay[:] = delay
