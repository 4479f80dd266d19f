"""Wild samples: glitches of an encoder, lost packets, flips of a motion capture. No smooth motion explains them.

A wild sample jumps away from the samples around it and comes back. One far off weighs in a sum of squares as much as
thousands of good ones, so wild samples are masked, in two stages:

* ``wild_positions``: by the positions alone, as a log is read;
* ``wild_residuals``: by the residuals of a fit, before its noise is estimated. White noise passes this threshold once
  in 10^8 samples. It is a redescending estimator of two weights, all or nothing (P. Huber 1981, "Robust Statistics",
  4.8).

More than a twentieth of a channel are no accidents: then none is masked. Within ``AFTER`` samples of a jump of a
command a residual may jump: the model follows a little sooner or later.
"""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray
from sipe_bayes.core.rotations import continued
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.likelihood.noise import NORMAL_MAD
from sipe_bayes.likelihood.windows import Windows

AFTER = 5  # samples: a fast joint may follow a jump of a command
_NEIGHBOURS = 4  # steps on each side that a step is compared with
_SHORT = 3  # samples that a residual may stay away where no position jumps: friction slips
_MOST = 0.05  # share of a channel's samples from which they are no accidents


def jumps(values: FloatArray) -> IntArray:
    """Numbers k of the samples of a measured position (n,), or several (n, K), from which it jumps to the next, k + 1.

    A jump is 20 times as long as the steps around it, and a tenth of the log's range: quanta and noise jump as well.
    """
    rows = values.reshape(len(values), -1)
    steps = np.linalg.norm(np.diff(rows, axis=0), axis=-1)
    if len(steps) <= 2 * _NEIGHBOURS:
        return np.zeros(0, np.int64)
    spread = float(np.linalg.norm(np.ptp(rows, axis=0)))
    return np.flatnonzero(steps > np.maximum(20.0 * _around(steps), 0.1 * spread))


def wild_positions(values: FloatArray) -> BoolArray:
    """Which samples (n,) of a measured position (n,), or of a vector or aligned quaternion (n, K), are wild.

    NaN where nothing was measured. Fewer than 40 samples do not tell how a position moves.
    """
    rows = values.reshape(len(values), -1)
    wild, known = np.zeros(len(rows), bool), np.isfinite(rows).all(axis=1)
    for _ in range(5 if known.sum() >= 40 else 0):  # what is masked makes smaller ones stand out
        left = np.flatnonzero(known & ~wild)
        away = _away(rows[left], jumps(rows[left]), max(_SHORT, int(0.1 * known.sum())))
        if not away.any():
            break
        wild[left[away]] = True
    return wild if wild.sum() <= _MOST * known.sum() else np.zeros(len(rows), bool)


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
        if not np.isfinite(least) or len(index) <= 2 * _NEIGHBOURS + 1 or not np.isfinite(series).all():
            continue
        log, sample = windows.log[sequence.window], windows.start[sequence.window] + index % residual.shape[1]
        steps, within = np.abs(np.diff(series)), np.diff(log) == 0
        limit = np.maximum(5.0 * _scale(steps[within]), least * windows.spread[c])
        limit = np.maximum(6.0 * _around(steps), limit)
        at, wild = np.flatnonzero((steps > limit) & within & ~follows[log[1:], sample[1:]]), np.zeros(len(index), bool)
        moved = np.abs(np.diff(windows.measured[..., c].reshape(-1)[index]))
        sudden = at[moved[at] > 20.0 * _around(moved)[at]]
        for number in np.unique(log[at]):
            first, past = np.searchsorted(log, [number, number + 1])
            edges = np.flatnonzero(np.diff(sequence.window[first:past]))  # a new initial state moves a residual there
            for places, longest in ((at, _SHORT), (sudden, max(_SHORT, int(0.1 * (past - first))))):
                places = places[(places >= first) & (places < past)] - first
                if not windows.num_start:  # to zero, where the initial state is known
                    places = np.setdiff1d(places, edges)
                wild[first:past] |= _away(series[first:past, None], places, longest, edges)
        if wild.any() and wild.sum() <= _MOST * len(index):
            found.append(np.stack([log[wild], sample[wild], np.full(wild.sum(), windows.channels[c])], axis=1))
    return np.concatenate(found) if found else np.zeros((0, 3), np.int64)


def _follows_command(logs: Trajectories) -> BoolArray:
    """Which samples (B, T + 1) come right after a command jumped; none of a log in which they jump all the time."""
    follows = np.zeros(logs.observations.shape[:2], bool)
    for own, actions, length in zip(follows, logs.actions, logs.length, strict=True):
        for command in actions[:length].T:
            at = jumps(command) + 1  # the first sample with the new one, which moves nothing yet
            for k in at if len(at) <= _MOST * length else ():
                own[k + 1 : k + 1 + AFTER] = True
        own &= own.sum() <= _MOST * AFTER * length
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


def _away(rows: FloatArray, at: IntArray, longest: int, edges: IntArray | tuple[()] = ()) -> BoolArray:
    """Which of rows (n, K) lie between a jump ``at`` k -> k + 1 and the one that comes home, or at an end.

    Home is within .4 of the jump. A jump at one of ``edges`` alone puts nothing away.
    """
    away = np.zeros(len(rows), bool)
    here = 0
    while here < len(at):
        left, size = rows[at[here]], _distance(rows[at[here] + 1], rows[at[here]])
        later = at[here + 1 :][at[here + 1 :] <= at[here] + longest]
        home = np.flatnonzero(_distance(rows[later + 1], left) <= 0.4 * size)
        if len(home):
            away[at[here] + 1 : later[home[0]] + 1] = True
            here += int(home[0]) + 1
        elif at[here] not in edges and at[here] < _SHORT and not away.any():
            away[: at[here] + 1] = True
        elif at[here] not in edges and at[here] >= len(rows) - 1 - _SHORT:
            away[at[here] + 1 :] = True
        here += 1
    return away


def _distance(rows: FloatArray, other: FloatArray) -> FloatArray:
    """Of rows (..., K) from another (K,); quaternions (K = 4) and their negatives are the same."""
    plain = np.linalg.norm(rows - other, axis=-1)
    return np.minimum(plain, np.linalg.norm(rows + other, axis=-1)) if rows.shape[-1] == 4 else plain


def _around(steps: FloatArray) -> FloatArray:
    """Median (n,) of the steps on both sides of each."""
    padded = np.pad(steps, _NEIGHBOURS, mode="reflect")
    neighbours = np.delete(sliding_window_view(padded, 2 * _NEIGHBOURS + 1), _NEIGHBOURS, axis=1)
    return np.asarray(np.median(neighbours, axis=1))


def _scale(steps: FloatArray) -> float:
    """Robust sd of steps (n,); of an encoder's, most of which are zero, that of the larger ones."""
    trimmed = steps[steps <= np.quantile(steps, 0.97)]
    return max(NORMAL_MAD * float(np.median(steps)), 1.1 * float(np.sqrt((trimmed**2).mean())))
