"""Friction that differs by direction."""

from __future__ import annotations

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.structure.extension import Extension
from sipe_bayes.structure.machine import Machine


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
