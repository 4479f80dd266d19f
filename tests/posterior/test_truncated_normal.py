"""The truncated normal: masses, moments and draws against quadrature, also where they are hard.

Statistical tests use fixed seeds and five standard errors (false alarms 6e-7 each over reseeding, were the errors
normal) unless they say otherwise; Kolmogorov-Smirnov tests reject below p = 1e-5.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats
from scipy.special import log_ndtr

from sipe_bayes.posterior.truncated_normal import (
    TruncatedNormal,
    interval_moments,
    interval_quantile,
    log_interval,
)
from tests.problems.posteriors import RIDGE, SIGMAS, seeded, single


@pytest.mark.parametrize(
    ("mean", "sd"), [(0.5, 1e-4), (0.5, 1e3), (-3.0, 0.1), (40.0, 0.1), (-0.001, 1e-4), (1e3, 5.0)]
)
def test_one_dimension_against_numerical_integration(mean: float, sd: float) -> None:
    """Mass, moments and median by plain quadrature on the scale where the density lives."""
    peak = min(max(mean, 0.0), 1.0)
    width = min(1.0, 45 * sd, 60 * sd**2 / max(abs(peak - mean), 1e-300))
    grid = np.linspace(max(0.0, peak - width), min(1.0, peak + width), 400_001)
    exponent = -(grid - peak) * (grid + peak - 2 * mean) / (2 * sd**2)
    density = np.exp(exponent)
    total = np.trapezoid(density, grid)
    log_mass = math.log(total / sd / math.sqrt(2 * math.pi)) - (peak - mean) ** 2 / (2 * sd**2)
    posterior = single(mean, [[sd**2]])
    assert float(posterior.log_masses[0]) == pytest.approx(log_mass, rel=1e-11, abs=1e-7)
    expected = np.trapezoid(density * grid, grid) / total
    scale = math.sqrt(np.trapezoid(density * (grid - expected) ** 2, grid) / total)
    assert float(posterior.mean) == pytest.approx(expected, abs=1e-6 * scale)
    assert float(posterior.stddev) == pytest.approx(scale, rel=1e-6)
    median = np.interp(0.5, np.cumsum(density) / density.sum(), grid)
    assert float(posterior.quantile(0.5)) == pytest.approx(median, abs=1e-3 * scale)
    draws = (posterior.sample((4000,), generator=seeded(10))[:, 0].numpy() - expected) / scale
    reference = np.interp((np.arange(4000) + 0.5) / 4000, np.cumsum(density) / density.sum(), grid)
    assert stats.ks_2samp(draws, (reference - expected) / scale).pvalue > 1e-5


def test_log_interval_in_the_tails() -> None:
    for a in (5.0, 30.0, 1e3, 1e6):
        assert float(log_interval(a, a + 50.0)) == pytest.approx(float(log_ndtr(-a)), rel=1e-12)
        assert float(log_interval(-a - 50.0, -a)) == pytest.approx(float(log_ndtr(-a)), rel=1e-12)
    levels = np.linspace(0.01, 0.99, 50)
    a, b = np.full(50, 7.0), np.full(50, 9.0)
    x = interval_quantile(a, b, levels)
    np.testing.assert_allclose(np.exp(log_interval(a, x) - log_interval(a, b)), levels, rtol=1e-9)
    mean, variance = interval_moments([0.0], [1.0], [0.5], [math.inf])
    np.testing.assert_allclose([mean[0], variance[0]], [0.5, 1 / 12], rtol=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_mass_in_three_dimensions(seed: int) -> None:
    rng = np.random.default_rng(seed)
    factor = rng.standard_normal((3, 3)) * 0.4
    covariance, mean = factor @ factor.T + 0.01 * np.eye(3), rng.uniform(-0.3, 1.3, 3)
    ours = TruncatedNormal(mean, covariance)
    reference = stats.multivariate_normal(mean, covariance, abseps=1e-9, releps=1e-6, maxpts=4_000_000)
    mass = reference.cdf(np.ones(3), lower_limit=np.zeros(3), rng=np.random.default_rng(0))
    assert math.exp(ours.log_mass) == pytest.approx(mass, rel=5e-4)
    assert ours.log_mass_error < 2e-4


def conditional_log_mass(mean: np.ndarray, covariance: np.ndarray) -> float:
    """Two dimensions by plain quadrature: theta_1 on a grid, theta_2 given theta_1 in closed form."""
    grid = np.linspace(0, 1, 200_001)
    sd = math.sqrt(covariance[0, 0])
    slope = covariance[0, 1] / covariance[0, 0]
    centre = mean[1] + slope * (grid - mean[0])
    spread = math.sqrt(covariance[1, 1] - slope * covariance[0, 1])
    log_density = stats.norm.logpdf(grid, mean[0], sd) + log_interval(-centre / spread, (1 - centre) / spread)
    top = log_density.max()
    return float(top + math.log(np.trapezoid(np.exp(log_density - top), grid)))


HARD = {
    "ridge": (np.array([0.3, 0.5]), RIDGE),
    "ridge at the edge": (np.array([0.3, -2e-5]), RIDGE),
    "correlated, far outside": (np.array([2.0, 1.5]), np.array([[0.04, 0.03], [0.03, 0.04]])),
    "opposite tails": (np.array([2.0, -1.0]), np.array([[0.04, 0.038], [0.038, 0.04]])),
    "wide": (np.array([0.5, 0.5]), np.array([[100.0, 99.0], [99.0, 100.0]])),
}


@pytest.mark.parametrize("name", HARD)
def test_hard_masses_and_samples(name: str) -> None:
    mean, covariance = HARD[name]
    posterior = single(mean, covariance)
    log_mass = conditional_log_mass(mean, covariance)
    assert float(posterior.log_masses[0]) == pytest.approx(log_mass, abs=1e-3)
    theta = posterior.sample((4000,), generator=seeded(11))
    assert bool(((theta >= 0) & (theta <= 1)).all())
    # exact draws pass their own conditional CDF: given theta_1, theta_2 is a truncated normal
    slope = covariance[0, 1] / covariance[0, 0]
    centre = mean[1] + slope * (theta[:, 0].numpy() - mean[0])
    spread = math.sqrt(covariance[1, 1] - slope * covariance[0, 1])
    a, b, x = -centre / spread, (1 - centre) / spread, (theta[:, 1].numpy() - centre) / spread
    levels = np.exp(log_interval(a, np.clip(x, a, b)) - log_interval(a, b))
    assert stats.kstest(levels, "uniform").pvalue > 1e-5


def test_exact_sampler_in_thirty_dimensions() -> None:
    """An equicorrelated law given one common factor f factorises: mass by quadrature over f alone."""
    n, rho, mean = 30, 0.5, 1.5
    truncated = TruncatedNormal(np.full(n, mean), (1 - rho) * np.eye(n) + rho)
    factor = np.linspace(-12, 12, 20_001)
    centre, sd = mean + math.sqrt(rho) * factor, math.sqrt(1 - rho)
    log_terms = stats.norm.logpdf(factor) + n * log_interval(-centre / sd, (1 - centre) / sd)
    mass = np.trapezoid(np.exp(log_terms), factor)
    assert truncated.log_mass == pytest.approx(math.log(mass), abs=SIGMAS * truncated.log_mass_error + 1e-4)
    inside = interval_moments(np.zeros_like(centre), np.ones_like(centre), centre, np.full_like(centre, sd))[0]
    expected = np.trapezoid(np.exp(log_terms) * inside, factor) / mass
    theta = truncated.sample(3000, seeded(12))
    row_means = theta.mean(1)
    assert row_means.mean() == pytest.approx(expected, abs=SIGMAS * row_means.std() / math.sqrt(3000))
    np.testing.assert_allclose(truncated.moments()[0], expected, atol=2e-3)
