"""A force that falls short the more of it is asked for."""

from __future__ import annotations

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.structure.extension import Extension, members
from sipe_bayes.structure.machine import Machine


class ForceDrop(Extension):
    """A force that falls short the more of it is asked for."""

    name, kind = "force_drop", "actuator"
    reference = "-"
    native = False
    nearest = "actuator gain, at its mean over the motion"

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"a gain of {site} that changes with its force"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """Up to a half at twice the usual force."""
        names = members(site)
        most = 0.25 / max(machine.forces[name] for name in names)
        return (
            Parameter(
                f"{site}.force_drop",
                -most,
                most,
                targets=tuple(f"actuator:{name}.force_drop" for name in names),
                description="relative loss per force",
            ),
        )

    def groups(self, machine: Machine) -> tuple[tuple[str, ...], ...]:
        """Actuators of one make."""
        return machine.alike
