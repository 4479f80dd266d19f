"""Dry friction that is larger at low speed."""

from __future__ import annotations

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.structure.extension import PROBE, Extension
from sipe_bayes.structure.machine import Machine


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
