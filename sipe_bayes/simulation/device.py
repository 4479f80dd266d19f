"""Where rollouts are simulated: what a Simulator asks of a device, and the processor's answer to it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import mujoco

from sipe_bayes.core.arrays import FloatArray, IntArray
from sipe_bayes.simulation.engine import Engine, Motion, Run
from sipe_bayes.simulation.model_pool import ModelPool


@dataclass(frozen=True)
class Memory:
    """What a rollout may hold at once."""

    numbers: int = 2**24  # of state and sensor output, 128 MiB
    model_bytes: int = 2**29  # of written models


MEMORY = Memory()


class Batch(NamedTuple):
    """T control steps of B simulations to come.

    Args:
        pool: of the device, which holds their parameters.
        slots: (B,), where.
        skip: physics steps of a control step.
        timesteps: (B,) seconds of their physics steps.
        actions: (B, T, A).
        start: states (B, S) to begin at.
    """

    pool: ModelPool
    slots: IntArray
    skip: int
    timesteps: FloatArray
    actions: FloatArray
    start: FloatArray


class Device(Protocol):
    """Written parameters, and simulations with them."""

    def pool(self) -> ModelPool:
        """Room for written parameters."""

    @property
    def own_slots(self) -> bool:
        """Whether each simulation needs a slot of the pool to itself."""

    @property
    def wave(self) -> int:
        """How many simulations cost about as much as one, together."""

    def most(self, horizon: int, skip: int) -> int:
        """How many simulations of ``horizon`` control steps of ``skip`` physics steps memory holds at once."""

    def advance(self, batch: Batch, first: bool = True) -> Motion:
        """Simulate; without ``first`` the derived quantities of sample 0 may be missing."""

    def sensors(self, pool: ModelPool, slots: IntArray, states: FloatArray) -> FloatArray:
        """What is derived (B, D) of states (B, S) without control, for parameters in slots (B,)."""


class Processor:
    """MuJoCo itself, in float64 on native threads.

    Args:
        engine: runs written models.
    """

    def __init__(self, engine: Engine) -> None:
        self.engine = engine

    wave = 1

    def pool(self) -> ModelPool:
        """See ``Device``."""
        return ModelPool(self.engine.environment, self.engine.model)

    @property
    def own_slots(self) -> bool:
        """Where laws write into the models in every step."""
        return self.engine.own_models

    def most(self, horizon: int, skip: int) -> int:
        """See ``Device``."""
        engine, environment = self.engine, self.engine.environment
        rows = horizon * (1 if environment.data_fields else skip) + 1
        state = engine.physics_size + environment.memory_size
        width = rows * (state + engine.derived_size + int(engine.model.nu))
        held = min(MEMORY.numbers // width, MEMORY.model_bytes // mujoco.mj_sizeModel(engine.model))
        return max(engine.num_threads, held)

    def advance(self, batch: Batch, first: bool = True) -> Motion:
        """See ``Device``."""
        models = batch.pool.models(batch.slots)
        return self.engine.advance(Run(batch.skip, models, batch.timesteps, batch.actions, batch.start), first)

    def sensors(self, pool: ModelPool, slots: IntArray, states: FloatArray) -> FloatArray:
        """See ``Device``."""
        return self.engine.sensors(pool.models(slots), states)
