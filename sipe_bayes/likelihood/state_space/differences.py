"""A chain of states compared with its logs, and linearised by finite differences: short ones, or over what is open.

``linearise`` takes the derivative at a point. Through rough contact that says little of the point's surroundings: a
simulation of one control step jumps where a contact opens or closes, differences of 1e-5 reach slopes of 1e5, and a
smoother that believes them stops anywhere. ``linearise_widely`` takes central differences as long as the posterior is
wide. A difference as long as the sd of the state's coordinate averages over the contacts that are possible, and where
the two sides of it do not lie opposite each other, the jump gets a variance for what no line can follow. Both shrink as
the states get known. This is the iterated posterior linearisation smoother (A. F. Garcia-Fernandez, L. Svensson,
S. Sarkka, "Iterated posterior linearization smoother", IEEE Transactions on Automatic Control 62(4), 2017).

Deviations:

- One coordinate at a time instead of sigma points along the covariance's axes, a state's sd being that for a given
  theta, and expectations stay those at the mean.
- The variance is half the squared deviation of the line between both ends, summed over coordinates and theta: for a
  kink at the mean 0.36 of it would be right, for a parabola 2.
- What theta does to all jumps alike counts as independent from jump to jump.
- Measurements get no such variance.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.likelihood.starts.estimates import STATE_STEP
from sipe_bayes.likelihood.state_space.chain import Chain
from sipe_bayes.likelihood.state_space.linearisation import ChainLinearisation


def compare(
    chain: Chain, theta: FloatArray, states: FloatArray, slopes: ChainLinearisation | None = None
) -> list[ChainLinearisation | None]:
    """Hold what thetas (B, N) and states (B, K, S) predict against the logs: B comparisons, None where one diverged.

    Jacobians and their error are taken over from ``slopes``; else there are none.
    """
    predicted, ends, valid = chain.simulate(theta, states)
    return [
        _compared(chain, s, p, e, slopes) if v.all() else None
        for s, p, e, v in zip(states, predicted, ends, valid, strict=True)
    ]


def _compared(
    chain: Chain, states: FloatArray, predicted: FloatArray, ends: FloatArray, slopes: ChainLinearisation | None = None
) -> ChainLinearisation:
    """Residual, jump and offset of states (K, S) with predictions (K, C) and ends of control steps (K, S)."""
    none = np.empty(0)
    new = ChainLinearisation(
        residual=np.where(chain.observed, chain.measured - predicted, 0.0),
        jump=np.where(chain.linked[:, None], chain.difference(states[1:], ends[:-1]), 0.0),
        offset=np.where(chain.first[:, None], chain.difference(states, chain.reference), 0.0),
        observed=chain.observed,
        linked=chain.linked,
        precision=chain.prior_precision,
        measurement=none,
        measurement_theta=none,
        transition=none,
        transition_theta=none,
        error=np.zeros((1, 1)),
    )
    return new if slopes is None else replace(slopes, residual=new.residual, jump=new.jump, offset=new.offset)


def linearise(
    chain: Chain, theta: FloatArray, states: FloatArray, with_states: bool = True
) -> ChainLinearisation | None:
    """Everything at theta (N,) and states (K, S), in one batch of 1 + N + D control steps a state; None if it diverged.

    A difference whose simulation diverges counts as zero; so do the states' Jacobians unless ``with_states``.
    """
    n, d = chain.num_theta, chain.num_start
    count = 1 + n + d * with_states
    # one row of the batch for the point, for each parameter and for each coordinate
    # of theta by the root of what a rollout rounds to
    size = np.maximum(1e-4, chain.simulator.environment.least_steps(theta))
    sign = np.where(theta + size <= 1, 1.0, -1.0)
    thetas, all_states = np.tile(theta, (count, 1)), np.tile(states, (count, 1, 1))
    thetas[np.arange(1, n + 1), np.arange(n)] += sign * size
    for j in range(count - 1 - n):
        all_states[1 + n + j] = chain.moved(states, _along(np.full((len(states), d), STATE_STEP), j))
    predicted, ends, valid = chain.simulate(thetas, all_states)
    if not valid[0].all():
        return None
    length = np.concatenate([sign * size, np.full(count - 1 - n, STATE_STEP)])[:, None, None]
    both = valid[1:, :, None]
    seen = np.where(both & chain.observed, (predicted[1:] - predicted[0]) / length, 0.0)
    reached = np.where(both, chain.difference(ends[1:], ends[0]) / length, 0.0)[:, :-1]
    reached = np.where(chain.linked[:, None], reached, 0.0)
    error = np.zeros((len(chain.linked), d))
    return _with_slopes(chain, _compared(chain, states, predicted[0], ends[0]), seen, reached, error)


def linearise_widely(
    chain: Chain, theta: FloatArray, states: FloatArray, theta_step: FloatArray, state_step: FloatArray
) -> ChainLinearisation | None:
    """Everything over the surroundings of theta (N,) and states (K, S), in one batch of 1 + 2 (N + D) control steps.

    By differences of theta_step (N,), within the cube, and state_step (K, D) to both sides. None where it diverged; a
    difference of which one side diverges counts as zero, and as straight.
    """
    n, d = chain.num_theta, chain.num_start
    count = n + d
    # the point, then all one sides, then all the others
    thetas, all_states = np.tile(theta, (1 + 2 * count, 1)), np.tile(states, (1 + 2 * count, 1, 1))
    theta_step = np.maximum(theta_step, chain.simulator.environment.least_steps(theta))
    up, down = np.minimum(theta_step, 1 - theta), np.minimum(theta_step, theta)
    thetas[np.arange(1, n + 1), np.arange(n)] += up
    thetas[np.arange(count + 1, count + n + 1), np.arange(n)] -= down
    for j in range(d):
        tangent = _along(state_step, j)
        all_states[1 + n + j] = chain.moved(states, tangent)
        all_states[1 + count + n + j] = chain.moved(states, -tangent)
    predicted, ends, valid = chain.simulate(thetas, all_states)
    if not valid[0].all():
        return None
    length = np.concatenate([np.repeat((up + down)[:, None], len(states), axis=1), 2 * state_step.T])[..., None]
    ahead, behind = slice(1, count + 1), slice(count + 1, None)
    both = (valid[ahead] & valid[behind])[..., None]
    seen = np.where(both & chain.observed, (predicted[ahead] - predicted[behind]) / length, 0.0)
    turned, back = chain.difference(ends[ahead], ends[0]), chain.difference(ends[behind], ends[0])
    linked = both[:, :-1] & chain.linked[:, None]
    reached = np.where(linked, ((turned - back) / length)[:, :-1], 0.0)
    # how far the point itself is from the line between both ends
    share = np.concatenate([down / (up + down), np.full(d, 0.5)])[:, None, None]
    bent = np.where(linked, (share * turned + (1 - share) * back)[:, :-1], 0.0)
    error = 0.5 * (bent**2).sum(0)
    return _with_slopes(chain, _compared(chain, states, predicted[0], ends[0]), seen, reached, error)


def linearise_by(
    chain: Chain, theta: FloatArray, states: FloatArray, theta_step: FloatArray, state_step: FloatArray
) -> ChainLinearisation | None:
    """By differences as long as a search took them: ``linearise_widely``, or ``linearise`` where they are zero."""
    if not state_step.any():
        return linearise(chain, theta, states)
    return linearise_widely(chain, theta, states, theta_step, state_step)


def _along(lengths: FloatArray, coordinate: int) -> FloatArray:
    """Tangents (K, D) along one coordinate, of lengths (K, D)."""
    tangent = np.zeros_like(lengths)
    tangent[:, coordinate] = lengths[:, coordinate]
    return tangent


def _with_slopes(
    chain: Chain, linear: ChainLinearisation, seen: FloatArray, reached: FloatArray, error: FloatArray
) -> ChainLinearisation:
    """With Jacobians of measurements (N + D, K, C) and ends (N + D, K-1, D); those by the states zero where missing."""
    n, d = chain.num_theta, chain.num_start
    seen, reached = np.moveaxis(seen, 0, -1), np.moveaxis(reached, 0, -1)
    measurement, transition = seen[..., n:], reached[..., n:]
    if measurement.shape[-1] < d:
        measurement, transition = np.zeros((*seen.shape[:-1], d)), np.zeros((*reached.shape[:-1], d))
    return replace(
        linear,
        measurement=measurement,
        measurement_theta=seen[..., :n],
        transition=transition,
        transition_theta=reached[..., :n],
        error=error,
    )
