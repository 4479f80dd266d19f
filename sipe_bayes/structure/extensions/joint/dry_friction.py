"""Friction whose size does not depend on the velocity."""

from __future__ import annotations

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.structure.extension import Extension
from sipe_bayes.structure.machine import Machine


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
