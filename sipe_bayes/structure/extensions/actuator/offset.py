"""A zero error of the command."""

from __future__ import annotations

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.structure.extension import Extension
from sipe_bayes.structure.machine import Machine


class Offset(Extension):
    """A zero error of the command."""

    name, kind = "offset", "actuator"
    reference = "-"

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"an offset of {site}"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """Up to the largest command, either way."""
        size = machine.commands[site] or 1.0
        return (
            Parameter(
                f"{site}.offset",
                -size,
                size,
                targets=(f"actuator:{site}.offset",),
                description="added to the command",
            ),
        )
