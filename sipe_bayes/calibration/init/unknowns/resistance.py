"""What resists a motion, as unknowns: friction, inertia of rotors and gears, and springs, of joints and of tendons."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from sipe_bayes.calibration.init.draft import Unknown, rounded_up
from sipe_bayes.calibration.init.unknowns.contacts import word_of
from sipe_bayes.calibration.machine import Actuator, Joint, Sizes


def of_joint(model: mujoco.MjModel, joint: Joint, sizes: Sizes, rotor: bool = True) -> list[Unknown]:
    """Friction, the inertia of a ``rotor`` and its gears, and the spring where the model has one."""
    dof = int(model.joint(joint.name).dofadr[0])
    own = {what: float(getattr(model, f"dof_{what}")[dof]) for what in _USUAL}
    spring = float(np.ravel(model.joint(joint.name).stiffness)[0])
    asked = tuple(what for what in _USUAL if rotor or what != "armature")
    return _unknowns(f"joint:{joint.name}", joint.name, {**own, "stiffness": spring}, sizes, asked)


def of_tendons(model: mujoco.MjModel, driven: Sequence[Actuator], sizes: Sizes) -> list[Unknown]:
    """Of tendons that are pulled what joints have; of others that move what the model gives them.

    What pulls at one joint alone over a fixed tendon is left to that joint, which it can not be told from.

    Args:
        model: as given.
        driven: the actuators that logs command.
        sizes: of the motion.
    """
    pulled = {int(model.actuator(a.name).trnid[0]) for a in driven if a.tendon}
    out = []
    for tendon in range(model.ntendon):
        name = model.tendon(tendon).name
        owner = f"tendon:{name}"
        if not name or owner not in sizes.inertia:
            continue
        own = {what: float(getattr(model, f"tendon_{what}")[tendon]) for what in (*_USUAL, "stiffness")}
        first = int(model.tendon_adr[tendon])
        by_joints = int(model.wrap_type[first]) == int(mujoco.mjtWrap.mjWRAP_JOINT)
        coupling = tendon in pulled and not (by_joints and int(model.tendon_num[tendon]) == 1)
        asked = tuple(what for what in _USUAL if coupling or own[what] > 0)
        out += _unknowns(owner, name, own, sizes, asked)
    return out


_USUAL = {"damping": "viscous friction", "frictionloss": "dry friction", "armature": "inertia of rotor and gears"}


def _unknowns(owner: str, name: str, own: dict[str, float], sizes: Sizes, asked: tuple[str, ...]) -> list[Unknown]:
    """What is asked for of a joint or tendon, up to sizes of the motion, and its spring where it has one."""
    key = name if owner.startswith("joint:") else owner
    force, speed, inertia = sizes.force[key], sizes.speed[key], sizes.inertia[key]
    usual, word = (
        {"damping": 0.5 * force / speed, "frictionloss": 0.4 * force, "armature": 0.6 * inertia},
        word_of(name),
    )
    out = [
        Unknown(
            f"{word}_{what}", (f"{owner}.{what}",), 0.0, rounded_up(max(4 * own[what], usual[what])), False,
            f"{_USUAL[what]}, {own[what]:g} in the model",
        )
        for what in asked
    ]  # fmt: skip
    if own["stiffness"] > 0:
        note = f"spring, {own['stiffness']:g} in the model"
        out.append(Unknown(f"{word}_stiffness", (f"{owner}.stiffness",), 0.5, 2.0, True, note))
    return out
