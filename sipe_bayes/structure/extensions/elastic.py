"""Gears, links and bases that give way: their parameters, and the edits that bring them.

Between a motor without inertia and its joint nothing can give way that shows: where the model has no armature there,
the extension ``armature`` is found first, and these beside it. A base moves along x and y of the world, as soft and as
heavy either way.
"""

from __future__ import annotations

import mujoco
import numpy as np

from sipe_bayes.envs.internal.elastic import Base, Elastic, Gear, Link
from sipe_bayes.structure.extensions.row import Unknown
from sipe_bayes.structure.machine import Machine

_SOFTEST = 2.0  # times the motion's own frequency: the lowest resonance, of a base under the machine alone
_LEAST_RANGE = 20.0  # of the softest spring to the stiffest that the physics step resolves
_LOSSES = 0.005, 0.3  # time constants, of the motion's own


def compliance(side: str, machine: Machine, site: str) -> tuple[Unknown, ...]:
    """From rigid to a spring whose resonance lies at twice the frequency of the motion; and its loss."""
    if (elastic := _elastic(machine, site)) is None:
        return ()
    softest, losses = elastic[1:]
    return (
        Unknown(f"{side}_compliance", 0.0, 1 / softest, "twist per force", f"{side}.compliance"),
        Unknown(f"{side}_compliance_loss", *losses, "damping over stiffness", f"{side}.compliance_loss", "log"),
    )


def backlash(side: str, machine: Machine, site: str) -> tuple[Unknown, ...]:
    """Up to half the usual position."""
    most = 0.5 * machine.joints[site].position
    gap = Unknown(f"{side}_backlash", 0.0, most, "width of the gap", f"{side}.play")
    return () if _elastic(machine, site) is None else (gap,)


def spring(kind: type[Gear] | type[Link], machine: Machine, site: str) -> Gear | Link | None:
    """The edit of a gear or a link."""
    elastic = _elastic(machine, site)
    return None if elastic is None else kind(site, elastic[0])


def _elastic(machine: Machine, site: str) -> tuple[Elastic, float, tuple[float, float]] | None:
    """What the elastic joint begins with, its softest spring in N m/rad or N/m, and the ends of its loss in s.

    None where no motor drives the joint or the physics step is too long for any spring.
    """
    if all(machine.joint_of(actuator) != site for actuator in machine.environment.actuators):
        return None
    sizes, model = machine.joints[site], machine.model
    own = float(model.dof_armature[int(model.joint(site).dofadr[0])])
    rotor = own or 0.2 * sizes.inertia  # the motor's share of what the joint moves, where the model has none
    link = max(sizes.inertia - own, 0.1 * sizes.inertia)
    reduced, frequency = rotor * link / (rotor + link), sizes.velocity / sizes.position
    stiffest, softest = reduced / machine.timestep**2, reduced * (_SOFTEST * frequency) ** 2
    if stiffest < _LEAST_RANGE * softest:
        return None
    twist = 0.05 * sizes.force / softest  # of the softest spring's usual one, where windows may start
    start = (min(twist, sizes.position), min(twist * _SOFTEST * frequency, sizes.velocity))
    low, high = (share / frequency for share in _LOSSES)
    return Elastic(stiffest, reduced, start, loss=(low * high) ** 0.5), softest, (low, high)


def base(machine: Machine, site: str) -> tuple[Unknown, ...]:
    """From rigid to a base whose resonance lies at twice the frequency of the motion; its mass and its loss."""
    if base_joints(machine, site) is None:
        return ()
    mass, frequency, softest = _swaying(machine, *_roots(machine.model))
    low, high = (share / frequency for share in _LOSSES)
    names = ("compliance", "compliance_inertia", "compliance_loss")
    spring, inertia, loss = (tuple(f"joint:base_{axis}.{name}" for axis in "xy") for name in names)
    return (
        Unknown("base_compliance", 0.0, 1 / softest, "displacement per force", spring),
        Unknown("base_mass", mass, 30 * mass, "of what moves with the base", inertia, "log"),
        Unknown("base_loss", low, high, "damping over stiffness", loss, "log"),
    )


def base_joints(machine: Machine, site: str) -> Base | None:
    """The edit of a base; None of a machine with several roots, or a free one, or without joints."""
    model, roots = machine.model, _roots(machine.model)
    if len(roots) != 1 or not machine.joints:
        return None
    mass, frequency, softest = _swaying(machine, *roots)
    stiffest, name = mass / machine.timestep**2, str(model.body(roots[0]).name)
    if not name or stiffest < _LEAST_RANGE * softest:
        return None
    swing = 0.0  # how far the machine's mass moves, at most
    for joint, sizes in machine.joints.items():
        lever = float(np.sqrt(sizes.inertia / mass)) if machine.is_hinge(joint) else 1.0
        swing = max(swing, lever * sizes.position)
    start = 0.3 * swing * frequency**2 * mass / softest  # of the softest base's usual displacement
    turn = np.empty(9)
    mujoco.mju_quat2Mat(turn, model.body_quat[roots[0]])
    axes = tuple(tuple(row) for row in turn.reshape(3, 3)[:2].tolist())  # the world's x and y in the body's frame
    return Base(name, axes, Elastic(stiffest, mass, (start, start * _SOFTEST * frequency), inertia=mass))


def _roots(model: mujoco.MjModel) -> list[int]:
    """Bodies that move in the world by joints of their own; none where one of them is free."""
    roots = [b for b in range(1, model.nbody) if model.body_parentid[b] == 0 and model.body_jntnum[b] > 0]
    free = int(mujoco.mjtJoint.mjJNT_FREE)
    return [] if any(int(model.jnt_type[model.body_jntadr[b]]) == free for b in roots) else roots


def _swaying(machine: Machine, root: int) -> tuple[float, float, float]:
    """The machine's mass, kg, its fastest joint's frequency, rad/s, and the stiffness of the softest base, N/m."""
    mass = float(machine.model.body_subtreemass[root])
    frequency = max(sizes.velocity / sizes.position for sizes in machine.joints.values())
    return mass, frequency, mass * (_SOFTEST * frequency) ** 2
