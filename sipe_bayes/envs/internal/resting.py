"""Joints of an undriven base that nothing measures and that contact holds: height and pitch of a cart on its wheels.

What a joint rests on tells where it is as well as a sensor would. Along a log it is where the model comes to rest with
all other joints held at the log's positions, without friction and commands; and whether it stays there is seen in
simulations of the model as given: how far these lead from it in ``_AHEAD`` seconds is the spread that windows may start
with. What they lead further from than ``_HELD``, as of a machine that hops, contact does not hold, nor what no contact
bears on.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Collection, Sequence
from typing import Protocol

import mujoco
import numpy as np

from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray
from sipe_bayes.envs.foreign.quiet import quiet

_HELD = 0.02  # rad or m, root mean square of each simulation
_LEAST = 1e-3  # rad or m, and ten times as much a second: no smaller spread is claimed, the model's masses are off
_WIDER = 2.0  # of the spread that is seen: another model's is another
_AHEAD, _LOOKS = 0.3, 24  # seconds of a simulation, and how many of a log
_STILL = 1e-4  # rad/s or m/s
_CHECK, _FIRST, _NEXT = 10, 16.0, 0.8  # steps between looks; s at most, for a log's first sample and for each other
_MOST = 2000  # samples of a log at which it comes to rest; lines between them
_HEAVY, _DAMPED = 1e9, 10.0  # rotor inertia that does not move; damping a second, as a share of a joint's own inertia


class Simulate(Protocol):
    """The model as given, along a log."""

    def __call__(self, first: IntArray, starts: FloatArray, ahead: int) -> FloatArray:
        """States (B, ahead + 1, S) from starts (B, S) at the log's samples ``first`` (B,)."""


def loose_joints(model: mujoco.MjModel, unknown: Collection[int]) -> list[int]:
    """Of the joints that nothing measures those that may rest on something: hinges and slides that nothing drives."""
    scalar = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    count = int(data.moment_rownnz.sum())
    driven = set(data.moment_colind[:count][data.actuator_moment[:count] != 0].tolist())
    return [j for j in unknown if int(model.jnt_type[j]) in scalar and int(model.jnt_dofadr[j]) not in driven]


def resting_joints(model: mujoco.MjModel, known: Collection[int]) -> set[int]:
    """Ids of the joints that contact holds where the model has them; ``known``: those that are measured."""
    dt = float(model.opt.timestep)
    state = np.concatenate([[0.0], model.qpos0, np.zeros(model.nv + model.na)])
    states = np.tile(state, (2 + round(_AHEAD / dt), 1))

    def simulate(first: IntArray, starts: FloatArray, ahead: int) -> FloatArray:
        """Without commands."""
        out, data = np.repeat(starts[:, None], ahead + 1, axis=1), mujoco.MjData(model)
        for own in out:
            mujoco.mj_resetData(model, data)
            data.qpos[:], data.qvel[:] = own[0, 1 : 1 + model.nq], own[0, 1 + model.nq : 1 + model.nq + model.nv]
            for k in range(ahead):
                mujoco.mj_step(model, data)
                own[k + 1] = np.concatenate([[data.time], data.qpos, data.qvel, data.act])
        return out

    return set(rest(model, states, dt, loose_joints(model, set(range(model.njnt)) - set(known)), simulate))


def rest(
    model: mujoco.MjModel, states: FloatArray, dt: float, joints: Sequence[int], simulate: Simulate
) -> dict[int, tuple[float, float]]:
    """Write where contact holds joints, and how they move there, into states (T+1, S) along a log.

    Args:
        model: the model.
        states: of which the other joints are right; those that nothing holds stay as they are.
        dt: seconds of a control step.
        joints: ids of ``loose_joints``.
        simulate: the model as given, along the log.

    Returns:
        Of each joint that is held the standard deviations of a start's position and velocity about these states.
    """
    held, ahead = list(joints), max(1, min(round(_AHEAD / dt), len(states) - 1))
    while held and len(states) > 1:
        with quiet:
            places = _settled(model, states, held)
        if isinstance(places, list):
            held = places
            continue
        at, motion = 1 + model.jnt_qposadr[held], 1 + model.nq + model.jnt_dofadr[held]
        trial = states.copy()
        trial[:, at], trial[:, motion] = places, np.gradient(places, dt, axis=0)
        first = np.unique(np.linspace(0, len(states) - 1 - ahead, _LOOKS).astype(int))
        with quiet:
            runs = simulate(first, trial[first], ahead)
        expected = np.stack([trial[k : k + ahead + 1] for k in first])
        square = ((runs - expected)[:, 1:, np.concatenate([at, motion])] ** 2).mean(1)
        square = np.where(np.isfinite(square), square, np.inf)
        stays = np.sqrt(square.max(0))[: len(held)] <= _HELD
        if stays.all():
            states[:] = trial
            sd = np.maximum(_WIDER * np.sqrt(square.mean(0)), np.repeat([_LEAST, 10 * _LEAST], len(held)))
            return {j: (float(sd[i]), float(sd[len(held) + i])) for i, j in enumerate(held)}
        held = [j for j, stay in zip(held, stays, strict=True) if stay]
    return {}


def _settled(model: mujoco.MjModel, states: FloatArray, joints: list[int]) -> FloatArray | list[int]:
    """Positions (T+1, J) at rest of joints along states (T+1, S); or those of the joints that came to rest in touch."""
    own, places, dofs = copy.copy(model), model.jnt_qposadr[joints], model.jnt_dofadr[joints]
    for kind in (mujoco.mjtDisableBit.mjDSBL_ACTUATION, mujoco.mjtDisableBit.mjDSBL_AUTORESET):  # what diverges shows
        own.opt.disableflags |= int(kind)
    own.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    own.geom_condim[:], own.pair_dim[:] = 1, 1  # frictionless
    data = mujoco.MjData(own)
    own.dof_armature[np.setdiff1d(np.arange(own.nv), dofs)] = _HEAVY
    own.dof_damping[dofs] += _DAMPED * own.dof_M0[dofs]
    looks = np.unique(np.linspace(0, len(states) - 1, _MOST).astype(int))
    out, position = np.empty((len(looks), len(joints))), states[0, 1 + places]
    for k, state in enumerate(states[looks]):
        data.qpos[:], data.qvel[:] = state[1 : 1 + model.nq], 0.0
        data.qpos[places] = position
        moves = _come_to_rest(own, data, dofs, _NEXT if k else _FIRST)
        stays = ~moves if moves.any() or k else _borne(own, data, dofs)
        if not (k or stays.all()):
            return [j for j, stay in zip(joints, stays, strict=True) if stay]
        out[k] = position = data.qpos[places]
    return np.stack([np.interp(np.arange(len(states)), looks, column) for column in out.T], axis=1)


def _come_to_rest(model: mujoco.MjModel, data: mujoco.MjData, dofs: IntArray, most: float) -> BoolArray:
    """Step until the degrees of freedom (J,) are still; which of them (J,) are not after ``most`` seconds."""
    moves = np.ones(len(dofs), bool)
    for _ in range(math.ceil(most / model.opt.timestep / _CHECK)):
        for _ in range(_CHECK):
            mujoco.mj_step(model, data)
        moves = ~(np.abs(data.qvel[dofs]) < _STILL)
        if not moves.any():
            break
    return moves


def _borne(model: mujoco.MjModel, data: mujoco.MjData, dofs: IntArray) -> BoolArray:
    """Which degrees of freedom (J,) a contact that carries load bears on."""
    mujoco.mj_forward(model, data)
    count = int(data.nefc)
    jacobian = data.efc_J.reshape(-1, model.nv)[:count]
    touches = data.efc_type[:count] >= int(mujoco.mjtConstraint.mjCNSTR_CONTACT_FRICTIONLESS)
    touches &= data.efc_force[:count] > 0
    return np.abs(jacobian[touches][:, dofs]).max(axis=0, initial=0.0) > _LEAST
