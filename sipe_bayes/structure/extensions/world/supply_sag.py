"""A supply whose voltage falls with the currents of all motors."""

from __future__ import annotations

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.structure.extension import Extension
from sipe_bayes.structure.machine import Machine


class SupplySag(Extension):
    """A supply whose voltage falls with the currents of all motors.

    One motor by itself has a force that falls short the more of it is asked for: ``force_drop``.
    """

    name, kind = "supply_sag", "world"
    reference = "-"
    native = False
    nearest = "actuator gain, at its mean over the motion"

    def sentence(self, site: str) -> str:
        """What it is."""
        return "a supply whose voltage falls with the force of all motors"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """Up to a half of every force at the usual ones of all."""
        driving = [a for a in machine.environment.actuators if machine.joint_of(a) is not None]
        if len(driving) < 2:
            return ()
        return (
            Parameter(
                "supply_sag",
                0.0,
                0.5 / sum(machine.forces[a] for a in driving),
                targets=tuple(f"actuator:{a}.supply_sag" for a in driving),
                description="relative loss of every force per force of all",
            ),
        )
