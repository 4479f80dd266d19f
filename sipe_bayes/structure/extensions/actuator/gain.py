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

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"a gain of {site} that is not the model's"

    def wholes(self, machine: Machine, site: str) -> tuple[float, ...]:
        """All of it."""
        return (float(machine.model.actuator(site).gainprm[0]),)

    def off(self, site: str, share: float) -> str:
        """See ``Extension``."""
        return f"a gain of {site} that is {100 * share:.3g} % off"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """The gain, with a normal prior of a tenth around the model's.

        None where gear or gain are unknown, nor of drives whose force is no one number's multiple: velocity servos,
        motors with a bias, muscles and dcmotors.
        """
        index = machine.model.actuator(site).id
        gain, bias = float(machine.model.actuator_gainprm[index, 0]), machine.model.actuator_biasprm[index]
        scaled = {f"actuator:{site}.{number}" for number in ("gear", "gain", "kp")}
        servo = bias[1] == -gain and not bias[0]
        if not gain or scaled & machine.written() or not (servo or not bias[:3].any()):
            return ()
        low, high = sorted((gain * (1 - _FURTHEST), gain * (1 + _FURTHEST)))
        return (
            Parameter(
                f"{site}.gain",
                low,
                high,
                prior_mean=gain,
                prior_sd=_SD * abs(gain),
                targets=(f"actuator:{site}.{'kp' if servo else 'gain'}",),
                description="force for each unit of command",
            ),
        )
