"""Dry friction that grows with the torque that the joint passes on."""

from __future__ import annotations

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.structure.extension import Extension
from sipe_bayes.structure.machine import Machine


class LoadFriction(Extension):
    """Dry friction that grows with the torque that the joint passes on."""

    name, kind = "load_friction", "joint"
    reference = "M. Duclusaud et al. 2024, https://arxiv.org/abs/2410.08650"
    native = False
    nearest = "joint frictionloss, at its mean over the motion"

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"friction at {site} that grows with its load"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """A share of the transmitted torque."""
        return (
            Parameter(
                f"{site}.load_friction",
                0.0,
                1.0,
                targets=(f"joint:{site}.load_friction",),
                description="share of the transmitted torque",
            ),
        )
