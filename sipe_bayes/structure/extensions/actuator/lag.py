"""A command that takes effect little by little."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.envs.internal.states import UNSETTLED, declare_start
from sipe_bayes.structure.extension import Extension, members
from sipe_bayes.structure.machine import Machine

_LONGEST, _SAMPLES = 0.2, 50  # seconds, or so many samples


@dataclass(frozen=True)
class FilteredCommand:
    """Actuators that follow their commands through a first-order lag, exactly integrated, none by default.

    Args:
        actuators: their names.
        unsettled: how far a window may start from the command before it.
    """

    actuators: tuple[str, ...]
    unsettled: float

    def __call__(self, spec: mujoco.MjSpec) -> None:
        """Give them the filter; raises ValueError for one that has dynamics of its own."""
        for name in self.actuators:
            actuator = spec.actuator(name)
            if int(actuator.dyntype) != int(mujoco.mjtDyn.mjDYN_NONE):
                raise ValueError(f"actuator {name!r}: has dynamics of its own; add its lag as a parameter")
            actuator.dyntype, actuator.actearly = mujoco.mjtDyn.mjDYN_FILTEREXACT, True
            actuator.dynprm = np.zeros(len(actuator.dynprm))
            declare_start(spec, f"actuator:{name}", [self.unsettled])


class Lag(Extension):
    """A command that takes effect little by little: a first-order lag."""

    name, kind = "lag", "actuator"
    reference = 'MuJoCo documentation, actuator dyntype="filterexact"'

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"a first-order lag of {site}"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """Up to a fifth of a second, or fifty samples."""
        return (
            Parameter(
                f"{site}.lag",
                0.0,
                min(_LONGEST, _SAMPLES * machine.dt),
                targets=tuple(f"actuator:{name}.lag" for name in members(site)),
                description="time constant from command to force",
            ),
        )

    def edit(self, machine: Machine, site: str) -> FilteredCommand:
        """The filter."""
        names = members(site)
        return FilteredCommand(names, UNSETTLED * (max(machine.commands[name] for name in names) or 1.0))

    def groups(self, machine: Machine) -> tuple[tuple[str, ...], ...]:
        """Actuators of one make."""
        return machine.alike

    def imitators(self, site: str) -> tuple[str, ...]:
        """A delay."""
        return tuple(f"actuator:{name}.delay" for name in members(site))

    def probes(self, machine: Machine, parameters: tuple[Parameter, ...]) -> FloatArray:
        """One sample, and at least two physics steps."""
        (lag,) = parameters
        return np.array([[max(machine.dt, 2 * machine.timestep) / lag.high]])
