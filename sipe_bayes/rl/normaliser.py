"""Running mean and spread of observations, merged batch by batch (Chan, Golub, LeVeque, "Updating Formulae and a Pairwise
Algorithm for Computing Sample Variances", 1979, http://i.stanford.edu/pub/cstr/reports/cs/tr/79/773/CS-TR-79-773.pdf)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]

_LEAST = 1e-2  # spread below which a channel counts as constant and is not blown up


class Normaliser:
    """Of observations (B, O). clip: bound of what ``apply`` returns. ``mean`` and ``scale`` (O,) in float32."""

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

    def state(self) -> dict[str, NDArray[np.generic]]:
        """Arrays from which ``restore`` goes on."""
        return {"count": np.array([self._count]), "mean": self._mean.copy(), "squares": self._squares.copy()}

    def restore(self, state: dict[str, NDArray[np.generic]]) -> None:
        self._count = float(np.asarray(state["count"], float)[0])
        self._mean, self._squares = np.array(state["mean"], float), np.array(state["squares"], float)
        self._refresh()

    def _refresh(self) -> None:
        spread = np.sqrt(self._squares / self._count) if self._count else np.ones_like(self._mean)
        self.mean = self._mean.astype(np.float32)
        self.scale = np.maximum(spread, _LEAST).astype(np.float32)
