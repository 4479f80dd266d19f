"""Dependent joints of closed chains, which nothing measures: a four-bar linkage's rocker, a gripper's second finger.

Where equality constraints (connect, weld, joint, tendon) tie joints to measured ones, their positions are solved from
sample to sample by Gauss-Newton steps of the constraints' residuals, and their velocities by the constraints' Jacobian,

    J_o dq_o = -r,    J_o v_o = -J_m v_m,    with o the joints that nothing measures and m all others.

The first sample is come to from the reset state, where the chain is assembled, in steps of the measured joints, so that
the branch of the mechanism is the model's. Which joints are dependent is asked there: those that no motion with the
measured ones at rest moves.

Where J_o loses rank on the way the mechanism folds: a rocker turns back where its crank goes on, and beyond such a dead
centre what is measured tells two places. Joints that are moved by the motion that opens there do not follow, nor do
those of a loop that does not close.
"""

from __future__ import annotations

import copy
from collections.abc import Collection, Iterator

import mujoco
import numpy as np

from sipe_bayes.core.arrays import FloatArray, IntArray

SD = 0.1  # rad or m, and ten times as much a second: how far from closed a window may start, a noisy crank included
_STEP, _MOST, _TOLERANCE, _APART, _HARDLY = 0.05, 30, 1e-10, 1e-6, 1e-3
_LONGEST = 0.3  # rad or m, a step
_KEPT, _IN_VAIN = 0.1, 4  # of what a step promises; and how many in a row that keep less until a loop is given up
_FOLDED = 0.02  # of the largest singular value, now or by the next sample as it goes
_APPROACH = 40  # steps from the reset to the first sample, at least


class _Chain:
    """A model's equality constraints alone, and what they say of joints that nothing measures.

    Args:
        model: the model.
        known: ids of the joints that are measured, or of which the model says where they start.
        position: (nq,) where the chain is assembled; it is closed from there.
    """

    def __init__(self, model: mujoco.MjModel, known: Collection[int], position: FloatArray) -> None:
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
        unknown = [j for j in range(model.njnt) if j not in known]
        self.dofs = np.array([d for j in unknown for d in dofs_of(model, j)], int)
        self.position = self.closed(position)
        jacobian = self.at(self.position)[1][:, self.dofs]
        self.scale = np.linalg.norm(jacobian, axis=0)  # of radians and metres
        self.scale[self.scale == 0] = 1.0
        sizes, ways = np.linalg.svd(jacobian / self.scale)[1:]
        self.rank = int((sizes > _APART * sizes.max(initial=0.0)).sum())
        moves = np.abs(ways[self.rank :]).max(axis=0, initial=0.0) > _HARDLY
        self.joints = [j for j in unknown if not moves[np.isin(self.dofs, dofs_of(model, j))].any()]

    def at(self, position: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Residuals (E,) and Jacobian (E, nv) at positions (nq,)."""
        self.data.qpos[:] = position
        mujoco.mj_fwdPosition(self.model, self.data)
        count = int(self.data.nefc)
        return self.data.efc_pos[:count].copy(), self.data.efc_J.reshape(-1, self.model.nv)[:count].copy()

    def closed(self, position: FloatArray) -> FloatArray:
        """Positions (nq,) at which joints that nothing measures are moved so that the chain closes."""
        out, way, wanted, vain = position.copy(), np.zeros(self.model.nv), np.inf, 0
        for _ in range(_MOST if len(self.dofs) else 0):
            residual, jacobian = self.at(out)
            size = float(np.abs(residual).max(initial=0.0))
            vain = vain + 1 if size > wanted and size > _TOLERANCE else 0
            if vain == _IN_VAIN:  # it can not be closed
                break
            step = -np.linalg.lstsq(jacobian[:, self.dofs], residual, rcond=_APART)[0]
            wanted = size * (1 - _KEPT * min(1.0, _LONGEST / max(float(np.abs(step).max(initial=0.0)), 1e-300)))
            way[self.dofs] = np.clip(step, -_LONGEST, _LONGEST)
            mujoco.mj_integratePos(self.model, out, way, 1.0)
            if np.abs(step).max() < _TOLERANCE:
                break
        return out

    def opening(self, position: FloatArray) -> tuple[float, set[int]]:
        """How far from a dead centre, as a share, and the joints that are loose there: all where a loop is open."""
        residual, jacobian = self.at(position)
        own = jacobian[:, self.dofs] / self.scale
        sizes, ways = np.linalg.svd(own)[1:]
        if np.abs(residual).max(initial=0.0) > SD * np.abs(jacobian).max(initial=1e-12):
            return 0.0, set(self.joints)
        loose = np.abs(ways[self.rank - 1]) > _HARDLY
        moved = {j for j in self.joints if loose[np.isin(self.dofs, dofs_of(self.model, j))].any()}
        return float(sizes[self.rank - 1] / sizes[0]), moved


def dofs_of(model: mujoco.MjModel, joint: int) -> IntArray:
    """Of a joint: one, three of a ball, six of a free joint."""
    sizes = {int(mujoco.mjtJoint.mjJNT_FREE): 6, int(mujoco.mjtJoint.mjJNT_BALL): 3}
    return int(model.jnt_dofadr[joint]) + np.arange(sizes.get(int(model.jnt_type[joint]), 1))


def _of_mocap(model: mujoco.MjModel, equality: int) -> bool:
    """Whether a constraint ties something to what a mocap body carries."""
    ids = [int(model.eq_obj1id[equality]), int(model.eq_obj2id[equality])]
    kind = int(model.eq_objtype[equality])
    if kind == int(mujoco.mjtObj.mjOBJ_SITE):
        bodies = [int(model.site_bodyid[i]) for i in ids]
    elif kind == int(mujoco.mjtObj.mjOBJ_TENDON):
        bodies = [body for i in ids if i >= 0 for body in _bodies_of(model, i)]
    elif kind == int(mujoco.mjtObj.mjOBJ_BODY):
        bodies = ids
    else:
        return False
    roots = model.body_rootid[bodies]
    return bool((model.body_mocapid[roots] >= 0).any() and len(set(roots.tolist())) > 1)


def _bodies_of(model: mujoco.MjModel, tendon: int) -> list[int]:
    """Bodies whose sites and geoms a spatial tendon runs along."""
    first = int(model.tendon_adr[tendon])
    owners = {int(mujoco.mjtWrap.mjWRAP_SITE): model.site_bodyid}
    owners |= dict.fromkeys((int(mujoco.mjtWrap.mjWRAP_SPHERE), int(mujoco.mjtWrap.mjWRAP_CYLINDER)), model.geom_bodyid)
    wraps = range(first, first + int(model.tendon_num[tendon]))
    kinds = [(int(model.wrap_type[w]), int(model.wrap_objid[w])) for w in wraps]
    return [int(owners[kind][index]) for kind, index in kinds if kind in owners]


def dependent_joints(model: mujoco.MjModel, known: Collection[int], reset: FloatArray | None = None) -> list[int]:
    """Ids of the joints that nothing measures and that closed chains tie to what is known.

    Args:
        model: the model.
        known: ids of the joints that are measured, or of which the model says where they start.
        reset: positions (nq,) where the chain is assembled; default those of the model.
    """
    if not model.neq or len(set(known)) == model.njnt:
        return []
    return _Chain(model, known, model.qpos0 if reset is None else reset).joints


def close(
    model: mujoco.MjModel, states: FloatArray, reset: FloatArray, known: Collection[int], along: bool = True
) -> list[int]:
    """Write positions and velocities of what nothing measures into states (T+1, S) along a log.

    Args:
        model: the model.
        states: of which the known joints are right.
        reset: a state (S,) in which the chain is assembled.
        known: ids of the joints that are measured, or of which the model says where they start.
        along: whether the states are one sample after the other, so that two tell where it goes.

    Returns:
        Ids of the joints that follow the known ones all along.
    """
    if not model.neq or len(set(known)) == model.njnt:
        return []
    nq, nv = model.nq, model.nv
    chain = _Chain(model, known, reset[1 : 1 + nq])
    if not chain.joints:
        return []
    others = np.setdiff1d(np.arange(nv), chain.dofs)
    position, follows = chain.position, set(chain.joints)

    def gone(goal: FloatArray, least: int) -> Iterator[FloatArray]:
        """The positions (nq,) on the way to where the known joints are at their goal, in at least so many steps."""
        way, ahead = np.zeros(nv), position.copy()
        mujoco.mj_differentiatePos(model, way, 1.0, position, goal)
        way[chain.dofs] = 0
        count = max(least, int(np.ceil(np.abs(way).max() / _STEP)))
        for _ in range(count):
            mujoco.mj_integratePos(model, ahead, way, 1.0 / count)
            ahead = chain.closed(ahead)
            yield ahead

    for position in gone(states[0, 1 : 1 + nq], _APPROACH):
        opening, loose = chain.opening(position)
        follows -= loose if opening < _FOLDED else set()
    last = 0.0
    for state in states:
        *_, position = gone(state[1 : 1 + nq], 1)
        opening, loose = chain.opening(position)
        follows -= loose if min(opening, 2 * opening - last if along else opening) < _FOLDED else set()
        last = opening
        state[1 : 1 + nq] = position
        jacobian = chain.at(position)[1]
        velocity = state[1 + nq : 1 + nq + nv]
        moved = jacobian[:, others] @ velocity[others]
        velocity[chain.dofs] = -np.linalg.lstsq(jacobian[:, chain.dofs], moved, rcond=_APART)[0]
    return sorted(follows)
