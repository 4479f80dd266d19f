"""A gap in the gear between a motor and its joint."""

from __future__ import annotations

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.envs.internal.elastic import Gear
from sipe_bayes.structure.elastic_sizes import elastic_sizes
from sipe_bayes.structure.extension import Extension
from sipe_bayes.structure.machine import Machine

_SIZES = 0.03, 0.1, 0.3  # of the widest gap: its effect is far from linear


class GearBacklash(Extension):
    """A gap in the gear between a motor and its joint.

    The position is measured behind it, at the joint.
    """

    name, kind = "gear_backlash", "joint"
    reference = "M. Nordin, P.-O. Gutman 2002, https://doi.org/10.1016/S0005-1098(02)00047-X"

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"backlash between the motor and {site}"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """Up to half the usual position."""
        sizes = elastic_sizes(machine, site)
        if sizes is None:
            return ()
        joint = f"{site}.gear"
        play = Parameter(
            f"{site}.gear_backlash",
            0.0,
            0.5 * machine.joints[site].position,
            targets=(f"joint:{joint}.play",),
            description="width of the gap",
        )
        return (play,)

    def edit(self, machine: Machine, site: str) -> Gear | None:
        """The spring."""
        sizes = elastic_sizes(machine, site)
        return None if sizes is None else Gear(site, sizes.elastic)

    def probes(self, machine: Machine, parameters: tuple[Parameter, ...]) -> FloatArray:
        """Three gaps."""
        return np.array([[[size]] for size in _SIZES])
