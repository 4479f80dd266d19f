"""Extensions at actuators."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.envs.internal.states import UNSETTLED, declare_start
from sipe_bayes.structure.extension import PROBE, Extension, members
from sipe_bayes.structure.machine import Machine

_LONGEST, _SAMPLES = 0.2, 50  # seconds, or so many samples
_MOST_COGGING = 60  # periods in a turn
_SD, _FURTHEST = 0.1, 0.5  # of the model's gain


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


class Cogging(Extension):
    """A torque that goes round with the rotor."""

    name, kind = "cogging", "actuator"
    reference = "MuJoCo documentation, actuator/dcmotor, cogging"
    native = False
    nearest = "actuator/dcmotor, cogging"

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"cogging at the joint of {site}"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """Up to a third of the usual force, with 1 to 60 poles."""
        joint = machine.joint_of(site)
        if joint is None or not machine.is_hinge(joint):
            return ()
        most, at = machine.joints[joint].force / 3, f"joint:{joint}"
        return (
            Parameter(f"{site}.cogging_sin", -most, most, targets=(f"{at}.cogging_sin",), description="sine part"),
            Parameter(f"{site}.cogging_cos", -most, most, targets=(f"{at}.cogging_cos",), description="cosine part"),
            Parameter(
                f"{site}.cogging_poles",
                1.0,
                float(_MOST_COGGING),
                scale="log",
                targets=(f"{at}.cogging_poles",),
                description="periods in a turn",
            ),
        )

    def probes(self, machine: Machine, parameters: tuple[Parameter, ...]) -> FloatArray:
        """A little of either phase, for numbers of poles that the motion's range tells apart."""
        range_of = 2 * machine.joints[parameters[0].targets[0].removeprefix("joint:").rpartition(".")[0]].position
        apart = max(np.pi / max(range_of, 0.1) / 1.5, 1.0)  # whole periods, or as far as the range tells apart
        poles = np.log(np.arange(1.0, _MOST_COGGING, apart)) / np.log(_MOST_COGGING)
        phases = ((PROBE, 0.0), (0.0, PROBE))
        return np.array([[[0.5 + a, 0.5 + b, n] for a, b in phases] for n in poles])


class Gain(Extension):
    """A gain that is another one than the model's: of a motor's constant data sheets know about a tenth."""

    name, kind = "gain", "actuator"
    reference = "-"

    def sentence(self, site: str) -> str:
        """What it is."""
        return f"a gain error of {site}"

    def wholes(self, machine: Machine, site: str) -> tuple[float, ...]:
        """All of it."""
        return (float(machine.model.actuator(site).gainprm[0]),)

    def off(self, site: str, share: float) -> str:
        """See ``Extension``."""
        return f"a {100 * share:.3g} % error of the gain of {site}"

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
