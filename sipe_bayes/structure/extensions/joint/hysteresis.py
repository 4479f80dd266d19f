"""A force that lags behind the position, as of belts, cables and rubber."""

from __future__ import annotations

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.structure.extension import PROBE, Extension
from sipe_bayes.structure.machine import Machine


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
