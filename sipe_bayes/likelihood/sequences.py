"""The observed samples of logs in order of time, across windows and gaps; and which windows are kept of long logs."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray


@dataclass(frozen=True)
class Sequence:
    """The observed samples of one channel in order of time: rows of the flattened (W * L) samples.

    Args:
        index: (n,), the rows.
        previous: (n,), the row before; -1 begins a sequence.
        window: (n,), to which a row belongs.
        crosses: (n,), whether the row before belongs to another window.
        gap: (n,), since the row before, as an index into ``gaps``.
        gaps: seconds, ascending; infinite where a sequence begins.
    """

    index: IntArray
    previous: IntArray
    window: IntArray
    crosses: BoolArray
    gap: IntArray
    gaps: FloatArray

    def coefficients(self, tau: float) -> FloatArray:
        """Autoregression coefficient (n,) of each row; see ``coefficients``."""
        return coefficients(self.gaps, tau)[self.gap]


def cut(sequence: Sequence, first: IntArray) -> Sequence:
    """A sequence of which the rows of some windows, ``first``, do not depend on the row of the window before."""
    apart = sequence.crosses & np.isin(sequence.window, first)
    begin = len(sequence.gaps) - 1  # infinite
    return replace(
        sequence,
        previous=np.where(apart, -1, sequence.previous),
        crosses=sequence.crosses & ~apart,
        gap=np.where(apart, begin, sequence.gap),
    )


def coefficients(gaps: FloatArray, tau: float | FloatArray) -> FloatArray:
    """Autoregression coefficient of each gap in seconds; 0 for white noise (tau = 0) and infinite gaps."""
    return np.where(np.asarray(tau) > 0, np.exp(-gaps / np.maximum(tau, 1e-300)), 0.0)


def sequences(observed: BoolArray, sample: IntArray, log: IntArray, dt: FloatArray) -> list[Sequence]:
    """One Sequence for each of C channels: its samples in order of time; a gap of over 20 samples begins a new one.

    Args:
        observed: (W, L, C), samples that count.
        sample: (W, L), their number within the log.
        log: (W,), the log of each window.
        dt: (W,), seconds per sample.
    """
    _, length, channels = observed.shape
    by_channel, dt = [], _rates(dt)
    for c in range(channels):
        index = np.flatnonzero(observed[:, :, c].ravel())
        window, number = index // length, sample.ravel()[index]
        steps = np.diff(number, prepend=0)
        linked = np.zeros(len(index), bool)
        if len(index) > 1:
            linked[1:] = (log[window[1:]] == log[window[:-1]]) & (np.diff(window) <= 1) & (steps[1:] <= 20)
        previous = np.where(linked, np.concatenate([[-1], index[:-1]])[: len(index)], -1)
        seconds = np.where(linked, steps * dt[window], np.inf)
        gaps, gap = np.unique(np.asarray(np.round(seconds, 12), np.float64), return_inverse=True)
        crosses = linked & (window != np.concatenate([[-1], window[:-1]])[: len(index)])
        by_channel.append(Sequence(index, previous, window, crosses, gap, gaps))
    return by_channel


def spread_blocks(log: IntArray, share: float) -> IntArray:
    """Numbers of the windows that are kept of logs (W,): blocks of four, spread evenly over each log.

    share: of the windows, all from 1 on; at least two windows of each log are kept.
    """
    kept = []
    for number in np.unique(log):
        own = np.flatnonzero(log == number)
        count = min(len(own), max(2, round(share * len(own))))
        blocks = np.array_split(own, math.ceil(count / 4))
        sizes = [len(x) for x in np.array_split(np.arange(count), len(blocks))]
        for block, size in zip(blocks, sizes, strict=True):
            first = (len(block) - size) // 2
            kept.append(block[first : first + size])
    return np.concatenate(kept)


def _rates(dt: FloatArray) -> FloatArray:
    """Seconds per sample (W,), those alike to .1 % as the shortest of them: each length of a gap costs products."""
    alike = dt.copy()
    while (left := alike > 0).any():
        shortest = alike[left].min()
        alike[left & (alike <= shortest * (1 + 1e-3))] = -shortest
    return -alike


def _blocks(log: IntArray, start: IntArray, stride: IntArray) -> tuple[IntArray, IntArray]:
    """First sample and the end (W,) of the windows (W,) without a gap among which each is: a log's, if all are kept."""
    begins = np.ones(len(log), bool)
    begins[1:] = (log[1:] != log[:-1]) | (start[1:] != start[:-1] + stride[:-1])
    block = np.cumsum(begins) - 1
    last = np.append(np.flatnonzero(begins)[1:], len(log)) - 1
    return start[begins][block], (start + stride)[last][block]


def reached(
    remembers: FloatArray, dt: FloatArray, log: IntArray, start: IntArray, stride: IntArray
) -> tuple[IntArray, IntArray, IntArray]:
    """How many samples (W, C) after its start a window's predictions tell of it alone, and where they begin (W, C).

    And the control steps (W,) to the end of the log or block. The second differs where a log begins, or a block of one
    that is kept in part: no window predicts what tells of the time before, an eighth of the log or block at most.

    Args:
        remembers: (C,) seconds in which a channel tells of what was before; half a block's at most.
        dt: (W,) seconds between samples.
        log: (W,), of which each window is.
        start: (W,), its first sample.
        stride: (W,), control steps to the beginning of the next window.
    """
    first, past = _blocks(log, start, stride)
    length = past - first
    lead = np.minimum(np.ceil(remembers / dt[:, None] - 1e-9).astype(np.int64), length[:, None] // 2)
    into = (start - first)[:, None]
    left_out = np.minimum(lead, length[:, None] // 8) - into
    return lead, np.maximum(left_out, np.where(into, lead, 0)), past - start


def compared_samples(
    place: IntArray, stride: IntArray, left: IntArray, begin: IntArray, lead: IntArray, known: bool
) -> BoolArray:
    """Whether a window predicts a channel's sample (W, L, C); of zeros ``begin`` and ``lead`` each sample is of one.

    Args:
        place: (L,), in the window.
        stride: (W,), control steps to the beginning of the next window.
        left: (W,), to the end of the log or block.
        begin: (W, C), the first that it predicts.
        lead: (W, C), samples that predictions come later, see ``reached``.
        known: whether starts are, so that the samples after them are what a window predicts.
    """
    end, begin = (stride[:, None] + lead)[:, None], begin[:, None]
    place, inside = place[None, :, None], (place <= left[:, None])[..., None]
    if known:
        return np.asarray((place > begin) & (place <= end) & inside)
    at_end = (stride == left)[:, None, None] & (lead == 0)[:, None]
    return np.asarray((place >= begin) & (place < end + at_end) & inside)
