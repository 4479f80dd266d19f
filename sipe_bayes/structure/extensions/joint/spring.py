"""A spring, as an encoder cable or a hose is, with the place where it rests."""

from __future__ import annotations

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.structure.extension import PROBE, Extension
from sipe_bayes.structure.machine import Machine


class Spring(Extension):
    """A spring, as an encoder cable or a hose is, with the place where it rests."""

    name, kind = "spring", "joint"
    reference = "MuJoCo documentation, joint stiffness and springref"

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"a spring at {site}"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """Stiffness up to the usual force at the usual position, rest within twice that."""
        sizes = machine.joints[site]
        stiffness = Parameter(
            f"{site}.spring",
            0.0,
            2 * sizes.force / sizes.position,
            targets=(f"joint:{site}.stiffness",),
            description="stiffness of the spring",
        )
        rest = Parameter(
            f"{site}.spring_rest",
            -2 * sizes.position,
            2 * sizes.position,
            targets=(f"joint:{site}.springref",),
            description="where the spring rests",
        )
        return stiffness, rest

    def probes(self, machine: Machine, parameters: tuple[Parameter, ...]) -> FloatArray:
        """A weak spring that rests at either side: the force is a sum of the two."""
        return np.array([[PROBE, 0.25], [PROBE, 0.75]])
