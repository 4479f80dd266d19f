"""A measurement that has gone through a first-order low-pass filter."""

from __future__ import annotations

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.structure.extension import Extension, members
from sipe_bayes.structure.machine import Machine


class SensorFilter(Extension):
    """A measurement that has gone through a first-order low-pass filter.

    MuJoCo knows no such sensor: sipe_bayes does it to what is simulated.
    """

    name, kind = "sensor_filter", "channel"
    reference = "-"
    native = False

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"a low-pass filter of {site}"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """Up to a tenth of a second, or twenty samples."""
        return (
            Parameter(
                f"{site}.filter",
                0.0,
                self._slowest(machine.dt),
                targets=tuple(f"sensor:{name}.filter" for name in members(site)),
                description="time constant of a low-pass filter",
            ),
        )

    def memory(self, dt: float) -> float:
        """Three of the longest time constants."""
        return 3 * self._slowest(dt)

    @staticmethod
    def _slowest(dt: float) -> float:
        return min(0.1, 20 * dt)

    def imitators(self, site: str) -> tuple[str, ...]:
        """A delay."""
        return tuple(f"sensor:{name}.delay" for name in members(site))
