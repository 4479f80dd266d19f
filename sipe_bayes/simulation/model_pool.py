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
        named = np.array(logs if self.environment.by_log else [None] * len(theta), object)
        differs = (theta[1:] != theta[:-1]).any(1) | (timesteps[1:] != timesteps[:-1]) | (named[1:] != named[:-1])
        first = np.flatnonzero(np.concatenate([[True], differs | own]))
        index: dict[bytes, int] = {}
        slots, rows = np.empty(len(first), int), list[int]()
        for i, at in enumerate(first.tolist()):
            key = _key(theta[at], timesteps[at], named[at]) + (str(i).encode() if own else b"")
            if key not in index:
                index[key] = len(index)
                rows.append(at)
            slots[i] = index[key]
        self.put(np.arange(len(rows)), theta[rows], timesteps[rows], [named[at] for at in rows])
        return np.repeat(slots, np.diff(first, append=len(theta)))

    def put(self, slots: IntArray, theta: FloatArray, timesteps: FloatArray, logs: Sequence[str | None]) -> None:
        """Write into chosen slots; what they hold already costs nothing.

        Args:
            slots: (n,), each once; of those behind the last one the next.
            theta: (n, N).
            timesteps: (n,) seconds of their physics steps.
            logs: n names.
        """
        while len(self.slots) <= slots.max(initial=-1):
            self.slots.append(Slot(self.fresh(), self.environment.exact_sensing))
        keys = [_key(*row) for row in zip(theta, timesteps, logs, strict=True)]
        new = [i for i, (k, key) in enumerate(zip(slots.tolist(), keys, strict=True)) if self.slots[k].key != key]
        for i, values in zip(new, self._values(theta[new]), strict=True):
            index = int(slots[i])
            slot = self.slots[index]
            slot.key = b""
            slot.physical = self._write(slot.model, values, float(timesteps[i]), logs[i])
            slot.sensing = self.environment.sensing(values, logs[i])
            self.keep(index)
            slot.key = keys[i]

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
        if not self.environment.write(self._trial, self._values(theta[None])[0], None):
            space = self.environment.space
            named = ", ".join(f"{p.name} = {p.value(t):.4g} {p.unit}" for p, t in zip(space, theta, strict=True))
            raise ValueError(f"theta: unphysical parameters ({named}); choose values within the bounds")

    def written(self, theta: FloatArray, model: mujoco.MjModel | None = None) -> mujoco.MjModel:
        """``model``, or else a new copy, with theta (N,); raises ValueError for an unphysical one, nothing written."""
        self.check_physical(theta)
        model = copy.copy(self.model) if model is None else model
        self._write(model, self._values(theta[None])[0], float(self.model.opt.timestep), None)
        return model

    @cached_property
    def _trial(self) -> mujoco.MjModel:
        """A model that is only written to, to see whether a theta is physical."""
        return copy.copy(self.model)

    @cached_property
    def _scratch(self) -> mujoco.MjData:
        return mujoco.MjData(self.model)

    def _values(self, theta: FloatArray) -> FloatArray:
        """Values (n, N) of theta (n, N), each as alone: the last bit of an exponential may depend on the batch."""
        values = np.empty(theta.shape)
        for j, parameter in enumerate(self.environment.space):
            column = theta[:, j]
            alone = parameter.scale == "log"
            values[:, j] = [parameter.value(t) for t in column.tolist()] if alone else parameter.value(column)
        return values

    def _write(self, model: mujoco.MjModel, values: FloatArray, timestep: float, log: str | None) -> bool:
        """Write values (N,) and return whether they are physical."""
        physical = self.environment.write(model, values, log)
        model.opt.timestep = timestep
        if physical and self.environment.needs_constants:
            mujoco.mj_setConst(model, self._scratch)
        return physical


def _key(theta: FloatArray, timestep: float, log: str | None) -> bytes:
    """What tells the contents of slots apart."""
    return theta.tobytes() + float(timestep).hex().encode() + str(log).encode()
