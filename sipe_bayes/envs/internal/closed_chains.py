"""Dependent joints of closed chains, which nothing measures: a four-bar linkage's rocker, a gripper's second finger.

Where equality constraints (connect, weld, joint, tendon) tie hinges and slides to measured ones, their positions are
solved from sample to sample by Gauss-Newton steps of the constraints' residuals, and their velocities by the
constraints' Jacobian,

    J_o dq_o = -r,    J_o v_o = -J_m v_m,    with o the dependent joints and m all others.

The first sample is come to from the reset state, where the chain is assembled, in steps of the measured joints, so that
the branch of the mechanism is the model's. Which joints are dependent is asked there: those that no motion with the
measured ones at rest moves.
"""

from __future__ import annotations

import copy
from collections.abc import Collection

import mujoco
import numpy as np

from sipe_bayes.core.arrays import FloatArray, IntArray
from sipe_bayes.envs.internal.states import joints_at_rest

SD = 0.1  # rad or m, and ten times as much a second: how far from closed a window may start, a noisy crank included
_STEP, _MOST, _TOLERANCE, _APART, _HARDLY = 0.05, 30, 1e-10, 1e-6, 1e-3


class _Chain:
    """A model's equality constraints alone, and their residuals and Jacobian at a place."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model = copy.copy(model)
        self.model.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
        kinds = (
            mujoco.mjtDisableBit.mjDSBL_CONTACT,
            mujoco.mjtDisableBit.mjDSBL_LIMIT,
            mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS,
        )
        for kind in kinds:
            self.model.opt.disableflags |= int(kind)
        self.data = mujoco.MjData(self.model)
        self.data.eq_active[[k for k in range(model.neq) if _of_mocap(model, k)]] = 0  # what it follows no state tells

    def at(self, position: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Residuals (E,) and Jacobian (E, nv) at positions (nq,)."""
        self.data.qpos[:] = position
        mujoco.mj_fwdPosition(self.model, self.data)
        count = int(self.data.nefc)
        return self.data.efc_pos[:count].copy(), self.data.efc_J.reshape(-1, self.model.nv)[:count].copy()

    def closed(self, position: FloatArray, columns: IntArray, dofs: IntArray) -> FloatArray:
        """Positions (nq,) of which the dependent ``columns`` close the chain; ``dofs`` are theirs."""
        out = position.copy()
        for _ in range(_MOST):
            residual, jacobian = self.at(out)
            step = -np.linalg.lstsq(jacobian[:, dofs], residual, rcond=_APART)[0]
            out[columns] += np.clip(step, -0.3, 0.3)
            if np.abs(step).max() < _TOLERANCE:
                break
        return out


def _of_mocap(model: mujoco.MjModel, equality: int) -> bool:
    """Whether a constraint ties something to a mocap body."""
    ids = [int(model.eq_obj1id[equality]), int(model.eq_obj2id[equality])]
    kind = int(model.eq_objtype[equality])
    if kind == int(mujoco.mjtObj.mjOBJ_SITE):
        ids = [int(model.site_bodyid[i]) for i in ids]
    elif kind != int(mujoco.mjtObj.mjOBJ_BODY):
        return False
    return bool((model.body_mocapid[ids] >= 0).any())


def dependent_joints(model: mujoco.MjModel, known: Collection[int]) -> list[int]:
    """Ids of the hinges and slides that nothing measures and that closed chains tie to what is known.

    known: ids of the joints that are measured, or of which the model says where they start.
    """
    kinds = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
    joints = [j for j in range(model.njnt) if j not in known and int(model.jnt_type[j]) in kinds]
    if not model.neq or not joints:
        return []
    jacobian = _Chain(model).at(model.qpos0)[1][:, model.jnt_dofadr[joints]]
    sizes, ways = np.linalg.svd(jacobian)[1:]
    free = ways[int((sizes > _APART * sizes.max(initial=0.0)).sum()) :]  # motions that the chain allows
    return [j for j, own in zip(joints, np.abs(free).max(axis=0, initial=0.0), strict=True) if own < _HARDLY]


def narrowed(model: mujoco.MjModel, columns: Collection[int | None], sd: FloatArray) -> FloatArray:
    """Prior sds (2 nv + na,) of a window's start with those of dependent joints.

    columns: of the state, that channels measure.
    """
    dofs = model.jnt_dofadr[dependent_joints(model, known_joints(model, columns))]
    out = sd.copy()
    out[dofs], out[model.nv + dofs] = SD, 10 * SD
    return out


def known_joints(model: mujoco.MjModel, columns: Collection[int | None]) -> set[int]:
    """Ids of the joints whose column of the state is measured, or of which the model says where they start."""
    return {j for j in range(model.njnt) if 1 + int(model.jnt_qposadr[j]) in columns} | joints_at_rest(model)


def close(model: mujoco.MjModel, states: FloatArray, reset: FloatArray, joints: Collection[int]) -> None:
    """Write positions and velocities of ``joints`` into states (T+1, S) along a log; reset: a state (S,)."""
    chain, nq, nv = _Chain(model), model.nq, model.nv
    columns, dofs = model.jnt_qposadr[list(joints)], model.jnt_dofadr[list(joints)]
    others = np.setdiff1d(np.arange(nv), dofs)
    position = reset[1 : 1 + nq].copy()
    first = states[0, 1 : 1 + nq].copy()
    first[columns] = position[columns]
    way = np.zeros(nv)
    mujoco.mj_differentiatePos(model, way, 1.0, position, first)
    steps = max(1, int(np.ceil(np.abs(way).max() / _STEP)))
    for _ in range(steps):
        mujoco.mj_integratePos(model, position, way, 1.0 / steps)
        position = chain.closed(position, columns, dofs)
    for state in states:
        measured = state[1 : 1 + nq].copy()
        measured[columns] = position[columns]
        position = chain.closed(measured, columns, dofs)
        state[1 : 1 + nq][columns] = position[columns]
        jacobian = chain.at(position)[1]
        velocity = state[1 + nq : 1 + nq + nv]
        moved = jacobian[:, others] @ velocity[others]
        velocity[dofs] = -np.linalg.lstsq(jacobian[:, dofs], moved, rcond=_APART)[0]
