"""A mass that is another one in each log: a payload that was put on, a tool that was changed."""

from __future__ import annotations

from dataclasses import replace

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.structure.extension import Extension
from sipe_bayes.structure.extensions.body.mass import Mass
from sipe_bayes.structure.machine import Machine

_LOGS = 12  # at most: it has a number for each


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
