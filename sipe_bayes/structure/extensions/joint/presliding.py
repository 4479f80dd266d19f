"""Dry friction that is built up over a small distance: at rest the joint is held by a spring."""

from __future__ import annotations

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.structure.extension import PROBE, Extension
from sipe_bayes.structure.machine import Machine


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
