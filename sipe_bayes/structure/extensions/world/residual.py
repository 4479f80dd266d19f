"""A force that no named piece of physics gives: a Gaussian process of position, velocity and command."""

from __future__ import annotations

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.envs.laws.bound import LawNumbers
from sipe_bayes.envs.laws.registry import LAWS
from sipe_bayes.structure.extension import Extension
from sipe_bayes.structure.machine import Machine


class Residual(Extension):
    """A force that no named piece of physics gives: a Gaussian process of position, velocity and command."""

    name, kind = "residual", "joint"
    reference = "A. Rahimi, B. Recht 2007, Random Features for Large-Scale Kernel Machines"
    native, last_resort = False, True
    scales = ("residual_position", "residual_velocity", "residual_command")

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"a force at {site} that nothing here has a name for"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """Twelve weights, with normal priors of a tenth of the usual force."""
        sd = machine.joints[site].force / 10
        weights = LAWS["residual"].numbers[3:]
        return tuple(
            Parameter(
                f"{site}.{number.attribute}",
                -5 * sd,
                5 * sd,
                prior_mean=0.0,
                prior_sd=sd,
                targets=(f"joint:{site}.{number.attribute}",),
                description="weight of a random feature",
            )
            for number in weights
        )

    def edit(self, machine: Machine, site: str) -> LawNumbers:
        """The usual position, velocity and command are the lengths."""
        sizes = machine.joints[site]
        driving = [a for a in machine.environment.actuators if machine.joint_of(a) == site]
        command = machine.commands[driving[0]] / 2 if driving else 1.0
        lengths = (sizes.position, sizes.velocity, command or 1.0)
        return LawNumbers(f"joint:{site}", "residual", tuple(zip(Residual.scales, lengths, strict=True)))
