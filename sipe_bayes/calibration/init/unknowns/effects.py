"""What each unknown changes of the joints' forces along the logs, and the values that explain most of them."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace

import mujoco
import numpy as np
import scipy.optimize

from sipe_bayes.calibration.init.decisions import DECIDED
from sipe_bayes.calibration.init.draft import Unknown, rounded_up
from sipe_bayes.calibration.init.regression import Outcome, Regression, turning_of
from sipe_bayes.core.arrays import FloatArray

_STEP = 0.02  # of the cube, of finite differences
_PRIOR = 0.4  # sd in the cube of what a model does not know
_SHOWN = 2.0  # nats, from which a delay is asked for: that costs little, and one that is left out is in all others


@dataclass(frozen=True)
class Fit:
    """Values of unknowns that explain most.

    Args:
        theta: (N,) in the cube.
        errors: (N,) standard errors of these.
        jacobian: (R, N) of what is left, in units of its size.
    """

    theta: FloatArray
    errors: FloatArray
    jacobian: FloatArray


def fit_unknowns(regression: Regression, outcome: Outcome, start: FloatArray) -> Fit:
    """One Gauss-Newton step; of logs as the configuration reads them.

    Args:
        regression: whose environment has the unknowns.
        outcome: its own, for the delay and the sizes.
        start: (N,) where it begins.
    """
    given = np.clip(start, 0.0, 1.0)
    late = regression.delays[int(np.argmin(outcome.behind))] if len(outcome.behind) else 0
    dofs = np.flatnonzero(regression.known & (outcome.size > 0))
    if not len(dofs) or not len(given):
        return Fit(given, np.full(len(given), np.inf), np.zeros((1, len(given))))
    base = _left(regression, given, late)[:, dofs]
    size = (outcome.left[:, dofs] * outcome.size[dofs]).std(0) + 1e-12
    signs = np.where(given + _STEP > 1, -1.0, 1.0)
    moved = [_left(regression, given + _STEP * row, late)[:, dofs] for row in np.diag(signs)]
    slopes = [((one - base) / size / (sign * _STEP)).ravel() for one, sign in zip(moved, signs, strict=True)]
    jacobian, left = np.stack(slopes, axis=1), (base / size).ravel()
    share = np.sqrt(min(1.0, regression.independent(outcome) / len(base)))  # what is left is correlated
    design = np.concatenate([share * jacobian, np.eye(len(given)) / _PRIOR])
    wanted = np.concatenate([-share * left, np.zeros(len(given))])
    room = (-given - 1e-9, 1 - given + 1e-9)
    step = scipy.optimize.lsq_linear(design, wanted, room, method="bvls").x
    errors = np.sqrt(np.diag(np.linalg.inv(design.T @ design)))
    return Fit(np.clip(given + step, 0.0, 1.0), errors, jacobian)


def _left(regression: Regression, theta: FloatArray, late: int) -> FloatArray:
    """Forces (R, V) that the model asks for beyond those that its actuators and its friction give."""
    environment, model = regression.simulator.environment, copy(regression.simulator.model)
    values = environment.space.values(theta)
    environment.write(model, values)
    if environment.needs_constants:
        mujoco.mj_setConst(model, mujoco.MjData(model))
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    motion, data, bias = regression.given_motion, mujoco.MjData(model), environment.bias(values)
    if bias.any():
        motion = regression.motion(replace(regression.given, zeros=tuple(bias.tolist())))
    commands = np.concatenate(
        [
            regression.driven(log, regression.given, width, model)[np.maximum(rows - regression.late(late, log), 0)]
            for log, width, rows in zip(regression.logs, regression.widths, regression.rows, strict=True)
        ]
    )
    nq, nv = model.nq, model.nv
    out = model.dof_frictionloss * turning_of(motion.speed)
    for k, (row, command) in enumerate(zip(motion.states, commands, strict=True)):
        data.qpos[:], data.qvel[:], data.qacc[:] = row[:nq], row[nq : nq + nv], row[nq + nv : nq + 2 * nv]
        data.ctrl[regression.actuators] = command
        for index, value in zip(regression.actuators, command, strict=True):
            if (adr := int(model.actuator_actadr[index])) >= 0:
                data.act[adr] = value
        mujoco.mj_inverse(model, data)
        mujoco.mj_fwdActuation(model, data)
        out[k] += data.qfrc_inverse - data.qfrc_actuator
    return np.asarray(out)


def delay_of(
    actuators: Sequence[str], outcome: Outcome, count: float, delays: Sequence[int], dt: float
) -> tuple[list[Unknown], str]:
    """The delay as an unknown where one shows, and what is to be said of it; dt in s."""
    if not actuators or len(delays) < 2 or not len(outcome.behind) or not outcome.behind.any():
        return [], ""
    targets = tuple(f"actuator:{name}.delay" for name in actuators)
    best, behind = delays[int(np.argmin(outcome.behind))], count * float(outcome.behind[0])
    may = [d for d, x in zip(delays, count * outcome.behind, strict=True) if x < 3 * DECIDED]
    if not best and len(may) == 1:
        return [], "commands arrive at once: a delay would not explain more of the joints' forces"
    if not best or behind < _SHOWN:
        latest = delays[min(delays.index(may[-1]) + 1, len(delays) - 1)]
        note = f"commands may be up to {1e3 * dt * may[-1]:.3g} ms late: these logs hardly tell"
        return [Unknown("delay", targets, 0.0, rounded_up(dt * latest), False, note)], note
    if best == delays[-1]:
        why = "which other things than a delay do as well: look at the model and at what drives it; none is asked for"
        return [], f"the later commands arrive the better, up to the {1e3 * dt * best:.3g} ms that were tried, {why}"
    high = rounded_up(dt * max(2 * best, best + 3))
    when = f"{1e3 * dt * outcome.delay:.3g} ms late, {outcome.delay:.2g} samples"
    note = f"commands arrive about {when}: {behind:.2g} nats more than without a delay"
    return [Unknown("delay", targets, 0.0, high, False, note)], note  # none at all is what the model has
