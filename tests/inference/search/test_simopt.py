"""SimOpt: the dual against a grid, the bounds on KL, and recovery of a pendulum's parameters."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sipe_bayes.inference.search.gaussians import draw_in_cube, gaussian_kl, log_normal
from sipe_bayes.inference.search.simopt import SimOpt, SimOptOptions, reps_temperature, reps_weights, updated_gaussian
from sipe_bayes.posterior import GaussianMixture
from tests.problems.searches import (
    check_contract,
    check_divergence,
    check_other_trajectories,
    check_recovery,
    check_resumes,
    problem,
)


@pytest.mark.parametrize("epsilon", [0.1, 0.5, 1.0])
@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
def test_the_temperature_is_the_least_of_the_dual_on_a_grid(epsilon: float, scale: float) -> None:
    rng = np.random.default_rng(0)
    reward = scale * (5 + rng.standard_normal(20))
    log_base = np.log(rng.dirichlet(np.ones(20)))
    eta = reps_temperature(reward, log_base, epsilon)
    grid = scale * np.geomspace(1e-3, 1e3, 20001)
    base = np.exp(log_base)
    plain = [e * epsilon + e * np.log((base * np.exp((reward - reward.max()) / e)).sum()) + reward.max() for e in grid]
    assert abs(np.log(eta / grid[int(np.argmin(plain))])) < 1e-3
    weights = reps_weights(reward, log_base, eta)
    assert abs((weights * np.log(weights / base)).sum() - epsilon) < 1e-6


def test_rewards_that_cannot_reach_the_bound() -> None:
    """Equal rewards leave the base; too few draws for the bound choose the best; diverged draws have no weight."""
    base = np.full(4, np.log(0.25))
    same = reps_weights(np.ones(4), base, reps_temperature(np.ones(4), base, 0.5))
    np.testing.assert_allclose(same, 0.25)
    reward = np.array([0.0, 1.0, 0.5, -np.inf])
    greedy = reps_weights(reward, base, reps_temperature(reward, base, 5.0))
    np.testing.assert_allclose(greedy, [0, 1, 0, 0], atol=1e-12)
    mild = reps_weights(reward, base, reps_temperature(reward, base, 0.1))
    assert mild[3] == 0
    assert mild[1] > mild[2] > mild[0] > 0


def test_the_new_gaussian_stays_within_the_bound_and_follows_the_reward() -> None:
    rng = np.random.default_rng(1)
    mean, covariance = np.full(3, 0.5), np.diag([0.04, 0.01, 0.02])
    theta = rng.multivariate_normal(mean, covariance, 60)
    base = np.full(60, 1 / 60)
    for epsilon in (0.05, 0.5):
        reward = theta[:, 0]
        weights = reps_weights(reward, np.log(base), reps_temperature(reward, np.log(base), epsilon))
        new_mean, new_covariance = updated_gaussian(
            theta, weights, base, mean, covariance, SimOptOptions(epsilon=epsilon)
        )
        assert gaussian_kl(new_mean, new_covariance, mean, covariance) <= epsilon * (1 + 1e-9)
        assert new_mean[0] > 0.55
    unchanged = updated_gaussian(theta, base, base, mean, covariance, SimOptOptions())
    np.testing.assert_allclose(unchanged[0], mean)
    np.testing.assert_allclose(unchanged[1], covariance, atol=1e-8)


def test_damping_slows_the_covariance_and_leaves_the_mean() -> None:
    """None: a variance follows the weights as far as least_factor allows; much: it stays; one is the default."""
    rng = np.random.default_rng(1)
    mean, covariance = np.full(2, 0.5), 0.01 * np.eye(2)
    theta, base = rng.multivariate_normal(mean, covariance, 60), np.full(60, 1 / 60)
    reward = -((theta[:, 0] - 0.5) ** 2)
    weights = reps_weights(reward, np.log(base), reps_temperature(reward, np.log(base), 1.0))
    options = {d: SimOptOptions(epsilon=10.0, damping=d) for d in (0.0, 1.0, 1e6)}
    found = {d: updated_gaussian(theta, weights, base, mean, covariance, o) for d, o in options.items()}
    assert found[0.0][1][0, 0] < found[1.0][1][0, 0] < found[1e6][1][0, 0]
    np.testing.assert_allclose(found[1e6][1], covariance, rtol=1e-3, atol=1e-6)
    np.testing.assert_array_equal(found[0.0][0], found[1e6][0])
    default = updated_gaussian(theta, weights, base, mean, covariance, SimOptOptions(epsilon=10.0))
    np.testing.assert_array_equal(default[1], found[1.0][1])


def test_every_update_of_a_fit_respects_the_bound() -> None:
    simulator, trajectory, _ = problem()
    fit = SimOpt(simulator, budget=150, seed=0)
    fit.fit(trajectory)
    means, covariances = fit.state.means, fit.state.covariances
    moves = [gaussian_kl(means[k + 1], covariances[k + 1], means[k], covariances[k]) for k in range(len(means) - 1)]
    assert len(moves) == 25
    assert max(moves) <= fit.options.epsilon * (1 + 1e-9)
    assert (means[0] <= 0.5).all()
    np.testing.assert_allclose(covariances[0], 0.2 * np.eye(2))
    assert isinstance(fit.proposal, GaussianMixture)
    np.testing.assert_allclose(fit.proposal.means[0], means[-1])


def test_gaussians_against_plain_formulas() -> None:
    """KL and density by their definitions; draws in the cube have the truncated moments (4 standard errors)."""
    mean, old = np.array([0.2, 0.7]), np.array([0.5, 0.5])
    c, c_old = np.array([[0.05, 0.02], [0.02, 0.04]]), np.array([[0.1, -0.03], [-0.03, 0.2]])
    inverse, d = np.linalg.inv(c_old), old - mean
    plain = 0.5 * (np.trace(inverse @ c) + d @ inverse @ d - 2 + np.log(np.linalg.det(c_old) / np.linalg.det(c)))
    assert abs(gaussian_kl(mean, c, old, c_old) - plain) < 1e-12
    point = np.array([[0.3, 0.1]])
    e = point[0] - mean
    density = -0.5 * e @ np.linalg.inv(c) @ e - np.log(2 * np.pi) - 0.5 * np.log(np.linalg.det(c))
    assert abs(log_normal(point, mean, c)[0] - density) < 1e-12
    rng = np.random.default_rng(0)
    draws = draw_in_cube(mean, c, 4000, rng)
    many = rng.multivariate_normal(mean, c, 400_000)
    many = many[((many >= 0) & (many <= 1)).all(1)]
    assert ((draws >= 0) & (draws <= 1)).all()
    assert (np.abs(draws.mean(0) - many.mean(0)) < 4 * many.std(0) / np.sqrt(4000)).all()
    np.testing.assert_allclose(np.cov(draws.T), np.cov(many.T), atol=0.003)


def test_recovery() -> None:
    check_recovery("simopt", 144, 3.0)


def test_recovery_with_a_learned_reward() -> None:
    check_recovery("simopt", 144, 1.5, seeds=2, reward="learned")


def test_contract() -> None:
    check_contract("simopt", 61)


@pytest.mark.parametrize("reward", ["state_difference", "learned"])
def test_resumes(reward: str, tmp_path: Path) -> None:
    check_resumes("simopt", 100, tmp_path, reward=reward)


def test_divergence(monkeypatch: pytest.MonkeyPatch) -> None:
    check_divergence("simopt", 150, monkeypatch)


@pytest.mark.parametrize("reward", ["state_difference", "learned"])
def test_other_trajectories(reward: str) -> None:
    check_other_trajectories("simopt", reward=reward)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"updates": 0}, "updates: expected at least 1"),
        ({"particles": 1}, "particles: expected at least 2"),
        ({"initial_mean": 1.5}, "initial_mean"),
        ({"initial_variance": 0.0}, "initial_variance"),
        ({"epsilon": -1.0}, "epsilon"),
        ({"reward": "guess"}, "state_difference, learned"),
    ],
)
def test_wrong_settings(settings: dict, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        SimOpt(problem()[0], **settings)
