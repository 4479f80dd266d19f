"""Points of finite differences by theta, within the cube: short ones to one side, long ones to both.

Where an effect rises in stairs or begins late (``Environment.least_steps``), a difference has to be long, and lies
around theta: to one side its slope is that of half its length further on, as a wrong model's residual shows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sipe_bayes.core.arrays import FloatArray, IntArray


@dataclass(frozen=True)
class ThetaDifferences:
    """Of N parameters, M of them to both sides.

    Args:
        theta: (N,), where.
        ahead: (N,), signed ways to the points ahead.
        back: (N,), to those behind; zero where there are none.
    """

    theta: FloatArray
    ahead: FloatArray
    back: FloatArray

    @classmethod
    def of(cls, theta: FloatArray, size: FloatArray, least: FloatArray) -> ThetaDifferences:
        """Of so long differences (N,), to both sides where they are long, of at least (N,)."""
        sign = np.where(theta + size <= 1, 1.0, -1.0)
        room = np.where(sign > 0, theta, 1 - theta)
        back = np.where(least > 0, np.minimum(0.5 * size, room), 0.0)
        return cls(theta, sign * (size - back), -sign * back)

    @property
    def both(self) -> IntArray:
        """(M,) those to both sides."""
        return np.flatnonzero(self.back)

    @property
    def length(self) -> FloatArray:
        """(N,), signed."""
        return self.ahead - self.back

    @property
    def points(self) -> FloatArray:
        """(N + M, N), those ahead and then those behind."""
        return np.concatenate([self.theta + np.diag(self.ahead), self.theta + np.diag(self.back)[self.both]])

    def other_way(self, wrong: IntArray) -> ThetaDifferences:
        """Some (K,) to the other side alone, within the cube, as long as all of them were."""
        ahead, back = self.ahead.copy(), self.back.copy()
        ahead[wrong] = np.clip(self.theta - self.length, 0, 1)[wrong] - self.theta[wrong]
        back[wrong] = 0.0
        return replace(self, ahead=ahead, back=back)
