"""Friction along a tendon that is proportional to its velocity."""

from __future__ import annotations

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.structure.extension import Extension
from sipe_bayes.structure.machine import Machine


class TendonViscousFriction(Extension):
    """Friction along a tendon that is proportional to its velocity."""

    name, kind = "tendon_viscous_friction", "tendon"
    reference = "MuJoCo documentation, tendon damping"

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"viscous friction along {site}"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """Damping up to what would take the whole force at the usual speed."""
        sizes = machine.tendons[site]
        target = f"tendon:{site}.damping"
        return (
            Parameter(
                f"{site}.viscous_friction",
                0.0,
                2 * sizes.force / sizes.velocity,
                targets=(target,),
                description="force per velocity",
            ),
        )
