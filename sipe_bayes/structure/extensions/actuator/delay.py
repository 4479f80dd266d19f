"""A command that takes effect late."""

from __future__ import annotations

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.structure.extension import Extension, members
from sipe_bayes.structure.machine import Machine


class Delay(Extension):
    """A command that takes effect late."""

    name, kind = "delay", "actuator"
    reference = "MuJoCo documentation, actuator delay"

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"a delay of {site}"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """Up to a tenth of a second, or twenty samples."""
        return (
            Parameter(
                f"{site}.delay",
                0.0,
                min(0.1, 20 * machine.dt),
                targets=tuple(f"actuator:{name}.delay" for name in members(site)),
                description="from command to force",
            ),
        )

    def groups(self, machine: Machine) -> tuple[tuple[str, ...], ...]:
        """Actuators of one make."""
        return machine.alike

    def imitators(self, site: str) -> tuple[str, ...]:
        """A first-order lag."""
        return tuple(f"actuator:{name}.lag" for name in members(site))

    def probes(self, machine: Machine, parameters: tuple[Parameter, ...]) -> FloatArray:
        """One sample, and at least two physics steps."""
        (delay,) = parameters
        return np.array([[max(machine.dt, 2 * machine.timestep) / delay.high]])
