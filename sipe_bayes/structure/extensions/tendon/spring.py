"""A spring along a tendon, as a cable that stretches over a return spring, with the length at which it rests."""

from __future__ import annotations

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.structure.extension import PROBE, Extension
from sipe_bayes.structure.machine import Machine


class TendonSpring(Extension):
    """A spring along a tendon, with the length at which it rests; none where the model's rests over a range."""

    name, kind = "tendon_spring", "tendon"
    reference = "MuJoCo documentation, tendon stiffness and springlength"

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"a spring along {site}"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """Stiffness up to the usual force over the usual stretch, rest within twice that about the mean length."""
        sizes = machine.tendons[site]
        stiffness = Parameter(
            f"{site}.spring",
            0.0,
            2 * sizes.force / sizes.stretch,
            targets=(f"tendon:{site}.stiffness",),
            description="stiffness of the spring",
        )
        rest = Parameter(
            f"{site}.spring_rest",
            max(sizes.length - 2 * sizes.stretch, sizes.least),
            sizes.length + 2 * sizes.stretch,
            targets=(f"tendon:{site}.springlength",),
            description="length at which the spring rests",
        )
        return stiffness, rest

    def probes(self, machine: Machine, parameters: tuple[Parameter, ...]) -> FloatArray:
        """A weak spring that rests at either side: the force is a sum of the two."""
        return np.array([[PROBE, 0.25], [PROBE, 0.75]])
