"""A link or shaft that gives way behind the joint where the position is measured."""

from __future__ import annotations

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.envs.internal.elastic import Link
from sipe_bayes.structure.elastic_sizes import elastic_sizes
from sipe_bayes.structure.extension import Extension
from sipe_bayes.structure.machine import Machine

_SIZES = 0.05, 0.15, 0.4  # of the softest spring: its effect is far from linear
_LOSS = 0.5


class LinkCompliance(Extension):
    """A link or shaft that gives way behind the joint where the position is measured.

    The position is measured before it, at the motor.
    """

    name, kind = "link_compliance", "joint"
    reference = "M. W. Spong 1987, Modeling and control of elastic joint robots, https://doi.org/10.1115/1.3143860"

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"a link or shaft that gives way behind {site}"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """From rigid to a spring whose resonance lies at twice the frequency of the motion; and its loss."""
        sizes = elastic_sizes(machine, site)
        if sizes is None:
            return ()
        joint = f"{site}.link"
        compliance = Parameter(
            f"{site}.link_compliance",
            0.0,
            sizes.most,
            targets=(f"joint:{joint}.compliance",),
            description="twist per force",
        )
        return (compliance, sizes.loss(joint, f"{site}.link_compliance"))

    def edit(self, machine: Machine, site: str) -> Link | None:
        """The spring."""
        sizes = elastic_sizes(machine, site)
        return None if sizes is None else Link(site, sizes.elastic)

    def probes(self, machine: Machine, parameters: tuple[Parameter, ...]) -> FloatArray:
        """Three springs."""
        return np.array([[[size, _LOSS]] for size in _SIZES])
