"""The chain's linear algebra against dense matrices, and the gradient of its noise against differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sipe_bayes.inference.laplace.state_space.options import OutlierTuning
from sipe_bayes.inference.laplace.state_space.outlying_jumps import rarity, regular_gains
from sipe_bayes.inference.laplace.state_space.smoother import border
from sipe_bayes.likelihood.block_tridiagonal import Border
from sipe_bayes.likelihood.quadratic_prior import QuadraticPrior
from sipe_bayes.likelihood.state_space.linearisation import (
    ChainLinearisation,
    ChainNoise,
    eliminate_states,
    energy,
    expected_squares,
    jump_normal,
    log_likelihood,
    restricted,
)

FLAT = QuadraticPrior(np.full(2, 0.5), np.zeros((2, 2)))


def random_chain(
    rng: np.random.Generator, some_outliers: bool = False, bent: bool = False
) -> tuple[ChainLinearisation, ChainNoise]:
    """Two logs of 4 and 3 states with 3 coordinates, 2 channels, 2 parameters; with outliers and errors."""
    k, d, c, n = 7, 3, 2, 2
    linked = np.array([True, True, True, False, True, True])
    first = np.array([True, False, False, False, True, False, False])
    observed = rng.uniform(size=(k, c)) < 0.8
    rows, links = observed[..., None], linked[:, None, None]
    linear = ChainLinearisation(
        residual=observed * rng.standard_normal((k, c)),
        jump=linked[:, None] * rng.standard_normal((k - 1, d)),
        offset=first[:, None] * rng.standard_normal((k, d)),
        observed=observed,
        linked=linked,
        precision=first[:, None] * rng.uniform(0.1, 1, (k, d)),
        measurement=rows * rng.standard_normal((k, c, d)),
        measurement_theta=rows * rng.standard_normal((k, c, n)),
        transition=links * rng.standard_normal((k - 1, d, d)),
        transition_theta=links * rng.standard_normal((k - 1, d, n)),
        error=np.zeros((k - 1, d)),
    )
    noise = ChainNoise(rng.uniform(0.3, 1, c), rng.uniform(0.3, 1, d))
    if some_outliers:  # wider in two coordinates, in the third no wider than all
        wide = np.array([2.2, 2.9, 0.1])
        noise = replace(noise, wide=wide, outliers=np.array([False, True, False, False, False, True]))
    if bent:
        linear = replace(linear, error=rng.uniform(0, 1, (k - 1, d)))
    return linear, noise


def test_regular_gains_are_the_difference_of_evidence() -> None:
    """Of each outlier, against two restricted likelihoods and the price of one more outlier."""
    linear, noise = random_chain(np.random.default_rng(8), some_outliers=True)
    theta, prior = np.full(2, 0.4), FLAT
    hold = border(prior, theta, np.zeros(2))
    gains = regular_gains(linear, noise, prior, theta, OutlierTuning())
    assert noise.outliers is not None
    for gain, at in zip(gains, np.flatnonzero(noise.outliers), strict=True):
        tighter = replace(noise, outliers=noise.outliers & (np.arange(6) != at))
        values = [restricted(linear, one, hold)[0] - rarity(one, OutlierTuning()) for one in (tighter, noise)]
        assert gain == pytest.approx(values[0] - values[1], abs=1e-9)
        print(gain)


@pytest.mark.parametrize(("some_outliers", "bent"), [(False, False), (True, False), (False, True), (True, True)])
def test_the_chain_is_the_dense_least_squares(some_outliers: bool, bent: bool) -> None:
    """Eliminated equations, covariances and the likelihood's gradient against one dense matrix of all rows."""
    linear, noise = random_chain(np.random.default_rng(2), some_outliers, bent)
    jump_sd = np.sqrt(np.broadcast_to(noise.jump_sd, linear.jump.shape) ** 2 + linear.error)
    (k, c, d), n = linear.measurement.shape, linear.measurement_theta.shape[2]
    rows, right = [], []
    for i in range(k):
        for j in range(c):
            row = np.zeros((k, d))
            row[i] = linear.measurement[i, j]
            rows.append(
                np.concatenate([row.ravel(), linear.measurement_theta[i, j]]) * linear.observed[i, j] / noise.sd[j]
            )
            right.append(linear.residual[i, j] / noise.sd[j])
        for j in range(d):
            row = np.zeros((k, d))
            row[i, j] = 1.0
            rows.append(np.concatenate([row.ravel(), np.zeros(n)]) * np.sqrt(linear.precision[i, j]))
            right.append(-linear.offset[i, j] * np.sqrt(linear.precision[i, j]))
            if i < k - 1 and linear.linked[i]:
                row = np.zeros((k, d))
                row[i], row[i + 1, j] = linear.transition[i, j], -1.0
                rows.append(np.concatenate([row.ravel(), linear.transition_theta[i, j]]) / jump_sd[i, j])
                right.append(linear.jump[i, j] / jump_sd[i, j])
    design, target = np.array(rows), np.array(right)
    assert energy(linear, noise) == pytest.approx(0.5 * target @ target)
    normal, force = design.T @ design, design.T @ target
    states = k * d
    inverse = np.linalg.inv(normal[:states, :states])
    solved = eliminate_states(linear, noise)
    schur = normal[states:, states:] - normal[states:, :states] @ inverse @ normal[:states, states:]
    np.testing.assert_allclose(solved.precision, schur, rtol=1e-9)
    np.testing.assert_allclose(
        solved.gradient, force[states:] - normal[states:, :states] @ inverse @ force[:states], rtol=1e-9
    )
    assert solved.log_determinant == pytest.approx(np.linalg.slogdet(normal[:states, :states])[1])
    best = np.linalg.solve(normal, force)
    np.testing.assert_allclose(solved.blocks(best[states:]).ravel(), best[:states], rtol=1e-8)
    blocks = inverse.reshape(k, d, k, d)
    own, cross = solved.covariances()
    np.testing.assert_allclose(own, [blocks[i, :, i] for i in range(k)], rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(cross, [blocks[i + 1, :, i] for i in range(k - 1)], rtol=1e-8, atol=1e-12)
    covariance = np.linalg.inv(normal)
    spread = np.square(target - design @ best) + np.einsum("ri,ij,rj->r", design, covariance, design)
    squares, jumps = expected_squares(linear, solved, best[states:], covariance[states:, states:])
    places = np.cumsum([c + d + d * (i < k - 1 and bool(linear.linked[i])) for i in range(k)])
    begins = np.concatenate([[0], places[:-1]])
    expected = [linear.observed[i] * spread[b : b + c] * noise.sd**2 for i, b in enumerate(begins)]
    np.testing.assert_allclose(squares, expected, rtol=1e-8)
    rows_of = {i: b + c + 2 * np.arange(d) + 1 for i, b in enumerate(begins) if i < k - 1 and linear.linked[i]}
    for i, o in rows_of.items():
        np.testing.assert_allclose(jumps[i], spread[o] * jump_sd[i] ** 2, rtol=1e-8)
    at = np.array([1, 5])
    means, spreads = jump_normal(linear, solved, best[states:], covariance[states:, states:], at)
    for i, mean, covered in zip(at, means, spreads, strict=True):
        o, unit = rows_of[i], jump_sd[i]
        np.testing.assert_allclose(mean, (target - design @ best)[o] * unit, rtol=1e-8)
        np.testing.assert_allclose(
            covered, unit[:, None] * (design[o] @ covariance @ design[o].T) * unit, rtol=1e-7, atol=1e-12
        )


@pytest.mark.parametrize("held", [False, True])
@pytest.mark.parametrize(("some_outliers", "bent"), [(False, False), (True, False), (False, True), (True, True)])
def test_fishers_gradient_of_the_noise(some_outliers: bool, bent: bool, held: bool) -> None:
    """Against central differences of the restricted likelihood, held back without what the best step would gain."""
    linear, noise = random_chain(np.random.default_rng(3), some_outliers, bent)
    hold = border(FLAT, np.full(2, 0.4), np.zeros(2))
    value, by_sd, by_process = restricted(linear, noise, hold, held)
    solved = eliminate_states(linear, noise)
    step, _, _ = hold.solve(solved)
    promised = 0.5 * (solved.explained + step @ (solved.gradient + hold.pull))
    assert promised > 1
    assert value + held * promised == pytest.approx(restricted(linear, noise, hold)[0])
    logs = np.log(np.concatenate([noise.sd, noise.process]))
    for j, slope in enumerate(np.concatenate([by_sd, by_process])):
        around = []
        for step in (1e-5, -1e-5):
            moved = np.exp(logs + step * np.eye(5)[j])
            around.append(restricted(linear, replace(noise, sd=moved[:2], process=moved[2:]), hold, held)[0])
        assert (around[0] - around[1]) / 2e-5 == pytest.approx(slope, rel=1e-5, abs=1e-6)


def test_parameters_that_all_sit_at_bounds_leave_the_likelihood_of_the_states() -> None:
    linear, noise = random_chain(np.random.default_rng(3), False, False)
    held = Border(np.eye(2), np.zeros(2), np.zeros(2, bool))
    step, covariance, determinant = held.solve(eliminate_states(linear, noise))
    assert not step.any()
    assert not covariance.any()
    assert determinant == 0.0
    alone = log_likelihood(linear, noise, eliminate_states(linear, noise))
    assert restricted(linear, noise, held)[0] == pytest.approx(alone)
