"""Minimising within bounds: a quadratic, a damped one in the unit cube, a smooth loss."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np

from sipe_bayes.core.arrays import FloatArray

_GAIN, _LONGEST_STEP = 1e-3, 2.0  # nats, and of a coordinate: the losses are in nats of logarithms


def box_quadratic(hessian: FloatArray, slope: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray | None:
    """Minimiser (N,) of a quadratic within the box from low to high, by MuJoCo's mju_boxQP.

    Of the Hessian (N, N) and the slope (N,) at zero; None where rounding leaves the Hessian not positive definite.
    """
    n = len(slope)
    minimum, factor, index = np.zeros(n), np.zeros((n, n + 7)), np.zeros(n, np.int32)
    rank = mujoco.mju_boxQP(minimum, factor, index, hessian, slope, low, high)
    return minimum if rank >= 0 else None


def damped_box_step(hessian: FloatArray, gradient: FloatArray, theta: FloatArray, damping: float) -> FloatArray:
    """Step (N,) within the unit cube around theta that maximises a quadratic model.

    Of the precision (N, N) and the pull (N,) there, damped by a share of the diagonal (Levenberg, Marquardt); zero
    where rounding leaves no positive definite model.
    """
    n = len(theta)
    # parameters that change nothing leave a zero on the diagonal
    damped = hessian + damping * np.diag(np.diag(hessian)) + 1e-12 * np.trace(hessian) / n * np.eye(n)
    step = box_quadratic(damped, -gradient, -theta, 1 - theta)
    return np.zeros(n) if step is None else step


def minimise(
    loss: Callable[[FloatArray], tuple[float, FloatArray]], x: FloatArray, bounds: FloatArray, curvature: FloatArray
) -> FloatArray:
    """Minimiser within bounds of a smooth loss, by BFGS steps.

    SciPy's L-BFGS-B stops early on these losses and its steps cost more than they do.

    Args:
        loss: value in nats and slope (N,) at a point (N,).
        x: (N,) where to begin.
        bounds: (2, N).
        curvature: (N,), a first diagonal Hessian.
    """
    hessian = np.diag(np.maximum(curvature, 1.0))
    value, slope = loss(x)
    for _ in range(100):
        low, high = np.maximum(bounds[0] - x, -_LONGEST_STEP), np.minimum(bounds[1] - x, _LONGEST_STEP)
        move = box_quadratic(hessian, slope, low, high)
        if move is None:
            return x
        expected = -float(slope @ move + 0.5 * move @ hessian @ move)
        if expected < _GAIN:
            return x
        # shorter until it gains
        trial, steeper = loss(x + move)
        while value - trial < 1e-4 * expected and np.abs(move).max() > 1e-9:
            move = 0.3 * move
            trial, steeper = loss(x + move)
        if trial >= value:
            return x
        # the Hessian learns what the slope has changed by
        bend, along = steeper - slope, hessian @ move
        if bend @ move < 0.1 * (move @ along):  # Powell's damping keeps the Hessian positive
            mix = 0.9 * (move @ along) / (move @ along - bend @ move)
            bend = mix * bend + (1 - mix) * along
        hessian += np.outer(bend, bend) / (bend @ move) - np.outer(along, along) / (move @ along)
        x, value, slope = x + move, trial, steeper
    return x
