"""Extensions of gears, links and bases that give way."""

from __future__ import annotations

import mujoco
import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.envs.internal.elastic import Base, Elastic, Gear, Link
from sipe_bayes.structure.elastic_sizes import elastic_sizes
from sipe_bayes.structure.extension import Extension
from sipe_bayes.structure.machine import Machine

_COMPLIANCES = 0.05, 0.15, 0.4  # of the softest spring or base: the effect is far from linear
_LOSS = 0.5
_GAPS = 0.03, 0.1, 0.3  # of the widest gap: the effect is far from linear
_LIGHTEST, _HEAVIEST = 1.0, 30.0  # of the machine's mass
_SOFTEST = 2.0  # times the motion's own frequency: the lowest resonance under the machine alone
_LEAST_RANGE = 20.0  # of the softest spring to the stiffest that the physics step resolves
_LOSSES = 0.005, 0.3  # time constants, of the motion's own
_START = 0.3  # of the softest base's usual displacement, where windows may start


class GearCompliance(Extension):
    """A gear or belt that gives way between a motor and its joint.

    The position is measured behind it, at the joint.
    """

    name, kind = "gear_compliance", "joint"
    reference = "M. W. Spong 1987, Modeling and control of elastic joint robots, https://doi.org/10.1115/1.3143860"

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"gear compliance at {site}"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """From rigid to a spring whose resonance lies at twice the frequency of the motion; and its loss."""
        sizes = elastic_sizes(machine, site)
        if sizes is None:
            return ()
        joint = f"{site}.gear"
        compliance = Parameter(
            f"{site}.gear_compliance",
            0.0,
            sizes.most,
            targets=(f"joint:{joint}.compliance",),
            description="twist per force",
        )
        return (compliance, sizes.loss(joint, f"{site}.gear_compliance"))

    def edit(self, machine: Machine, site: str) -> Gear | None:
        """The spring."""
        sizes = elastic_sizes(machine, site)
        return None if sizes is None else Gear(site, sizes.elastic)

    def probes(self, machine: Machine, parameters: tuple[Parameter, ...]) -> FloatArray:
        """Three springs."""
        return np.array([[[size, _LOSS]] for size in _COMPLIANCES])


class LinkCompliance(Extension):
    """A link or shaft that gives way behind the joint where the position is measured.

    The position is measured before it, at the motor.
    """

    name, kind = "link_compliance", "joint"
    reference = "M. W. Spong 1987, Modeling and control of elastic joint robots, https://doi.org/10.1115/1.3143860"

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"link or shaft compliance behind {site}"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """From rigid to a spring whose resonance lies at twice the frequency of the motion; and its loss."""
        sizes = elastic_sizes(machine, site)
        if sizes is None:
            return ()
        joint = f"{site}.link"
        compliance = Parameter(
            f"{site}.link_compliance",
            0.0,
            sizes.most,
            targets=(f"joint:{joint}.compliance",),
            description="twist per force",
        )
        return (compliance, sizes.loss(joint, f"{site}.link_compliance"))

    def edit(self, machine: Machine, site: str) -> Link | None:
        """The spring."""
        sizes = elastic_sizes(machine, site)
        return None if sizes is None else Link(site, sizes.elastic)

    def probes(self, machine: Machine, parameters: tuple[Parameter, ...]) -> FloatArray:
        """Three springs."""
        return np.array([[[size, _LOSS]] for size in _COMPLIANCES])


class GearBacklash(Extension):
    """A gap in the gear between a motor and its joint.

    The position is measured behind it, at the joint.
    """

    name, kind = "gear_backlash", "joint"
    reference = "M. Nordin, P.-O. Gutman 2002, https://doi.org/10.1016/S0005-1098(02)00047-X"

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"backlash between the motor and {site}"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """Up to half the usual position."""
        sizes = elastic_sizes(machine, site)
        if sizes is None:
            return ()
        joint = f"{site}.gear"
        play = Parameter(
            f"{site}.gear_backlash",
            0.0,
            0.5 * machine.joints[site].position,
            targets=(f"joint:{joint}.play",),
            description="width of the gap",
        )
        return (play,)

    def edit(self, machine: Machine, site: str) -> Gear | None:
        """The spring."""
        sizes = elastic_sizes(machine, site)
        return None if sizes is None else Gear(site, sizes.elastic)

    def probes(self, machine: Machine, parameters: tuple[Parameter, ...]) -> FloatArray:
        """Three gaps."""
        return np.array([[[size]] for size in _GAPS])


class LinkBacklash(Extension):
    """A gap behind the joint where the position is measured.

    The position is measured before it, at the motor.
    """

    name, kind = "link_backlash", "joint"
    reference = "M. Nordin, P.-O. Gutman 2002, https://doi.org/10.1016/S0005-1098(02)00047-X"

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"backlash behind {site}"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """Up to half the usual position."""
        sizes = elastic_sizes(machine, site)
        if sizes is None:
            return ()
        joint = f"{site}.link"
        play = Parameter(
            f"{site}.link_backlash",
            0.0,
            0.5 * machine.joints[site].position,
            targets=(f"joint:{joint}.play",),
            description="width of the gap",
        )
        return (play,)

    def edit(self, machine: Machine, site: str) -> Link | None:
        """The spring."""
        sizes = elastic_sizes(machine, site)
        return None if sizes is None else Link(site, sizes.elastic)

    def probes(self, machine: Machine, parameters: tuple[Parameter, ...]) -> FloatArray:
        """Three gaps."""
        return np.array([[[size]] for size in _GAPS])


class BaseCompliance(Extension):
    """A base, such as a table or a frame, that moves sideways under the machine.

    Along x and y of the world, as soft and as heavy either way; of a machine with one root that is not free.
    """

    name, kind = "base_compliance", "world"
    reference = "-"

    def sentence(self, site: str) -> str:
        """What it is."""
        return "a base that moves under the machine"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """From rigid to a base whose resonance lies at twice the frequency of the motion; its mass and its loss."""
        edit = self.edit(machine, site)
        if edit is None:
            return ()
        mass, frequency = _mass(machine), _frequency(machine)
        least, most = (share / frequency for share in _LOSSES)
        return (
            Parameter(
                "base_compliance",
                0.0,
                1 / (mass * (_SOFTEST * frequency) ** 2),
                targets=_both("compliance"),
                description="displacement per force",
            ),
            Parameter(
                "base_mass",
                _LIGHTEST * mass,
                _HEAVIEST * mass,
                scale="log",
                targets=_both("compliance_inertia"),
                description="of what moves with the base",
            ),
            Parameter(
                "base_loss",
                least,
                most,
                scale="log",
                targets=_both("compliance_loss"),
                description="damping over stiffness",
            ),
        )

    def edit(self, machine: Machine, site: str) -> Base | None:
        """The base's joints."""
        model, roots = machine.model, _roots(machine.model)
        if len(roots) != 1 or not machine.joints:
            return None
        mass, frequency = _mass(machine), _frequency(machine)
        stiffest, softest = _LIGHTEST * mass / machine.timestep**2, mass * (_SOFTEST * frequency) ** 2
        if not model.body(roots[0]).name or stiffest < _LEAST_RANGE * softest:
            return None
        swing = max(_lever(machine, name, mass) * sizes.position for name, sizes in machine.joints.items())
        start = _START * swing * frequency**2 * mass / softest
        turn = np.empty(9)
        mujoco.mju_quat2Mat(turn, model.body_quat[roots[0]])
        axes = tuple(tuple(row) for row in turn.reshape(3, 3)[:2].tolist())  # the world's x and y in the body's frame
        elastic = Elastic(stiffest, mass, (start, start * _SOFTEST * frequency), inertia=mass)
        return Base(str(model.body(roots[0]).name), axes, elastic)

    def probes(self, machine: Machine, parameters: tuple[Parameter, ...]) -> FloatArray:
        """Three springs under a base of about five times the machine's mass."""
        return np.array([[[size, 0.5, 0.5]] for size in _COMPLIANCES])


def _both(attribute: str) -> tuple[str, ...]:
    return tuple(f"joint:base_{axis}.{attribute}" for axis in "xy")


def _roots(model: mujoco.MjModel) -> list[int]:
    """Bodies that move in the world by joints of their own; none where one of them is free."""
    roots = [b for b in range(1, model.nbody) if model.body_parentid[b] == 0 and model.body_jntnum[b] > 0]
    free = int(mujoco.mjtJoint.mjJNT_FREE)
    return [] if any(int(model.jnt_type[model.body_jntadr[b]]) == free for b in roots) else roots


def _lever(machine: Machine, joint: str, mass: float) -> float:
    """How far the machine's mass moves per unit of a joint's motion, at most."""
    return float(np.sqrt(machine.joints[joint].inertia / mass)) if machine.is_hinge(joint) else 1.0


def _mass(machine: Machine) -> float:
    """Of the machine, kg."""
    return float(machine.model.body_subtreemass[_roots(machine.model)[0]])


def _frequency(machine: Machine) -> float:
    """Of the fastest joint's motion, rad/s."""
    return max(sizes.velocity / sizes.position for sizes in machine.joints.values())
