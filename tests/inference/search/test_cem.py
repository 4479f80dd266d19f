"""CEM: a quadratic's minimum, elites' moments, and a pendulum's parameters."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sipe_bayes.inference.search.cem import CEM, CEMState, elite_moments
from tests.problems.searches import (
    check_contract,
    check_divergence,
    check_other_trajectories,
    check_recovery,
    check_resumes,
    problem,
)


def test_the_minimum_of_a_quadratic(monkeypatch: pytest.MonkeyPatch) -> None:
    """A tilted quadratic of condition number 25.

    The last elites lie within 0.01 of its minimum, the cost's best within 300 evaluations, from three seeds.
    """
    simulator, trajectory, _ = problem()
    target, curvature = np.array([0.85, 0.2]), np.array([[1.0, 0.9], [0.9, 1.0]]) + 0.02 * np.eye(2)

    def evaluated(self: CEM, state: CEMState, theta: np.ndarray, trajectories: Any, most: int) -> CEMState:
        self.windows(trajectories).rollouts += len(theta)
        reward = -np.einsum("bi,ij,bj->b", theta - target, curvature, theta - target)
        pool = replace(
            state.pool,
            theta=np.concatenate([state.pool.theta, theta]),
            reward=np.concatenate([state.pool.reward, reward]),
            draw=np.concatenate([state.pool.draw, np.full(len(theta), state.draws)]),
        )
        return replace(state, pool=pool, draws=state.draws + 1, simulated=state.simulated + len(theta))

    monkeypatch.setattr(CEM, "evaluated", evaluated)
    for seed in range(3):
        posterior = CEM(simulator, budget=300, seed=seed).fit(trajectory)
        theta = posterior.theta.numpy()
        cost = np.einsum("bi,ij,bj->b", theta - target, curvature, theta - target)
        assert len(np.unique(cost)) > 2
        np.testing.assert_array_equal(posterior.mode.numpy(), theta[cost.argmin()])
        np.testing.assert_allclose(posterior.mode.numpy(), target, atol=0.01)
        np.testing.assert_allclose(posterior.mean.numpy(), target, atol=0.01)


def test_moments_of_many_elites_are_theirs_and_of_few_nearly_diagonal() -> None:
    rng = np.random.default_rng(0)
    covariance = np.array([[0.02, 0.015], [0.015, 0.03]])
    many = rng.multivariate_normal([0.4, 0.6], covariance, 20_000)
    mean, found = elite_moments(many)
    np.testing.assert_allclose(mean, [0.4, 0.6], atol=0.01)
    np.testing.assert_allclose(found, covariance, rtol=0.05)
    few = elite_moments(many[:2])[1]
    assert abs(few[0, 1]) < 0.67 * np.sqrt(few[0, 0] * few[1, 1])
    assert np.linalg.eigvalsh(elite_moments(np.ones((2, 2)))[1]).min() > 0


def test_recovery() -> None:
    check_recovery("cem", 120, 4.0)


def test_contract() -> None:
    check_contract("cem", 61)


def test_resumes(tmp_path: Path) -> None:
    check_resumes("cem", 80, tmp_path)


def test_divergence(monkeypatch: pytest.MonkeyPatch) -> None:
    check_divergence("cem", 100, monkeypatch)


def test_other_trajectories() -> None:
    check_other_trajectories("cem")


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"population": 3}, "population: expected at least 4"),
        ({"elites": 0.0}, "elites: expected a share"),
        ({"smoothing": 1.5}, "smoothing: expected a share"),
    ],
)
def test_wrong_settings(settings: dict, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        CEM(problem()[0], **settings)
