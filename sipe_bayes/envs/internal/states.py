"""States that nothing measures and that an extension brings into a model: where windows of a log start in them.

They begin at rest: joints where the model has them, a filtered command where the commands before the window have
brought it. How far from there they may be stands in the model as standard deviations of a normal prior, ``<numeric
name="joint:NAME.start" data="POSITION VELOCITY"/>`` or ``<numeric name="actuator:NAME.start" data="ACTIVATION"/>``.
Without it the prior is that of any state, so wide that each window would pay for a state that is never far from rest;
of filters that a model has itself it is ``UNSETTLED`` of the largest command.
"""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from sipe_bayes.core.arrays import FloatArray

UNSETTLED = 0.3  # of the largest command: how far a filter may be from where a window starts
_START = ".start"
_FILTERS = (int(mujoco.mjtDyn.mjDYN_FILTER), int(mujoco.mjtDyn.mjDYN_FILTEREXACT))


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
    """How many activations follow from the commands, or the model says this of."""
    return sum(len(declared) for kind, _, declared in _declared(model) if kind == "actuator") + len(own_filters(model))


def own_filters(model: mujoco.MjModel) -> list[int]:
    """Ids of the actuators with a filter that no extension has brought."""
    brought = {index for kind, index, _ in _declared(model) if kind == "actuator"}
    return [k for k in range(model.nu) if int(model.actuator_dyntype[k]) in _FILTERS and k not in brought]


def settle(model: mujoco.MjModel, sd: FloatArray, largest: FloatArray) -> None:
    """Write into prior sds (2 nv + na,) of a start those of the model's own filters; largest: (nu,) of commands."""
    for k in own_filters(model):
        control = int(model.actuator_ctrladr[k])
        size = float(largest[control])
        if model.actuator_ctrllimited[control]:
            size = min(size, float(np.abs(model.actuator_ctrlrange[control]).max()))
        sd[2 * model.nv + int(model.actuator_actadr[k])] = UNSETTLED * (size or 1.0)


def filtered_commands(model: mujoco.MjModel) -> list[tuple[int, int]]:
    """(actuator, column of the physics state) of each command that goes through a filter."""
    filters = [k for k in range(model.nu) if int(model.actuator_dyntype[k]) in _FILTERS]
    return [(k, 1 + model.nq + model.nv + int(model.actuator_actadr[k])) for k in filters]


def kept_by_filter(model: mujoco.MjModel, actuator: int, timestep: float) -> float:
    """The share of where an actuator's filter was that is left a timestep (s) later, as MuJoCo integrates it."""
    exact = int(model.actuator_dyntype[actuator]) != int(mujoco.mjtDyn.mjDYN_FILTER)
    x, slope = timestep / max(float(model.actuator_dynprm[actuator, 0]), mujoco.mjMINVAL), 1.0
    if int(model.opt.integrator) == int(mujoco.mjtIntegrator.mjINT_RK4):
        second = 1 - x / 2
        third = 1 - x / 2 * second
        slope = (1 + 2 * second + 2 * third + 1 - x * third) / 6
    kept = 1 - slope * (-np.expm1(-x) if exact else x)
    return float(kept) if abs(kept) < 1 else 0.0  # one that grows is no filter


def filtered_command(model: mujoco.MjModel, actuator: int, past: FloatArray, timestep: float) -> float:
    """Where an actuator's filter is after commands (P,), one a timestep (s), the first of them held for long before."""
    control, kept = int(model.actuator_ctrladr[actuator]), kept_by_filter(model, actuator, timestep)
    late = round(float(model.actuator_delay[actuator]) / timestep)
    past = past[: max(1, len(past) - late)]
    if model.actuator_ctrllimited[control]:
        past = np.clip(past, *model.actuator_ctrlrange[control])
    weights = kept ** np.arange(len(past))[::-1]
    weights[0] /= 1 - kept
    value = float(weights @ past / weights.sum())
    limited = bool(model.actuator_actlimited[actuator])
    return float(np.clip(value, *model.actuator_actrange[actuator])) if limited else value


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
