"""BayesSim's summary statistics of trajectories, for ``bayessim`` and ``abc``.

F. Ramos, R. Possas, D. Fox 2019, "BayesSim" (https://arxiv.org/abs/1906.01728), section IV-C: with the state
differences tau = s' - s, the mean and the variance of every channel of tau and the cross-products of tau with the
actions.

Deviations:

- The cross-products are averaged over the control steps, not summed, so that logs of different lengths compare.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sipe_bayes.core.arrays import FloatArray


def step_statistics(steps: NDArray[np.floating], num_observations: int, num_actions: int) -> FloatArray:
    """Summary statistics of sets of control steps.

    Args:
        steps: (n, M, 2 O + A), as ``transitions.control_steps`` makes them; those with NaN are left out.
        num_observations: O.
        num_actions: A.

    Returns:
        (n, 2 O + O A): means of s' - s, their variances, and means of their products with the actions; NaN where there
        is no step.

    Raises:
        ValueError: for steps of another shape.
    """
    expected = 2 * num_observations + num_actions
    if steps.ndim != 3 or steps.shape[2] != expected:
        raise ValueError(f"steps: expected shape (n, M, {expected}), got {steps.shape}; use control_steps")
    good = np.isfinite(steps).all(-1)
    count = np.maximum(good.sum(1), 1)[:, None]
    clean = np.where(good[..., None], steps, 0.0).astype(np.float64)
    taken, change = np.split(clean[..., num_observations:], [num_actions], axis=-1)
    mean = change.sum(1) / count
    deviation = np.where(good[..., None], change - mean[:, None], 0.0)
    variance = (deviation**2).sum(1) / count
    products = np.einsum("nmo,nma->noa", change, taken) / count[..., None]
    statistics = np.concatenate([mean, variance, products.reshape(len(steps), -1)], axis=1)
    return np.where(good.any(1)[:, None], statistics, np.nan)
