r"""Friction that MJCF has no element for.

- ``load_friction``: dry friction grows by p \|tau_t\| (M. Duclusaud et al. 2024, "Extended Friction Models for the
  Physics Simulation of Servo Actuators", https://arxiv.org/abs/2410.08650, their load-dependent models).
- ``direction``: dry friction grows by p sign(v); and a force -p' \|v\|.
- ``stribeck``: dry friction grows by p exp(-(v / v_s)^2) (R. Stribeck 1902).
"""

from __future__ import annotations

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.envs.laws.base import Law, Now, Number


class LoadFriction(Law):
    """Dry friction that grows with the transmitted torque."""

    name, senses = "load_friction", "torque"
    numbers = (Number("load_friction", "1", minimum=0.0),)

    def value(self, now: Now) -> FloatArray:
        """P |tau_t|."""
        return now.numbers[:, 0] * np.abs(now.sensed)


class DirectionFriction(Law):
    """Dry friction that differs by direction."""

    name = "direction_friction"
    numbers = (Number("direction_friction", "force"),)

    def value(self, now: Now) -> FloatArray:
        """P sign(v)."""
        return now.numbers[:, 0] * np.sign(now.velocity)


class DirectionDamping(Law):
    """Viscous friction that differs by direction."""

    name, friction = "direction_damping", False
    numbers = (Number("direction_damping", "force/velocity"),)

    def value(self, now: Now) -> FloatArray:
        """-p |v|."""
        return -now.numbers[:, 0] * np.abs(now.velocity)


class Stribeck(Law):
    """Dry friction that is larger at low speed."""

    name = "stribeck"
    numbers = (
        Number("stribeck_friction", "force", minimum=0.0),
        Number("stribeck_velocity", "velocity", 1.0, 1e-12, shape=True),
    )

    def value(self, now: Now) -> FloatArray:
        """P exp(-(v / v_s)^2)."""
        excess, speed = now.numbers.T
        return excess * np.exp(-((now.velocity / speed) ** 2))
