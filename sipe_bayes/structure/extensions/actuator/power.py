"""A force that goes with a power of its command, as a propeller's with the square of its speed."""

from __future__ import annotations

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.structure.extension import PROBE, Extension, members
from sipe_bayes.structure.machine import Machine

_MOST, _FORCES = 2.5, 5.0


class Power(Extension):
    """A force that goes with a power of its command, as a propeller's with the square of its speed."""

    name, kind = "power", "actuator"
    reference = "T. I. Fossen 2011, Handbook of Marine Craft Hydrodynamics and Motion Control"
    native = False
    nearest = "actuator gain, at its mean over the motion"

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"a force of {site} that goes with a power of its command"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """From a root to more than the square; a fifth to five times of the usual force is the model's."""
        names = members(site)
        usual = max(machine.forces[name] for name in names)
        return (
            Parameter(
                f"{site}.exponent",
                1 / _MOST,
                _MOST,
                scale="log",
                targets=tuple(f"actuator:{name}.exponent" for name in names),
                description="power of the command that the force goes with",
            ),
            Parameter(
                f"{site}.exponent_force",
                usual / _FORCES,
                usual * _FORCES,
                scale="log",
                targets=tuple(f"actuator:{name}.exponent_force" for name in names),
                description="force that is the model's whatever the power",
            ),
        )

    def groups(self, machine: Machine) -> tuple[tuple[str, ...], ...]:
        """Actuators of one make."""
        return machine.alike

    def probes(self, machine: Machine, parameters: tuple[Parameter, ...]) -> FloatArray:
        """A power a little above one, about the usual force."""
        return np.array([[0.5 + PROBE, 0.5]])
