"""The user's parameters against the model: what they write, units and defaults, and that none overrules another."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace

import mujoco
import numpy as np

from sipe_bayes.core.parameters import Parameter, ParameterSpace
from sipe_bayes.core.validation import nearest_name
from sipe_bayes.envs.channels import Channel, is_rotation
from sipe_bayes.envs.sensing import LEAST, NEUTRAL, UNITS, of_sensor, sensed_channels
from sipe_bayes.envs.target import TargetError
from sipe_bayes.envs.targets import bind

# the numbers that a target writes, where they are not its own
_WRITES = {
    "actuator.kp": ("gain", "bias_position"),
    "actuator.kv": ("bias_velocity",),
    "actuator.offset": ("bias_force",),
    "tendon.springlength": ("springlength_low", "springlength_high"),
}


def check_conflicts(space: ParameterSpace) -> None:
    """Raises TargetError when two targets write the same number in the same log: one would overrule the other."""
    owners: dict[str, list[tuple[str, str | None]]] = {}
    for parameter in space:
        for spec in parameter.targets:
            head, _, attribute = spec.rpartition(".")
            if attribute == "bias":  # they add up
                continue
            numbers = _WRITES.get(f"{head.partition(':')[0]}.{attribute}", (attribute,))
            for number in numbers:
                for other, log in owners.setdefault(f"{head}.{number}", []):
                    if log is None or parameter.log is None or log == parameter.log:
                        raise TargetError(
                            f"parameter {parameter.name!r}: target {spec!r} writes what parameter {other!r} "
                            "writes too; keep one"
                        )
                owners[f"{head}.{number}"].append((parameter.name, parameter.log))


def with_model_values(model: mujoco.MjModel, parameter: Parameter, channels: Sequence[Channel]) -> Parameter:
    """The parameter with the unit and the default that the model gives it; raises TargetError where it gives none."""
    if not parameter.targets:
        raise TargetError(f"parameter {parameter.name!r}: names no target; give what it changes, such as body:rod.mass")
    units, values, least, shape = [], [], -np.inf, False
    for spec in parameter.targets:
        sensed = sensed_channels(spec, channels)
        if sensed is not None:
            attribute, concerned = sensed
            unit = _channel_unit(parameter, spec, channels, concerned, attribute)
            units.append(UNITS.get(attribute, unit))
            values.append(NEUTRAL[attribute])
            least = max(least, LEAST.get(attribute, -np.inf))
            continue
        try:
            target = bind(model, spec)
        except TargetError as error:
            raise TargetError(f"parameter {parameter.name!r}: {error}") from None
        units.append(target.unit)
        values.append(target.value)
        least, shape = max(least, target.minimum), shape or target.shape
    if parameter.relative and parameter.default is None:
        parameter = _absolute(parameter, values[0])
    if parameter.low < least:
        raise TargetError(
            f"parameter {parameter.name!r}: bounds from {parameter.low:g} {parameter.unit or units[0]}, but "
            f"{parameter.targets[0]} cannot be below {least:g}; raise the lower one"
        )
    default: float | None = parameter.high if math.isinf(values[0]) else values[0]  # a limit that the model has not
    if shape:
        default = parameter.default
    return replace(parameter, unit=parameter.unit or units[0], default=default)


def _channel_unit(
    parameter: Parameter, target: str, channels: Sequence[Channel], concerned: Sequence[int], attribute: str
) -> str:
    if any(is_rotation(channels[k]) for k in concerned) and (attribute != "delay" or len(concerned) % 3):
        raise TargetError(
            f"parameter {parameter.name!r}: target {target!r} is of an orientation, whose sensor has a delay, of the "
            "whole measurement, and no bias, scale or filter here; turn the frame in the MJCF instead"
        )
    if concerned:
        return channels[concerned[0]].unit
    names = [c.label for c in channels]
    hint = nearest_name(of_sensor(target) or "", names) or f"; measured are {names}"
    raise TargetError(f"parameter {parameter.name!r}: target {target!r} names no measured sensor or channel{hint}")


def _absolute(parameter: Parameter, value: float) -> Parameter:
    """A parameter that was given as a factor of the model's ``value``, in its unit."""
    if not value:
        raise TargetError(
            f"parameter {parameter.name!r}: {parameter.targets[0]} is 0 in the model, so a factor of it "
            "says nothing; give absolute bounds"
        )
    low, high = sorted((parameter.low * value, parameter.high * value))
    mean, sd = parameter.prior_mean, parameter.prior_sd
    if mean is not None and sd is not None:
        mean, sd = mean * value, abs(sd * value)
    return replace(parameter, low=low, high=high, prior_mean=mean, prior_sd=sd)


def bounded_by_nature(model: mujoco.MjModel, space: ParameterSpace) -> frozenset[str]:
    """Names of the parameters whose lower bound is the smallest physical value, as of friction that is 0."""
    names = set()
    for parameter in space:
        specs = physical_targets(parameter.targets)
        if specs and parameter.low <= max(bind(model, spec).minimum for spec in specs):
            names.add(parameter.name)
    return frozenset(names)


def physical_targets(targets: Iterable[str]) -> list[str]:
    """Those that write a number of the model; a sensor's bias and its like do not."""
    return [target for target in targets if of_sensor(target) is None]
