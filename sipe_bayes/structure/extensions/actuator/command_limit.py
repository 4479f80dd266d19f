"""A command that goes no further: a set-point that is limited, or a duty."""

from __future__ import annotations

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.structure.extension import Extension
from sipe_bayes.structure.machine import Machine

_LEAST = 0.1  # of the largest command
_SIZES = 0.9, 0.7, 0.5  # of it: a limit that is never met has no effect


class CommandLimit(Extension):
    """A command that goes no further: a set-point that is limited, or a duty.

    Of an actuator whose force depends on the motion too; elsewhere it is a limit of the force.
    """

    name, kind = "command_limit", "actuator"
    reference = "MuJoCo documentation, actuator ctrlrange"

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"a limit of the command of {site}"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """From a tenth of the largest command to all of it."""
        largest = machine.commands[site]
        if not largest or not machine.is_position(site):
            return ()
        return (
            Parameter(
                f"{site}.command_limit",
                _LEAST * largest,
                largest,
                targets=(f"actuator:{site}.command_limit",),
                description="largest command either way",
            ),
        )

    def probes(self, machine: Machine, parameters: tuple[Parameter, ...]) -> FloatArray:
        """At three shares of the largest command."""
        (limit,) = parameters
        return np.array([[[float(limit.normalise(share * limit.high))]] for share in _SIZES])
