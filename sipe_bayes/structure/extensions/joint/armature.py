"""Inertia of a rotor and its gears."""

from __future__ import annotations

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.structure.extension import Extension
from sipe_bayes.structure.machine import Machine


class Armature(Extension):
    """Inertia of a rotor and its gears."""

    name, kind = "armature", "joint"
    reference = "MuJoCo documentation, joint armature"

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"inertia of a rotor at {site}"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """Up to the inertia that the joint moves."""
        return (
            Parameter(
                f"{site}.armature",
                0.0,
                machine.joints[site].inertia,
                targets=(f"joint:{site}.armature",),
                description="reflected inertia",
            ),
        )
