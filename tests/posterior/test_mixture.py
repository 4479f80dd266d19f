"""Mixtures in the cube: shares, modes, marginals, gradients.

Statistical tests use fixed seeds and five standard errors (false alarms 6e-7 each over reseeding, were the errors
normal) unless they say otherwise; Kolmogorov-Smirnov tests reject below p = 1e-5.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy import stats

from sipe_bayes.posterior import GaussianMixture, Particles, prior
from tests.problems.posteriors import RIDGE, SIGMAS, random_mixture, seeded, single, space_of


def test_components_keep_their_truncated_share() -> None:
    """The component at -0.5 has 2.3 % of its mass inside, the one at 0.5 almost all."""
    mixture = GaussianMixture(np.log([0.9, 0.1]), [[-0.5], [0.5]], [[[0.0625]], [[0.0001]]], space_of(1))
    inside = stats.norm.sf(2.0) - stats.norm.sf(6.0)
    expected = 0.9 * inside / (0.9 * inside + 0.1)
    assert float(mixture.probabilities[0]) == pytest.approx(expected, rel=1e-9)
    theta = mixture.sample((20_000,), generator=seeded(13))
    share = float((theta < 0.45).double().mean())
    tail = 1 - float(torch.as_tensor(stats.norm.sf(3.8) / inside))
    assert share == pytest.approx(expected * tail, abs=SIGMAS * math.sqrt(expected * (1 - expected) / 20_000))


def test_of_masses_draws_components_as_often_as_the_weights_say() -> None:
    mixture = GaussianMixture(np.log([0.9, 0.1]), [[-0.5], [0.5]], [[[0.0625]], [[0.0001]]], space_of(1)).of_masses()
    np.testing.assert_allclose(mixture.probabilities.numpy(), [0.9, 0.1], rtol=1e-12)
    anew = GaussianMixture(mixture.log_weights, mixture.means, mixture.covariances, space_of(1))
    theta = torch.linspace(0.01, 0.99, 9, dtype=torch.float64)[:, None]
    torch.testing.assert_close(mixture.log_prob(theta), anew.log_prob(theta), rtol=1e-12, atol=0)


def test_mode_on_the_boundary() -> None:
    """With the mean outside, the mode is not the clipped mean: theta_2 is its regression on theta_1 = 1."""
    covariance = np.array([[0.04, 0.03], [0.03, 0.04]])
    mode = single([1.2, 0.5], covariance).mode
    torch.testing.assert_close(mode, torch.tensor([1.0, 0.5 - 0.75 * 0.2], dtype=torch.float64))
    ridge = single([0.3, -2e-5], RIDGE).mode
    conditional = 0.3 + 0.9999 / 1e-4 * 2e-5
    torch.testing.assert_close(ridge, torch.tensor([conditional, 0.0], dtype=torch.float64), rtol=1e-6, atol=1e-12)


def test_mode_of_overlapping_components() -> None:
    """Two close components make one mode between their means, where no component has its own."""
    mixture = GaussianMixture([0.0, 0.0], [[0.45], [0.55]], [[[0.01]], [[0.01]]], space_of(1))
    grid = torch.linspace(0, 1, 10_001, dtype=torch.float64)[:, None]
    assert float(mixture.mode) == pytest.approx(float(grid[mixture.log_prob(grid).argmax()]), abs=1e-3)
    assert float(mixture.mode) == pytest.approx(0.5, abs=1e-3)


def test_exact_marginals_of_mixtures() -> None:
    """Dropping an uncorrelated parameter moves its mass into the weights; an interior one adds nothing."""
    block = np.diag([0.04, 0.04, 0.04])
    block[0, 1] = block[1, 0] = 0.03
    mixture = GaussianMixture([0.0, 0.0], [[0.4, 0.6, 0.5], [0.6, 0.4, 1.3]], [block, block], space_of(3))
    marginal = mixture.marginal(["p1", "p0"])
    assert isinstance(marginal, GaussianMixture)
    torch.testing.assert_close(marginal.probabilities, mixture.probabilities, rtol=1e-3, atol=0)
    interior = single([0.9, 0.5], [[0.04, 0.0005], [0.0005, 1e-5]]).marginal(["p0"])
    assert isinstance(interior, GaussianMixture)
    coupled = single([0.9, 0.9], [[0.04, 0.03], [0.03, 0.04]]).marginal(["p0"])
    assert isinstance(coupled, Particles)
    assert len(coupled.theta) == 8000


def test_gaussian_moments_rebuild_the_posterior() -> None:
    for original in (single([1.2, 0.5], [[0.04, 0.03], [0.03, 0.04]]), prior(space_of(2))):
        mean, covariance = original.gaussian_moments()
        theta = original.sample((100,), generator=seeded(14))
        torch.testing.assert_close(
            single(mean, covariance).log_prob(theta), original.log_prob(theta), atol=1e-6, rtol=0
        )


def test_log_prob_is_differentiable() -> None:
    mixture = random_mixture(2)
    theta = torch.tensor([[0.3, 0.6], [1.5, 0.2]], dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(mixture.log_prob(theta)[0], theta)
    step = torch.tensor([1e-6, 0.0], dtype=torch.float64)
    rise = mixture.log_prob(theta[0] + step) - mixture.log_prob(theta[0] - step)
    assert float(gradient[0, 0]) == pytest.approx(float(rise.detach()) / 2e-6, rel=1e-6)
