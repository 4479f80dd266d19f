"""A measurement that comes late."""

from __future__ import annotations

from collections.abc import Sequence

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.envs.channels import is_rotation
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
        return f"a measurement {_short(site)} that is taken {100 * share:.3g} % of a sample off"

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
