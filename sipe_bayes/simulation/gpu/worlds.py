"""W worlds on a device: mujoco-warp's model and data, and control steps that are recorded there.

On CUDA a control step is captured once as a graph: commands in, k physics steps, what is recorded out. The order in
which a card's threads add shows in the last bits. mujoco-warp's `deterministic` is off: with it rollouts took 2.7 times
as long, its buffers outgrew what Warp can address, and bits differed all the same (docs/gpu.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple

import mujoco
import mujoco_warp
import numpy as np
import warp
from numpy.typing import NDArray

from sipe_bayes.core.arrays import Float32Array, IntArray
from sipe_bayes.simulation.gpu.fields import Field, FieldPool
from sipe_bayes.simulation.gpu.kernels import keep_flags, stream_in, stream_out, stream_out_first, tick

_PARTS = {  # of states and commands, by the bits that put them in order
    mujoco.mjtState.mjSTATE_TIME: "time",
    mujoco.mjtState.mjSTATE_QPOS: "qpos",
    mujoco.mjtState.mjSTATE_QVEL: "qvel",
    mujoco.mjtState.mjSTATE_ACT: "act",
    mujoco.mjtState.mjSTATE_HISTORY: "history",
    mujoco.mjtState.mjSTATE_CTRL: "ctrl",
    mujoco.mjtState.mjSTATE_QFRC_APPLIED: "qfrc_applied",
    mujoco.mjtState.mjSTATE_PLASTIC: "plastic",
}


class Capacity(NamedTuple):
    """Room of a world: contacts, its share of a common pool, and rows of constraints."""

    contacts: int
    rows: int


@dataclass(frozen=True)
class Recipe:
    """What is simulated and recorded.

    Args:
        model: decides which terms there are.
        joined: whether constraints join bodies, for which mujoco-warp takes velocities that it computes only later.
        controls: mjtState bits of the commands.
        derived: arrays of MjData that are recorded beside the state.
        late: whether they belong to the state before the last physics step, else before the first of the next.
        resting: whether those of the first sample are without control.
    """

    model: mujoco.MjModel
    joined: bool
    controls: int
    derived: tuple[str, ...]
    late: bool
    resting: bool


class Recording(NamedTuple):
    """What W worlds did in T control steps.

    Args:
        states: (T+1, W, S).
        derived: (T+1, W, D).
        flags: (T+1, W), mujoco-warp's overflow bits until then.
    """

    states: Float32Array
    derived: Float32Array
    flags: NDArray[np.int32]


@dataclass(frozen=True)
class _Columns:
    """An array of the device, (W, width) floats, and the first of the columns that it is in a record."""

    first: int
    values: warp.array


class Worlds:
    """Worlds that are simulated together, again and again.

    Args:
        recipe: what is simulated.
        differing: the fields that each world has its own of.
        count: W.
        capacity: room of a world.
        device: Warp's name of it.
    """

    def __init__(self, recipe: Recipe, differing: Sequence[Field], count: int, capacity: Capacity, device: str) -> None:
        self.recipe, self.count, self.capacity = recipe, count, capacity
        self.device = warp.get_device(device)
        with warp.ScopedDevice(self.device):
            own = {field.name: count for field in differing if not field.option}
            self.model = mujoco_warp.put_model(recipe.model, own)
            self.model.opt.warn_overflow = 0  # it is recorded, not printed
            self.model.opt.run_rne_postconstraint = recipe.resting
            for field in differing:
                if field.option:
                    name = _option(field)
                    kind = getattr(self.model.opt, name).dtype
                    setattr(self.model.opt, name, warp.zeros(count, dtype=kind))
            self.data = mujoco_warp.make_data(recipe.model, count, capacity.contacts, njmax=capacity.rows)
            self._state = self._columns(_names(int(mujoco.mjtState.mjSTATE_FULLPHYSICS)))
            self._command = self._columns(_names(recipe.controls))
            self._derived = self._columns(recipe.derived)
            self._moment = warp.zeros(1, dtype=int)
        self._horizon, self._graphs = -1, dict[int, warp.Graph]()
        self._written: tuple[FieldPool, int, bytes] | None = None

    def write(self, pool: FieldPool, slots: IntArray) -> None:
        """The fields of slots (W,), unless the worlds have them already."""
        wanted = (pool, pool.version, slots.tobytes())
        if self._written is not None and self._written[0] is pool and self._written[1:] == wanted[1:]:
            return
        self._written = None
        with warp.ScopedDevice(self.device):
            for field, values in pool.rows(slots).items():
                if field.name == "impratio":
                    values = np.sqrt(1 / np.maximum(values, mujoco.mjMINVAL)).astype(np.float32)
                target = getattr(self.model.opt if field.option else self.model, _option(field))
                target.assign(values.reshape(target.shape + getattr(target.dtype, "_shape_", ())))
        self._written = wanted

    def run(self, skip: int, start: Float32Array, commands: Float32Array) -> Recording:
        """Simulate.

        Args:
            skip: physics steps of a control step.
            start: (W, S).
            commands: (T, W, U).
        """
        horizon = len(commands)
        with warp.ScopedDevice(self.device):
            self._make_room(horizon)
            self._begin(start)
            graph = self._graph(skip, start) if horizon else None
            if horizon:
                self._commands[:horizon].assign(commands)
            if self.recipe.resting:
                self._forward()
            for _ in range(horizon):
                if graph is None:
                    self._control_step(skip)
                else:
                    warp.capture_launch(graph)
            if self.recipe.derived and (not self.recipe.late or (not horizon and not self.recipe.resting)):
                self._forward()
            recorded = (self._kept, self._kept_derived, self._flags)
            states, derived, flags = (kept[: horizon + 1].numpy() for kept in recorded)
        states[0] = start
        return Recording(states, derived, flags)

    def _columns(self, names: tuple[str, ...]) -> list[_Columns]:
        """Arrays of the data, of whatever vectors, as columns of floats one after the other."""
        columns, first = [], 0
        for name in names:
            array = getattr(self.data, name)
            width = array.size * warp.types.type_size_in_bytes(array.dtype) // (4 * self.count)
            if width:
                shape = (self.count, width)
                columns.append(_Columns(first, warp.array(ptr=array.ptr, dtype=float, shape=shape, copy=False)))
            first += width
        return columns

    def _make_room(self, horizon: int) -> None:
        if horizon <= self._horizon:
            return
        self._horizon, self._graphs = horizon, {}
        self._commands = warp.zeros((horizon, self.count, max(1, _width(self._command))), dtype=float)
        self._kept = warp.zeros((horizon + 1, self.count, _width(self._state)), dtype=float)
        self._kept_derived = warp.zeros((horizon + 1, self.count, max(1, _width(self._derived))), dtype=float)
        self._flags = warp.zeros((horizon + 1, self.count), dtype=int)

    def _begin(self, start: Float32Array) -> None:
        mujoco_warp.reset_data(self.model, self.data)
        self._moment.zero_()
        for part in self._state:
            part.values.assign(np.ascontiguousarray(start[:, part.first : part.first + part.values.shape[1]]))

    def _graph(self, skip: int, start: Float32Array) -> warp.Graph | None:
        """The captured control step; None where the device has no graphs."""
        if not self.device.is_cuda:
            return None
        if skip not in self._graphs:
            self._control_step(skip)  # compiles what it needs, which a capture must not
            with warp.ScopedCapture() as capture:
                self._control_step(skip)
            self._graphs[skip] = capture.graph
            self._begin(start)
        return self._graphs[skip]

    def _forward(self) -> None:
        """Record what is derived of the state, without a step."""
        self._know_velocities()
        mujoco_warp.forward(self.model, self.data)
        self._keep(self._derived, self._kept_derived, 0)

    def _control_step(self, skip: int) -> None:
        late = self.recipe.late
        for part in self._command:
            self._launch(stream_in, part.values, self._moment, self._commands, part.first, part.values)
        for k in range(skip):
            self._know_velocities()
            mujoco_warp.step(self.model, self.data)
            if k == 0 and not late:
                self._keep(self._derived, self._kept_derived, 0)
            if k == 0 and late and not self.recipe.resting:
                for part in self._derived:
                    self._launch(
                        stream_out_first, part.values, self._moment, part.values, part.first, self._kept_derived
                    )
        if late:
            self._keep(self._derived, self._kept_derived, 1)
        self._keep(self._state, self._kept, 1)
        warp.launch(keep_flags, dim=self.count, inputs=[self._moment, self.data.overflow, self._flags])
        warp.launch(tick, dim=1, inputs=[self._moment])

    def _know_velocities(self) -> None:
        """Bodies' velocities as the state has them, where constraints between bodies take them before a step does."""
        if self.recipe.joined:
            for known in (mujoco_warp.kinematics, mujoco_warp.com_pos, mujoco_warp.com_vel):
                known(self.model, self.data)

    def _keep(self, columns: list[_Columns], kept: warp.array, shift: int) -> None:
        for part in columns:
            self._launch(stream_out, part.values, self._moment, shift, part.values, part.first, kept)

    def _launch(self, kernel: warp.Kernel, over: warp.array, *inputs: object) -> None:
        warp.launch(kernel, dim=over.shape, inputs=list(inputs))


def bytes_of_a_world(recipe: Recipe, capacity: Capacity, device: str) -> int:
    """How much of the device a world takes, without what is recorded."""
    with warp.ScopedDevice(device):
        data = mujoco_warp.make_data(recipe.model, 1, capacity.contacts, njmax=capacity.rows)
    owners = (data, data.contact, data.efc)
    arrays = [getattr(owner, field.name) for owner in owners for field in fields(owner)]
    return sum(int(array.capacity) for array in arrays if isinstance(array, warp.array))


def _names(bits: int) -> tuple[str, ...]:
    return tuple(name for bit, name in sorted(_PARTS.items(), key=lambda part: int(part[0])) if int(bit) & bits)


def _option(field: Field) -> str:
    return "impratio_invsqrt" if field.name == "impratio" else field.name


def _width(columns: list[_Columns]) -> int:
    return columns[-1].first + int(columns[-1].values.shape[1]) if columns else 0
