"""Positions that no channel measures but some tell: an angle of which cosine and sine are recorded.

Where fitted channels depend on the position of one hinge or slide that none of them measures directly, and on that of no other such one, it
is looked for sample by sample: the best of a grid over its range or the circle, then Gauss-Newton steps, with the parameters in the middle of
their ranges. It is a first guess for a search over states, so noise is left to that. It is taken only where it is unique, unlike an angle of
which the cosine alone is recorded, and fits. An unlimited slide is not looked for, nor the turns of a ball or of a free body.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from sipe_bayes.likelihood.state_space.chain import Chain

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_GRID, _STEPS, _DIFFERENCE = 32, 6, 1e-5  # values tried, Gauss-Newton steps, finite difference in rad or m
_SAMPLES, _VALUES = 16, 4  # with which it is seen whether a position matters at all
_HINGE, _SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
_MATTERS = 1e-6  # of a channel's spread
_UNIQUE = 0.9  # share of the samples at which the next best place must fit worse,
_CLEAR = 0.1  # by so many squared spreads
_FITS = 0.2  # of a channel's spread: root mean square of what may be left


def indirect_positions(
    chain: Chain, states: FloatArray, measured: BoolArray
) -> tuple[FloatArray, BoolArray, BoolArray]:
    """states (K, S) with such positions where they fit best, velocities too where none is measured; which positions (nv,) these are; and on
    which no fitted channel depends. measured (D,): coordinates that a channel measures directly."""
    model, states = chain.simulator.model, states.copy()
    told, idle = np.zeros(model.nv, bool), np.zeros(model.nv, bool)
    size = np.nanstd(np.where(chain.observed, chain.measured, np.nan), axis=0)
    size = np.maximum(size, chain.least[0])
    moving: dict[int, BoolArray] = {}  # degree of freedom -> channels (C,) that depend on its position
    for j in map(int, np.flatnonzero(~measured[: model.nv])):
        joint = int(model.dof_jntid[j])
        if int(model.jnt_type[joint]) in (_HINGE, _SLIDE):
            moving[j] = _moves(chain, states, int(model.jnt_qposadr[joint]), _values(model, joint), size)
            idle[j] = not moving[j].any()
        else:
            idle[j] = True
    alone = np.sum(list(moving.values()), axis=0) == 1
    for j, channels in moving.items():
        joint = int(model.dof_jntid[j])
        endless = int(model.jnt_type[joint]) == _SLIDE and not model.jnt_limited[joint]
        if endless or not (channels & alone).any():
            continue
        column = 1 + int(model.jnt_qposadr[joint])
        found = _best(chain, states, column, _values(model, joint), np.where(channels & alone, size, np.inf))
        if found is not None:
            states[:, column], told[j] = found, True
            if not measured[model.nv + j]:
                states[:, 1 + model.nq + j] = _slopes(chain, found)
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


def _moves(chain: Chain, states: FloatArray, position: int, values: FloatArray, size: FloatArray) -> BoolArray:
    """Which channels (C,) depend on a position."""
    at = np.unique(np.linspace(0, len(states) - 1, _SAMPLES).astype(int))
    tried = values[np.linspace(0, len(values) - 1, _VALUES).astype(int)]
    found = _predicted(chain, states[at], 1 + position, np.repeat(tried[:, None], len(at), axis=1), at)
    spread = np.where(chain.observed[at], np.nan_to_num(np.ptp(found, axis=0) / size), 0.0)
    return np.asarray((spread > _MATTERS).any(0))


def _best(chain: Chain, states: FloatArray, column: int, values: FloatArray, size: FloatArray) -> FloatArray | None:
    """Position (K,) of every sample; None where it is not unique, or does not fit. size (C,): infinite of channels that do not count."""
    tried = np.repeat(values[:, None], len(states), axis=1)
    left = _left(chain, _predicted(chain, states, column, tried), size)
    misfit = np.where(np.isnan(left), np.inf, left**2).sum(-1)
    spacing = float(values[1] - values[0])
    circle = bool(np.isclose(spacing * _GRID, 2 * np.pi))
    seen = np.ptp(np.where(np.isfinite(misfit), misfit, 0.0), axis=0) > _MATTERS
    if not seen.any() or (_lead(misfit[:, seen], circle) > _CLEAR).mean() < _UNIQUE:
        return None
    found = values[misfit.argmin(0)]
    for k in range(_STEPS):
        at, moved = _left(chain, _predicted(chain, states, column, np.stack([found, found + _DIFFERENCE])), size)
        slope = np.nan_to_num((at - moved) / _DIFFERENCE)
        steepness = (slope**2).sum(-1)
        step = (slope * np.nan_to_num(at)).sum(-1) / np.maximum(steepness, 1e-12)
        found = found + np.where(seen, np.clip(step, -spacing, spacing) / (1 + (k == 0)), 0.0)
    rest = _left(chain, _predicted(chain, states, column, found[None]), size)[0][:, np.isfinite(size)]
    counted = chain.observed[:, np.isfinite(size)]
    if not float(np.sqrt((rest[counted] ** 2).mean())) < _FITS:
        return None
    return _joined(chain, found, ~seen, circle)


def _lead(misfit: FloatArray, circle: bool) -> FloatArray:
    """By how much (K,) the best of the grid's local minima (G, K) is ahead of the next, infinite where it is the only one."""
    edge = np.full_like(misfit[:1], np.inf)
    before, after = (misfit[-1:], misfit[:1]) if circle else (edge, edge)
    minimum = (misfit <= np.concatenate([before, misfit[:-1]])) & (misfit < np.concatenate([misfit[1:], after]))
    values = np.sort(np.where(minimum, misfit, np.inf), axis=0)
    return np.asarray(np.where(np.isfinite(values[1]), values[1] - values[0], np.inf))


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
