"""Physics steps under controllers that firmware samples (``sipe_bayes.envs.laws.firmware``).

At each tick the controller's law is evaluated with the model's own numbers, and its output held until the next: a force
of ``position``, ``velocity`` and ``pid``, a voltage of ``dcmotor``, times the supply's share. Ticks are the multiples
of the period in the state's time, each at the first physics step that does not come before it. A rollout that begins
between two ticks holds what the controller gave at the last one, by the start's position and velocity. Integrals go on,
and slew rates and filters of the set-point act, by one period a tick.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import mujoco
import numpy as np

from sipe_bayes.core.arrays import BoolArray, FloatArray
from sipe_bayes.envs.laws.firmware import BoundFirmware, firmware_of
from sipe_bayes.simulation.law_steps import Steps
from sipe_bayes.simulation.short_delays import stored

_EARLY = 1e-6  # of a period: a tick is not late by rounding
_ENDLESS = 1e10
_WHOLE = 1e-3  # of a period: a log's clock is measured
_MOTOR = int(mujoco.mjtGain.mjGAIN_DCMOTOR)
_PID = int(mujoco.mjtGain.mjGAIN_PID)
_WRITTEN = (
    "actuator_gaintype",
    "actuator_biastype",
    "actuator_dyntype",
    "actuator_forcelimited",
    "actuator_ctrllimited",
    "actuator_ctrlspec",
    "actuator_gainprm",
    "actuator_dynprm",
    "actuator_delay",
)


@dataclass(frozen=True)
class _Numbers:
    """Of one controller in each of B simulations, (B,) each: force = gain u + force + stiffness l + damping v + ki x.

    Of a dcmotor that is the torque which it asks for, and ``resistance`` over ``constant`` its volts.
    """

    gain: FloatArray
    force: FloatArray
    stiffness: FloatArray
    damping: FloatArray
    ki: FloatArray
    slew: FloatArray
    largest_integral: FloatArray
    lag: FloatArray
    low: FloatArray
    high: FloatArray
    least: FloatArray
    most: FloatArray
    resistance: FloatArray
    constant: FloatArray
    gear: FloatArray
    delay: FloatArray

    @classmethod
    def of(cls, models: Sequence[mujoco.MjModel], bound: BoundFirmware) -> _Numbers:
        """Read off the models."""
        distinct = {id(m): m for m in models}
        rows = {key: _row(m, bound) for key, m in distinct.items()}
        return cls(*np.array([rows[id(m)] for m in models]).T)


def _row(model: mujoco.MjModel, bound: BoundFirmware) -> tuple[float, ...]:
    a, c = bound.actuator, bound.control
    gain, bias, dyn = model.actuator_gainprm[a], model.actuator_biasprm[a], model.actuator_dynprm[a]
    kind, endless = int(model.actuator_gaintype[a]), (-np.inf, np.inf)
    limits = tuple(model.actuator_forcerange[a]) if model.actuator_forcelimited[a] else endless
    command = tuple(model.actuator_ctrlrange[c]) if model.actuator_ctrllimited[c] else endless
    lag, resistance, constant = 0.0, 0.0, 0.0
    if kind == _MOTOR:
        law, ki, slew, most = (gain[4], 0.0, -gain[4], -gain[6]), gain[5], dyn[7], dyn[8]
        if int(model.actuator_ctrlspec[a]) == int(mujoco.mjtCtrlInput.mjINPUT_VEL):
            law = (gain[6], 0.0, -gain[4], -gain[6])
        resistance, constant = gain[0], gain[1]
        limits = (-gain[7], gain[7]) if gain[7] > 0 else endless
    elif kind == _PID:
        velocity = int(model.actuator_ctrlspec[a]) == int(mujoco.mjtCtrlInput.mjINPUT_VEL)
        law, ki = (-bias[2] if velocity else -bias[1], bias[0], bias[1], bias[2]), gain[0]
        slew, most = dyn[1], dyn[0]
    else:
        law, ki, slew, most = (gain[0], *bias[:3]), 0.0, 0.0, 0.0
        lag = dyn[0] if int(model.actuator_dyntype[a]) != int(mujoco.mjtDyn.mjDYN_NONE) else 0.0
    gear, delay = model.actuator_gear[a, 0], model.actuator_delay[a]
    own = (slew or np.inf, most or np.inf, lag)
    return *law, ki, *own, *limits, *command, resistance, constant, gear, delay


@dataclass
class _Loop:
    """A controller on its way through a rollout of B simulations.

    Args:
        bound: which.
        numbers: of the models.
        kept: (B, n) its own activations: set-point after its slew rate or filter, integral.
        slots: which of them is the slewed set-point, and which the integral; -1 without.
        output: (B,) that it holds.
    """

    bound: BoundFirmware
    numbers: _Numbers
    kept: FloatArray
    slots: tuple[int, int]
    output: FloatArray

    @classmethod
    def start(
        cls, bound: BoundFirmware, models: Sequence[mujoco.MjModel], here: FloatArray, set_point: FloatArray
    ) -> _Loop:
        """At the beginning of rollouts from states (B, S): what it holds since its last tick."""
        model, a = models[0], bound.actuator
        kind, dyn = int(model.actuator_gaintype[a]), model.actuator_dynprm[a]
        slewed = dyn[7] > 0 if kind == _MOTOR else dyn[1] > 0
        integral = model.actuator_gainprm[a, 5 if kind == _MOTOR else 0] != 0
        if kind not in (_MOTOR, _PID):
            slewed, integral = bound.activations.stop > bound.activations.start, False
        count = int(slewed) + int(integral)
        kept = here[:, bound.activations][:, :count].copy()
        slots = (0 if slewed else -1, count - 1 if integral else -1)
        loop = cls(bound, _Numbers.of(models, bound), kept, slots, np.zeros(len(here)))
        past = here.copy()
        elapsed = here[:, 0] - np.floor(here[:, 0] / bound.period + _EARLY) * bound.period
        past[:, bound.position] -= elapsed * here[:, bound.velocity]
        effective = loop.kept[:, 0] if slewed else np.clip(set_point, loop.numbers.least, loop.numbers.most)
        loop.output = loop._law(past, effective)
        return loop

    @property
    def by_activation(self) -> bool:
        """Whether MuJoCo takes the held force from the last activation, not from the control."""
        motor = bool((self.numbers.constant > 0).any())
        return not motor and self.bound.activations.stop > self.bound.activations.start

    def tick(self, here: FloatArray, set_point: FloatArray, due: BoolArray) -> None:
        """Evaluate the law where it is ``due`` (B,), at states (B, S) and set-points (B,)."""
        numbers, period = self.numbers, self.bound.period
        wanted = np.clip(self._delayed(here, set_point), numbers.least, numbers.most)
        slewed, integral = self.slots
        if slewed >= 0:
            before = self.kept[:, slewed]
            share = 1 - np.exp(-period / np.maximum(numbers.lag, 1e-300))
            wanted = before + share * np.clip(wanted - before, -numbers.slew * period, numbers.slew * period)
            self.kept[:, slewed] = np.where(due, wanted, before)
        if integral >= 0:
            error = wanted - numbers.gear * here[:, self.bound.position]
            most = numbers.largest_integral
            summed = np.clip(self.kept[:, integral] + period * error, -most, most)
            self.kept[:, integral] = np.where(due, summed, self.kept[:, integral])
        self.output = np.where(due, self._law(here, wanted), self.output)

    def _law(self, here: FloatArray, wanted: FloatArray) -> FloatArray:
        """Force or volts (B,) at states (B, S) for set-points (B,)."""
        n = self.numbers
        length, velocity = n.gear * here[:, self.bound.position], n.gear * here[:, self.bound.velocity]
        out = n.gain * wanted + n.force + n.stiffness * length + n.damping * velocity
        if self.slots[1] >= 0:
            out = out + n.ki * self.kept[:, self.slots[1]]
        motor = n.constant > 0
        volts = n.resistance / np.where(motor, n.constant, 1.0) * out + n.constant * velocity
        return np.clip(np.where(motor, volts, out), n.low, n.high)

    def _delayed(self, here: FloatArray, set_point: FloatArray) -> FloatArray:
        """The set-point (B,) that has arrived, of those that the states (B, S) remember."""
        block = here[:, self.bound.history]
        if not block.shape[1] or not self.numbers.delay.any():
            return set_point
        times, values = np.split(block, 2, axis=1)
        order, now = np.argsort(times, axis=1), here[:, :1]
        times = np.concatenate([np.take_along_axis(times, order, 1), now], axis=1)
        values = np.concatenate([np.take_along_axis(values, order, 1), set_point[:, None]], axis=1)
        at = now - self.numbers.delay[:, None]
        after = np.clip((times < at).sum(1, keepdims=True), 1, times.shape[1] - 1)
        (t0, t1), (u0, u1) = ([np.take_along_axis(x, k, 1) for k in (after - 1, after)] for x in (times, values))
        share = np.clip((at - t0) / np.maximum(t1 - t0, 1e-12), 0, 1)
        return np.asarray((u0 + share * (u1 - u0))[:, 0])


class FirmwareSteps:
    """The sampled controllers of a compiled model; false where it has none."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self.controllers = firmware_of(model)

    def __bool__(self) -> bool:
        return bool(self.controllers)

    def whole(self, steps: int, dt: float) -> int:
        """About ``steps`` control steps of ``dt`` s, but so that ticks and samples fall together again, if they do."""
        periods = [controller.period / dt for controller in self.controllers]
        together = math.lcm(*(round(n) for n in periods if n > 0.5 and abs(n - round(n)) < _WHOLE * n))
        return max(1, round(steps / together)) * together

    def advance(
        self,
        steps: Steps,
        models: Sequence[mujoco.MjModel],
        start: FloatArray,
        controls: FloatArray,
        control_spec: int,
        reads: bool,
    ) -> tuple[FloatArray, FloatArray]:
        """States (B, P, S) and sensordata (B, P, D).

        Args:
            steps: takes the physics steps.
            models: one for each simulation; as before afterwards.
            start: (B, S).
            controls: (B, P, U), set-points.
            control_spec: of the controls.
            reads: whether sensordata is wanted.
        """
        horizon = controls.shape[1]
        timestep = np.array([model.opt.timestep for model in models])
        times = start[:, :1] + np.arange(horizon) * timestep[:, None]
        loops = [_Loop.start(bound, models, start, controls[:, 0, bound.control]) for bound in self.controllers]
        due = [_due(times, bound.period) for bound in self.controllers]
        edges = np.zeros(horizon, bool)
        edges[0] = True
        for bound, ticks in zip(self.controllers, due, strict=True):
            edges |= ticks.any(0)
            if bound.supply >= 0:
                edges[1:] |= (np.diff(controls[:, :, bound.supply], axis=1) != 0).any(0)
        begins = np.flatnonzero(edges)
        here, states, sensors = start.copy(), [], []
        with _silenced(models, self.controllers):
            for a, b in zip(begins, [*begins[1:], horizon], strict=True):
                inputs = controls[:, a:b].copy()
                for loop, ticks in zip(loops, due, strict=True):
                    bound = loop.bound
                    loop.tick(here, controls[:, a, bound.control], ticks[:, a])
                    share = 1.0 if bound.supply < 0 else controls[:, a, bound.supply]
                    inputs[:, :, bound.control] = (loop.output * share)[:, None]
                    if loop.by_activation:
                        here[:, bound.activations.stop - 1] = loop.output * share
                out, seen = steps(models, here, inputs, control_spec, reads)
                for loop in loops:
                    self._restore(loop, out, times[:, a:b], controls[:, a:b, loop.bound.control], timestep)
                here = out[:, -1].copy()
                states.append(out)
                sensors.append(seen)
        return np.concatenate(states, axis=1), np.concatenate(sensors, axis=1)

    def _restore(
        self, loop: _Loop, out: FloatArray, times: FloatArray, set_points: FloatArray, timestep: FloatArray
    ) -> None:
        """Put into states (B, n, S) what the controller remembers, and the set-points (B, n) that came at times.

        Physics steps take ``timestep`` (B,) seconds.
        """
        bound = loop.bound
        first = bound.activations.start
        out[:, :, first : first + loop.kept.shape[1]] = loop.kept[:, None]
        if samples := (bound.history.stop - bound.history.start) // 2:
            begin = bound.history.start
            stamped, values = slice(begin, begin + samples), slice(begin + samples, bound.history.stop)
            stored(out, stamped, values, times, set_points, timestep)


def _due(times: FloatArray, period: float) -> BoolArray:
    """Which physics steps (B, P) that begin at ``times`` are the first ones at or after a tick."""
    count = np.floor(times / period + _EARLY)
    begun = times[:, :1] - count[:, :1] * period <= 2 * _EARLY * period
    return np.concatenate([begun, np.diff(count, axis=1) > 0], axis=1)


@contextmanager
def _silenced(models: Sequence[mujoco.MjModel], controllers: Sequence[BoundFirmware]) -> Iterator[None]:
    """Models in which what a controller asks for is the control, and nothing of its own is evaluated."""
    distinct = list({id(model): model for model in models}.values())
    before = [[getattr(model, name).copy() for name in _WRITTEN] for model in distinct]
    try:
        for model in distinct:
            for bound in controllers:
                _silence(model, bound)
        yield
    finally:
        for model, fields in zip(distinct, before, strict=True):
            for name, values in zip(_WRITTEN, fields, strict=True):
                getattr(model, name)[:] = values


def _silence(model: mujoco.MjModel, bound: BoundFirmware) -> None:
    a = bound.actuator
    model.actuator_delay[a], model.actuator_ctrllimited[bound.control] = 0.0, False
    if int(model.actuator_gaintype[a]) != _MOTOR:
        model.actuator_gaintype[a] = int(mujoco.mjtGain.mjGAIN_USER)
        model.actuator_biastype[a] = int(mujoco.mjtBias.mjBIAS_USER)
        model.actuator_dyntype[a], model.actuator_forcelimited[a] = int(mujoco.mjtDyn.mjDYN_NONE), False
        return
    model.actuator_ctrlspec[a] = int(mujoco.mjtCtrlInput.mjINPUT_VOLTAGE)
    gain, dyn = model.actuator_gainprm[a], model.actuator_dynprm[a]
    gain[[4, 6, 7]] = 0.0
    gain[5] *= 1e-300  # zero would change the number of activations
    dyn[7] = _ENDLESS if dyn[7] else 0.0
    dyn[8] = 1e-300 if dyn[8] else 0.0
