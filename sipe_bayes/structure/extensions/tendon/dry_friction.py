"""Dry friction along a tendon, as of a cable in its sheath or over its pulleys."""

from __future__ import annotations

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.structure.extension import Extension
from sipe_bayes.structure.machine import Machine


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
