"""Parameters of many worlds: what differs between them of the model's fields, written by the targets' own writers.

One MjModel is written again and again, with mj_setConst on the processor in float64 where derived constants depend on
what was written; of each only the fields that can differ are kept. Which those are is seen by writing theta all over
the unit cube once.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import mujoco
import mujoco_warp
import numpy as np
from numpy.typing import NDArray

from sipe_bayes.core.arrays import Float32Array, FloatArray, IntArray
from sipe_bayes.envs.base import Environment
from sipe_bayes.simulation.gpu.unsupported import Unsupported
from sipe_bayes.simulation.model_pool import ModelPool

_LEVELS = (0.0, 0.25, 0.5, 0.75, 1.0)  # of each parameter, the others in the middle
_DRAWS = 8  # of all parameters together
_OPTIONS = ("gravity", "wind", "density", "viscosity", "impratio")
_UNUSED = ("dof_M0", "dof_length", "bvh_aabb", "body_sameframe", "geom_sameframe", "actuator_length0")
"""Derived fields that mujoco-warp computes with in no step: bounds, short cuts and what sleeping bodies need."""


@dataclass(frozen=True)
class Field:
    """An array of the model, or an entry of its options, that differs between worlds."""

    name: str
    option: bool = False

    def of(self, model: mujoco.MjModel) -> NDArray[np.generic]:
        """Its values; of an array a view."""
        return np.asarray(getattr(model.opt if self.option else model, self.name))


class FieldPool(ModelPool):
    """Fields with parameters written in, kept from call to call; see ``ModelPool``.

    Args:
        environment: whose parameters.
        model: its compiled model; never written to.

    Raises:
        Unsupported: for a parameter that mujoco-warp does not let differ between worlds.
    """

    version: int
    _room: int
    _rows: dict[Field, Float32Array]
    _options: list[Field]
    _arrays: list[tuple[Field, NDArray[np.generic]]]
    _targets: list[tuple[Float32Array, NDArray[np.generic]]]

    def __init__(self, environment: Environment, model: mujoco.MjModel) -> None:
        super().__init__(environment, model)
        self.written_model = super().fresh()
        self.fields, self.base = self._varying()
        self._empty()

    def another(self) -> FieldPool:
        """One with slots of its own."""
        other = copy.copy(self)
        other.slots = []
        other._empty()
        return other

    def fresh(self) -> mujoco.MjModel:
        """All slots share one model."""
        return self.written_model

    def keep(self, index: int) -> None:
        """Keep the fields of the model that has been written."""
        self.version += 1
        if index >= self._room:
            self._room = max(64, 2 * self._room, index + 1)
            for field, rows in self._rows.items():
                more = np.empty((self._room, *rows.shape[1:]), np.float32)
                more[: len(rows)] = rows
                self._rows[field] = more
            self._targets = [(self._rows[field], now) for field, now in self._arrays]
        for rows, now in self._targets:
            rows[index] = now
        for field in self._options:
            self._rows[field][index] = field.of(self.written_model)

    def rows(self, slots: IntArray) -> dict[Field, Float32Array]:
        """The fields of slots (W,), each (W, ...)."""
        return {field: rows[slots] for field, rows in self._rows.items()}

    def _empty(self) -> None:
        """No rows yet; ``version`` counts what has been written into them."""
        self.version, self._room = 0, 0
        self._rows = {field: np.empty((0, *field.of(self.model).shape), np.float32) for field in self.fields}
        self._options = [field for field in self.fields if field.option]
        self._arrays = [(field, field.of(self.written_model)) for field in self.fields if not field.option]  # views
        self._targets = []

    def _varying(self) -> tuple[list[Field], mujoco.MjModel]:
        """The fields that can differ, and a model that is zero in them only where it always is.

        mujoco-warp decides by the model that it is given which terms there are at all.
        """
        model, base, data = self.written_model, super().fresh(), mujoco.MjData(self.model)
        first: dict[Field, NDArray[np.generic]] = {}
        different: dict[Field, None] = {}
        places: FloatArray | None = None
        for theta in _examples(len(self.environment.space)):
            values = self._values(theta[None])[0]
            if not self._write(model, values, float(self.model.opt.timestep), None):
                continue
            if not first:
                self._write(base, values, float(self.model.opt.timestep), None)
                first = {field: field.of(model).copy() for field in _fields(model)}
            changed = [field for field, own in first.items() if not np.array_equal(own, field.of(model))]
            different |= dict.fromkeys(changed)
            for field in changed:
                _fill(base, field, model)
            mujoco.mj_kinematics(model, data)
            static = model.body_weldid[model.geom_bodyid] == 0
            here = np.concatenate([data.geom_xpos[static], data.geom_xmat[static]], axis=1)
            places = here if places is None else places
            if not np.array_equal(here, places):
                raise Unsupported("mujoco-warp places what is fixed to the world once, but parameters move it")
        if not first:
            raise Unsupported("no theta that was tried is physical")
        return [Field("timestep", option=True), *_batched(different)], base


def _batched(different: Iterable[Field]) -> Iterator[Field]:
    """Those that mujoco-warp computes with; raises Unsupported where it has one for all worlds."""
    kinds = mujoco_warp.Model.__dataclass_fields__
    for field in different:
        if field.name in _UNUSED:
            continue
        shape = getattr(kinds[field.name].type, "shape", ()) if field.name in kinds else ()
        if not (field.name in _OPTIONS if field.option else shape[:1] == ("*",)):
            raise Unsupported(f"mujoco-warp has one {field.name} for all simulations, but parameters change it")
        yield field


def _examples(size: int) -> FloatArray:
    """Theta (n, N) all over the unit cube."""
    middle = np.full((1 + len(_LEVELS) * size, size), 0.5)
    for j in range(size):
        middle[1 + j * len(_LEVELS) : 1 + (j + 1) * len(_LEVELS), j] = _LEVELS
    return np.concatenate([middle, np.random.default_rng(0).random((_DRAWS, size))])


def _fields(model: mujoco.MjModel) -> list[Field]:
    """All arrays of numbers of a model, and its options."""
    arrays = [n for n in dir(model) if not n.startswith("_") and isinstance(getattr(model, n), np.ndarray)]
    numbers = [n for n in dir(model.opt) if isinstance(getattr(model.opt, n), np.ndarray | float | int)]
    return [*(Field(n) for n in arrays), *(Field(n, option=True) for n in numbers if not n.startswith("_"))]


def _fill(base: mujoco.MjModel, field: Field, other: mujoco.MjModel) -> None:
    """Take over from another model what is zero in ``base``."""
    values = np.where(field.of(base) == 0, field.of(other), field.of(base))
    if values.ndim:
        field.of(base)[...] = values
    else:
        setattr(base.opt, field.name, float(values))
