"""Physics steps under laws that MJCF has no element for (``sipe_bayes.envs.laws``): one at a time, written anew."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import mujoco
import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.envs.laws.bound import laws_of

_APPLIED = int(mujoco.mjtState.mjSTATE_QFRC_APPLIED)


class Steps(Protocol):
    """Physics steps of B simulations on native threads."""

    def __call__(
        self,
        models: Sequence[mujoco.MjModel],
        start: FloatArray,
        controls: FloatArray,
        control_spec: int,
        reads_sensors: bool,
    ) -> tuple[FloatArray, FloatArray]:
        """States (B, P, S) and sensordata (B, P, D) of controls (B, P, U)."""


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
        self.control_spec, self.num_dofs = control_spec | _APPLIED, int(model.nv)

    def __bool__(self) -> bool:
        return bool(self.laws)

    def advance(
        self, steps: Steps, models: Sequence[mujoco.MjModel], start: FloatArray, controls: FloatArray, reads: bool
    ) -> tuple[FloatArray, FloatArray]:
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
        for helper, (own, _) in self.helpers.items():
            for model in models:
                model.actuator_gear[helper] = model.actuator_gear[own]
        inputs, here, states, sensors = np.zeros((batch, 1, width + self.num_dofs)), start, [], []
        for t in range(horizon):
            command = controls[:, t]
            inputs[:, 0, :width], inputs[:, 0, width:] = command, 0.0
            # what the laws sense, in a step that is forgotten
            sensed = steps(models, here, inputs, self.control_spec, True)[1][:, 0] if self.senses else None
            for bound in self.pushing:
                force = bound.law.value(bound.now(numbers, here, command, sensed))
                if bound.helper >= 0:
                    inputs[:, 0, self.helpers[bound.helper][1]] += force
                    continue
                scale = gears[bound.actuator] if bound.law.kind == "actuator" else 1.0
                inputs[:, 0, width + bound.dof] += scale * force
            self._rub(friction, self._friction(dry, numbers, here, command, sensed))
            moved, seen = steps(models, here, inputs, self.control_spec, reads)
            self._rub(friction, dry)
            here = self._remembered(moved[:, 0], here, numbers, command, sensed)
            states.append(here)
            sensors.append(seen[:, 0])
        return np.stack(states, axis=1), np.stack(sensors, axis=1)

    def _friction(
        self,
        dry: FloatArray,
        numbers: FloatArray,
        states: FloatArray,
        command: FloatArray,
        sensed: FloatArray | None,
    ) -> FloatArray:
        """Dry friction (B, nv) with that of the laws, never below zero."""
        total = dry.copy()
        for bound in self.rubbing:
            total[:, bound.dof] += bound.law.value(bound.now(numbers, states, command, sensed))
        return np.maximum(total, 0.0)

    def _remembered(
        self,
        states: FloatArray,
        before: FloatArray,
        numbers: FloatArray,
        command: FloatArray,
        sensed: FloatArray | None,
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
