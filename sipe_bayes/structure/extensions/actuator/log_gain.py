"""A gain that is another one in each log, as a battery's charge or a motor's temperature make it."""

from __future__ import annotations

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.structure.extension import Extension
from sipe_bayes.structure.machine import Machine

_SD, _FURTHEST = 0.1, 0.5  # of the model's gain


class LogGain(Extension):
    """A gain that is another one in each log, as a battery's charge or a motor's temperature make it."""

    name, kind = "log_gain", "actuator"
    reference = "-"

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"a gain of {site} that differs between the logs"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """A gain for each log, with a normal prior of a tenth around the model's."""
        gain = float(machine.model.actuator_gainprm[machine.model.actuator(site).id, 0])
        if len(machine.logs) < 2 or not gain:
            return ()
        target = f"actuator:{site}.{'kp' if machine.is_position(site) else 'gain'}"
        low, high = sorted((gain * (1 - _FURTHEST), gain * (1 + _FURTHEST)))
        return tuple(
            Parameter(
                f"{site}.gain[{log}]",
                low,
                high,
                prior_mean=gain,
                prior_sd=_SD * abs(gain),
                targets=(target,),
                log=log,
                description="gain in this log",
            )
            for log in machine.logs
        )
