"""A target of a parameter: one number of a compiled model, with its unit and how another one is written."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np

from sipe_bayes.core.validation import nearest_name

Writer = Callable[[mujoco.MjModel, float], None]
Maker = Callable[[mujoco.MjModel, str, int], "Target"]
Check = Callable[[mujoco.MjModel, str, int], None]

OBJECTS = {
    "body": mujoco.mjtObj.mjOBJ_BODY,
    "joint": mujoco.mjtObj.mjOBJ_JOINT,
    "actuator": mujoco.mjtObj.mjOBJ_ACTUATOR,
    "geom": mujoco.mjtObj.mjOBJ_GEOM,
    "sensor": mujoco.mjtObj.mjOBJ_SENSOR,
}
_COUNTS = {"body": "nbody", "joint": "njnt", "actuator": "nactuator", "geom": "ngeom", "sensor": "nsensor"}


class TargetError(ValueError):
    """A target that the model does not have, or that cannot be written."""


@dataclass(frozen=True)
class Target:
    """One number of a compiled model.

    Args:
        spec: how it is named.
        unit: of its value.
        value: in the model that it is bound to.
        write: writes another one into a copy of that model.
        order: writes with a smaller order come first.
        constants: MuJoCo's derived constants, counts or flags depend on it, so mj_setConst follows a write.
        minimum: the smallest physical value.
        physical: whether it is a property of the machine that a report may compare with the model's.
        step: the least change that a finite difference can be taken over, from values below it.
        shape: whether its value in the model says nothing, as that of a force's shape while its size is zero.
    """

    spec: str
    unit: str
    value: float
    write: Writer
    order: int = 0
    constants: bool = False
    minimum: float = -np.inf
    physical: bool = True
    step: float = 0.0
    shape: bool = False


def named(model: mujoco.MjModel, kind: str, name: str, where: str) -> int:
    """Id of an object of ``kind``; raises TargetError that lists what there is."""
    index = mujoco.mj_name2id(model, OBJECTS[kind], name)
    if index < 0:
        names = [mujoco.mj_id2name(model, OBJECTS[kind], i) for i in range(getattr(model, _COUNTS[kind]))]
        known = [n for n in names if n]
        hint = nearest_name(name, known) or f"; the model has {known}"
        raise TargetError(f"{where}: the model has no {kind} {name!r}{hint}")
    return index


def entry(
    field: str,
    unit: str,
    slot: int | None = None,
    check: Check | None = None,
    constants: bool = False,
    minimum: float = -np.inf,
    order: int = 0,
) -> Maker:
    """Of an array of the model, at the object's index and perhaps a slot."""

    def make(model: mujoco.MjModel, spec: str, index: int) -> Target:
        if check is not None:
            check(model, spec, index)
        at = index if slot is None else (index, slot)

        def write(other: mujoco.MjModel, value: float) -> None:
            getattr(other, field)[at] = value

        return Target(spec, unit, float(getattr(model, field)[at]), write, order, constants, minimum)

    return make
