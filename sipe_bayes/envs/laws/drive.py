r"""Forces of motors that MJCF has no element for.

- ``cogging``: a force a sin(n q) + b cos(n q).
- ``force_drop``: the actuator's force falls short by p f \|f\|.
- ``direction_gain``: it is larger by p one way and smaller the other: p \|f\|.
- ``power``: it goes with a power n of the model's, sign(f) F \|f / F\|^n; what the model has at F it has, too.
- ``dead_zone``: of the actuator's force up to d, either way, nothing arrives, and of more the rest.
- ``supply_sag``: it falls short by p f F, with F the forces of all actuators on one supply, added up by size: their
  currents lower the voltage that each of them gets.
"""

from __future__ import annotations

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.envs.laws.base import Law, Now, Number


class Cogging(Law):
    """A torque that goes round with the position."""

    name, friction = "cogging", False
    numbers = (
        Number("cogging_sin", "force"),
        Number("cogging_cos", "force"),
        Number("cogging_poles", "1", 1.0, shape=True),
    )

    def value(self, now: Now) -> FloatArray:
        """A sin(n q) + b cos(n q)."""
        a, b, poles = now.numbers.T
        return a * np.sin(poles * now.position) + b * np.cos(poles * now.position)


class ForceDrop(Law):
    """An actuator whose force falls short the more of it is asked for."""

    name, kind, senses, friction = "force_drop", "actuator", "force", False
    numbers = (Number("force_drop", "1/force"),)

    def value(self, now: Now) -> FloatArray:
        """-p f |f|."""
        return -now.numbers[:, 0] * now.sensed * np.abs(now.sensed)


class DirectionGain(Law):
    """An actuator that is stronger one way than the other."""

    name, kind, senses, friction = "direction_gain", "actuator", "force", False
    numbers = (Number("direction_gain", "1"),)

    def value(self, now: Now) -> FloatArray:
        """The force p |f|."""
        return now.numbers[:, 0] * np.abs(now.sensed)


class Power(Law):
    """An actuator whose force goes with a power of the model's, as a propeller's with the square of its speed."""

    name, kind, senses, friction = "power", "actuator", "force", False
    numbers = (
        Number("exponent", "1", 1.0, minimum=0.1),
        Number("exponent_force", "force", 1.0, minimum=1e-12, shape=True),
    )

    def value(self, now: Now) -> FloatArray:
        """The force f (|f / F|^(n - 1) - 1)."""
        exponent, whole = now.numbers.T
        share = np.abs(np.where(now.sensed == 0, whole, now.sensed) / whole)
        return np.asarray(now.sensed * (share ** (exponent - 1) - 1))


class DeadZone(Law):
    """An actuator of whose force the first bit moves nothing."""

    name, kind, senses, friction = "dead_zone", "actuator", "force", False
    numbers = (Number("dead_zone", "force", minimum=0.0),)

    def value(self, now: Now) -> FloatArray:
        """-min(max(f, -d), d)."""
        width = now.numbers[:, 0]
        return -np.clip(now.sensed, -width, width)


class SupplySag(Law):
    """Actuators on one supply, whose voltage falls with the currents of all."""

    name, kind, senses, friction = "supply_sag", "actuator", "force", False
    numbers = (Number("supply_sag", "1/force", minimum=0.0),)

    def value(self, now: Now) -> FloatArray:
        """-f min(p F, 1)."""
        return -now.sensed * np.minimum(now.numbers[:, 0] * now.total, 1.0)
