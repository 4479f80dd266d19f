"""Drag of the medium that the machine moves in."""

from __future__ import annotations

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.structure.extension import Extension
from sipe_bayes.structure.machine import Machine

_DENSEST, _MOST_VISCOUS = 1200.0, 1.5  # kg/m^3 and Pa s: brine and glycerine


class MediumDrag(Extension):
    """Drag of the medium that the machine moves in.

    MuJoCo takes each body for the box or ellipsoid of its inertia.
    """

    name, kind = "medium_drag", "world"
    reference = "MuJoCo documentation, passive forces, option density and viscosity"

    def sentence(self, site: str) -> str:
        """What it is."""
        return "drag of the medium around it"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """From vacuum to brine, and to glycerine."""
        return (
            Parameter(
                "medium_density", 0.0, _DENSEST, targets=("option.density",), description="of the medium; air has 1.2"
            ),
            Parameter(
                "medium_viscosity",
                0.0,
                _MOST_VISCOUS,
                targets=("option.viscosity",),
                description="of the medium; air has 2e-5",
            ),
        )
