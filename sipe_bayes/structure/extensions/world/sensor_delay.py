"""A measurement that comes late."""

from __future__ import annotations

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.structure.extension import Extension, members
from sipe_bayes.structure.machine import Machine


class SensorDelay(Extension):
    """A measurement that comes late.

    MuJoCo knows no such sensor: sipe_bayes does it to what is simulated.
    """

    name, kind = "sensor_delay", "channel"
    reference = "-"
    native = False

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"a delay of the measurement {site}"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """Up to a tenth of a second, or twenty samples."""
        return (
            Parameter(
                f"{site}.delay",
                0.0,
                self.memory(machine.dt),
                targets=tuple(f"sensor:{name}.delay" for name in members(site)),
                description="age of the measurement",
            ),
        )

    def memory(self, dt: float) -> float:
        """The longest delay."""
        return min(0.1, 20 * dt)

    def imitators(self, site: str) -> tuple[str, ...]:
        """A low-pass filter."""
        return tuple(f"sensor:{name}.filter" for name in members(site))
