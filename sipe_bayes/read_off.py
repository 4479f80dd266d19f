"""Positions that no channel measures but some tell: an angle of which cosine and sine are recorded.

Where fitted channels depend on the position of a hinge or a slide that none of them measures directly, it is looked for sample by sample:
the best of a grid over its range or the circle, then Gauss-Newton steps, one position after the other, with the parameters in the middle of
their ranges. It is a first guess for a search over states, so noise is left to that. An unlimited slide is not looked for, nor the turns of a
ball or of a free body, nor what several positions tell only together.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from sipe_bayes.state_space import Chain

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_GRID, _STEPS, _DIFFERENCE = 32, 6, 1e-5  # values tried, Gauss-Newton steps, finite difference in rad or m
_SAMPLES, _VALUES = 16, 4  # with which it is seen whether a position matters at all
_HINGE, _SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
_MATTERS = 1e-6  # of a channel's spread


def read_off(chain: Chain, states: FloatArray, measured: BoolArray) -> tuple[FloatArray, BoolArray, BoolArray]:
    """states (K, S) with such positions where they fit best, velocities too where none is measured; which positions (nv,) these are; and on
    which no fitted channel depends. measured (D,): coordinates that a channel measures directly."""
    model, states = chain.simulator.model, states.copy()
    told, idle = np.zeros(model.nv, bool), np.zeros(model.nv, bool)
    size = np.nanstd(np.where(chain.observed, chain.measured, np.nan), axis=0)
    size = np.maximum(size, chain.least[0])
    for j in np.flatnonzero(~measured[: model.nv]):
        joint = int(model.dof_jntid[j])
        if int(model.jnt_type[joint]) not in (_HINGE, _SLIDE):
            idle[j] = True
            continue
        column, values = 1 + int(model.jnt_qposadr[joint]), _values(model, joint)
        idle[j] = not _matters(chain, states, column, values, size)
        if idle[j] or (model.jnt_type[joint] == _SLIDE and not model.jnt_limited[joint]):
            continue
        states[:, column] = _best(chain, states, column, values, size)
        told[j] = True
        if not measured[model.nv + j]:
            states[:, 1 + model.nq + j] = _slopes(chain, states[:, column])
    return states, told, idle


def _values(model: Any, joint: int) -> FloatArray:
    """What a position may be; of an unlimited slide something near by."""
    if model.jnt_limited[joint]:
        low, high = model.jnt_range[joint]
        return np.linspace(float(low), float(high), _GRID)
    reach = np.pi if model.jnt_type[joint] == _HINGE else 1.0
    return np.linspace(-reach, reach, _GRID, endpoint=False)


def _predicted(chain: Chain, states: FloatArray, column: int, values: FloatArray, at: Any = None) -> FloatArray:
    """Predictions (B, K, C) with values (B, K) in a column of the states (K, S), NaN where they diverge."""
    many = np.repeat(states[None], len(values), axis=0)
    many[..., column] = values
    middle = np.full((len(values), chain.num_theta), 0.5)
    predicted, _, _ = chain.simulate(middle, many, at)
    return predicted


def _matters(chain: Chain, states: FloatArray, column: int, values: FloatArray, size: FloatArray) -> bool:
    at = np.unique(np.linspace(0, len(states) - 1, _SAMPLES).astype(int))
    tried = values[np.linspace(0, len(values) - 1, _VALUES).astype(int)]
    found = _predicted(chain, states[at], column, np.repeat(tried[:, None], len(at), axis=1), at)
    spread = np.nan_to_num(np.ptp(found, axis=0) / size)
    return bool((spread[chain.observed[at]] > _MATTERS).any())


def _best(chain: Chain, states: FloatArray, column: int, values: FloatArray, size: FloatArray) -> FloatArray:
    """Position (K,) of every sample."""
    tried = np.repeat(values[:, None], len(states), axis=1)
    left = _left(chain, _predicted(chain, states, column, tried), size)
    misfit = np.where(np.isnan(left), np.inf, left**2).sum(-1)
    blind = np.ptp(np.where(np.isfinite(misfit), misfit, 0.0), axis=0) <= _MATTERS
    found, spacing = values[misfit.argmin(0)], float(values[1] - values[0])
    for k in range(_STEPS):
        at, moved = _left(chain, _predicted(chain, states, column, np.stack([found, found + _DIFFERENCE])), size)
        slope = np.nan_to_num((at - moved) / _DIFFERENCE)
        steepness = (slope**2).sum(-1)
        step = (slope * np.nan_to_num(at)).sum(-1) / np.maximum(steepness, 1e-12)
        found = found + np.where(blind, 0.0, np.clip(step, -spacing, spacing) / (1 + (k == 0)))
    return _joined(chain, found, blind, circle=bool(np.isclose(spacing * _GRID, 2 * np.pi)))


def _left(chain: Chain, predicted: FloatArray, size: FloatArray) -> FloatArray:
    """Residuals (B, K, C) in units of the channels' spread, zero where nothing was observed."""
    return np.where(chain.observed, (chain.measured - predicted) / size, 0.0)


def _joined(chain: Chain, found: FloatArray, blind: BoolArray, circle: bool) -> FloatArray:
    """Log by log without jumps round the circle, and between the samples that tell."""
    joined = found.copy()
    for log in np.unique(chain.log):
        mine = np.flatnonzero(chain.log == log)
        seen = mine[~blind[mine]]
        if len(seen):
            along = np.unwrap(found[seen]) if circle else found[seen]
            joined[mine] = np.interp(mine, seen, along)
    return joined


def _slopes(chain: Chain, positions: FloatArray) -> FloatArray:
    """Velocities (K,) of positions."""
    found = np.zeros_like(positions)
    for log in np.unique(chain.log):
        mine = chain.log == log
        if mine.sum() > 1:
            found[mine] = np.gradient(positions[mine]) / chain.dt[mine]
    return found
