"""Transitions linearised over what is still open, by central differences as long as the posterior is wide.

Through rough contact the derivative at a point says little of its surroundings: a simulation of one control step jumps where a
contact opens or closes, differences of 1e-5 reach slopes of 1e5, and a smoother that believes them stops anywhere. A difference as
long as the sd of the state's coordinate averages over the contacts that are possible, and where the two sides of it do not lie
opposite each other, the jump gets a variance for what no line can follow. Both shrink as the states get known. This is the
iterated posterior linearisation smoother (A. F. Garcia-Fernandez, L. Svensson, S. Sarkka, "Iterated posterior linearization
smoother", IEEE Transactions on Automatic Control 62(4), 2017).

Deviations: one coordinate at a time instead of sigma points along the covariance's axes, a state's sd being that for a given theta, and
expectations stay those at the mean. The variance is half the squared deviation of the line between both ends, summed over coordinates and
theta: for a kink at the mean 0.36 of it would be right, for a parabola 2. What theta does to all jumps alike counts as independent
from jump to jump. Measurements get no such variance.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sipe_bayes.likelihood.state_space.chain import Chain
from sipe_bayes.likelihood.state_space.linearisation import ChainLinearisation

FloatArray = NDArray[np.float64]

_BENT = 0.5  # of a squared deviation from a line


def linearise(
    chain: Chain, theta: FloatArray, states: FloatArray, theta_step: FloatArray, state_step: FloatArray
) -> ChainLinearisation | None:
    """Everything at theta (N,), states (K, S), by steps (N,) and (K, D) to both sides, in one batch of 1 + 2 (N + D) control steps a
    state; None where it diverged. A difference of which one side diverges counts as zero, and as straight."""
    n, d = chain.num_theta, chain.num_start
    count = n + d
    thetas, lanes = np.tile(theta, (1 + 2 * count, 1)), np.tile(states, (1 + 2 * count, 1, 1))
    theta_step = np.maximum(theta_step, chain.simulator.environment.least_steps(theta))
    up, down = np.minimum(theta_step, 1 - theta), np.minimum(theta_step, theta)
    thetas[np.arange(1, n + 1), np.arange(n)] += up
    thetas[np.arange(count + 1, count + n + 1), np.arange(n)] -= down
    for j in range(d):
        tangent = np.zeros_like(state_step)
        tangent[:, j] = state_step[:, j]
        lanes[1 + n + j], lanes[1 + count + n + j] = chain.moved(states, tangent), chain.moved(states, -tangent)
    predicted, ends, valid = chain.simulate(thetas, lanes)
    if not valid[0].all():
        return None
    length = np.concatenate([np.repeat((up + down)[:, None], len(states), axis=1), 2 * state_step.T])[..., None]
    ahead, behind = slice(1, count + 1), slice(count + 1, None)
    share = np.concatenate([down / (up + down), np.full(d, 0.5)])[:, None, None]
    sound = (valid[ahead] & valid[behind])[..., None]
    seen = np.where(sound & chain.observed, (predicted[ahead] - predicted[behind]) / length, 0.0)
    turned, back = chain.difference(ends[ahead], ends[0]), chain.difference(ends[behind], ends[0])
    linked = sound[:, :-1] & chain.linked[:, None]
    reached = np.where(linked, ((turned - back) / length)[:, :-1], 0.0)
    straight = (share * turned + (1 - share) * back)[:, :-1]  # from here to the line between both ends
    bent = np.where(linked, straight, 0.0)
    seen, reached = np.moveaxis(seen, 0, -1), np.moveaxis(reached, 0, -1)
    return ChainLinearisation(
        **chain.compared(states, predicted[0], ends[0]),
        measurement=seen[..., n:],
        measurement_theta=seen[..., :n],
        transition=reached[..., n:],
        transition_theta=reached[..., :n],
        error=_BENT * (bent**2).sum(0),
    )
