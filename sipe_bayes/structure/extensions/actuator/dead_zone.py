"""A force of which the first bit moves nothing."""

from __future__ import annotations

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.structure.extension import Extension, members
from sipe_bayes.structure.machine import Machine


class DeadZone(Extension):
    """A force of which the first bit moves nothing, as an amplifier's or a valve's."""

    name, kind = "dead_zone", "actuator"
    reference = "G. Tao and P. V. Kokotovic 1996, Adaptive Control of Systems with Actuator and Sensor Nonlinearities"
    native = False
    nearest = "dry friction, where the actuator drives a joint"

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"a dead zone of {site}"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """Up to the usual force."""
        names = members(site)
        return (
            Parameter(
                f"{site}.dead_zone",
                0.0,
                max(machine.forces[name] for name in names),
                targets=tuple(f"actuator:{name}.dead_zone" for name in names),
                description="force of which nothing arrives",
            ),
        )

    def groups(self, machine: Machine) -> tuple[tuple[str, ...], ...]:
        """Actuators of one make."""
        return machine.alike
