"""A force that falls with the velocity, as under voltage control."""

from __future__ import annotations

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.structure.extension import Extension
from sipe_bayes.structure.machine import Machine


class BackEmf(Extension):
    """A force that falls with the velocity, as under voltage control."""

    name, kind = "back_emf", "actuator"
    reference = "MuJoCo documentation, actuator/dcmotor"

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"back-EMF of {site}"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """Up to the usual force at the usual speed."""
        joint = machine.joint_of(site)
        if joint is None or machine.is_position(site):
            return ()
        most = 2 * machine.forces[site] / machine.joints[joint].velocity
        return (
            Parameter(
                f"{site}.back_emf",
                -most,
                0.0,
                targets=(f"actuator:{site}.bias_velocity",),
                description="force per velocity",
            ),
        )
