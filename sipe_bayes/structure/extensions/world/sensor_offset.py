"""A zero error of a measurement."""

from __future__ import annotations

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.structure.extension import Extension
from sipe_bayes.structure.machine import Machine


class SensorOffset(Extension):
    """A zero error of a measurement."""

    name, kind = "sensor_offset", "channel"
    reference = "-"

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"a zero error of {site}"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """Up to a half of what the channel measures."""
        most = machine.channels[site] / 2
        return (
            Parameter(
                f"{site}.offset", -most, most, targets=(f"sensor:{site}.bias",), description="added to the measurement"
            ),
        )
