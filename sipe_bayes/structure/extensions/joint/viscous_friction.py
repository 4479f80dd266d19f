"""Friction proportional to the velocity."""

from __future__ import annotations

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.structure.extension import Extension
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
