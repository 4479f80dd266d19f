"""Outliers that only the residuals of a fit show, found before its noise is estimated.

They are masked as those of a log are when it is read (``sipe_bayes.core.wild_samples``): a redescending estimator of
two weights, all or nothing (P. Huber 1981, "Robust Statistics", 4.8).

More than a twentieth of a channel are no accidents: then none is masked. Within ``AFTER`` samples of a jump of a
command a residual may jump: the model follows a little sooner or later.
"""

from __future__ import annotations

import numpy as np

from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray
from sipe_bayes.core.rotations import continued
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.core.wild_samples import AFTER, MOST, NEIGHBOURS, SHORT, around, away_from, jumps
from sipe_bayes.likelihood.noise import NORMAL_MAD
from sipe_bayes.likelihood.windows import Windows


def wild_residuals(windows: Windows, residual: FloatArray) -> IntArray:
    """Samples (k, 3), each by log, number in it and channel of the model, that a residual (W, L, C) shows as wild.

    Only channels that measure positions and velocities of the state are looked at. A residual jumps where its step is
    longer than five robust sds and six times the steps around it. Where the measured position jumps as well, it may
    stay away for a tenth of the log.
    """
    found, follows = [], _follows_command(windows.trajectories)
    residual = _continued(windows, residual)
    for c, sequence in enumerate(windows.sequences):
        index, least = sequence.index, _least_jump(windows, c)
        series = residual[..., c].reshape(-1)[index]
        if not np.isfinite(least) or len(index) <= 2 * NEIGHBOURS + 1 or not np.isfinite(series).all():
            continue
        log, sample = windows.log[sequence.window], windows.start[sequence.window] + index % residual.shape[1]
        steps, within = np.abs(np.diff(series)), np.diff(log) == 0
        limit = max(5.0 * _scale(steps[within]), least * windows.spread[c])
        at, wild = np.flatnonzero((steps > limit) & within & ~follows[log[1:], sample[1:]]), np.zeros(len(index), bool)
        at = at[steps[at] > 6.0 * around(steps, at)]
        moved = np.abs(np.diff(windows.measured[..., c].reshape(-1)[index]))
        sudden = at[moved[at] > 20.0 * around(moved, at)]
        for number in np.unique(log[at]):
            first, past = np.searchsorted(log, [number, number + 1])
            edges = np.flatnonzero(np.diff(sequence.window[first:past]))  # a new initial state moves a residual there
            for places, longest in ((at, SHORT), (sudden, max(SHORT, int(0.1 * (past - first))))):
                places = places[(places >= first) & (places < past)] - first
                if not windows.num_start:  # to zero, where the initial state is known
                    places = np.setdiff1d(places, edges)
                wild[first:past] |= away_from(series[first:past, None], places, longest, edges)
        if wild.any() and wild.sum() <= MOST * len(index):
            found.append(np.stack([log[wild], sample[wild], np.full(wild.sum(), windows.channels[c])], axis=1))
    return np.concatenate(found) if found else np.zeros((0, 3), np.int64)


def _follows_command(logs: Trajectories) -> BoolArray:
    """Which samples (B, T + 1) come right after a command jumped; none of a log in which they jump all the time."""
    follows = np.zeros(logs.observations.shape[:2], bool)
    for own, actions, length in zip(follows, logs.actions, logs.length, strict=True):
        for command in actions[:length].T:
            at = jumps(command) + 1  # the first sample with the new one, which moves nothing yet
            for k in at if len(at) <= MOST * length else ():
                own[k + 1 : k + 1 + AFTER] = True
        own &= own.sum() <= MOST * AFTER * length
    return follows


def _continued(windows: Windows, residual: FloatArray) -> FloatArray:
    """Residuals (W, L, C) whose rotation vectors go on beyond half a turn: there a tumbling body would seem to flip."""
    out = residual.copy() if windows.rotations else residual
    for triple in map(list, windows.rotations):
        for own, observed in zip(out, windows.observed[..., triple].all(-1), strict=True):
            rows = np.flatnonzero(observed)[:, None]
            own[rows, triple] = continued(own[rows, triple])
    return out


def _least_jump(windows: Windows, channel: int) -> float:
    """Least jump of a fitted channel, of what it measured; infinite where it measures no state.

    Less of a position is the simulation's own. Impacts and slips do move a velocity in a step.
    """
    environment, model = windows.simulator.environment, getattr(windows.simulator, "model", None)
    if model is None:
        return np.inf
    number = windows.channels[channel]
    column = environment.state_columns(model)[number]
    posed = {c: reading.quantity for reading in environment.poses for c in reading.channels}
    if number in posed:
        return 1e-4 if posed[number] in ("position", "orientation") else 0.5
    if column is None:
        return np.inf
    return 1e-4 if column <= model.nq else 0.5


def _scale(steps: FloatArray) -> float:
    """Robust sd of steps (n,); of an encoder's, most of which are zero, that of the larger ones."""
    trimmed = steps[steps <= np.quantile(steps, 0.97)]
    return max(NORMAL_MAD * float(np.median(steps)), 1.1 * float(np.sqrt((trimmed**2).mean())))
