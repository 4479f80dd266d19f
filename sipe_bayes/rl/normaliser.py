"""Running mean and spread of observations, merged batch by batch.

Chan, Golub, LeVeque, "Updating Formulae and a Pairwise Algorithm for Computing Sample Variances", 1979,
http://i.stanford.edu/pub/cstr/reports/cs/tr/79/773/CS-TR-79-773.pdf.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sipe_bayes.core.arrays import Float32Array, FloatArray

_LEAST = 1e-2  # spread below which a channel counts as constant and is not blown up


@dataclass(frozen=True)
class Moments:
    """Of observations seen so far: their number (1,), mean (O,) and sum of squared deviations (O,)."""

    count: FloatArray
    mean: FloatArray
    squares: FloatArray


class Normaliser:
    """Of observations (B, O), by ``mean`` and ``scale`` (O,) in float32.

    Args:
        size: O.
        clip: bound of what ``apply`` returns.
    """

    def __init__(self, size: int, clip: float) -> None:
        self.clip = clip
        self._count, self._mean, self._squares = 0.0, np.zeros(size), np.zeros(size)
        self._refresh()

    def update(self, observations: FloatArray) -> None:
        """Count observations (B, O) in."""
        if not len(observations):
            return
        count, mean = self._count + len(observations), observations.mean(0)
        apart = mean - self._mean
        self._squares += ((observations - mean) ** 2).sum(0) + apart**2 * self._count * len(observations) / count
        self._mean += apart * len(observations) / count
        self._count = count
        self._refresh()

    def apply(self, observations: Float32Array) -> Float32Array:
        """Observations (B, O), shifted, scaled and clipped."""
        return np.clip((observations - self.mean) / self.scale, -self.clip, self.clip)

    def state(self) -> Moments:
        """From which ``restore`` goes on."""
        return Moments(np.array([self._count]), self._mean.copy(), self._squares.copy())

    def restore(self, moments: Moments) -> None:
        """Go on from what ``state`` gave."""
        self._count = float(moments.count[0])
        self._mean, self._squares = moments.mean.copy(), moments.squares.copy()
        self._refresh()

    def _refresh(self) -> None:
        spread = np.sqrt(self._squares / self._count) if self._count else np.ones_like(self._mean)
        self.mean = self._mean.astype(np.float32)
        self.scale = np.maximum(spread, _LEAST).astype(np.float32)
