"""Samples of a log that are cut off at an extreme value, as a saturated sensor or command is, and rests that are not.

A signal that stays at its largest or smallest value is cut off where something else tells that it should move: the
set-point that it follows, what follows it, or where there is neither, anything else of the machine. Where that stands
still as well, it rests, as in the pauses of an arm that is led by hand.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sipe_bayes.calibration.signals import likeness
from sipe_bayes.core.arrays import BoolArray, FloatArray
from sipe_bayes.core.options import Options, option


@dataclass(frozen=True)
class Saturation(Options):
    """When samples at an extreme value count as cut off."""

    run: int = option(5, "in a row at the extreme value", "samples", least=2)
    share: float = option(0.01, "worth a note: dry friction holds a turning joint for a few", "of the samples", above=0)
    levels: int = option(10, "different values: a signal with fewer is switched, not clipped", least=2)
    quanta: float = option(2.5, "from as far it was cut off, from nearer it turned round", "smallest steps", above=0)
    follows: float = option(0.9, "from which a signal follows another, which tells its rests", "of variance", above=0)
    still: float = option(0.002, "within which what tells a rest stands still", "of its range", above=0)
    shaken: float = option(0.02, "by which a joint moves at most that is held", "of its range", above=0)
    late: float = option(0.25, "by which a joint follows its set-point at most", "s", above=0)


SATURATION = Saturation()
_COARSEST, _NOISIEST, _SPREAD = 0.02, 0.1, 6.0  # of a range, quanta and noise that count as still; in deviations
_LOOKED_AT = 50  # windows of a run


@dataclass(frozen=True)
class Signal:
    """A command or a measurement: seconds (n,) and values (n,), of which some may be missing.

    counted: False for what only tells whether others rest.
    """

    name: str
    time: FloatArray
    values: FloatArray
    command: bool
    counted: bool = True


def clipped_of(signals: Sequence[Signal]) -> dict[str, int]:
    """Samples of each signal of a log that are cut off."""
    known = []
    for signal in signals:
        ok = np.isfinite(signal.values)
        known.append(replace(signal, time=signal.time[ok], values=signal.values[ok]))
    return {s.name: count_clipped(s.values, s.command, _Rests(s, known)) for s in known if s.counted}


def count_clipped(
    values: FloatArray, command: bool = False, rests: Callable[[int, int], bool] = lambda start, stop: False
) -> int:
    """Samples of a signal (n,) stuck at its largest or smallest value, in runs of five or more.

    A quantised signal that rests or turns there also repeats itself; clipping cuts off a moving one. So a run
    counts only if two samples before or after it the signal is at least three quanta away, a quantum being
    its smallest step. Switched and constant signals have none, and a command that is 0 there rests: an idle rotor.
    Nor has a command of steps, which holds two other values at least half as long.

    Args:
        values: without those that are missing.
        command: whether it is one.
        rests: whether the machine rests from one sample to before another.
    """
    values = values[np.isfinite(values)]
    if len(np.unique(values)) < SATURATION.levels:
        return 0
    low, high = float(values.min()), float(values.max())
    far = SATURATION.quanta * _quantum(values)
    same = _runs(np.diff(values) == 0)
    holds = sorted(stop - start + 1 for start, stop in same if values[start] not in (0.0, low, high))
    usual = 2 * holds[-2] if command and len(holds) > 1 else 0
    return sum(
        stop - start
        for extreme in (low, high)
        if extreme or not command
        for start, stop in _stuck(values, extreme, far)
        if stop - start > usual and not rests(start, stop)
    )


def _quantum(values: FloatArray) -> float:
    """The smallest step, rounding apart; 0 for what is constant."""
    steps = np.abs(np.diff(values))
    steps = steps[steps > 1e-6 * np.ptp(values)]
    return float(steps.min()) if len(steps) else 0.0


def _stuck(values: FloatArray, extreme: float, far: float) -> list[tuple[int, int]]:
    away = np.concatenate([[0.0, 0.0], np.abs(values - extreme), [0.0, 0.0]])
    return [
        (start, stop)
        for start, stop in _runs(values == extreme)
        if stop - start >= SATURATION.run and max(away[start], away[stop + 3]) >= far
    ]


def _runs(true: BoolArray) -> list[tuple[int, int]]:
    """Where what is true begins and ends."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], true, [False]]).astype(np.int8))).tolist()
    return list(zip(edges[::2], edges[1::2], strict=True))


class _Rests:
    """Whether a signal rests in a run of its samples, by what goes with it."""

    def __init__(self, signal: Signal, signals: Sequence[Signal]) -> None:
        self._signal = signal
        self._others = [s for s in signals if s is not signal and len(s.time) > 1 and np.ptp(s.values)]
        self._beside: FloatArray | None = None  # (m, n): what tells a rest
        self._tolerance = np.zeros(0)
        self._late = 0

    def __call__(self, start: int, stop: int) -> bool:
        """Whether all that tells it stands still for half of the run."""
        if self._beside is None:
            self._beside = self._chosen()
            self._tolerance = np.array([_stillness(values) for values in self._beside])
            if self._late and self._signal.command:  # held there, a joint is still shaken by the others
                self._tolerance = np.maximum(self._tolerance, SATURATION.shaken * np.ptp(self._beside, axis=1))
        if not len(self._beside):
            return False
        first = max(0, start - (0 if self._signal.command else self._late))
        last = min(self._beside.shape[1], stop + (self._late if self._signal.command else 0))
        width = max(3, (stop - start + 1) // 2)
        places = np.unique(np.linspace(first, max(first, last - width), _LOOKED_AT).astype(int))
        moves = [np.ptp(self._beside[:, place : place + width], axis=1) for place in places]
        return any(bool((way <= self._tolerance).all()) for way in moves)

    def _chosen(self) -> FloatArray:
        """What it follows, or what follows it, and else all others, at its own times."""
        own = self._signal
        if not self._others:
            return np.zeros((0, len(own.time)))
        beside = np.stack([np.interp(own.time, s.time, s.values) for s in self._others])
        shares = [
            (likeness(values, own.values) if s.command else likeness(own.values, values)).share
            if s.command != own.command
            else 0.0
            for s, values in zip(self._others, beside, strict=True)
        ]
        if max(shares) < SATURATION.follows:
            return beside
        self._late = round(SATURATION.late / max(float(np.median(np.diff(own.time))), 1e-9))
        return beside[[int(np.argmax(shares))]]


def _stillness(values: FloatArray) -> float:
    """How far a signal (n,) goes at most while it stands still: a part of its range, some quanta, its noise."""
    span = float(np.ptp(values))
    noise = float(np.median(np.abs(np.diff(values, 3)))) / (0.6745 * np.sqrt(20)) if len(values) > 3 else 0.0
    quanta = min(SATURATION.quanta * _quantum(values), _COARSEST * span)
    return max(SATURATION.still * span, quanta, min(_SPREAD * noise, _NOISIEST * span))
