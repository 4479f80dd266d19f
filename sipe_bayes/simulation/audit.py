"""How far float32 is to be trusted: a share of the rollouts of a GPU is simulated again in float64.

A difference counts against the spread of its channel over all that was simulated with it, in time and between
rollouts: what parameters and commands do to it. Where contacts make a motion chaotic, a rounding error grows like any
other small change, and from some sample on the two motions part; until then they agree.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np

from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray
from sipe_bayes.core.findings import Code, Finding, finding
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.core.trajectory import Trajectories

SHARE = 1 / 256
_RESOLVED = 1e-4  # a thousand times the rounding of float32


@dataclass(frozen=True)
class Compared:
    """A rollout that was simulated twice.

    Args:
        steps: control steps of it.
        agreed: control steps until float32 and float64 part, ``steps`` where they never do.
        dt: seconds of a control step.
        difference: the largest until the end, in spreads of a channel; infinite where one of the two is not valid.
    """

    steps: int
    agreed: int
    dt: float
    difference: float


@dataclass
class Audit:
    """What is simulated again, and what that came to.

    Args:
        share: of the rollouts.
        rollouts: how many there were.
        compared: those that were simulated again.
    """

    share: float = SHARE
    rollouts: int = 0
    compared: list[Compared] = field(default_factory=list)

    def chosen(self, batch: int) -> IntArray:
        """Which of ``batch`` rollouts to come are simulated again: evenly spaced ones of all that there ever were."""
        number = np.floor((self.rollouts + np.arange(batch + 1) - 1) * self.share)
        self.rollouts += batch
        return np.flatnonzero(np.diff(number))

    @contextmanager
    def every(self) -> Iterator[None]:
        """Simulate all rollouts again meanwhile."""
        share, self.share = self.share, 1.0
        try:
            yield
        finally:
            self.share = share

    def compare(self, single: Trajectories, chosen: IntArray, double: Trajectories) -> None:
        """Note how far rollouts ``chosen`` of ``single``, in float32, are from ``double``, the same in float64."""
        unit = spread(single.observations, single.valid)
        with np.errstate(invalid="ignore"):
            difference = (np.abs(single.observations[chosen] - double.observations) / unit).max(-1)
        both = single.valid[chosen] & double.valid
        difference = np.where(both, difference, np.where(single.valid[chosen] == double.valid, 0.0, np.inf))
        apart = difference > THRESHOLDS.float32_difference
        steps = difference.shape[1] - 1
        agreed = np.where(apart.any(1), np.maximum(apart.argmax(1) - 1, 0), steps)
        rows = zip(agreed.tolist(), double.dt.tolist(), difference.max(1).tolist(), strict=True)
        self.compared += [Compared(steps, *row) for row in rows]

    def findings(self) -> list[Finding]:
        """What it came to; nothing where nothing was simulated again."""
        if not self.compared:
            return []
        apart, count = [one for one in self.compared if one.agreed < one.steps], len(self.compared)
        if not apart:
            percent = 100 * max(one.difference for one in self.compared)
            return [finding(Code.FLOAT32_AGREES, count=count, rollouts=self.rollouts, percent=percent)]
        tolerance, first = 100 * THRESHOLDS.float32_difference, min(apart, key=lambda one: one.agreed * one.dt)
        seconds, steps = first.agreed * first.dt, first.agreed
        return [
            finding(
                Code.FLOAT32_DIFFERS,
                count=len(apart),
                audited=count,
                tolerance=tolerance,
                seconds=seconds,
                steps=steps,
            )
        ]


def spread(observations: FloatArray, valid: BoolArray) -> FloatArray:
    """What each channel of (B, T+1, O) varies by (O,), where it was simulated, as far as float32 resolves that.

    At least a ten-thousandth of its size, and of what the middle one of the channels varies by: below, a difference is
    the rounding of one number.
    """
    seen = np.where(valid[..., None] & np.isfinite(observations), observations, np.nan)
    if not np.isfinite(seen).any():
        return np.ones(observations.shape[-1])
    sd, size = np.nanstd(seen, axis=(0, 1)), np.nanmax(np.abs(seen), axis=(0, 1))
    unit = np.maximum(sd, _RESOLVED * np.maximum(size, np.median(sd)))
    return np.where(unit > 0, unit, 1.0)
