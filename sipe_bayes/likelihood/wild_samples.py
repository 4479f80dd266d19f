"""Samples that hide in the motion, and that the residuals of a fit show before its noise is estimated.

They are masked as those of a log are when it is read (``sipe_bayes.core.wild_samples``): a redescending estimator of
two weights, all or nothing (P. Huber 1981, "Robust Statistics", 4.8).

A residual's threshold is one that white noise passes once in 10^8 samples, so that a clean log loses none. Where so
many would be masked that they are no accidents, none is. Within ``after`` samples of a jump of a command a residual
jumps too, if the model follows a little sooner or later: that says something of the model, and stays.
"""

from __future__ import annotations

import numpy as np

from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray
from sipe_bayes.core.rotations import continued
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.core.wild_samples import WILD, around, away_from, jumps
from sipe_bayes.likelihood.noise import NORMAL_MAD
from sipe_bayes.likelihood.windows import Windows


def wild_residuals(windows: Windows, residual: FloatArray) -> IntArray:
    """Samples (k, 3), each by log, number in it and channel of the model, that a residual (W, L, C) shows as wild.

    Asked of channels that measure positions and velocities of the state. Rotation vectors are followed beyond half a
    turn, where a body that tumbles otherwise than its simulation would seem to flip.
    """
    length, found, follows = residual.shape[1], [], _commanded(windows.trajectories)
    spread, residual = windows.spread, _continued(windows, residual)
    for c, sequence in enumerate(windows.sequences):
        index = sequence.index
        if not np.isfinite(least := _least(windows, c)) or len(index) <= 2 * WILD.neighbours + 1:
            continue
        series, log = residual[..., c].reshape(-1)[index], windows.log[sequence.window]
        if not np.isfinite(series).all():  # a window diverged
            continue
        steps, within = np.abs(np.diff(series)), np.diff(log) == 0
        limit = np.maximum(WILD.residual_sds * _scale(steps[within]), least * spread[c])
        limit = np.maximum(WILD.residual_times * around(steps), limit)
        sample = windows.start[sequence.window] + index % length
        free = ~follows[log[1:], sample[1:]]
        at, wild = np.flatnonzero((steps > limit) & within & free), np.zeros(len(index), bool)
        moved = np.abs(np.diff(windows.measured[..., c].reshape(-1)[index]))
        sudden = at[moved[at] > WILD.position_times * around(moved)[at]]
        for number in np.unique(log[at]):
            first, past = np.searchsorted(log, [number, number + 1])
            rows, longest = series[first:past, None], max(int(WILD.longest_share * (past - first)), WILD.longest)
            edges = np.flatnonzero(np.diff(sequence.window[first:past]))  # there a start of its own moves a residual
            own, seen = (one[(one >= first) & (one < past)] - first for one in (at, sudden))
            if not windows.num_start:  # to nought, where the start is known
                own, seen = np.setdiff1d(own, edges), np.setdiff1d(seen, edges)
            wild[first:past] = away_from(rows, own, WILD.longest, edges) | away_from(rows, seen, longest)
        if wild.any() and wild.sum() <= WILD.most * len(index):
            found.append(np.stack([log[wild], sample[wild], np.full(wild.sum(), windows.channels[c])], axis=1))
    return np.concatenate(found) if found else np.zeros((0, 3), np.int64)


def _commanded(logs: Trajectories) -> BoolArray:
    """Which samples (B, T + 1) come right after a command jumped; none of a log in which they jump all the time."""
    follows = np.zeros(logs.observations.shape[:2], bool)
    for own, actions, length in zip(follows, logs.actions, logs.length, strict=True):
        for command in actions[:length].T:
            at = jumps(command) + 1  # the first sample with the new one, which moves nothing yet
            for k in at if len(at) <= WILD.most * length else ():
                own[k + 1 : k + 1 + WILD.after] = True
        own &= own.sum() <= WILD.most * WILD.after * length
    return follows


def _continued(windows: Windows, residual: FloatArray) -> FloatArray:
    """Residuals (W, L, C) whose rotation vectors go on from sample to sample of each window."""
    out = residual.copy() if windows.rotations else residual
    for triple in map(list, windows.rotations):
        for own, observed in zip(out, windows.observed[..., triple].all(-1), strict=True):
            rows = np.flatnonzero(observed)[:, None]
            own[rows, triple] = continued(own[rows, triple])
    return out


def _least(windows: Windows, channel: int) -> float:
    """Least jump of a fitted channel, of what it measured; infinite where it measures no state."""
    environment, model = windows.simulator.environment, getattr(windows.simulator, "model", None)
    if model is None:
        return np.inf
    number = windows.channels[channel]
    column = environment.state_columns(model)[number]
    posed = {c: reading.quantity for reading in environment.poses for c in reading.channels}
    if number in posed:
        return WILD.residual_share if posed[number] in ("position", "orientation") else WILD.velocity_share
    if column is None:
        return np.inf
    return WILD.residual_share if column <= model.nq else WILD.velocity_share


def _scale(steps: FloatArray) -> float:
    """Robust sd of steps (n,); of an encoder's, most of which are zero, that of the larger ones."""
    trimmed = steps[steps <= np.quantile(steps, 0.97)]
    return max(NORMAL_MAD * float(np.median(steps)), 1.1 * float(np.sqrt((trimmed**2).mean())))
