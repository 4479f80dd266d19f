"""Written models: theta goes into copies of the compiled model in place, never by parsing XML again."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import mujoco
import numpy as np

from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray
from sipe_bayes.envs.base import Environment
from sipe_bayes.envs.sensing import Sensing


@dataclass
class Slot:
    """A model of the pool, and what it holds: ``key`` tells theta, timestep and log; what its O sensors do."""

    model: mujoco.MjModel
    sensing: Sensing
    key: bytes = b""
    physical: bool = False


@dataclass
class ModelPool:
    """Copies of an environment's model with parameters written in, kept from call to call.

    Args:
        environment: whose parameters.
        model: its compiled model; never written to.
    """

    environment: Environment
    model: mujoco.MjModel
    slots: list[Slot] = field(default_factory=list)

    def take(self, theta: FloatArray, timesteps: FloatArray, logs: Sequence[str | None], own: bool = False) -> IntArray:
        """Write what B simulations need; those that follow their like cost nothing.

        Args:
            theta: (B, N).
            timesteps: (B,) seconds of their physics steps.
            logs: B names of the logs that they belong to.
            own: whether each simulation has a model to itself.

        Returns:
            The slot of each, (B,).
        """
        named = np.array(logs, object)
        differs = (theta[1:] != theta[:-1]).any(1) | (timesteps[1:] != timesteps[:-1]) | (named[1:] != named[:-1])
        first = np.flatnonzero(np.concatenate([[True], differs | own]))
        index: dict[bytes, int] = {}
        slots = np.empty(len(first), int)
        for i, at in enumerate(first):
            timestep, log = float(timesteps[at]), logs[int(at)]
            key = theta[at].tobytes() + timestep.hex().encode() + str(log).encode() + str(i if own else "").encode()
            if key not in index:
                index[key] = len(index)
                self._fill(index[key], key, theta[at], timestep, log)
            slots[i] = index[key]
        return np.repeat(slots, np.diff(first, append=len(theta)))

    def fresh(self) -> mujoco.MjModel:
        """The model of a new slot."""
        return copy.copy(self.model)

    def keep(self, index: int) -> None:
        """What is done with the model of a slot that has been written."""

    def models(self, slots: IntArray) -> list[mujoco.MjModel]:
        """The models of ``slots`` (B,)."""
        return [self.slots[k].model for k in slots]

    def physical(self, slots: IntArray) -> BoolArray:
        """(B,): whether the parameters in ``slots`` (B,) are ones that a model can have."""
        return np.array([self.slots[k].physical for k in slots], bool)

    def sensing(self, slots: IntArray) -> Sensing:
        """What the sensors (B, O) of ``slots`` (B,) do."""
        return Sensing.stack([self.slots[k].sensing for k in slots])

    def check_physical(self, theta: FloatArray) -> None:
        """Raises ValueError for theta (N,) that no model can have."""
        if not self.environment.write(self._trial, self._values(theta), None):
            space = self.environment.space
            named = ", ".join(f"{p.name} = {p.value(t):.4g} {p.unit}" for p, t in zip(space, theta, strict=True))
            raise ValueError(f"theta: unphysical parameters ({named}); choose values within the bounds")

    def written(self, theta: FloatArray, model: mujoco.MjModel | None = None) -> mujoco.MjModel:
        """``model``, or else a new copy, with theta (N,); raises ValueError for an unphysical one, nothing written."""
        self.check_physical(theta)
        model = copy.copy(self.model) if model is None else model
        self._write(model, self._values(theta), float(self.model.opt.timestep), None)
        return model

    @cached_property
    def _trial(self) -> mujoco.MjModel:
        """A model that is only written to, to see whether a theta is physical."""
        return copy.copy(self.model)

    @cached_property
    def _scratch(self) -> mujoco.MjData:
        return mujoco.MjData(self.model)

    def _fill(self, index: int, key: bytes, theta: FloatArray, timestep: float, log: str | None) -> None:
        if index == len(self.slots):
            self.slots.append(Slot(self.fresh(), Sensing.of_bias(np.zeros(len(self.environment.channels)))))
        slot = self.slots[index]
        if slot.key == key:
            return
        slot.key = b""
        values = self._values(theta)
        slot.physical = self._write(slot.model, values, timestep, log)
        slot.sensing = self.environment.sensing(values, log)
        self.keep(index)
        slot.key = key

    def _values(self, theta: FloatArray) -> FloatArray:
        # a number at a time: the last bit of a vectorised exponential may depend on the length of the batch
        return np.array([p.value(t) for p, t in zip(self.environment.space, theta.tolist(), strict=True)])

    def _write(self, model: mujoco.MjModel, values: FloatArray, timestep: float, log: str | None) -> bool:
        """Write values (N,) and return whether they are physical."""
        physical = self.environment.write(model, values, log)
        model.opt.timestep = timestep
        if physical and self.environment.needs_constants:
            mujoco.mj_setConst(model, self._scratch)
        return physical
