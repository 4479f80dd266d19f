"""Extensions of sensors, of the world and of what no piece of physics explains."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.envs.channels import is_rotation
from sipe_bayes.envs.laws.bound import LawNumbers
from sipe_bayes.envs.laws.registry import LAWS
from sipe_bayes.envs.sensing import sensed_channels, vector_of
from sipe_bayes.structure.extension import Extension, members
from sipe_bayes.structure.machine import Machine


class SensorDelay(Extension):
    """A measurement that comes late.

    MuJoCo knows no such sensor: sipe_bayes does it to what is simulated.
    """

    name, kind = "sensor_delay", "channel"
    reference = "-"
    native = False

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"a delay of the measurement{'s' * (len(members(site)) > 1)} {_short(site)}"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """Up to a tenth of a second, or twenty samples; none of a part of an orientation."""
        names = members(site)
        if _late(machine).intersection(names):
            return ()
        if any(0 < len([name for name in names if vector_of(name) == whole]) < 3 for whole in _turning(machine)):
            return ()
        return (
            Parameter(
                f"{_short(site)}.delay",
                0.0,
                self.memory(machine.dt),
                targets=_targets(machine, names),
                description="age of the measurement",
            ),
        )

    def wholes(self, machine: Machine, site: str) -> tuple[float, ...]:
        """From sample to sample."""
        return (machine.dt,)

    def off(self, site: str, share: float) -> str:
        """See ``Extension``."""
        return f"an error of the time stamps of {_short(site)} by {100 * share:.3g} % of a sample"

    def memory(self, dt: float) -> float:
        """The longest delay."""
        return min(0.1, 20 * dt)

    def groups(self, machine: Machine) -> tuple[tuple[str, ...], ...]:
        """What one instrument tells: the pose of a body, the numbers of a sensor."""
        instruments: dict[str, list[str]] = {}
        for channel in machine.environment.measurements:
            if not channel.target.startswith("joint:"):
                instrument = channel.target.rpartition(".")[0] or channel.target.partition("[")[0]
                instruments.setdefault(instrument, []).append(channel.label)
        return tuple(tuple(names) for names in instruments.values())

    def imitators(self, site: str) -> tuple[str, ...]:
        """A low-pass filter."""
        return tuple(f"sensor:{name}.filter" for name in members(site))


def _short(site: str) -> str:
    """Of a site that is many the first and the last."""
    names = members(site)
    return site if len(names) < 3 else f"{names[0]} to {names[-1]}"


def _late(machine: Machine) -> set[str]:
    """Channels that have an unknown delay already."""
    channels = machine.environment.measurements
    targets = (target for parameter in machine.environment.parameters for target in parameter.targets)
    sensed = [one for target in targets if (one := sensed_channels(target, channels)) is not None]
    return {channels[k].label for attribute, own in sensed if attribute == "delay" for k in own}


def _turning(machine: Machine) -> set[str]:
    """Names of the orientations that are measured."""
    return {vector_of(channel.label) for channel in machine.environment.measurements if is_rotation(channel)}


def _targets(machine: Machine, names: Sequence[str]) -> tuple[str, ...]:
    """Of an orientation the whole of it has a delay."""
    turning = _turning(machine)
    whole = [own if (own := vector_of(name)) in turning else name for name in names]
    return tuple(dict.fromkeys(f"sensor:{name}.delay" for name in whole))


class SensorFilter(Extension):
    """A measurement that has gone through a first-order low-pass filter.

    MuJoCo knows no such sensor: sipe_bayes does it to what is simulated.
    """

    name, kind = "sensor_filter", "channel"
    reference = "-"
    native = False

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"a low-pass filter of {site}"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """Up to a twentieth of a second, or twenty samples."""
        return (
            Parameter(
                f"{site}.filter",
                0.0,
                self._slowest(machine.dt),
                targets=tuple(f"sensor:{name}.filter" for name in members(site)),
                description="time constant of a low-pass filter",
            ),
        )

    def memory(self, dt: float) -> float:
        """Three of the longest time constants."""
        return 3 * self._slowest(dt)

    @staticmethod
    def _slowest(dt: float) -> float:
        return min(0.05, 20 * dt)

    def imitators(self, site: str) -> tuple[str, ...]:
        """A delay."""
        return tuple(f"sensor:{name}.delay" for name in members(site))


class GravityTilt(Extension):
    """A base that does not stand level."""

    name, kind = "gravity_tilt", "world"
    reference = "-"

    def sentence(self, site: str) -> str:
        """What it is."""
        return "a base that is tilted"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """Up to three degrees either way: bases are put up with a level."""
        most = 0.05 * float(np.linalg.norm(machine.model.opt.gravity))
        if not most:
            return ()
        names = ("gravity_x", "gravity_y")
        return tuple(
            Parameter(name, -most, most, targets=(f"option.{name}",), description="of a tilted base") for name in names
        )


class SupplySag(Extension):
    """A supply whose voltage falls with the currents of all motors.

    One motor by itself has a force that falls short the more of it is asked for: ``force_drop``.
    """

    name, kind = "supply_sag", "world"
    reference = "-"
    native = False
    nearest = "actuator gain, at its mean over the motion"

    def sentence(self, site: str) -> str:
        """What it is."""
        return "a supply whose voltage falls with the force of all motors"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """Up to a half of every force at the usual ones of all."""
        driving = [a for a in machine.environment.actuators if machine.joint_of(a) is not None]
        if len(driving) < 2:
            return ()
        return (
            Parameter(
                "supply_sag",
                0.0,
                0.5 / sum(machine.forces[a] for a in driving),
                targets=tuple(f"actuator:{a}.supply_sag" for a in driving),
                description="relative loss of every force per force of all",
            ),
        )


class Residual(Extension):
    """A force that no named piece of physics gives: a Gaussian process of position, velocity and command."""

    name, kind = "residual", "joint"
    reference = "A. Rahimi, B. Recht 2007, Random Features for Large-Scale Kernel Machines"
    native, by_name = False, True
    scales = ("residual_position", "residual_velocity", "residual_command")

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"an unstructured residual force at {site}"

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
