"""An extended Kalman filter through the logs, which proposes states from which the smoother goes on.

Contacts make the energy many-valleyed: a state smoothed from its own noisy measurement settles on the wrong side of a
contact, and little process noise then keeps it there, with an estimate that is overconfident. What the past says of a
state is sharper than its measurement: the filter (B. D. O. Anderson, J. B. Moore, "Optimal Filtering", 1979)
linearises each control step where it stands.

Deviations:

- Channels that are read late are left out, and no jump is an outlier; it only proposes.
"""

from __future__ import annotations

import numpy as np

from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray
from sipe_bayes.inference.laplace.state_space.options import SmoothingTuning
from sipe_bayes.likelihood.starts.estimates import STATE_STEP
from sipe_bayes.likelihood.state_space.chain import Chain
from sipe_bayes.likelihood.state_space.linearisation import ChainLinearisation, ChainNoise, eliminate_states


def filtered(
    chain: Chain,
    linear: ChainLinearisation,
    noise: ChainNoise,
    theta: FloatArray,
    states: FloatArray,
    tuning: SmoothingTuning,
) -> FloatArray | None:
    """States (K, S) of every log at theta (N,), filtered at once; None where the simulation diverges.

    Measurements are linear about ``states`` (K, S), where ``linear`` was taken; each control step is linearised where
    the filter stands.
    """
    size, timely = chain.num_start, ~chain.late
    covariance = eliminate_states(linear, noise).covariances()[0][chain.first] * tuning.filter_width
    at, out = np.flatnonzero(chain.first), states.copy()
    mean, thetas = states[at], np.tile(theta, (1 + size, 1))
    steps = np.concatenate([np.zeros((1, size)), STATE_STEP * np.eye(size)])
    while True:
        # what the measurements say of where each log stands
        mean, covariance = _update(chain, linear, noise, timely, at, mean, covariance, states)
        out[at] = mean
        on = np.append(chain.linked, False)[at]
        if not on.any():
            return out
        # one control step on, of the logs that have one
        at, mean, covariance = at[on], mean[on], covariance[on]
        _, ends, valid = chain.simulate(thetas, chain.moved(mean[None], steps[:, None]), at)
        if not valid[0].all():
            return None
        turned = chain.difference(ends[1:], ends[0]) / STATE_STEP
        transition = np.moveaxis(np.where(valid[1:, :, None], turned, 0.0), 0, -1)
        covariance = transition @ covariance @ np.swapaxes(transition, 1, 2) + np.diag(noise.process**2)
        at = at + 1
        mean = chain.moved(chain.reference[at], chain.difference(ends[0], chain.reference[at]))


def _update(
    chain: Chain,
    linear: ChainLinearisation,
    noise: ChainNoise,
    timely: BoolArray,
    at: IntArray,
    mean: FloatArray,
    covariance: FloatArray,
    states: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Means (R, S) and covariances (R, D, D) after the measurements of the chain's states ``at`` (R,)."""
    rows = linear.measurement[at][:, timely]
    away = chain.difference(mean, states[at])
    innovation = linear.residual[at][:, timely] - np.einsum("rcd,rd->rc", rows, away) * linear.observed[at][:, timely]
    cross = rows @ covariance
    spread = cross @ np.swapaxes(rows, 1, 2) + np.diag(noise.sd[timely] ** 2)
    gain = np.swapaxes(np.linalg.solve(spread, cross), 1, 2)
    covariance = covariance - gain @ cross
    moved = chain.moved(mean, np.einsum("rdc,rc->rd", gain, innovation))
    return moved, 0.5 * (covariance + np.swapaxes(covariance, 1, 2))
