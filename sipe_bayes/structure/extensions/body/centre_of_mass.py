"""A centre of mass that lies elsewhere than in the model, as where CAD has left out motors and cables."""

from __future__ import annotations

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.structure.extension import Extension
from sipe_bayes.structure.machine import Machine

_SD, _FURTHEST = 0.3, 1.5  # of the body's radius of gyration


class CentreOfMass(Extension):
    """A centre of mass that lies elsewhere than in the model, as where CAD has left out motors and cables."""

    name, kind = "centre_of_mass", "body"
    reference = "MuJoCo documentation, body inertial"

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"a centre of mass of {site} that is not the model's"

    def wholes(self, machine: Machine, site: str) -> tuple[float, ...]:
        """How far its mass lies from what turns it."""
        body = machine.bodies[site]
        return (body.reach,) * sum(body.turned)

    def off(self, site: str, share: float) -> str:
        """See ``Extension``."""
        return f"a centre of mass of {site} that lies {100 * share:.3g} % of its reach elsewhere"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """Its place in the body's frame where it matters, with a normal prior around the model's."""
        body = machine.bodies[site]
        return tuple(
            Parameter(
                f"{site}.com_{axis}",
                place - _FURTHEST * body.gyration,
                place + _FURTHEST * body.gyration,
                prior_mean=place,
                prior_sd=_SD * body.gyration,
                targets=(f"body:{site}.com_{axis}",),
                description="centre of mass",
            )
            for axis, place, turned in zip("xyz", body.centre, body.turned, strict=True)
            if turned
        )
