"""ADR: the Stein variational direction against loops and a Gaussian target, its gradients, and a pendulum."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sipe_bayes.inference.search.adr import ADR, centred_ranks, policy_gradients, stein_direction
from tests.problems.searches import (
    check_contract,
    check_divergence,
    check_other_trajectories,
    check_recovery,
    check_resumes,
    problem,
)


def plain_direction(particles: np.ndarray, scores: np.ndarray) -> np.ndarray:
    """Equation 11 of Liu et al. 2017 in loops."""
    count = len(particles)
    apart = [np.sum((particles[i] - particles[j]) ** 2) for i in range(count) for j in range(i + 1, count)]
    h = np.median(apart) / np.log(count + 1)
    out = np.zeros_like(particles)
    for i in range(count):
        for j in range(count):
            kernel = np.exp(-np.sum((particles[j] - particles[i]) ** 2) / h)
            gradient = kernel * -2 / h * (particles[j] - particles[i])
            out[i] += (kernel * scores[j] + gradient) / count
    return out


def test_the_direction_is_the_plain_one() -> None:
    rng = np.random.default_rng(0)
    particles, scores = rng.standard_normal((2, 7, 3))
    np.testing.assert_allclose(stein_direction(particles, scores), plain_direction(particles, scores), rtol=1e-12)


def test_particles_settle_on_a_gaussian_target() -> None:
    """From a narrow cloud far away to mean and spread of N((1, -2), diag(1, 0.25)).

    60 particles underestimate sds by less than a fifth.
    """
    rng = np.random.default_rng(1)
    mean, sd = np.array([1.0, -2.0]), np.array([1.0, 0.5])
    particles = 4 + 0.1 * rng.standard_normal((60, 2))
    for _ in range(3000):
        particles = particles + 0.1 * stein_direction(particles, -(particles - mean) / sd**2)
    np.testing.assert_allclose(particles.mean(0), mean, atol=0.1)
    np.testing.assert_allclose(particles.std(0), sd, rtol=0.2)


def test_gradients_of_a_quadratic() -> None:
    """Local regression points as the true gradient does: cosine above 0.9 at each of ten particles."""
    rng = np.random.default_rng(2)
    theta, particles = rng.uniform(size=(200, 3)), rng.uniform(0.2, 0.8, size=(10, 3))
    target = np.array([0.9, 0.1, 0.5])
    found = policy_gradients(particles, theta, -((theta - target) ** 2).sum(1), 0.1)
    true = -2 * (particles - target)
    cosine = (found * true).sum(1) / np.linalg.norm(found, axis=1) / np.linalg.norm(true, axis=1)
    assert cosine.min() > 0.9, cosine
    assert not policy_gradients(particles, theta, np.zeros(200), 0.1).any()


def test_ranks() -> None:
    np.testing.assert_allclose(
        centred_ranks(np.array([3.0, -np.inf, 10.0, 4.0, -np.inf])), [0, -0.375, 0.5, 0.25, -0.375]
    )


def test_recovery() -> None:
    check_recovery("adr", 300, 2.5)


def test_recovery_with_a_learned_reward() -> None:
    check_recovery("adr", 300, 1.5, reward="learned")


def test_paths_are_kept_and_the_first_is_the_prior() -> None:
    simulator, trajectory, _ = problem()
    fit = ADR(simulator, budget=55, seed=0)
    posterior = fit.fit(trajectory)
    assert fit.state.paths.shape == (7, 10, 2)
    np.testing.assert_array_equal(fit.state.paths[-1], posterior.theta.numpy())
    np.testing.assert_allclose(posterior.weights.numpy(), 0.1)
    assert fit.state.paths[0].std(0).min() > 0.15


def test_contract() -> None:
    check_contract("adr", 61)


@pytest.mark.parametrize("reward", ["state_difference", "learned"])
def test_resumes(reward: str, tmp_path: Path) -> None:
    check_resumes("adr", 60, tmp_path, reward=reward)


def test_divergence(monkeypatch: pytest.MonkeyPatch) -> None:
    check_divergence("adr", 150, monkeypatch)


@pytest.mark.parametrize("reward", ["state_difference", "learned"])
def test_other_trajectories(reward: str) -> None:
    check_other_trajectories("adr", reward=reward)


@pytest.mark.parametrize("name", ["temperature", "step_size", "exploration"])
def test_wrong_settings(name: str) -> None:
    with pytest.raises(ValueError, match=f"{name}: expected a positive number"):
        ADR(problem()[0], **{name: 0.0})
    with pytest.raises(ValueError, match="particles: expected at least 2"):
        ADR(problem()[0], particles=1)
