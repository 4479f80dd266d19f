"""A force that goes no further."""

from __future__ import annotations

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.structure.extension import Extension
from sipe_bayes.structure.machine import Machine


class ForceLimit(Extension):
    """A force that goes no further."""

    name, kind = "force_limit", "actuator"
    reference = "MuJoCo documentation, actuator forcerange"

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"a limit of the force of {site}"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """From a third of the usual force to five times of it."""
        usual = machine.forces[site]
        return (
            Parameter(
                f"{site}.force_limit",
                usual / 3,
                5 * usual,
                targets=(f"actuator:{site}.force_limit",),
                description="largest force either way",
            ),
        )

    def probes(self, machine: Machine, parameters: tuple[Parameter, ...]) -> FloatArray:
        """At the usual force and a third above: a limit that is never met has no effect."""
        return np.array([[[0.143]], [[0.214]], [[0.3]]])
