"""Samples of a measured position that no smooth motion explains: glitches of an encoder, packets that were lost.

A position goes on from sample to sample as it does around; a wild sample jumps away and comes back. One far off counts
in a sum of squares as much as thousands of good ones, so such samples are left out of a log as it is read, and neither
the fit nor the starts of windows nor the checks see them. A fit leaves out those that its residuals show
(``sipe_bayes.likelihood.wild_residuals``).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray
from sipe_bayes.core.options import Options, option


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
    return np.flatnonzero(steps > np.maximum(WILD.position_times * around(steps), WILD.position_share * spread))


def wild_positions(values: FloatArray) -> BoolArray:
    """Which samples (n,) of a measured position (n,), or of a vector or aligned quaternion (n, K), are wild.

    NaN where nothing was measured.
    """
    rows = values.reshape(len(values), -1)
    wild, known = np.zeros(len(rows), bool), np.isfinite(rows).all(axis=1)
    longest = max(WILD.longest, int(WILD.longest_share * known.sum()))
    for _ in range(WILD.rounds if known.sum() >= WILD.fewest else 0):
        left = np.flatnonzero(known & ~wild)
        away = away_from(rows[left], jumps(rows[left]), longest)
        if not away.any():
            break
        wild[left[away]] = True
    return wild if wild.sum() <= WILD.most * known.sum() else np.zeros(len(rows), bool)


def away_from(rows: FloatArray, at: IntArray, longest: int, edges: IntArray = _NO_EDGES) -> BoolArray:
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


def around(steps: FloatArray) -> FloatArray:
    """Median (n,) of the steps on both sides of each."""
    padded = np.pad(steps, WILD.neighbours, mode="reflect")
    window = sliding_window_view(padded, 2 * WILD.neighbours + 1)
    return np.asarray(np.median(np.delete(window, WILD.neighbours, axis=1), axis=1))
