"""Steps between states: of the positions in the model's degrees of freedom, of velocities and activations as they are.

The turn of a ball or a free body is a rotation vector (``mj_integratePos``, ``mj_differentiatePos``); time stays as it
is, and so does what else a state holds.
"""

from __future__ import annotations

import mujoco
import numpy as np

from sipe_bayes.core.arrays import FloatArray


def moved(model: mujoco.MjModel, states: FloatArray, tangent: FloatArray) -> FloatArray:
    """States (..., S) moved by tangents (..., 2 nv + na); either may have fewer leading dimensions."""
    shape = np.broadcast_shapes(states.shape[:-1], tangent.shape[:-1])
    out = np.broadcast_to(states, (*shape, states.shape[-1])).copy()
    tangent = np.broadcast_to(tangent, (*shape, tangent.shape[-1]))
    nq, nv = model.nq, model.nv
    if nq == nv:
        out[..., 1 : 1 + nq] += tangent[..., :nv]
    else:
        flat, turns = out.reshape(-1, out.shape[-1]), tangent.reshape(-1, tangent.shape[-1])
        for state, turn in zip(flat, turns, strict=True):
            position = state[1 : 1 + nq].copy()
            mujoco.mj_integratePos(model, position, np.ascontiguousarray(turn[:nv]), 1.0)
            state[1 : 1 + nq] = position
    out[..., 1 + nq : 1 + nq + nv + model.na] += tangent[..., nv:]
    return out


def tangents(model: mujoco.MjModel, after: FloatArray, before: FloatArray) -> FloatArray:
    """Tangents (..., 2 nv + na) that lead from states ``before`` (..., S) to ``after``."""
    nq, nv, end = model.nq, model.nv, 1 + model.nq + model.nv + model.na
    after, before = np.broadcast_arrays(after, before)
    rest = after[..., 1 + nq : end] - before[..., 1 + nq : end]
    if nq == nv:
        return np.concatenate([after[..., 1 : 1 + nq] - before[..., 1 : 1 + nq], rest], axis=-1)
    turn = np.empty((*after.shape[:-1], nv))
    rows = (turn.reshape(-1, nv), before.reshape(-1, before.shape[-1]), after.reshape(-1, after.shape[-1]))
    for out, one, two in zip(*rows, strict=True):
        mujoco.mj_differentiatePos(model, out, 1.0, one[1 : 1 + nq].copy(), two[1 : 1 + nq].copy())
    return np.concatenate([turn, rest], axis=-1)
