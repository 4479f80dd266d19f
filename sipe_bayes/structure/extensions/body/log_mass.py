"""A mass that is another one in each log: a payload that was put on, a tool that was changed."""

from __future__ import annotations

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.structure.extension import Extension
from sipe_bayes.structure.machine import Machine

_SD, _LEAST, _MOST = 0.5, 0.25, 4.0  # of the model's mass, as of ``Mass``
_LOGS = 12  # at most: it has a number for each


class LogMass(Extension):
    """A mass that is another one in each log: a payload that was put on, a tool that was changed."""

    name, kind = "log_mass", "body"
    reference = "MuJoCo documentation, body inertial"

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"a mass of {site} that differs between the logs"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """A mass for each log, with a normal prior around the model's.

        None where it is an unknown already, where a log says what it has more, or of more than a dozen logs.
        """
        head, own = f"body:{site}.", machine.bodies[site].mass
        known = any(target.startswith((f"{head}mass", f"{head}inertia")) for target in machine.written())
        if not 2 <= len(machine.logs) <= _LOGS or known or machine.has_added(site):
            return ()
        return tuple(
            Parameter(
                f"{site}.mass[{log}]",
                _LEAST * own,
                _MOST * own,
                prior_mean=own,
                prior_sd=_SD * own,
                targets=(f"{head}mass",),
                log=log,
                description="mass in this log; the inertia scales with it",
            )
            for log in machine.logs
        )
