"""Posterior families: densities integrate to one, samples agree with them, files read back exactly.

Statistical tests use fixed seeds and five standard errors (false alarms 6e-7 each over reseeding, were the
errors normal) unless they say otherwise; Kolmogorov-Smirnov tests reject below p = 1e-5.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pyro
import pytest
import torch
from scipy import stats
from scipy.special import log_ndtr

from sipe_bayes.core.parameters import Parameter, ParameterSpace
from sipe_bayes.posterior import (
    FAMILIES,
    Dirac,
    GaussianMixture,
    IndependentPrior,
    NoDensityError,
    Particles,
    Posterior,
    SurrogatePosterior,
    load_posterior,
    prior,
    uniform,
)
from sipe_bayes.posterior.flow import Flow, spline_flow
from sipe_bayes.posterior.truncated_normal import (
    TruncatedNormal,
    interval_moments,
    interval_quantile,
    log_interval,
)
from tests.problems.surrogates import example_surrogate

SIGMAS = 5.0


def space_of(n: int) -> ParameterSpace:
    return ParameterSpace(
        Parameter(f"p{j}", 1.0, 3.0 + j, unit="kg" if j % 2 else "N m", scale="log" if j % 2 else "linear")
        for j in range(n)
    )


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def random_mixture(n: int, components: int = 3, seed: int = 0) -> GaussianMixture:
    """Correlated components, some means outside the cube."""
    rng = np.random.default_rng(seed)
    factors = rng.standard_normal((components, n, n)) * 0.25
    covariances = factors @ factors.transpose(0, 2, 1) + 0.02 * np.eye(n)
    means = rng.uniform(-0.3, 1.3, (components, n))
    return GaussianMixture(rng.standard_normal(components), means, covariances, space_of(n))


def single(mean: object, covariance: object) -> GaussianMixture:
    mean = np.atleast_1d(np.asarray(mean, dtype=float))
    return GaussianMixture([0.0], mean[None], np.atleast_2d(covariance)[None], space_of(len(mean)))


def example_particles(n: int) -> Particles:
    rng = np.random.default_rng(n)
    return Particles(rng.beta(2, 3, (400, n)), space_of(n), rng.exponential(size=400), best=rng.random(n))


def example_flow(n: int) -> Flow:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        net = spline_flow(n, 4, 2, 8, 4)
    architecture = {"transforms": 2, "hidden": 8, "bins": 4}
    learned = dict(net.named_parameters())
    mild = {name: 0.5 * tensor if name in learned else tensor for name, tensor in net.state_dict().items()}
    return Flow(mild, torch.ones(4), torch.zeros(n), torch.ones(n), space_of(n), **architecture)


EXAMPLES: dict[str, Callable[[int], Posterior]] = {
    "Dirac": lambda n: Dirac(np.linspace(0.2, 0.9, n), space_of(n)),
    "Particles": example_particles,
    "GaussianMixture": random_mixture,
    "IndependentPrior": lambda n: IndependentPrior(
        np.linspace(-0.2, 0.7, n), [math.inf if j % 2 else 0.3 for j in range(n)], space_of(n)
    ),
    "SurrogatePosterior": lambda n: example_surrogate(space_of(n)),
    "Flow": example_flow,
}


@pytest.fixture(params=[(name, n) for name in FAMILIES for n in (1, 2, 4)], ids=lambda p: f"{p[0]}-{p[1]}")
def posterior(request: pytest.FixtureRequest) -> Posterior:
    name, n = request.param
    if name not in EXAMPLES:
        pytest.fail(f"{name} is registered but has no example here: add one line to EXAMPLES")
    return example(name, n)


@cache
def example(name: str, n: int) -> Posterior:
    """Made once: posteriors do not change."""
    return EXAMPLES[name](n)


# The contract, over the registry.


def test_density_integrates_to_one(posterior: Posterior) -> None:
    if not posterior.has_density:
        with pytest.raises(NoDensityError, match="smoothed"):
            posterior.log_prob(torch.full((len(posterior.space),), 0.5))
        return
    uniforms = torch.rand(60_000, len(posterior.space), dtype=torch.float64, generator=seeded(1))
    density = posterior.log_prob(uniforms).exp()
    assert float(density.mean()) == pytest.approx(1, abs=SIGMAS * float(density.std()) / math.sqrt(60_000) + 1e-12)


def test_samples_agree_with_moments(posterior: Posterior) -> None:
    n = 20_000
    theta = posterior.sample((n,), generator=seeded(2))
    assert theta.dtype == torch.float64
    assert bool(((theta >= 0) & (theta <= 1)).all())
    error = posterior.stddev * math.sqrt(2 / n)  # a family may take its moments from as many draws
    assert bool(((theta.mean(0) - posterior.mean).abs() <= SIGMAS * error + 1e-12).all())
    products = (theta - posterior.mean)[:, :, None] * (theta - posterior.mean)[:, None, :]
    error = products.std(0) * math.sqrt(2 / n)
    # 1e-3: the covariance of a correlated truncated mixture is itself from quasi-random points
    slack = 1e-3 * float(posterior.variance.max()) + 1e-12
    assert bool(((products.mean(0) - posterior.covariance).abs() <= SIGMAS * error + slack).all())
    torch.testing.assert_close(posterior.stddev**2, posterior.covariance.diagonal())


def test_density_reproduces_the_moments(posterior: Posterior) -> None:
    """Importance weights from the uniform law see log_prob only, the moments the sampler only."""
    if not posterior.has_density:
        return
    uniforms = torch.rand(60_000, len(posterior.space), dtype=torch.float64, generator=seeded(3))
    weight = posterior.log_prob(uniforms).exp()
    terms = weight[:, None] * (uniforms - posterior.mean)
    error = terms.std(0) / math.sqrt(len(terms))
    assert bool((terms.mean(0).abs() <= SIGMAS * error + 1e-12).all()), (terms.mean(0), error)


def test_quantiles_agree_with_samples(posterior: Posterior) -> None:
    """The share of draws below a quantile is its level, up to binomial error and a discrete law's step."""
    levels, n = torch.tensor([0.05, 0.5, 0.9], dtype=torch.float64), 20_000
    quantiles = posterior.quantile(levels)
    assert quantiles.shape == (3, len(posterior.space))
    torch.testing.assert_close(posterior.quantile(0.5), quantiles[1])
    theta = posterior.sample((n,), generator=seeded(4))
    below = (theta[None] <= quantiles[:, None] + 1e-12).double().mean(1)
    if isinstance(posterior, Dirac):
        assert bool((below == 1).all())
        return
    step = float(posterior.weights.max()) if isinstance(posterior, Particles) else 0.0
    # twice: quantiles of a correlated mixture come from as many fixed draws
    error = 2 * SIGMAS / math.sqrt(2) * (levels * (1 - levels) / n).sqrt() + step
    assert bool(((below - levels[:, None]).abs() <= error[:, None]).all()), below


def test_mode_is_no_worse_than_any_draw(posterior: Posterior) -> None:
    if isinstance(posterior, Particles | SurrogatePosterior):
        assert torch.equal(posterior.mode, posterior.best)
    elif posterior.has_density:
        draws = posterior.sample((5000,), generator=seeded(5))
        assert float(posterior.log_prob(posterior.mode)) >= float(posterior.log_prob(draws).max()) - 1e-9


def test_round_trip_is_exact(posterior: Posterior, tmp_path: Path) -> None:
    posterior.save(tmp_path / "run.1" / "posterior")
    written = sorted(p.name for p in (tmp_path / "run.1").iterdir())
    assert written == ["posterior.json", "posterior.safetensors"]
    for suffix in ("", ".json", ".safetensors"):
        loaded = load_posterior(tmp_path / "run.1" / f"posterior{suffix}")
        assert type(loaded) is type(posterior)
        assert loaded.space == posterior.space
    theta = posterior.sample((200,), generator=seeded(6))
    assert torch.equal(loaded.sample((200,), generator=seeded(6)), theta)
    assert torch.equal(loaded.mode, posterior.mode)
    assert torch.equal(loaded.mean, posterior.mean)
    if posterior.has_density:
        assert torch.equal(loaded.log_prob(theta), posterior.log_prob(theta))


def test_pyro_and_expand(posterior: Posterior) -> None:
    n = len(posterior.space)
    batch = posterior.expand((3,))
    assert batch.batch_shape == (3,)
    assert batch.sample((2,)).shape == (2, 3, n)
    assert batch.mean.shape == (3, n)
    assert posterior.batch_shape == ()
    if not posterior.has_density:
        return
    assert batch.log_prob(posterior.mean).shape == (3,)

    def model() -> torch.Tensor:
        with pyro.plate("lanes", 3):
            return pyro.sample("theta", posterior)

    trace = pyro.poutine.trace(model).get_trace()
    theta = trace.nodes["theta"]["value"]
    torch.testing.assert_close(trace.log_prob_sum(), posterior.log_prob(theta).sum())


def test_global_generator_and_values(posterior: Posterior) -> None:
    with torch.random.fork_rng():
        torch.manual_seed(7)
        first = posterior.sample((5,))
        torch.manual_seed(7)
        assert torch.equal(first, posterior.sample((5,)))
    values = posterior.values(50, generator=seeded(8))
    np.testing.assert_array_equal(values, posterior.space.values(posterior.sample((50,), generator=seeded(8)).numpy()))
    assert posterior.sample((0,)).shape == (0, len(posterior.space))


def test_marginals_agree_with_columns(posterior: Posterior) -> None:
    """Means and sds of the reordered marginal are those of the columns; 8,000 draws where it is Particles."""
    names = list(posterior.space.names[::-1][:2])
    columns = [posterior.space.index(name) for name in names]
    marginal = posterior.marginal(names)
    assert marginal.space.names == tuple(names)
    error = SIGMAS * posterior.stddev[columns] / math.sqrt(8000) + 1e-9
    assert bool(((marginal.mean - posterior.mean[columns]).abs() <= error).all())
    assert bool(((marginal.stddev - posterior.stddev[columns]).abs() <= error).all())


def test_inference_data(posterior: Posterior) -> None:
    data = posterior.to_inference_data(300, generator=seeded(9)).posterior
    assert tuple(data.data_vars) == posterior.space.names
    values = posterior.values(300, generator=seeded(9))
    for j, parameter in enumerate(posterior.space):
        assert data[parameter.name].attrs["units"] == parameter.unit
        np.testing.assert_array_equal(data[parameter.name].values, values[None, :, j])


def test_outside_is_minus_infinity(posterior: Posterior) -> None:
    if posterior.has_density:
        assert float(posterior.log_prob(torch.full((len(posterior.space),), 1.001))) == -math.inf


# The truncated normal.


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


RIDGE = np.array([[1.0, 0.9999e-4], [0.9999e-4, 1e-8]])
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


# The mixture.


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


# Priors, points, particles.


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
    """Prior in units, what was observed, predictions and densities of each draw, what the sampler knows; also after storing."""
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


# Wrong input and broken files.

EYE = np.eye(2)[None]
TWO = space_of(2)
WRONG_INPUT: list[tuple[Callable[[], object], type[Exception], str]] = [
    (lambda: Particles([[0.5, 0.5]], TWO, sample_stats={"lp": [1.0]}), ValueError, "sample_stats: expected chains"),
    (
        lambda: Dirac([0.5, 0.5], TWO).to_inference_data(10, log_likelihood={"x": np.zeros((1, 9))}),
        ValueError,
        "log_likelihood: expected x",
    ),
    (
        lambda: Dirac([0.5, 0.5], TWO).to_inference_data(prior=uniform(space_of(1))),
        ValueError,
        "prior: expected one over",
    ),
    (lambda: Dirac([0.5], TWO), ValueError, r"theta: expected shape \(2\), got \(1,\)"),
    (lambda: Dirac([0.5, 1.5], TWO), ValueError, r"theta: expected theta in \[0, 1\].*normalise"),
    (lambda: Dirac([0.5, math.nan], TWO), ValueError, "theta: expected finite"),
    (lambda: Dirac("abc", TWO), ValueError, "theta: expected an array of numbers"),
    (lambda: Dirac([0.5, 0.5], ["a", "b"]), TypeError, "space: expected a ParameterSpace, got list"),
    (lambda: Dirac([0.5, 0.5], TWO).log_prob([0.5, 0.5]), NoDensityError, "smoothed"),
    (lambda: Dirac([0.5, 0.5], TWO).smoothed(0.0), ValueError, "bandwidth: expected a positive"),
    (lambda: Particles(np.empty((0, 2)), TWO), ValueError, "at least one row"),
    (
        lambda: Particles(np.ones((4, 2)), TWO, weights=[1, 1, 1, -1]),
        ValueError,
        "weights: expected non-negative",
    ),
    (lambda: Particles(np.ones((4, 2)), TWO, weights=[0, 0, 0, 0]), ValueError, "positive sum"),
    (lambda: Particles(np.ones((4, 2)), TWO, weights=[1, 1]), ValueError, "weights: expected shape"),
    (
        lambda: Particles(np.ones((4, 2)), TWO, chains=3),
        ValueError,
        "chains: expected a divisor of the 4 rows",
    ),
    (
        lambda: Particles(np.ones((2, 2)), TWO, weights=[1, 2], chains=2),
        ValueError,
        "chains: expected equal weights",
    ),
    (lambda: Particles(np.ones((4, 2)), TWO).smoothed("scott"), ValueError, "scott.*give a number"),
    (
        lambda: Particles(np.ones((4, 2)), TWO).smoothed("silverman"),
        ValueError,
        "bandwidth: expected.*silverman",
    ),
    (lambda: GaussianMixture([0.0], [[0.5]], EYE, TWO), ValueError, "means: expected shape"),
    (lambda: GaussianMixture([0.0, 0.0], [[0.5, 0.5]], EYE, TWO), ValueError, "log_weights: expected shape"),
    (
        lambda: GaussianMixture([-math.inf], [[0.5, 0.5]], EYE, TWO),
        ValueError,
        "log_weights: expected at least one",
    ),
    (lambda: GaussianMixture([0.0], [[0.5, 0.5]], np.eye(2), TWO), ValueError, "covariances: expected shape"),
    (
        lambda: single([0.5, 0.5], [[1, 2], [2, 1]]),
        ValueError,
        "positive definite.*eigenvalue -1 in component 0",
    ),
    (lambda: single([0.5, 0.5], [[1, 1], [1, 1]]), ValueError, "positive definite"),
    (lambda: single([0.5, 0.5], [[1, 0.5], [0, 1]]), ValueError, "covariances: expected symmetric"),
    (lambda: single([0.5, 0.5], [[1, 0], [0, 0]]), ValueError, "positive variances"),
    (lambda: IndependentPrior([0.5, 0.5], [1.0, 0.0], TWO), ValueError, "sd: expected 2 positive"),
    (lambda: uniform(TWO).log_prob([0.5]), ValueError, r"theta: expected shape \(\.\.\., 2\), got \(1,\)"),
    (lambda: uniform(TWO).quantile(1.5), ValueError, r"q: expected.*\[0, 1\].*1.5"),
    (lambda: uniform(TWO).marginal("p0"), TypeError, r"write \['p0'\]"),
    (lambda: uniform(TWO).marginal(["mass"]), KeyError, "no parameter 'mass'"),
]


@pytest.mark.parametrize("case", range(len(WRONG_INPUT)))
def test_wrong_input(case: int) -> None:
    call, exception, words = WRONG_INPUT[case]
    with pytest.raises(exception, match=words) as caught:
        call()
    assert "\n" not in str(caught.value)


def test_broken_files(tmp_path: Path) -> None:
    path = tmp_path / "posterior"
    header, tensors = tmp_path / "posterior.json", tmp_path / "posterior.safetensors"

    def refused(exception: type[Exception], words: str) -> None:
        with pytest.raises(exception, match=words) as caught:
            load_posterior(path)
        assert "\n" not in str(caught.value)
        assert str(tmp_path) in str(caught.value)

    refused(FileNotFoundError, "no such file")
    uniform(TWO).save(path)
    good_header, good_tensors = header.read_text(), tensors.read_bytes()
    tensors.write_bytes(good_tensors[:-3])
    refused(ValueError, "checksum.*save it again")
    tensors.write_bytes(good_tensors)
    header.write_text(good_header[:40])
    refused(ValueError, "not JSON.*save it again")
    header.write_text("[]")
    refused(ValueError, "expected a posterior header")
    header.write_text(good_header.replace("IndependentPrior", "Cauchy"))
    refused(ValueError, r"expected one of \[.*'Dirac'.*got 'Cauchy'")
    header.write_text(good_header.replace('"family": "IndependentPrior"', '"family": "GaussianMixture"'))
    refused(ValueError, "not a posterior this version reads.*save it again")
    header.write_text(good_header)
    tensors.unlink()
    refused(FileNotFoundError, "posterior.safetensors")
