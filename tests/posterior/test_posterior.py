"""Every family: densities integrate to one, samples agree with them, files read back exactly.

Statistical tests use fixed seeds and five standard errors (false alarms 6e-7 each over reseeding, were the errors
normal) unless they say otherwise; Kolmogorov-Smirnov tests reject below p = 1e-5.
"""

from __future__ import annotations

import math
from pathlib import Path

import arviz
import h5py
import numpy as np
import pyro
import pytest
import torch

from sipe_bayes.core.parameters import Parameter, ParameterSpace
from sipe_bayes.posterior import (
    FAMILIES,
    Dirac,
    NoDensityError,
    Particles,
    Posterior,
    SurrogatePosterior,
    load_posterior,
)
from tests.problems.html import cells
from tests.problems.posteriors import EXAMPLES, SIGMAS, example, seeded


@pytest.fixture(params=[(name, n) for name in FAMILIES for n in (1, 2, 4)], ids=lambda p: f"{p[0]}-{p[1]}")
def posterior(request: pytest.FixtureRequest) -> Posterior:
    name, n = request.param
    if name not in EXAMPLES:
        pytest.fail(f"{name} is registered but has no example here: add one line to EXAMPLES")
    return example(name, n)


def test_shows_its_medians_in_a_notebook(posterior: Posterior) -> None:
    rows = cells(posterior._repr_html_())
    assert [row[0] for row in rows] == list(posterior.space.names)
    medians = posterior.space.values(posterior.quantile(0.5).numpy())
    np.testing.assert_allclose([float(row[1]) for row in rows], medians, rtol=1e-3, atol=1e-12)


def test_draws_its_own_figure() -> None:
    posterior = example("GaussianMixture", 2)
    for figure, panels in ((posterior.plot(), 2), (posterior.plot(truth=[0.2, 0.5], pairs=True), 4)):
        assert len([ax for ax in figure.axes if ax.lines or ax.collections]) >= panels
        assert figure._repr_png_().startswith(b"\x89PNG")  # type: ignore[attr-defined]
    with pytest.raises(ValueError, match="expected 2 parameters"):
        posterior.plot(truth=[0.2])


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


def test_the_file_holds_what_arviz_gets(posterior: Posterior, tmp_path: Path) -> None:
    path = tmp_path / "draws.nc"
    path.write_bytes(posterior.netcdf(seeded()))
    stored, direct = arviz.from_netcdf(path), posterior.to_inference_data(generator=seeded())
    assert stored.groups() == direct.groups()
    for group in direct.groups():
        assert set(stored[group]) == set(direct[group])
        for name, values in direct[group].items():
            np.testing.assert_array_equal(stored[group][name], values)
            assert stored[group][name].attrs == values.attrs


def test_names_that_hdf5_has_another_meaning_for(tmp_path: Path) -> None:
    space = ParameterSpace([Parameter(name, 0.0, 1.0) for name in ("left/right", ".", "..", "plain")])
    content = Dirac([0.1, 0.2, 0.3, 0.4], space).netcdf()
    (tmp_path / "draws.nc").write_bytes(content)
    with h5py.File(tmp_path / "draws.nc") as file:
        assert {"left|right", "parameter.", "parameter..", "plain"} <= set(file["posterior"])
