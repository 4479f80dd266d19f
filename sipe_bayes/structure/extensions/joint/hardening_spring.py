"""A spring whose stiffness changes with its displacement."""

from __future__ import annotations

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.structure.extension import Extension
from sipe_bayes.structure.machine import Machine


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
