"""Samples of a measured position that no smooth motion explains: glitches of an encoder, packets that were lost.

An outlier jumps away from the samples around it and comes back. In a sum of squares one outlier can weigh as much as
thousands of good samples. So outliers are left out of a log as it is read: neither the fit nor the initial states nor
the checks see them. A fit also leaves out those that its residuals show (``sipe_bayes.likelihood.wild_residuals``).
"""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray

AFTER = 5  # samples: a fast joint may follow a jump of a command
NEIGHBOURS = 4  # steps on each side that a step is compared with
SHORT = 3  # samples that a residual may stay away where no position jumps: friction slips
MOST = 0.05  # share of a channel's samples from which they are no accidents


def jumps(values: FloatArray) -> IntArray:
    """Numbers k of the samples of a measured position (n,), or several (n, K), from which it jumps to the next, k + 1.

    A jump is 20 times as long as the steps around it, and a tenth of the log's range: quanta and noise jump as well.
    """
    rows = values.reshape(len(values), -1)
    steps = np.linalg.norm(np.diff(rows, axis=0), axis=-1)
    if len(steps) <= 2 * NEIGHBOURS:
        return np.zeros(0, np.int64)
    spread = float(np.linalg.norm(np.ptp(rows, axis=0)))
    return np.flatnonzero(steps > np.maximum(20.0 * around(steps), 0.1 * spread))


def wild_positions(values: FloatArray) -> BoolArray:
    """Which samples (n,) of a measured position (n,), or of a vector or aligned quaternion (n, K), are outliers.

    NaN where nothing was measured. Fewer than 40 samples do not tell how a position moves.
    """
    rows = values.reshape(len(values), -1)
    wild, known = np.zeros(len(rows), bool), np.isfinite(rows).all(axis=1)
    for _ in range(5 if known.sum() >= 40 else 0):  # what is masked makes smaller ones stand out
        left = np.flatnonzero(known & ~wild)
        away = away_from(rows[left], jumps(rows[left]), max(SHORT, int(0.1 * known.sum())))
        if not away.any():
            break
        wild[left[away]] = True
    return wild if wild.sum() <= MOST * known.sum() else np.zeros(len(rows), bool)


def away_from(rows: FloatArray, at: IntArray, longest: int, edges: IntArray | tuple[()] = ()) -> BoolArray:
    """Which of rows (n, K) are outliers: between a jump ``at`` k -> k + 1 and the jump back, or at an end.

    A jump leads back if it ends within .4 of the first jump's length from where that began. A jump at one of ``edges``
    alone makes no outlier.
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
        elif at[here] not in edges and at[here] < SHORT and not away.any():
            away[: at[here] + 1] = True
        elif at[here] not in edges and at[here] >= len(rows) - 1 - SHORT:
            away[at[here] + 1 :] = True
        here += 1
    return away


def _distance(rows: FloatArray, other: FloatArray) -> FloatArray:
    """Of rows (..., K) from another (K,); quaternions (K = 4) and their negatives are the same."""
    plain = np.linalg.norm(rows - other, axis=-1)
    return np.minimum(plain, np.linalg.norm(rows + other, axis=-1)) if rows.shape[-1] == 4 else plain


def around(steps: FloatArray, at: IntArray | slice = slice(None)) -> FloatArray:
    """Median of the steps on both sides of each of steps (n,), or of those ``at``."""
    padded = np.pad(steps, NEIGHBOURS, mode="reflect")
    neighbours = np.delete(sliding_window_view(padded, 2 * NEIGHBOURS + 1)[at], NEIGHBOURS, axis=1)
    return np.asarray(np.median(neighbours, axis=1))
