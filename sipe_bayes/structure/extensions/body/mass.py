"""A mass that is another one than the model's: a payload, a cable, a part that was weighed without its screws."""

from __future__ import annotations

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.structure.extension import Extension
from sipe_bayes.structure.machine import Machine

_SD, _LEAST, _MOST = 0.5, 0.25, 4.0  # of the model's mass: a gripper may double with what it holds


class Mass(Extension):
    """A mass that is another one than the model's: a payload, a cable, a part that was weighed without its screws."""

    name, kind = "mass", "body"
    reference = "MuJoCo documentation, body inertial"

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"a mass of {site} that is not the model's"

    def wholes(self, machine: Machine, site: str) -> tuple[float, ...]:
        """All of it."""
        return (machine.bodies[site].mass,)

    def off(self, site: str, share: float) -> str:
        """See ``Extension``."""
        return f"a mass of {site} that is {100 * share:.3g} % off"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """The mass, with a normal prior around the model's; none of a body whose mass is known or unknown already."""
        head, own = f"body:{site}.", machine.bodies[site].mass
        known = any(target.startswith((f"{head}mass", f"{head}inertia")) for target in machine.written())
        if known or machine.has_added(site):
            return ()
        return (
            Parameter(
                f"{site}.mass",
                _LEAST * own,
                _MOST * own,
                prior_mean=own,
                prior_sd=_SD * own,
                targets=(f"{head}mass",),
                description="mass; the inertia scales with it",
            ),
        )
