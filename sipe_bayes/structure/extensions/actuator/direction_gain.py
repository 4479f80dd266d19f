"""A force that is larger one way than the other, as a propeller's or a cylinder's."""

from __future__ import annotations

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.structure.extension import Extension, members
from sipe_bayes.structure.machine import Machine


class DirectionGain(Extension):
    """A force that is larger one way than the other, as a propeller's or a cylinder's."""

    name, kind = "direction_gain", "actuator"
    reference = "T. I. Fossen 2011, Handbook of Marine Craft Hydrodynamics and Motion Control"
    native = False
    nearest = "actuator gain, at its mean over the motion"

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"a gain of {site} that differs by direction"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """Up to a half either way."""
        return (
            Parameter(
                f"{site}.direction_gain",
                -0.5,
                0.5,
                targets=tuple(f"actuator:{name}.direction_gain" for name in members(site)),
                description="share of the force, more forward and less backward",
            ),
        )

    def groups(self, machine: Machine) -> tuple[tuple[str, ...], ...]:
        """Actuators of one make."""
        return machine.alike
