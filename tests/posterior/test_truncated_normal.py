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

from sipe_bayes.posterior.truncated_normal import TruncatedNormal, interval_moments, interval_quantile, log_interval
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


SERVO_MEAN = np.array([0.1677, -0.4955, 0.0295, 0.5545, 0.1188])
SERVO = np.array(
    [
        [0.000411, 0.000112, 0.000015, 0.000713, 0.000106],
        [0.000112, 366.227886, -31.394467, -0.003646, 0.01217],
        [0.000015, -31.394467, 2.691266, 0.000266, -0.001039],
        [0.000713, -0.003646, 0.000266, 0.003271, -0.000388],
        [0.000106, 0.01217, -0.001039, -0.000388, 0.001094],
    ]
)


def test_nearly_singular_covariance_whose_mass_is_small() -> None:
    """A servo's posterior: two parameters of sd 19 and 1.6 that are almost one, and a mass of 1e-8."""
    truncated = TruncatedNormal(SERVO_MEAN, SERVO)
    theta = truncated.sample(20_000, seeded(20))
    # reference: importance sampling, the two from a uniform box that holds them, the others given them
    rng, pair, rest = np.random.default_rng(0), np.array([1, 2]), np.array([0, 3, 4])
    width = np.array([0.1, 0.012])
    box = width * rng.random((400_000, 2))
    slope = np.linalg.solve(SERVO[np.ix_(pair, pair)], SERVO[np.ix_(pair, rest)])
    left = SERVO[np.ix_(rest, rest)] - SERVO[np.ix_(rest, pair)] @ slope
    others = SERVO_MEAN[rest] + (box - SERVO_MEAN[pair]) @ slope + rng.multivariate_normal(np.zeros(3), left, len(box))
    log_density = stats.multivariate_normal(SERVO_MEAN[pair], SERVO[np.ix_(pair, pair)]).logpdf(box)
    weight = np.exp(log_density - log_density.max()) * ((others >= 0) & (others <= 1)).all(1)
    log_mass = math.log(weight.mean()) + log_density.max() + np.log(width).sum()
    share, points = weight / weight.sum(), np.c_[others[:, :1], box, others[:, 1:]]
    effective = 1 / np.square(share).sum()
    mean = share @ points
    sd = np.sqrt(share @ np.square(points - mean))
    error = sd * math.sqrt(1 / effective + 1 / len(theta))
    print(f"{effective:.0f} effective points, acceptance {truncated._rate:.3f}, {(theta.mean(0) - mean) / error}")
    assert effective > 5000
    assert (np.abs(theta.mean(0) - mean) < SIGMAS * error).all()
    assert (np.abs(truncated.moments()[0] - mean) < SIGMAS * sd / math.sqrt(effective)).all()
    np.testing.assert_allclose(theta.std(0), sd, rtol=SIGMAS / math.sqrt(effective))
    assert truncated.log_mass == pytest.approx(log_mass, abs=SIGMAS / math.sqrt(effective))


@pytest.mark.parametrize("sampler", ["tilted", "chains"])
@pytest.mark.parametrize("n", [2, 4, 8])
def test_samplers_against_rejection(sampler: str, n: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each marginal, its two tails of a tenth and the first principal component; 56 tests at 1e-5: 6e-4 by chance."""
    monkeypatch.setattr(TruncatedNormal, "rejection_mass", 2.0)
    monkeypatch.setattr(TruncatedNormal, "least_acceptance", 0.0 if sampler == "tilted" else 2.0)
    rng = np.random.default_rng(n)
    basis = np.linalg.qr(rng.standard_normal((n, n)))[0]
    covariance = (basis * np.geomspace(0.5, 1e-3, n) ** 2) @ basis.T
    mean = rng.uniform(0.0, 1.0, n)
    theta = TruncatedNormal(mean, covariance).sample(8000, seeded(21))
    plain = rng.multivariate_normal(mean, covariance, 2_000_000)
    plain = plain[((plain >= 0) & (plain <= 1)).all(1)]
    assert len(plain) > 8000
    columns = np.c_[np.eye(n), np.linalg.eigh(covariance)[1][:, -1]]
    for ours, reference in zip((theta @ columns).T, (plain @ columns).T, strict=True):
        low, high = np.quantile(reference, [0.1, 0.9])
        assert stats.ks_2samp(ours, reference).pvalue > 1e-5
        assert stats.ks_2samp(ours[ours < low], reference[reference < low]).pvalue > 1e-5
        assert stats.ks_2samp(ours[ours > high], reference[reference > high]).pvalue > 1e-5


def spread_problem(n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Standard deviations from 1e-4 to 100 along random directions, means in and out of the cube."""
    rng = np.random.default_rng(100 * n + seed)
    basis = np.linalg.qr(rng.standard_normal((n, n)))[0]
    covariance = (basis * np.exp(rng.uniform(np.log(1e-4), np.log(100), n)) ** 2) @ basis.T
    return rng.uniform(-0.3, 1.3, n), (covariance + covariance.T) / 2


@pytest.mark.parametrize("n", [1, 2, 3, 5, 10, 20, 30])
def test_any_covariance_is_sampled(n: int) -> None:
    """Nearly singular ones too: draws and moments lie in the cube, and a seed gives the same draws again."""
    for seed in range(1 if n > 10 else 3):
        mean, covariance = spread_problem(n, seed)
        truncated = TruncatedNormal(mean, covariance)
        theta = truncated.sample(200, seeded(22))
        assert theta.shape == (200, n)
        assert ((theta >= 0) & (theta <= 1)).all()
        assert np.isfinite(truncated.log_mass)
        centre, spread = truncated.moments()
        assert ((centre >= 0) & (centre <= 1)).all()
        assert (np.diag(spread) > 0).all()
        again = TruncatedNormal(mean, covariance).sample(200, seeded(22))
        np.testing.assert_array_equal(theta, again)


def test_chains_where_hardly_a_draw_is_accepted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Thirty dimensions over six decades: one draw in 1,400 would be accepted; chains come within half a sd of them."""
    truncated = TruncatedNormal(*spread_problem(30, 8))
    assert truncated._rate < truncated.least_acceptance
    chains = truncated.sample(500, seeded(23))
    monkeypatch.setattr(TruncatedNormal, "least_acceptance", 0.0)
    exact = truncated.sample(200, seeded(24))
    off, ratio = np.abs(chains.mean(0) - exact.mean(0)) / exact.std(0), chains.std(0) / exact.std(0)
    print(f"means off by up to {off.max():.2f} sd, ratio of sds {ratio.min():.2f} to {ratio.max():.2f}")
    assert off.max() < 0.5
    assert 0.7 < ratio.min() < ratio.max() < 1.4
