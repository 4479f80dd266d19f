"""What a column's numbers say by themselves: steps of a clock, wrap-around, slopes, filters, set-points."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sipe_bayes.core.arrays import FloatArray

_FEWEST = 20  # samples from which anything is said
_LATEST = 25  # samples that a column may lag behind another


class Slope(NamedTuple):
    """How one column (n,) follows another's slope."""

    factor: float  # of the other's slope in this one's terms: value = slope / factor
    share: float  # of its variance that the slope explains
    lag: float  # samples by which it is late


class Likeness(NamedTuple):
    """How a command (n,) follows a measurement: value = factor * measurement, and the share of variance."""

    factor: float
    share: float


def slope_of(position: FloatArray, velocity: FloatArray, dt: float = 1.0) -> Slope:
    """Whether a column is the slope of another; both (n,), dt in the clock's terms.

    Over a few samples the mean velocity is compared with the way travelled, which noise and rounding spoil less than
    differences of single samples.
    """
    known = np.isfinite(position), np.isfinite(velocity)
    if min(k.sum() for k in known) < _FEWEST or not np.ptp(position[known[0]]) or not np.ptp(velocity[known[1]]):
        return Slope(1.0, 0.0, 0.0)
    row = np.arange(max(k.argmax() for k in known), len(position) - max(k[::-1].argmax() for k in known))
    position, velocity = (  # one of them may have been measured at every fifth row only
        np.interp(row, np.flatnonzero(k), values[k]) for k, values in zip(known, (position, velocity), strict=True)
    )
    span = int(np.clip(len(position) // 60, 2, 12))
    way = (position[span:] - position[:-span]) / (span * dt)
    total = np.concatenate([[0.0], np.cumsum(0.5 * (velocity[1:] + velocity[:-1]))])
    mean = (total[span:] - total[:-span]) / span
    shares, best = _shares_of(way, mean, range(-2, min(_LATEST, len(way) // 4) + 1))
    lag = float(best - 2)
    if 0 < best < len(shares) - 1 and (bend := shares[best - 1] - 2 * shares[best] + shares[best + 1]) < 0:
        lag += 0.5 * (shares[best - 1] - shares[best + 1]) / bend
    a, b = _shift(way, mean, best - 2)
    # the geometric mean of both regressions, so that noise of either does not shrink it
    factor = float(np.sign(a @ b) * np.sqrt((a @ a) / max(float(b @ b), 1e-300))) or 1.0
    return Slope(factor, float(shares[best]), lag)


def likeness(command: FloatArray, measured: FloatArray) -> Likeness:
    """Whether a command (n,) looks like a measurement (n,) that comes later."""
    known = np.isfinite(command) & np.isfinite(measured)
    a, b = command[known], measured[known]
    if len(a) < _FEWEST or np.ptp(a) == 0 or np.ptp(b) == 0:
        return Likeness(1.0, 0.0)
    shares, best = _shares_of(a, b, range(min(_LATEST, len(a) // 4)))
    x, y = _shift(a, b, best)
    return Likeness(float(x @ y) / max(float(y @ y), 1e-300), float(shares[best]))


def _shift(way: FloatArray, mean: FloatArray, lag: int) -> tuple[FloatArray, FloatArray]:
    a, b = (way[: len(way) - lag], mean[lag:]) if lag >= 0 else (way[-lag:], mean[:lag])
    return a - a.mean(), b - b.mean()


def _shares_of(way: FloatArray, mean: FloatArray, lags: range) -> tuple[FloatArray, int]:
    """The share of variance that one explains of the other at each lag, and where it is largest."""
    pairs = [_shift(way, mean, lag) for lag in lags]
    sizes = [float((a @ a) * (b @ b)) for a, b in pairs]
    shares = [float((a @ b) ** 2 / size) if size > 0 else 0.0 for (a, b), size in zip(pairs, sizes, strict=True)]
    return np.array(shares), int(np.argmax(shares))


def turn_of(values: FloatArray) -> float:
    """The turn by which a column (n,) jumps where its angle wraps round, in its own unit; 0 where it never does."""
    finite = values[np.isfinite(values)]
    steps, span = np.abs(np.diff(finite)), np.ptp(finite) if len(finite) >= _FEWEST else 0.0
    for turn in (360.0, 2 * np.pi, 1.0):
        inside = 0.9 * turn < span <= 1.02 * turn
        if inside and (steps > 0.8 * turn).any() and np.quantile(steps, 0.9) < 0.25 * turn:
            return turn
    return 0.0


def white_share(values: FloatArray) -> float:
    """Power of a column (n,) in its upper quarter of frequencies over that in the quarter below; 1 for white noise.

    The motion itself lies further down. A filtered column has far less; rounding alone is white.
    """
    finite = values[np.isfinite(values)]
    if len(finite) < 8 * _FEWEST:
        return 1.0
    bent = np.diff(finite, 2)  # takes the motion down; whitened below
    power = np.abs(np.fft.rfft(bent * np.hanning(len(bent)))[1:]) ** 2
    power /= (2 - 2 * np.cos(np.linspace(0, np.pi, len(power) + 1)[1:])) ** 2
    quarter = len(power) // 4
    high, low = power[3 * quarter :].mean(), power[2 * quarter : 3 * quarter].mean()
    return float(high / low) if low > 0 else 1.0


def time_unit(period: float) -> str:
    """The unit of a clock by its usual step: robots are logged at 4 Hz to 4 kHz."""
    for unit, largest in (("s", 0.25), ("ms", 250.0), ("us", 250e3)):
        if period < largest:
            return unit
    return "ns"
