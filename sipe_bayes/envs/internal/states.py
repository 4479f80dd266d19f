"""States that nothing measures and that an extension brings into a model: where windows of a log start in them.

They begin at rest: joints where the model has them, a filtered command at the command before the window. How far from
there they may be stands in the model, as ``<numeric name="joint:NAME.start" data="POSITION VELOCITY"/>`` or
``<numeric name="actuator:NAME.start" data="ACTIVATION"/>``, standard deviations of a normal prior. Without it the prior
is that of any state, so wide that each window would pay for a state that is never far from rest.
"""

from __future__ import annotations

from collections.abc import Sequence

import mujoco

from sipe_bayes.core.arrays import FloatArray

_START = ".start"


def declare_start(spec: mujoco.MjSpec, owner: str, sd: Sequence[float]) -> None:
    """Say how far from rest windows may start: of ``joint:NAME`` or ``actuator:NAME``, once."""
    if all(numeric.name != owner + _START for numeric in spec.numerics):
        spec.add_numeric(name=owner + _START, data=list(sd), size=len(sd))


def start_sd(model: mujoco.MjModel, wide: FloatArray) -> FloatArray:
    """Prior sds (2 nv + na,) of a window's start, what the model says in place of ``wide`` (2 nv + na,)."""
    sd = wide.copy()
    for kind, index, declared in _declared(model):
        if kind == "joint":
            dof = int(model.jnt_dofadr[index])
            sd[[dof, model.nv + dof]] = declared
        else:
            first = 2 * model.nv + int(model.actuator_actadr[index])
            sd[first : first + len(declared)] = declared
    return sd


def joints_at_rest(model: mujoco.MjModel) -> frozenset[int]:
    """Ids of the joints of which the model says how far from rest windows may start."""
    return frozenset(index for kind, index, _ in _declared(model) if kind == "joint")


def activations_at_rest(model: mujoco.MjModel) -> int:
    """How many activations the model says this of."""
    return sum(len(declared) for kind, _, declared in _declared(model) if kind == "actuator")


def filtered_commands(model: mujoco.MjModel) -> list[tuple[int, int]]:
    """(actuator, column of the physics state) of each command that goes through a declared filter."""
    filters = (int(mujoco.mjtDyn.mjDYN_FILTER), int(mujoco.mjtDyn.mjDYN_FILTEREXACT))
    first = 1 + model.nq + model.nv
    return [
        (index, first + int(model.actuator_actadr[index]))
        for kind, index, _ in _declared(model)
        if kind == "actuator" and int(model.actuator_dyntype[index]) in filters
    ]


def _declared(model: mujoco.MjModel) -> list[tuple[str, int, FloatArray]]:
    """(kind, id, standard deviations) of the model's ``.start`` numerics whose owner it has."""
    objects = {"joint": mujoco.mjtObj.mjOBJ_JOINT, "actuator": mujoco.mjtObj.mjOBJ_ACTUATOR}
    out = []
    for k in range(model.nnumeric):
        label = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_NUMERIC, k) or ""
        kind, _, name = label.removesuffix(_START).partition(":")
        if label.endswith(_START) and kind in objects:
            index, first = mujoco.mj_name2id(model, objects[kind], name), int(model.numeric_adr[k])
            if index >= 0:
                out.append((kind, index, model.numeric_data[first : first + int(model.numeric_size[k])].copy()))
    return out
