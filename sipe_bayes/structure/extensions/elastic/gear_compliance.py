"""A gear or belt that gives way between a motor and its joint."""

from __future__ import annotations

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.envs.internal.elastic import Gear
from sipe_bayes.structure.elastic_sizes import elastic_sizes
from sipe_bayes.structure.extension import Extension
from sipe_bayes.structure.machine import Machine

_SIZES = 0.05, 0.15, 0.4  # of the softest spring: its effect is far from linear
_LOSS = 0.5


class GearCompliance(Extension):
    """A gear or belt that gives way between a motor and its joint.

    The position is measured behind it, at the joint.
    """

    name, kind = "gear_compliance", "joint"
    reference = "M. W. Spong 1987, Modeling and control of elastic joint robots, https://doi.org/10.1115/1.3143860"

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"a gear at {site} that gives way"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """From rigid to a spring whose resonance lies at twice the frequency of the motion; and its loss."""
        sizes = elastic_sizes(machine, site)
        if sizes is None:
            return ()
        joint = f"{site}.gear"
        compliance = Parameter(
            f"{site}.gear_compliance",
            0.0,
            sizes.most,
            targets=(f"joint:{joint}.compliance",),
            description="twist per force",
        )
        return (compliance, sizes.loss(joint, f"{site}.gear_compliance"))

    def edit(self, machine: Machine, site: str) -> Gear | None:
        """The spring."""
        sizes = elastic_sizes(machine, site)
        return None if sizes is None else Gear(site, sizes.elastic)

    def probes(self, machine: Machine, parameters: tuple[Parameter, ...]) -> FloatArray:
        """Three springs."""
        return np.array([[[size, _LOSS]] for size in _SIZES])
