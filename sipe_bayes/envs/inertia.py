"""Inertia of a body in its own frame, and what a rigid body can have."""

from __future__ import annotations

import mujoco
import numpy as np

from sipe_bayes.core.arrays import FloatArray

_ROUNDING = 1e-9  # relative, of principal moments that diagonalising leaves


def body_frame_inertia(model: mujoco.MjModel, body: int) -> FloatArray:
    """Inertia (3, 3) in kg m^2 about the centre of mass, in the axes of the body's frame."""
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, model.body_iquat[body])
    rotation = matrix.reshape(3, 3)
    return rotation @ np.diag(model.body_inertia[body]) @ rotation.T


def restore_inertia(model: mujoco.MjModel, original: mujoco.MjModel, bodies: list[int]) -> None:
    """Give the bodies the inertia that they have in the model ``original``."""
    model.body_inertia[bodies] = original.body_inertia[bodies]
    model.body_iquat[bodies] = original.body_iquat[bodies]


def check_inertia(model: mujoco.MjModel, bodies: list[int]) -> bool:
    """Whether the principal moments of the bodies are ones a rigid body can have: positive, A + B >= C."""
    moments = np.sort(model.body_inertia[bodies], axis=1)
    return bool((moments[:, 0] >= 0).all() and (moments[:, 2] <= moments[:, :2].sum(1) * (1 + _ROUNDING)).all())
