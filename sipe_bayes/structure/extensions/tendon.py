"""Extensions at a tendon."""

from __future__ import annotations

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.structure.extension import PROBE, Extension
from sipe_bayes.structure.machine import Machine


class TendonViscousFriction(Extension):
    """Friction along a tendon that is proportional to its velocity."""

    name, kind = "tendon_viscous_friction", "tendon"
    reference = "MuJoCo documentation, tendon damping"

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"viscous friction along {site}"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """Damping up to what would take the whole force at the usual speed."""
        sizes = machine.tendons[site]
        target = f"tendon:{site}.damping"
        return (
            Parameter(
                f"{site}.viscous_friction",
                0.0,
                2 * sizes.force / sizes.velocity,
                targets=(target,),
                description="force per velocity",
            ),
        )


class TendonDryFriction(Extension):
    """Dry friction along a tendon, as of a cable in its sheath or over its pulleys."""

    name, kind = "tendon_dry_friction", "tendon"
    reference = "MuJoCo documentation, tendon frictionloss"

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"dry friction along {site}"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """Up to the usual force."""
        sizes = machine.tendons[site]
        target = f"tendon:{site}.frictionloss"
        return (
            Parameter(f"{site}.dry_friction", 0.0, sizes.force, targets=(target,), description="level of dry friction"),
        )


class TendonSpring(Extension):
    """A spring along a tendon, with the length at which it rests; none where the model's rests over a range."""

    name, kind = "tendon_spring", "tendon"
    reference = "MuJoCo documentation, tendon stiffness and springlength"

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"a spring along {site}"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """Stiffness up to the usual force over the usual stretch, rest within twice that about the mean length."""
        sizes = machine.tendons[site]
        stiffness = Parameter(
            f"{site}.spring",
            0.0,
            2 * sizes.force / sizes.stretch,
            targets=(f"tendon:{site}.stiffness",),
            description="stiffness of the spring",
        )
        rest = Parameter(
            f"{site}.spring_rest",
            max(sizes.length - 2 * sizes.stretch, sizes.least),
            sizes.length + 2 * sizes.stretch,
            targets=(f"tendon:{site}.springlength",),
            description="length at which the spring rests",
        )
        return stiffness, rest

    def probes(self, machine: Machine, parameters: tuple[Parameter, ...]) -> FloatArray:
        """A weak spring that rests at either side: the force is a sum of the two."""
        return np.array([[PROBE, 0.25], [PROBE, 0.75]])
