"""A measurement that is a factor off."""

from __future__ import annotations

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.structure.extension import Extension
from sipe_bayes.structure.machine import Machine


class SensorScale(Extension):
    """A measurement that is a factor off.

    MuJoCo knows no such sensor: sipe_bayes does it to what is simulated.
    """

    name, kind = "sensor_scale", "channel"
    reference = "-"
    native = False

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"a factor of {site}"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """Around one, with a normal prior of a fifth."""
        return (
            Parameter(
                f"{site}.scale",
                0.5,
                1.5,
                targets=(f"sensor:{site}.scale",),
                prior_mean=1.0,
                prior_sd=0.2,
                description="measured for what there is",
            ),
        )
