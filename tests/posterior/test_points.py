"""Priors, points and particles, and what ArviZ gets of them."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy import stats

from sipe_bayes.core.parameters import Parameter, ParameterSpace
from sipe_bayes.posterior import Dirac, Particles, load_posterior, prior, uniform
from tests.problems.posteriors import space_of


def test_prior_reads_the_parameters() -> None:
    space = ParameterSpace(
        [Parameter("mass", 1, 3, prior_mean=2.5, prior_sd=0.2), Parameter("friction", 0.1, 10, scale="log")]
    )
    theta = torch.tensor([0.6, 0.123], dtype=torch.float64)
    expected = stats.truncnorm.logpdf(0.6, -7.5, 2.5, loc=0.75, scale=0.1)
    assert float(prior(space).log_prob(theta)) == pytest.approx(expected, abs=1e-12)
    assert float(uniform(space).log_prob(theta)) == 0.0
    torch.testing.assert_close(uniform(space).variance, torch.full((2,), 1 / 12, dtype=torch.float64))
    torch.testing.assert_close(uniform(space).quantile(0.3), torch.full((2,), 0.3, dtype=torch.float64))


def test_smoothed_points() -> None:
    smooth = Dirac([1.0, 0.5], space_of(2)).smoothed(0.01)
    torch.testing.assert_close(smooth.mode, torch.tensor([1.0, 0.5], dtype=torch.float64))
    half_normal = 0.01 * math.sqrt(2 / math.pi)
    torch.testing.assert_close(smooth.mean, torch.tensor([1 - half_normal, 0.5], dtype=torch.float64))


def test_smoothed_particles_approach_the_density() -> None:
    """Scott's rule on 5,000 draws: the largest density error of a beta(3, 4) stays below 15 % of its peak."""
    draws = np.random.default_rng(0).beta(3, 4, (5000, 1))
    smooth = Particles(draws, space_of(1)).smoothed("scott")
    assert len(smooth.means) == 500
    grid = torch.linspace(0.05, 0.95, 91, dtype=torch.float64)[:, None]
    error = np.abs(smooth.log_prob(grid).exp().numpy() - stats.beta.pdf(grid[:, 0].numpy(), 3, 4))
    assert error.max() < 0.15 * stats.beta.pdf(0.4, 3, 4)


def test_particles_weights_and_chains() -> None:
    weighted = Particles([[0.1], [0.5], [0.9]], space_of(1), weights=[1, 3, 0])
    torch.testing.assert_close(weighted.mean, torch.tensor([0.4], dtype=torch.float64))
    torch.testing.assert_close(weighted.variance, torch.tensor([0.03], dtype=torch.float64))
    assert float(weighted.quantile(0.99)) == 0.5
    assert float(weighted.mode) == 0.5
    chains = Particles(np.linspace(0, 1, 12).reshape(12, 1), space_of(1), chains=3)
    data = chains.to_inference_data().posterior["p0"]
    assert data.shape == (3, 4)
    np.testing.assert_allclose(data.values[1], chains.space.values(chains.theta[4:8].numpy())[:, 0])


def test_inference_data_has_physical_units() -> None:
    data = Dirac([0.5, 0.5], space_of(2)).to_inference_data(10).posterior
    assert float(data["p0"][0, 0]) == pytest.approx(2.0)
    assert float(data["p1"][0, 0]) == pytest.approx(2.0)  # the geometric middle of 1 and 4


def test_inference_data_holds_what_else_is_known(tmp_path: Path) -> None:
    """Prior in units, what was observed, predictions and densities of each draw, what the sampler knows.

    Also after storing.
    """
    theta, lp = np.linspace(0, 1, 12).reshape(12, 1), np.arange(12.0)
    chains = Particles(theta, space_of(1), chains=3, sample_stats={"lp": lp})
    chains.save(tmp_path / "chains")
    predictive = np.random.default_rng(0).random((3, 4, 5))
    given = {"observed_data": {"x": np.arange(5.0)}, "posterior_predictive": {"x": predictive}}
    for found in (chains, load_posterior(tmp_path / "chains")):
        data = found.to_inference_data(50, prior=uniform(space_of(1)), log_likelihood={"x": predictive}, **given)
        np.testing.assert_array_equal(data.sample_stats["lp"], lp.reshape(3, 4))
        np.testing.assert_array_equal(data.posterior_predictive["x"], predictive)
        np.testing.assert_array_equal(data.log_likelihood["x"], predictive)
        np.testing.assert_array_equal(data.observed_data["x"], np.arange(5.0))
        assert data.prior["p0"].shape == (1, 50)
        low, high = space_of(1)[0].low, space_of(1)[0].high
        assert low <= float(data.prior["p0"].min()) < float(data.prior["p0"].max()) <= high
        assert data.prior["p0"].attrs["units"] == data.posterior["p0"].attrs["units"]
    plain = Dirac([0.5], space_of(1)).to_inference_data(10)
    assert plain.groups() == ["posterior"]
