"""Drag that grows with the square of the velocity."""

from __future__ import annotations

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.structure.extension import Extension
from sipe_bayes.structure.machine import Machine


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
