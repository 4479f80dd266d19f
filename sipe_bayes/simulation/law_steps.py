"""Physics steps under laws that MJCF has no element for (``sipe_bayes.envs.laws``): one at a time, written anew."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Protocol

import mujoco
import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.envs.laws.bound import laws_of

_APPLIED = int(mujoco.mjtState.mjSTATE_QFRC_APPLIED)
Models = Sequence[mujoco.MjModel]
Gears = dict[int, FloatArray]
Sensed = FloatArray | None
Moved = tuple[FloatArray, FloatArray]
"""States (B, P, S) and sensordata (B, P, D)."""


class Steps(Protocol):
    """Physics steps of B simulations on native threads."""

    def __call__(self, models: Models, start: FloatArray, controls: FloatArray, spec: int, reads: bool, /) -> Moved:
        """What controls (B, P, U) do from the start (B, S)."""


class LawSteps:
    """The laws of a compiled model, step by step. Their dry friction is written into the models, a force is applied.

    Args:
        model: the compiled one; false where it has no law.
        control_spec: of the environment's controls.
    """

    def __init__(self, model: mujoco.MjModel, control_spec: int) -> None:
        self.laws = laws_of(model)
        self.rubbing = [bound for bound in self.laws if bound.law.friction]
        self.pushing = [bound for bound in self.laws if not bound.law.friction]
        self.remembering = [bound for bound in self.laws if bound.law.memory]
        helped = [bound for bound in self.laws if bound.helper >= 0]
        self.helpers = {b.helper: (b.actuator, int(model.actuator_ctrladr[b.helper])) for b in helped}
        self.dofs = sorted({bound.dof for bound in self.rubbing})
        self.senses = any(bound.sensor >= 0 for bound in self.laws)
        torque = any(bound.law.senses == "torque" for bound in self.laws)
        self.only_push = not (self.rubbing or self.remembering or self.helpers or torque)
        self.control_spec, self.num_dofs = control_spec | _APPLIED, int(model.nv)

    def __bool__(self) -> bool:
        return bool(self.laws)

    def advance(self, steps: Steps, models: Models, start: FloatArray, controls: FloatArray, reads: bool) -> Moved:
        """States (B, P, S) and sensordata (B, P, D).

        Args:
            steps: takes the physics steps.
            models: one for each simulation, its own where laws rub; as before afterwards.
            start: (B, S).
            controls: (B, P, U).
            reads: whether sensordata is wanted.
        """
        batch, horizon, width = controls.shape
        numbers = np.stack([model.numeric_data for model in models])
        friction = [model.dof_frictionloss for model in models]
        dry = np.stack(friction)
        driven = {b.actuator for b in self.pushing if b.law.kind == "actuator"}
        gears = {actuator: np.array([m.actuator_gear[actuator, 0] for m in models]) for actuator in driven}
        if self.only_push and horizon > 8:  # where a force hangs on the motion, a few steps show it
            few, every = (
                partial(self._at_once, steps, models, start, c, numbers, gears) for c in (controls[:, :8], controls)
            )
            if few() is not None and (made := every()) is not None:
                return made[0], made[1] if reads else made[1][..., :0]
        for helper, (own, _) in self.helpers.items():
            for model in models:
                model.actuator_gear[helper] = model.actuator_gear[own]
        inputs, here, states, sensors = np.zeros((batch, 1, width + self.num_dofs)), start, [], []
        for t in range(horizon):
            command = controls[:, t]
            inputs[:, 0, :width], inputs[:, 0, width:] = command, 0.0
            # what the laws sense, in a step that is forgotten
            sensed = steps(models, here, inputs, self.control_spec, True)[1][:, 0] if self.senses else None
            self._push(inputs[:, 0], numbers, here, command, sensed, gears)
            self._rub(friction, self._friction(dry, numbers, here, command, sensed))
            moved, seen = steps(models, here, inputs, self.control_spec, reads)
            self._rub(friction, dry)
            here = self._remembered(moved[:, 0], here, numbers, command, sensed)
            states.append(here)
            sensors.append(seen[:, 0])
        return np.stack(states, axis=1), np.stack(sensors, axis=1)

    def _at_once(
        self, steps: Steps, models: Models, start: FloatArray, controls: FloatArray, numbers: FloatArray, gears: Gears
    ) -> Moved | None:
        """As ``advance`` by all steps in one call, where forces along the motion are those that led to it; else None.

        Such are those of actuators whose own force does not hang on the motion.
        """
        plain = inputs = np.concatenate([controls, np.zeros((*controls.shape[:2], self.num_dofs))], axis=2)
        each = np.repeat(np.arange(len(start)), controls.shape[1])
        scales = {actuator: gear[each] for actuator, gear in gears.items()}
        for _ in range(2):
            states, sensors = steps(models, start, inputs, self.control_spec, True)
            before, again = np.concatenate([start[:, None], states[:, :-1]], axis=1), plain.copy()
            before, command, sensed = (array.reshape(len(each), -1) for array in (before, controls, sensors))
            self._push(again.reshape(len(each), -1), numbers[each], before, command, sensed, scales)
            if (again == inputs).all():
                return states, sensors
            inputs = again
        return None

    def _push(
        self,
        inputs: FloatArray,
        numbers: FloatArray,
        states: FloatArray,
        command: FloatArray,
        sensed: Sensed,
        gears: Gears,
    ) -> None:
        """Add the forces of laws to inputs (B, U + nv)."""
        for bound in self.pushing:
            force = bound.law.value(bound.now(numbers, states, command, sensed))
            if bound.helper >= 0:
                inputs[:, self.helpers[bound.helper][1]] += force
                continue
            scale = gears[bound.actuator] if bound.law.kind == "actuator" else 1.0
            inputs[:, command.shape[1] + bound.dof] += scale * force

    def _friction(
        self, dry: FloatArray, numbers: FloatArray, states: FloatArray, command: FloatArray, sensed: Sensed
    ) -> FloatArray:
        """Dry friction (B, nv) with that of the laws, never below zero."""
        total = dry.copy()
        for bound in self.rubbing:
            total[:, bound.dof] += bound.law.value(bound.now(numbers, states, command, sensed))
        return np.maximum(total, 0.0)

    def _remembered(
        self, states: FloatArray, before: FloatArray, numbers: FloatArray, command: FloatArray, sensed: Sensed
    ) -> FloatArray:
        """States (B, S) after a step with what the laws remember of it."""
        for bound in self.remembering:
            shift = states[:, bound.position] - before[:, bound.position]
            states[:, bound.memory] = bound.law.remembered(bound.now(numbers, before, command, sensed), shift)
        return states

    def _rub(self, friction: list[FloatArray], level: FloatArray) -> None:
        """Write levels (B, nv) into the models' own arrays."""
        for dof in self.dofs:
            for array, value in zip(friction, level[:, dof].tolist(), strict=True):
                array[dof] = value
