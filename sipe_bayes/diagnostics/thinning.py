"""Which windows of long or many logs a check looks at: what it asks costs simulations, and a part of them answers."""

from __future__ import annotations

import numpy as np

from sipe_bayes.core.arrays import IntArray
from sipe_bayes.likelihood.windows import Windows


def spread_windows(windows: Windows, most_steps: int, every_log: bool = False, at_least: int = 8) -> IntArray:
    """Numbers of windows, spread evenly over the logs.

    Args:
        windows: the logs.
        most_steps: control steps that they have together, about.
        every_log: whether one of every log is among them, whatever they take.
        at_least: so many windows, whatever they take; all where there are no more.
    """
    every, count = windows.num_windows, max(int(most_steps / windows.steps.mean()), at_least)
    if count >= every:
        return np.arange(every)
    kept = ((np.arange(count) + 0.5) * every / count).astype(int)
    if every_log:
        missed = np.setdiff1d(windows.log, windows.log[kept])
        kept = np.sort(np.concatenate([kept, [np.flatnonzero(windows.log == log)[0] for log in missed]]).astype(int))
    return kept
