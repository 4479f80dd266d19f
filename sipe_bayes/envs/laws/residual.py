"""A force that no named law gives.

``residual``: a Gaussian process of (q, v, u) by random Fourier features (A. Rahimi, B. Recht 2007, "Random Features for
Large-Scale Kernel Machines").
"""

from __future__ import annotations

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.envs.laws.base import Law, Now, Number

_FEATURES = 12


def _frequencies() -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(0)
    return rng.standard_normal((3, _FEATURES)), rng.uniform(0, 2 * np.pi, _FEATURES)


class Residual(Law):
    """A force that no named law gives: a function of position, velocity and command."""

    name, friction = "residual", False
    scales = ("residual_position", "residual_velocity", "residual_command")
    numbers = (
        *(Number(scale, "", 1.0, 1e-12, shape=True) for scale in scales),
        *(Number(f"residual_{k}", "force") for k in range(_FEATURES)),
    )
    frequencies, phases = _frequencies()

    def value(self, now: Now) -> FloatArray:
        """Sum over k of w_k cos(omega_k . (q / l_q, v / l_v, u / l_u) + b_k)."""
        inputs = np.stack([now.position, now.velocity, now.command], axis=1) / now.numbers[:, :3]
        # a column at a time: the last bit of a matrix product depends on the batch
        angles = sum((inputs[:, i, None] * row for i, row in enumerate(self.frequencies)), self.phases)
        features = np.cos(angles) * np.sqrt(2 / _FEATURES)
        return (now.numbers[:, 3:] * features).sum(1)
