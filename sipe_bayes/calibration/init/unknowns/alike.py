"""Unknowns of parts that are alike in the model, a parameter for all of them: of more than are asked for else."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np

from sipe_bayes.calibration.column_names import pieces_of, read_vocabulary
from sipe_bayes.calibration.init.draft import Unknown
from sipe_bayes.calibration.init.unknowns.effects import Fit
from sipe_bayes.core.arrays import FloatArray

SHARED = ("armature", "damping", "frictionloss", "stiffness", "lag", "bias_velocity", "kv", "gain", "kp", "mass")
"""What is shared first: what logs tell least of."""
_OF_ACTUATOR = ("gainprm", "biasprm", "dynprm", "gear", "forcerange")
_OF_JOINT = ("dof_damping", "dof_frictionloss", "dof_armature", "jnt_stiffness")

Part = tuple[object, ...]


def shared(model: mujoco.MjModel, unknowns: Sequence[Unknown], what: str) -> list[list[int]]:
    """The places of unknowns, those together that one parameter may stand for; ``what``: of which property.

    Joints and actuators are alike where the model gives them the same numbers, and where it gives joints none or where
    it is about masses, if they are called alike but for a side as well.
    """
    groups: dict[Part, list[int]] = {}
    for k, unknown in enumerate(unknowns):
        owner, _, field = unknown.targets[0].rpartition(".")
        kind, _, name = owner.partition(":")
        of_one = all(target.rpartition(".")[0] == owner for target in unknown.targets)
        key: Part = (k,)
        if of_one and field == what and kind in ("joint", "actuator", "body"):
            key = (unknown.relative, len(unknown.targets), *_signature(model, kind, name))
        groups.setdefault(key, []).append(k)
    return list(groups.values())


def together(unknowns: Sequence[Unknown], fit: Fit, given: FloatArray, groups: Sequence[Sequence[int]], what: str) -> (
    tuple[list[Unknown], Fit, FloatArray]
):  # fmt: skip
    """The unknowns of each group as one, and a fit and the model's values (N,) with these.

    What stands behind the unknowns in the fit is left out.
    """
    merged: list[Unknown] = []
    theta, columns, own = [], [], []
    for group in groups:
        some = [unknowns[k] for k in group]
        low, high = min(u.low for u in some), max(u.high for u in some)
        spans = np.array([u.high - u.low for u in some])
        at = np.array([u.low for u in some]) - low
        theta.append(float(np.mean(at + spans * fit.theta[list(group)])) / (high - low))
        own.append(float(np.mean(at + spans * given[list(group)])) / (high - low))
        columns.append(fit.jacobian[:, list(group)] @ ((high - low) / spans))
        if len(some) > 1:
            one = replace(some[0], targets=tuple(t for u in some for t in u.targets), low=low, high=high)
            taken = {u.name for u in (*unknowns, *merged)}
            merged.append(replace(one, name=_name(some, what, taken), note=_note(some)))
        else:
            merged.append(some[0])
    return merged, replace(fit, theta=np.array(theta), jacobian=np.stack(columns, axis=1)), np.array(own)


def _signature(model: mujoco.MjModel, kind: str, name: str) -> Part:
    """What is the same of parts that are alike."""
    stem = tuple(piece for piece in pieces_of(name) if piece not in read_vocabulary().of("side"))
    if kind == "body":
        body = model.body(name)
        return (*stem, *body.mass.tolist(), *np.round(np.sort(body.inertia), 12).tolist())
    if kind == "actuator":
        index = model.actuator(name).id
        return _of_actuator(model, index)
    joint = model.joint(name).id
    dof = int(model.jnt_dofadr[joint])
    own = tuple(float(getattr(model, f)[dof if f.startswith("dof") else joint]) for f in _OF_JOINT)
    on_joint = int(mujoco.mjtTrn.mjTRN_JOINT)
    moved = (i for i in range(model.nu) if int(model.actuator_trntype[i]) == on_joint)
    motors = [_of_actuator(model, i) for i in moved if int(model.actuator_trnid[i, 0]) == joint]
    return (int(model.jnt_type[joint]), *own, *motors, *(() if any(own) else stem))


def _of_actuator(model: mujoco.MjModel, index: int) -> Part:
    return tuple(float(x) for field in _OF_ACTUATOR for x in getattr(model, f"actuator_{field}")[index])


def _name(some: Sequence[Unknown], what: str, taken: set[str]) -> str:
    """What the parts' names have in common, else the sort of them."""
    names = [unknown.name.removesuffix(f"_{what}") for unknown in some]
    stems = {tuple(piece for piece in pieces_of(name) if piece not in read_vocabulary().of("side")) for name in names}
    kind = some[0].targets[0].partition(":")[0]
    stem = "_".join(stems.pop()) if len(stems) == 1 else ""
    word = stem or {"body": "bodies"}.get(kind, f"{kind}s")
    tries = (f"{word}_{what}", *(f"{word}_{k}_{what}" for k in range(2, len(taken) + 3)))
    return next(name for name in tries if name not in taken)


def _note(some: Sequence[Unknown]) -> str:
    owners = [u.targets[0].rpartition(".")[0].partition(":")[2] for u in some]
    return f"{some[0].note}; one for {', '.join(owners)}, which are alike in the model: a table for each if they differ"
