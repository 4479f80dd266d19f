"""The engine on a GPU: batches of a Simulator on mujoco-warp, in float32.

Parameters come from the same writers as on the processor (``fields``); a batch is padded to a number of worlds that
stays on the device from call to call (``worlds``). Where contacts or constraints do not fit the room of a world, the
batch is simulated again with twice the room, so that what comes out depends on neither batch nor room; a world that
overflows all the same, or whose numbers are no longer finite, is not valid from there on.
"""

from __future__ import annotations

from collections import OrderedDict

import mujoco
import mujoco_warp
import numpy as np
import warp

from sipe_bayes.core.arrays import Float32Array, FloatArray, IntArray
from sipe_bayes.simulation.device import Batch
from sipe_bayes.simulation.engine import HUGE, Engine, Motion
from sipe_bayes.simulation.gpu.fields import FieldPool
from sipe_bayes.simulation.gpu.unsupported import Unsupported, check_supported, joined
from sipe_bayes.simulation.gpu.worlds import Capacity, Recipe, Recording, Worlds, bytes_of_a_world
from sipe_bayes.simulation.model_pool import ModelPool

_BITS = mujoco_warp.OverflowType
_SOLVER = int(_BITS.ITERATIONS) | int(_BITS.LS_ITERATIONS)  # it stopped where MuJoCo's own would have
_ROWS = int(_BITS.NEFC | _BITS.NJMAX_NNZ)
_TOUCHED = int(_BITS.BROADPHASE | _BITS.NARROWPHASE | _BITS.CCD)
_CONTACTS, _TOUCHING = 48, 16  # room of a world for contacts at first, and for rows of as many of them
_LARGEST = 4096  # contacts of a world, and rows of constraints
_SIZES = 2  # numbers of worlds that stay on the device
_SHARE, _HOST = 0.4, 2**30  # of the card's free memory, and bytes where the device is the processor
_MOST = 2**16  # worlds
_LEAST = 512  # worlds on a GPU, where fewer take as long


class GpuEngine:
    """Simulates batches on Warp's ``device``; see ``Device`` of ``simulation.device``.

    Args:
        engine: that of the processor, of the environment that is simulated.
        device: Warp's name of the device.

    Raises:
        Unsupported: for what mujoco-warp does not simulate.
    """

    own_slots = False
    wave = 4096

    def __init__(self, engine: Engine, device: str) -> None:
        environment = engine.environment
        check_supported(environment, engine)
        self.environment, self.engine, self.device = environment, engine, device
        self._pool = FieldPool(environment, engine.model)
        names = tuple(environment.data_fields) if environment.data_fields else ("sensordata",)
        derived = names if environment.needs_derived else ()
        late = environment.derived_late or bool(environment.data_fields)
        place = warp.get_device(device)
        self._memory = int(_SHARE * place.free_memory) if place.is_cuda else _HOST
        self._least = _LEAST if place.is_cuda else 1
        base, resting = self._pool.base, bool(environment.data_fields)
        self.recipe = Recipe(base, joined(engine.model), environment.control_spec, derived, late, resting)
        self._width = int(mujoco.mj_stateSize(engine.model, environment.control_spec))
        self.capacity = first_capacity(engine.model)
        self._worlds: OrderedDict[int, Worlds] = OrderedDict()
        try:
            self._bytes = bytes_of_a_world(self.recipe, self.capacity, device)
            with warp.ScopedDevice(device):
                mujoco_warp.put_model(self.recipe.model)
        except (NotImplementedError, ValueError) as error:
            raise Unsupported(f"mujoco-warp can not simulate the model: {error}".rstrip(".")) from None

    def pool(self) -> FieldPool:
        """See ``Device``."""
        return self._pool.another()

    def most(self, horizon: int, skip: int) -> int:
        """See ``Device``."""
        state = self.engine.physics_size + self.engine.derived_size + int(self.engine.model.nu) + 1
        return max(1, min(_MOST, self._memory // (_SIZES * (2 * self._bytes + 4 * (horizon + 1) * state))))

    def advance(self, batch: Batch, first: bool = True) -> Motion:
        """See ``Device``; states are as they were last where a simulation is no longer valid."""
        return self._run(batch, self.environment.control(self.engine.model, batch.start, batch.actions))

    def sensors(self, pool: ModelPool, slots: IntArray, states: FloatArray) -> FloatArray:
        """See ``Device``."""
        batch = Batch(pool, slots, 1, np.ones(len(states)), np.empty((len(states), 0, 0)), states)
        motion = self._run(batch, np.empty((len(states), 0, self._width)))
        assert motion.derived is not None
        return motion.derived[:, 0]

    def _run(self, batch: Batch, commands: FloatArray) -> Motion:
        """What a batch does under commands (B, T, U)."""
        start, pool = batch.start, batch.pool
        assert isinstance(pool, FieldPool)
        count = padded(len(start), self._least)
        index = np.minimum(np.arange(count), len(start) - 1)
        given = np.ascontiguousarray(commands[index].swapaxes(0, 1), np.float32)
        while True:
            worlds = self._of(count)
            worlds.write(pool, batch.slots[index])
            recording = worlds.run(batch.skip, start[index].astype(np.float32), given)
            motion, flags = self._motion(batch, recording)
            if not self._grow(motion, flags):
                return motion

    def _of(self, count: int) -> Worlds:
        """As many worlds, kept."""
        if count not in self._worlds:
            while len(self._worlds) >= _SIZES:
                self._worlds.popitem(last=False)
            self._worlds[count] = Worlds(self.recipe, self._pool.fields, count, self.capacity, self.device)
        self._worlds.move_to_end(count)
        return self._worlds[count]

    def _motion(self, batch: Batch, recording: Recording) -> tuple[Motion, IntArray]:
        """What the first B worlds did, and their flags (B, T+1)."""
        size = len(batch.start)
        states, flags = _turned(recording.states, size), recording.flags[:, :size].T.astype(int)
        derived = _turned(recording.derived, size) if self.recipe.derived else None
        times = batch.start[:, :1] + np.arange(states.shape[1]) * (batch.skip * batch.timesteps)[:, None]
        with np.errstate(invalid="ignore"):
            valid = (np.abs(states) <= HUGE).all(-1) & (flags & ~_SOLVER == 0)
            valid &= np.abs(states[..., 0] - times) < np.maximum(0.5 * batch.timesteps[:, None], 1e-5 * times)
        if derived is not None:
            valid &= np.isfinite(derived).all(-1)
        valid = np.logical_and.accumulate(valid, axis=1)
        states[..., 0], states[:, 0] = times, batch.start
        if not valid.all():
            last = np.maximum(valid.sum(1, keepdims=True) - 1, 0)
            states = np.take_along_axis(states, np.minimum(np.arange(states.shape[1]), last)[..., None], axis=1)
        return Motion(states, derived, valid), flags

    def _grow(self, motion: Motion, flags: IntArray) -> bool:
        """Whether a world wants more room than it had, and gets it."""
        contacts, rows = self.capacity
        wanted = int(np.bitwise_or.reduce(flags[np.isfinite(motion.states).all((1, 2))], axis=None))
        contacts *= 2 if wanted & _TOUCHED and contacts < _LARGEST else 1
        rows *= 2 if wanted & _ROWS and rows < _LARGEST else 1
        if (contacts, rows) == self.capacity:
            return False
        self.capacity = Capacity(contacts, rows)
        self._bytes = bytes_of_a_world(self.recipe, self.capacity, self.device)
        self._worlds.clear()
        return True


def padded(count: int, least: int) -> int:
    """The smallest power of two that holds ``count``, and ``least``."""
    return max(least, 1 << (count - 1).bit_length())


def first_capacity(model: mujoco.MjModel) -> Capacity:
    """Room for everything but contacts, and for a few of those."""
    widest = int(max([1, *model.geom_condim, *model.pair_dim]))
    limits = int(model.jnt_limited.sum()) + 2 * int(model.ntendon)
    rows = 6 * int(model.neq) + int(model.nv) + int(model.ntendon) + limits + _TOUCHING * max(1, 2 * (widest - 1))
    return Capacity(_CONTACTS, rows)


def _turned(kept: Float32Array, count: int) -> FloatArray:
    """(T+1, W, K) of the device as (count, T+1, K)."""
    return np.ascontiguousarray(kept[:, :count].swapaxes(0, 1), float)
