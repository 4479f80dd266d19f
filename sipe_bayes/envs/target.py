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
    "tendon": mujoco.mjtObj.mjOBJ_TENDON,
    "sensor": mujoco.mjtObj.mjOBJ_SENSOR,
}
_COUNTS = {kind: f"n{kind}" for kind in OBJECTS} | {"joint": "njnt"}
_AT_HINGE = {"force": "N m", "position": "rad", "velocity": "rad/s"}
_AT_SLIDE = {"force": "N", "position": "m", "velocity": "m/s"}
_SINGLE = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
_JOINTS = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
_INTEGRATOR = int(mujoco.mjtDyn.mjDYN_INTEGRATOR)


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
        step: the least change that a finite difference can be taken over.
        below: from values below this one; beyond it any change will do.
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
    below: float = np.inf
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


def actuator_unit(model: mujoco.MjModel, actuator: int, words: str) -> str:
    """``words`` such as ``force/velocity`` in the units of the joint that an actuator drives by itself.

    A servo whose gain is minus its bias_position compares its command with the position, one whose gain is minus its
    bias_velocity with the velocity. Of all else (a tendon, a motor whose command may be volts) words stay.

    Args:
        model: that has the actuator.
        actuator: its number.
        words: the unit as it is of any actuator.

    Returns:
        ``N m s/rad`` of ``force/velocity`` at a hinge; what the model does not tell stays a word.
    """
    joint = int(model.actuator_trnid[actuator, 0])
    if int(model.actuator_trntype[actuator]) not in _JOINTS or int(model.jnt_type[joint]) not in _SINGLE:
        return words
    hinge = int(model.jnt_type[joint]) == int(mujoco.mjtJoint.mjJNT_HINGE)
    if not hinge and abs(float(model.actuator_gear[actuator, 0])) != 1:  # of a spindle or a rack: it has a unit itself
        return words
    known = _AT_HINGE if hinge else _AT_SLIDE
    top, slash, bottom = words.partition("/")
    if bottom == "command":
        bottom = _compared(model, actuator)
    elif words == "command" and int(model.actuator_dyntype[actuator]) != _INTEGRATOR:
        top = _compared(model, actuator)
    top = known.get(top, top)
    if bottom == "velocity":
        return f"{top} s/{known['position']}"
    if bottom == "force":
        return f"{top}/({known['force']})" if hinge else f"{top}/{known['force']}"
    return top + slash + bottom.replace("position", known["position"])


def _compared(model: mujoco.MjModel, actuator: int) -> str:
    """What a servo's command, or the integral of it, is compared with; ``command`` where it is no servo."""
    fixed = int(model.actuator_gaintype[actuator]) == int(mujoco.mjtGain.mjGAIN_FIXED)
    affine = int(model.actuator_biastype[actuator]) == int(mujoco.mjtBias.mjBIAS_AFFINE)
    gain = float(model.actuator_gainprm[actuator, 0])
    if not (fixed and affine and gain):
        return "command"
    _, of_position, of_velocity = model.actuator_biasprm[actuator, :3].tolist()
    if np.isclose(gain, -of_position):
        return "position"
    return "velocity" if not of_position and np.isclose(gain, -of_velocity) else "command"
