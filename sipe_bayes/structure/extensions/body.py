"""Extensions at a body: its numbers that the model has wrong."""

from __future__ import annotations

from dataclasses import replace

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.structure.extension import Extension
from sipe_bayes.structure.machine import Machine

_SD_MASS, _LEAST, _MOST = 0.5, 0.25, 4.0  # of the model's mass: a gripper may double with what it holds
_LOGS = 12  # at most: it has a number for each
_SD_CENTRE_OF_MASS, _FURTHEST = 0.3, 1.5  # of the body's radius of gyration


class Mass(Extension):
    """A mass that is another one than the model's: a payload, a cable, a part that was weighed without its screws."""

    name, kind = "mass", "body"
    reference = "MuJoCo documentation, body inertial"

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"a mass error of {site}"

    def wholes(self, machine: Machine, site: str) -> tuple[float, ...]:
        """All of it."""
        return (machine.bodies[site].mass,)

    def off(self, site: str, share: float) -> str:
        """See ``Extension``."""
        return f"a {100 * share:.3g} % error of the mass of {site}"

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
                prior_sd=_SD_MASS * own,
                targets=(f"{head}mass",),
                description="mass; the inertia scales with it",
            ),
        )


class LogMass(Extension):
    """A mass that is another one in each log: a payload that was put on, a tool that was changed."""

    name, kind = "log_mass", "body"
    reference = "MuJoCo documentation, body inertial"

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"a mass of {site} that differs between the logs"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """A mass for each log, bounds and prior as of ``Mass``; none where that has none, or beyond a dozen logs."""
        if not 2 <= len(machine.logs) <= _LOGS:
            return ()
        return tuple(
            replace(one, name=f"{one.name}[{log}]", log=log, description="mass in this log; the inertia scales with it")
            for one in Mass().parameters(machine, site)
            for log in machine.logs
        )


class CentreOfMass(Extension):
    """A centre of mass that lies elsewhere than in the model, as where CAD has left out motors and cables."""

    name, kind = "centre_of_mass", "body"
    reference = "MuJoCo documentation, body inertial"

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"a centre of mass offset of {site}"

    def wholes(self, machine: Machine, site: str) -> tuple[float, ...]:
        """How far its mass lies from what turns it."""
        body = machine.bodies[site]
        return (body.reach,) * sum(body.turned)

    def off(self, site: str, share: float) -> str:
        """See ``Extension``."""
        return f"an error of the centre of mass of {site} by {100 * share:.3g} % of its reach"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """Its place in the body's frame where it matters, with a normal prior around the model's."""
        body = machine.bodies[site]
        return tuple(
            Parameter(
                f"{site}.com_{axis}",
                place - _FURTHEST * body.gyration,
                place + _FURTHEST * body.gyration,
                prior_mean=place,
                prior_sd=_SD_CENTRE_OF_MASS * body.gyration,
                targets=(f"body:{site}.com_{axis}",),
                description="centre of mass",
            )
            for axis, place, turned in zip("xyz", body.centre, body.turned, strict=True)
            if turned
        )
