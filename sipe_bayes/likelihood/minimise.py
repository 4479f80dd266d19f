"""Minimising a smooth loss within bounds."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

_GAIN, _MOST_STEPS, _LONGEST_STEP = 1e-3, 100, 2.0  # nats, steps, of a coordinate


def minimise(
    loss: Callable[[FloatArray], tuple[float, FloatArray]], x: FloatArray, bounds: FloatArray, curvature: FloatArray
) -> FloatArray:
    """Minimiser within bounds (2, n) of a smooth loss in nats, by BFGS steps from a first diagonal ``curvature`` (n,).

    SciPy's L-BFGS-B stops early on these losses and its steps cost more than they do."""
    hessian = np.diag(np.maximum(curvature, 1.0))
    value, slope = loss(x)
    for _ in range(_MOST_STEPS):
        low, high = np.maximum(bounds[0] - x, -_LONGEST_STEP), np.minimum(bounds[1] - x, _LONGEST_STEP)
        move, factor, index = np.zeros(len(x)), np.zeros((len(x), len(x) + 7)), np.zeros(len(x), np.int32)
        if mujoco.mju_boxQP(move, factor, index, hessian, slope, low, high) < 0:
            return x
        expected = -float(slope @ move + 0.5 * move @ hessian @ move)
        if expected < _GAIN:
            return x
        trial, steeper = loss(x + move)
        while value - trial < 1e-4 * expected and np.abs(move).max() > 1e-9:
            move = 0.3 * move
            trial, steeper = loss(x + move)
        if trial >= value:
            return x
        bend, along = steeper - slope, hessian @ move
        if bend @ move < 0.1 * (move @ along):  # Powell's damping keeps the Hessian positive
            mix = 0.9 * (move @ along) / (move @ along - bend @ move)
            bend = mix * bend + (1 - mix) * along
        hessian += np.outer(bend, bend) / (bend @ move) - np.outer(along, along) / (move @ along)
        x, value, slope = x + move, trial, steeper
    return x
