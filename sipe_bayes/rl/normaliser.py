"""Running mean and spread of observations, merged batch by batch.

Chan, Golub, LeVeque, "Updating Formulae and a Pairwise Algorithm for Computing Sample Variances", 1979,
http://i.stanford.edu/pub/cstr/reports/cs/tr/79/773/CS-TR-79-773.pdf.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from sipe_bayes.core.arrays import FloatArray

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
        self.restore(Moments(np.zeros(1), np.zeros(size), np.zeros(size)))

    def update(self, observations: FloatArray) -> None:
        """Count observations (B, O) in."""
        if not len(observations):
            return
        before, number, mean = self._moments, len(observations), observations.mean(0)
        count, apart = before.count + number, mean - before.mean
        squares = before.squares + (((observations - mean) ** 2).sum(0) + apart**2 * before.count * number / count)
        self.restore(Moments(count, before.mean + apart * number / count, squares))

    def apply(self, observations: Tensor) -> Tensor:
        """Observations (B, O) in float32, shifted, scaled and clipped."""
        mean, scale = (torch.from_numpy(x).to(observations.device) for x in (self.mean, self.scale))
        return ((observations - mean) / scale).clamp_(-self.clip, self.clip)

    def state(self) -> Moments:
        """From which ``restore`` goes on."""
        return self._moments

    def restore(self, moments: Moments) -> None:
        """Go on from what ``state`` gave."""
        self._moments = moments
        spread = np.sqrt(moments.squares / moments.count) if moments.count[0] else np.ones_like(moments.mean)
        self.mean = moments.mean.astype(np.float32)
        self.scale = np.maximum(spread, _LEAST).astype(np.float32)
