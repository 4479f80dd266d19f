"""A torque that goes round with the rotor."""

from __future__ import annotations

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.structure.extension import PROBE, Extension
from sipe_bayes.structure.machine import Machine

_MOST = 60  # periods in a turn


class Cogging(Extension):
    """A torque that goes round with the rotor."""

    name, kind = "cogging", "actuator"
    reference = "MuJoCo documentation, actuator/dcmotor, cogging"
    native = False
    nearest = "actuator/dcmotor, cogging"

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"cogging at the joint of {site}"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """Up to a third of the usual force, with 1 to 60 poles."""
        joint = machine.joint_of(site)
        if joint is None or not machine.is_hinge(joint):
            return ()
        most, at = machine.joints[joint].force / 3, f"joint:{joint}"
        return (
            Parameter(f"{site}.cogging_sin", -most, most, targets=(f"{at}.cogging_sin",), description="sine part"),
            Parameter(f"{site}.cogging_cos", -most, most, targets=(f"{at}.cogging_cos",), description="cosine part"),
            Parameter(
                f"{site}.cogging_poles",
                1.0,
                float(_MOST),
                scale="log",
                targets=(f"{at}.cogging_poles",),
                description="periods in a turn",
            ),
        )

    def probes(self, machine: Machine, parameters: tuple[Parameter, ...]) -> FloatArray:
        """A little of either phase, for numbers of poles that the motion's range tells apart."""
        range_of = 2 * machine.joints[parameters[0].targets[0].removeprefix("joint:").rpartition(".")[0]].position
        apart = max(np.pi / max(range_of, 0.1) / 1.5, 1.0)  # whole periods, or as far as the range tells apart
        poles = np.log(np.arange(1.0, _MOST, apart)) / np.log(_MOST)
        phases = ((PROBE, 0.0), (0.0, PROBE))
        return np.array([[[0.5 + a, 0.5 + b, n] for a, b in phases] for n in poles])
