"""A gain that is another one than the model's: of a motor's constant data sheets know about a tenth."""

from __future__ import annotations

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.structure.extension import Extension
from sipe_bayes.structure.machine import Machine

_SD, _FURTHEST = 0.1, 0.5  # of the model's gain


class Gain(Extension):
    """A gain that is another one than the model's: of a motor's constant data sheets know about a tenth."""

    name, kind = "gain", "actuator"
    reference = "-"
    tolerance = True

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"a gain of {site} that is not the model's"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """The gain, with a normal prior of a tenth around the model's; none where gear or motor constant is unknown."""
        gain = float(machine.model.actuator_gainprm[machine.model.actuator(site).id, 0])
        scaled = {f"actuator:{site}.{number}" for number in ("gear", "gain", "kp", "motor_constant")}
        if not gain or scaled & machine.written():
            return ()
        low, high = sorted((gain * (1 - _FURTHEST), gain * (1 + _FURTHEST)))
        return (
            Parameter(
                f"{site}.gain",
                low,
                high,
                prior_mean=gain,
                prior_sd=_SD * abs(gain),
                targets=(f"actuator:{site}.{'kp' if machine.is_position(site) else 'gain'}",),
                description="force for each unit of command",
            ),
        )
