"""Bounds of unknowns: by what the logs say first, then by the model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np

from sipe_bayes.calibration.init.draft import Unknown, rounded_up
from sipe_bayes.calibration.init.regression import Outcome, Regression
from sipe_bayes.calibration.machine import Machine, Sizes
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import ParameterSpace
from sipe_bayes.envs.targets import bind

_ROOM, _FAR = 4.0, 10.0  # times what a regression says of friction, and of gains: what the model lacks is in it too
_SURE = 3.0  # standard errors, from which a gain is believed
_GAINS = ("kp", "gain", "resistance", "motor_constant")


def sizes_of(model: mujoco.MjModel, machine: Machine, regression: Regression, outcome: Outcome) -> Sizes:
    """Usual forces, speeds and inertias: of joints by inverse dynamics, of tendons by what moves them."""
    motion = regression.given_motion
    count = model.nq + model.nv
    states = np.concatenate([np.zeros((len(motion.states), 1)), motion.states[:, :count]], axis=1)
    plain = Sizes.of(model, machine, states, None)
    forces = np.abs(motion.asked) + outcome.damping * np.abs(motion.speed) + outcome.friction
    force, speed = (np.quantile(np.abs(values), 0.9, axis=0) for values in (forces, motion.speed))
    at = {joint.name: int(model.joint(joint.name).dofadr[0]) for joint in machine.joints}
    known = {name: dof for name, dof in at.items() if regression.known[dof]}
    return Sizes(
        plain.force | {name: max(float(force[dof]), 1e-9) for name, dof in known.items()},
        plain.speed | {name: max(float(speed[dof]), 1e-3) for name, dof in known.items()},
        plain.inertia,
    )


def informed(
    model: mujoco.MjModel, unknowns: Sequence[Unknown], regression: Regression, outcome: Outcome
) -> tuple[list[Unknown], dict[str, float]]:
    """The unknowns with bounds that hold what the regression says, and these values, SI, by name."""
    values: dict[str, float] = {}
    out = []
    told = {
        model.actuator(a).name: (float(g), float(e))
        for a, g, e in zip(regression.actuators, outcome.gains, outcome.errors, strict=True)
    }
    for unknown in unknowns:
        owner, _, field = unknown.targets[0].rpartition(".")
        kind, _, name = owner.partition(":")
        if kind == "actuator" and field in _GAINS and unknown.relative and name in told:
            gain, error = told[name]
            if gain > _SURE * error:
                gain = 1 / gain if field == "resistance" else gain
                own = bind(model, unknown.targets[0]).value
                values[unknown.name] = gain * own
                unknown = _around_gain(unknown, gain, own)
        elif kind == "joint" and field in ("damping", "frictionloss") and not unknown.relative:
            dof = int(model.joint(name).dofadr[0])
            if regression.known[dof]:
                value = float((outcome.damping if field == "damping" else outcome.friction)[dof])
                values[unknown.name] = value
                unknown = replace(unknown, high=max(unknown.high, rounded_up(_ROOM * value) if value else 0.0))
        out.append(unknown)
    return out, values


def _around_gain(unknown: Unknown, gain: float, own: float) -> Unknown:
    """Bounds around what the logs say, with the model's own value at most at an end."""
    if unknown.low < gain < unknown.high or own <= 0:
        return unknown
    low, high = min(gain / _FAR, 1.0) * own, max(gain * _FAR, 1.0) * own
    note = f"{unknown.note}; the logs say about {gain * own:.2g}"
    low, high, told = float(f"{low:.2g}"), rounded_up(high), float(f"{gain * own:.3g}")
    return replace(unknown, low=low, high=high, relative=False, note=note, expected=told)


def started(space: ParameterSpace, values: dict[str, float]) -> FloatArray:
    """Theta (N,) of the model's own values, and of what the regression says where it does."""
    given = space.default_theta
    own = [p.normalise(values[p.name]) if p.name in values else x for p, x in zip(space, given, strict=True)]
    return np.clip(np.array(own, float), 0.0, 1.0)
