"""Samples that no smooth motion explains: glitches of an encoder, packets that were lost, flips of a motion capture.

A position goes on from sample to sample as it does around; a wild sample jumps away and comes back. One far off counts
in a sum of squares as much as thousands of good ones, so such samples are masked, in two stages:

* in a log as it is read, by the positions alone (``wild_positions``), so that neither the fit nor the starts of windows
  nor the checks see them;
* in a fit, by the residuals it leaves before its noise is estimated (``wild_residuals``), which shows those that hide
  in the motion: a redescending estimator of two weights, all or nothing (P. Huber 1981, "Robust Statistics", 4.8).

A residual's threshold is one that white noise passes once in 10^8 samples, so that a clean log loses none. Where so
many would be masked that they are no accidents, none is. Within ``after`` samples of a jump of a command a residual
jumps too, if the model follows a little sooner or later: that says something of the model, and stays.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray
from sipe_bayes.core.options import Options, option
from sipe_bayes.core.rotations import continued
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.likelihood.noise import NORMAL_MAD
from sipe_bayes.likelihood.windows import Windows


@dataclass(frozen=True)
class WildOptions(Options):
    """When a sample counts as wild."""

    neighbours: int = option(4, "steps on each side that a step is compared with", least=1)
    position_times: float = option(20.0, "of the middle one of these, of a measured position", above=1)
    position_share: float = option(0.1, "of the log's range: quanta and noise jump as well", above=0)
    longest_share: float = option(0.1, "of a log: how long a position may stay away", above=0, below=0.5)
    residual_times: float = option(6.0, "of the middle step around, of a residual", above=1)
    residual_sds: float = option(5.0, "robust sds of all steps: twice in a row by chance once in 10^8", above=0)
    residual_share: float = option(1e-4, "of what the channel measured: less is the simulation's own", above=0)
    velocity_share: float = option(0.5, "the same of a velocity, which impacts and slips do move in a step", above=0)
    longest: int = option(3, "a residual may stay away where no measured position jumps: friction slips", "samples")
    after: int = option(5, "a fast joint may follow a jump of a command", "samples", least=0)
    home: float = option(0.4, "how near it comes back to where it left", "of the jump", above=0, below=1)
    most: float = option(0.05, "share of a channel's samples from which they are no accidents", above=0, below=1)
    fewest: int = option(40, "samples of a log that tell how a position moves", least=10)
    rounds: int = option(5, "searches: what is found makes smaller ones stand out", least=1)


WILD = WildOptions()
_NO_EDGES = np.zeros(0, np.int64)


def jumps(values: FloatArray) -> IntArray:
    """Numbers k of the samples of a measured position (n,), or several (n, K), from which it jumps to the next, k + 1.

    A step is a jump where it is far longer than those around it, of which most are those of a motion: a counter or an
    angle that came round, a wild sample (two jumps), samples that were lost.
    """
    rows = values.reshape(len(values), -1)
    steps = _length(np.diff(rows, axis=0))
    if len(steps) <= 2 * WILD.neighbours:
        return np.zeros(0, np.int64)
    spread = float(_length(np.ptp(rows, axis=0)))
    return np.flatnonzero(steps > np.maximum(WILD.position_times * _around(steps), WILD.position_share * spread))


def wild_positions(values: FloatArray) -> BoolArray:
    """Which samples (n,) of a measured position (n,), or of a vector or aligned quaternion (n, K), are wild.

    NaN where nothing was measured.
    """
    rows = values.reshape(len(values), -1)
    wild, known = np.zeros(len(rows), bool), np.isfinite(rows).all(axis=1)
    longest = max(WILD.longest, int(WILD.longest_share * known.sum()))
    for _ in range(WILD.rounds if known.sum() >= WILD.fewest else 0):
        left = np.flatnonzero(known & ~wild)
        away = _away(rows[left], jumps(rows[left]), longest)
        if not away.any():
            break
        wild[left[away]] = True
    return wild if wild.sum() <= WILD.most * known.sum() else np.zeros(len(rows), bool)


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
        limit = max(WILD.residual_sds * _scale(steps[within]), least * spread[c])
        sample = windows.start[sequence.window] + index % length
        free = ~follows[log[1:], sample[1:]]
        at, wild = np.flatnonzero((steps > limit) & within & free), np.zeros(len(index), bool)
        at = at[steps[at] > WILD.residual_times * _around(steps, at)]
        moved = np.abs(np.diff(windows.measured[..., c].reshape(-1)[index]))
        sudden = at[moved[at] > WILD.position_times * _around(moved, at)]
        for number in np.unique(log[at]):
            first, past = np.searchsorted(log, [number, number + 1])
            rows, longest = series[first:past, None], max(int(WILD.longest_share * (past - first)), WILD.longest)
            edges = np.flatnonzero(np.diff(sequence.window[first:past]))  # there a start of its own moves a residual
            own, seen = (one[(one >= first) & (one < past)] - first for one in (at, sudden))
            if not windows.num_start:  # to nought, where the start is known
                own, seen = np.setdiff1d(own, edges), np.setdiff1d(seen, edges)
            wild[first:past] = _away(rows, own, WILD.longest, edges) | _away(rows, seen, longest)
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


def _away(rows: FloatArray, at: IntArray, longest: int, edges: IntArray = _NO_EDGES) -> BoolArray:
    """Which of rows (n, K) lie between a jump ``at`` k -> k + 1 and the one that comes home, or at an end.

    A jump at one of ``edges`` alone puts nothing away.
    """
    away = np.zeros(len(rows), bool)
    here = 0
    while here < len(at):
        left, size = rows[at[here]], _distance(rows[at[here] + 1], rows[at[here]])
        later = at[here + 1 :][at[here + 1 :] <= at[here] + longest]
        home = np.flatnonzero(_distance(rows[later + 1], left) <= WILD.home * size) if len(later) else later
        if len(home):
            away[at[here] + 1 : later[home[0]] + 1] = True
            here += int(home[0]) + 1
        elif at[here] in edges:
            pass
        elif at[here] < WILD.longest and not away.any():
            away[: at[here] + 1] = True
        elif at[here] >= len(rows) - 1 - WILD.longest:
            away[at[here] + 1 :] = True
        here += 1
    return away


def _distance(rows: FloatArray, other: FloatArray) -> FloatArray:
    """Of rows (..., K) from another (K,); quaternions (K = 4) and their negatives are the same."""
    plain = _length(rows - other)
    return np.minimum(plain, _length(rows + other)) if rows.shape[-1] == 4 else plain


def _length(rows: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt((rows**2).sum(axis=-1)))


def _around(steps: FloatArray, at: IntArray | slice = slice(None)) -> FloatArray:
    """Median of the steps on both sides of each of steps (n,), or of those ``at``."""
    padded = np.pad(steps, WILD.neighbours, mode="reflect")
    window = sliding_window_view(padded, 2 * WILD.neighbours + 1)[at]
    return np.asarray(np.median(np.delete(window, WILD.neighbours, axis=1), axis=1))


def _scale(steps: FloatArray) -> float:
    """Robust sd of steps (n,); of an encoder's, most of which are zero, that of the larger ones."""
    trimmed = steps[steps <= np.quantile(steps, 0.97)]
    return max(NORMAL_MAD * float(np.median(steps)), 1.1 * float(np.sqrt((trimmed**2).mean())))
