r"""Friction that remembers where it came from: before it slides it is a spring.

- ``presliding``: a force -p s, with s the share of the friction that is built up (P. R. Dahl 1968, "A solid friction
  model"; C. Canudas de Wit et al. 1995, "A new model for control of systems with friction",
  https://doi.org/10.1109/9.376053), over the distance d:

  .. math:: \frac{ds}{dq} = (1 - s \, \mathrm{sign}(v)) / d.

- ``hysteresis``: a force -p mean(s_i) of elasto-plastic springs in parallel (W. D. Iwan 1966; Maxwell slip,
  F. Al-Bender, V. Lampaert, J. Swevers 2005, https://doi.org/10.1109/TAC.2005.858676), each at its limit after a
  distance d_i of its own, d / 4, d and 4 d.

Deviations:

- MuJoCo's ``dcmotor`` has the LuGre model too, with the bristles' deflection in rad as its state: how far it may be
  from rest where a window starts is then known only to the factor by which the distance is unknown, and a window pays
  for that. Here it is a share.
- ``presliding`` is the LuGre model without damping of the bristles and without its Stribeck curve, a law of its own.
- A step goes on with the distance that the joint has moved in it.
"""

from __future__ import annotations

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.envs.laws.base import Law, Now, Number


class Presliding(Law):
    """Dry friction that is built up over a small distance."""

    name, friction, memory = "presliding", False, 1
    numbers = (
        Number("presliding_friction", "force", minimum=0.0),
        Number("presliding_range", "position", 1.0, 1e-12, shape=True),
    )

    def value(self, now: Now) -> FloatArray:
        """-p s."""
        return -now.numbers[:, 0] * now.memory[:, 0]

    def remembered(self, now: Now, shift: FloatArray) -> FloatArray:
        """S closer to the direction of the shift."""
        direction = np.sign(shift)
        share = direction + (now.memory[:, 0] - direction) * np.exp(-np.abs(shift) / now.numbers[:, 1])
        return np.where(shift == 0, now.memory[:, 0], share)[:, None]


class Hysteresis(Law):
    """A force that lags behind the position, as of belts, cables and rubber."""

    name, friction, memory = "hysteresis", False, 3
    numbers = (
        Number("hysteresis_force", "force", minimum=0.0),
        Number("hysteresis_range", "position", 1.0, 1e-12, shape=True),
    )
    ranges = np.array([0.25, 1.0, 4.0])  # of the springs, in its own
    stretched = np.array([1.0, 0.5, 0.0])  # how far motion in one direction is likely to have stretched them

    def value(self, now: Now) -> FloatArray:
        """-p mean(s_i)."""
        first, second, third = now.memory.T
        return -now.numbers[:, 0] * (first + second + third) / 3

    def remembered(self, now: Now, shift: FloatArray) -> FloatArray:
        """Each spring stretched, as far as it goes."""
        return np.clip(now.memory + shift[:, None] / (now.numbers[:, 1:] * self.ranges), -1.0, 1.0)

    def moving(self, direction: FloatArray) -> FloatArray:
        """The short springs more than the long ones."""
        return direction[:, None] * self.stretched
