"""Extensions at joints."""

from __future__ import annotations

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.structure.extension import PROBE, Extension
from sipe_bayes.structure.machine import Machine


class ViscousFriction(Extension):
    """Friction proportional to the velocity."""

    name, kind = "viscous_friction", "joint"
    reference = "MuJoCo documentation, joint damping"

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"viscous friction at {site}"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """Damping up to what would take the whole force at the usual speed."""
        sizes = machine.joints[site]
        return (
            Parameter(
                f"{site}.viscous_friction",
                0.0,
                2 * sizes.force / sizes.velocity,
                targets=(f"joint:{site}.damping",),
                description="force per velocity",
            ),
        )


class DryFriction(Extension):
    """Friction whose size does not depend on the velocity."""

    name, kind = "dry_friction", "joint"
    reference = "C. A. Coulomb 1785, Theorie des machines simples"

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"dry friction at {site}"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """Up to the usual force."""
        return (
            Parameter(
                f"{site}.dry_friction",
                0.0,
                machine.joints[site].force,
                targets=(f"joint:{site}.frictionloss",),
                description="level of dry friction",
            ),
        )


class Armature(Extension):
    """Inertia of a rotor and its gears."""

    name, kind = "armature", "joint"
    reference = "MuJoCo documentation, joint armature"

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"inertia of a rotor at {site}"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """Up to the inertia that the joint moves."""
        return (
            Parameter(
                f"{site}.armature",
                0.0,
                machine.joints[site].inertia,
                targets=(f"joint:{site}.armature",),
                description="reflected inertia",
            ),
        )


class QuadraticDamping(Extension):
    """Drag that grows with the square of the velocity."""

    name, kind = "quadratic_damping", "joint"
    reference = "MuJoCo documentation, polynomial forces"

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"drag (quadratic in the velocity) at {site}"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """Up to what would take the whole force at the usual speed."""
        sizes = machine.joints[site]
        return (
            Parameter(
                f"{site}.quadratic_damping",
                0.0,
                sizes.force / sizes.velocity**2,
                targets=(f"joint:{site}.damping_quadratic",),
                description="force per squared velocity",
            ),
        )


class CubicDamping(Extension):
    """Friction that grows with the cube of the velocity."""

    name, kind = "cubic_damping", "joint"
    reference = "MuJoCo documentation, polynomial forces"

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"drag (cubic in the velocity) at {site}"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """Up to what would take the whole force at the usual speed."""
        sizes = machine.joints[site]
        return (
            Parameter(
                f"{site}.cubic_damping",
                0.0,
                sizes.force / sizes.velocity**3,
                targets=(f"joint:{site}.damping_cubic",),
                description="force per cubed velocity",
            ),
        )


class Spring(Extension):
    """A spring, as an encoder cable or a hose is, with the place where it rests."""

    name, kind = "spring", "joint"
    reference = "MuJoCo documentation, joint stiffness and springref"

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"a spring at {site}"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """Stiffness up to the usual force at the usual position, rest within twice that."""
        sizes = machine.joints[site]
        stiffness = Parameter(
            f"{site}.spring",
            0.0,
            2 * sizes.force / sizes.position,
            targets=(f"joint:{site}.stiffness",),
            description="stiffness of the spring",
        )
        rest = Parameter(
            f"{site}.spring_rest",
            -2 * sizes.position,
            2 * sizes.position,
            targets=(f"joint:{site}.springref",),
            description="where the spring rests",
        )
        return stiffness, rest

    def probes(self, machine: Machine, parameters: tuple[Parameter, ...]) -> FloatArray:
        """A weak spring that rests at either side: the force is a sum of the two."""
        return np.array([[PROBE, 0.25], [PROBE, 0.75]])


class HardeningSpring(Extension):
    """A spring whose stiffness changes with its displacement."""

    name, kind = "hardening_spring", "joint"
    reference = "MuJoCo documentation, polynomial forces"

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"a spring that hardens at {site}"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """The force at twice the usual position stays within the usual one."""
        sizes = machine.joints[site]
        quadratic, cubic = sizes.force / sizes.position**2, sizes.force / sizes.position**3
        return (
            Parameter(
                f"{site}.spring_quadratic",
                -quadratic,
                quadratic,
                targets=(f"joint:{site}.stiffness_quadratic",),
                description="force per squared position",
            ),
            Parameter(
                f"{site}.spring_cubic",
                -cubic,
                cubic,
                targets=(f"joint:{site}.stiffness_cubic",),
                description="force per cubed position",
            ),
        )


class DirectionFriction(Extension):
    """Friction that differs by direction."""

    name, kind = "direction_friction", "joint"
    reference = "B. Armstrong-Helouvry, P. Dupont, C. Canudas de Wit 1994, https://doi.org/10.1016/0005-1098(94)90209-7"
    native = False
    nearest = "joint frictionloss and damping, alike both ways"

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"friction at {site} that differs by direction"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """Half the differences of dry and of viscous friction."""
        sizes = machine.joints[site]
        dry, viscous = sizes.force / 2, sizes.force / sizes.velocity
        return (
            Parameter(
                f"{site}.direction_friction",
                -dry,
                dry,
                targets=(f"joint:{site}.direction_friction",),
                description="half the difference of dry friction forwards and backwards",
            ),
            Parameter(
                f"{site}.direction_damping",
                -viscous,
                viscous,
                targets=(f"joint:{site}.direction_damping",),
                description="half the difference of viscous friction forwards and backwards",
            ),
        )


class Stribeck(Extension):
    """Dry friction that is larger at low speed."""

    name, kind = "stribeck", "joint"
    reference = "R. Stribeck 1902; H. Olsson et al. 1998, https://doi.org/10.1016/S0947-3580(98)70113-X"
    native = False
    nearest = 'actuator/dcmotor with input="none", LuGre friction'

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"friction at {site} that is larger at low speed (Stribeck)"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """Excess up to the usual force, at speeds from a hundredth of the usual one up to it."""
        sizes = machine.joints[site]
        return (
            Parameter(
                f"{site}.stribeck_friction",
                0.0,
                sizes.force,
                targets=(f"joint:{site}.stribeck_friction",),
                description="dry friction at rest above that at speed",
            ),
            Parameter(
                f"{site}.stribeck_velocity",
                0.01 * sizes.velocity,
                sizes.velocity,
                scale="log",
                targets=(f"joint:{site}.stribeck_velocity",),
                description="speed at which it has mostly gone",
            ),
        )

    def probes(self, machine: Machine, parameters: tuple[Parameter, ...]) -> FloatArray:
        """A little of it, at three shares of the usual speed."""
        return np.array([[[PROBE, 0.25]], [[PROBE, 0.5]], [[PROBE, 0.75]]])


class Presliding(Extension):
    """Dry friction that is built up over a small distance: at rest the joint is held by a spring."""

    name, kind = "presliding", "joint"
    reference = (
        "P. R. Dahl 1968, A solid friction model; C. Canudas de Wit et al. 1995, https://doi.org/10.1109/9.376053"
    )
    native = False
    nearest = 'actuator/dcmotor with input="none", LuGre friction'

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"friction at {site} that is built up over a small distance (presliding)"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """Friction up to the usual force, built up within a thousandth to a fifth of the usual distance."""
        sizes, step = machine.joints[site], machine.timestep
        stiffest = sizes.force * step**2 / sizes.inertia
        most = 0.2 * sizes.position
        return (
            Parameter(
                f"{site}.presliding_friction",
                0.0,
                sizes.force,
                targets=(f"joint:{site}.presliding_friction",),
                description="level of dry friction",
            ),
            Parameter(
                f"{site}.presliding_range",
                min(max(0.001 * sizes.position, stiffest), most / 2),
                most,
                scale="log",
                targets=(f"joint:{site}.presliding_range",),
                description="distance over which it is built up",
            ),
        )

    def probes(self, machine: Machine, parameters: tuple[Parameter, ...]) -> FloatArray:
        """A little of it, over three distances."""
        return np.array([[[PROBE, 0.2]], [[PROBE, 0.5]], [[PROBE, 0.8]]])


class Hysteresis(Extension):
    """A force that lags behind the position, as of belts, cables and rubber."""

    name, kind = "hysteresis", "joint"
    reference = "W. D. Iwan 1966; F. Al-Bender, V. Lampaert, J. Swevers 2005, https://doi.org/10.1109/TAC.2005.858676"
    native = False
    nearest = "joint springyield, one elasto-plastic spring"

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"hysteresis at {site}, a force that lags behind the position"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """Up to the usual force, which elasto-plastic springs reach between a fiftieth and twice the usual distance."""
        sizes, step = machine.joints[site], machine.timestep
        stiffest = sizes.force * step**2 / sizes.inertia
        most = 2.0 * sizes.position
        return (
            Parameter(
                f"{site}.hysteresis_force",
                0.0,
                sizes.force,
                targets=(f"joint:{site}.hysteresis_force",),
                description="largest force either way",
            ),
            Parameter(
                f"{site}.hysteresis_range",
                min(max(0.02 * sizes.position, stiffest), most / 2),
                most,
                scale="log",
                targets=(f"joint:{site}.hysteresis_range",),
                description="distance at which the second of three springs gives way",
            ),
        )

    def probes(self, machine: Machine, parameters: tuple[Parameter, ...]) -> FloatArray:
        """A little of it, over three distances."""
        return np.array([[[PROBE, 0.2]], [[PROBE, 0.5]], [[PROBE, 0.8]]])


class LoadFriction(Extension):
    """Dry friction that grows with the torque that the joint passes on."""

    name, kind = "load_friction", "joint"
    reference = "M. Duclusaud et al. 2024, https://arxiv.org/abs/2410.08650"
    native = False
    nearest = "joint frictionloss, at its mean over the motion"

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"friction at {site} that grows with its load"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """A share of the transmitted torque."""
        return (
            Parameter(
                f"{site}.load_friction",
                0.0,
                1.0,
                targets=(f"joint:{site}.load_friction",),
                description="share of the transmitted torque",
            ),
        )
