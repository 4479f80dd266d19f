"""Bayesian optimisation and its surrogate posterior."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import scipy.stats
import torch

from sipe_bayes.core.parameters import Parameter, ParameterSpace
from sipe_bayes.core.trajectory import Trajectory
from sipe_bayes.inference.search import bayesopt
from sipe_bayes.inference.search.acquisition import CandidateOptions, CandidateSearch, log_improvement
from sipe_bayes.inference.search.bayesopt import BayesOpt, BayesOptState, independent_residuals
from sipe_bayes.models.gaussian_process import GaussianProcess, fit_gaussian_process
from sipe_bayes.posterior import SurrogatePosterior, load_posterior, uniform
from sipe_bayes.posterior.ensemble import EnsembleOptions
from sipe_bayes.simulation.simulator import Simulator
from tests.problems.pendulums import DT, log, pendulum
from tests.problems.surrogates import bowl, example_surrogate

BUDGET = 60
ROUGH: dict[str, Any] = {"effective_draws": 50, "most_steps": 100}  # draws, where only form counts
TRUTH = np.array([0.6, 0.05])


def space_of(n: int) -> ParameterSpace:
    return ParameterSpace(Parameter(f"p{j}", 0.0, 1.0) for j in range(n))


def recorded(simulator: Simulator, values: np.ndarray = TRUTH) -> Trajectory:
    """Without noise, with its states."""
    trajectory = log(simulator, list(values), 1, steps=150, sd=0.0)
    theta = simulator.space.normalise(values)
    motion = simulator.rollout(theta, trajectory.actions, simulator.default_state(), dt=DT)
    assert motion.states is not None
    return Trajectory(motion.observations[0], trajectory.actions, DT, states=motion.states[0], channels=motion.channels)


def draws(posterior: SurrogatePosterior) -> torch.Tensor:
    return posterior.sample((300,), generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("n", [1, 3])
def test_the_process_against_dense_algebra(n: int) -> None:
    process, theta = bowl(n), torch.rand(7, n, dtype=torch.float64, generator=torch.Generator().manual_seed(0))

    def kernel(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        r = math.sqrt(5) * (((a[:, None] - b[None]) / process.lengthscale) ** 2).sum(-1).sqrt()
        return (1 + r + r**2 / 3) * torch.exp(-r)

    inverse = torch.linalg.inv(kernel(process.x, process.x) + process.noise * torch.eye(len(process.x)))
    cross = kernel(theta, process.x)
    z = (process.y - process.location) / process.scale - process.level
    mean, sd = process.predict(theta)
    torch.testing.assert_close(mean, process.location + process.scale * (process.level + cross @ inverse @ z))
    torch.testing.assert_close(sd, process.scale * (1 - (cross @ inverse * cross).sum(1)).sqrt(), rtol=1e-6, atol=1e-7)
    more = process.imagined(theta[0])
    plain = process.with_data(more.x, more.y)
    torch.testing.assert_close(more.predict(theta)[0], mean)
    torch.testing.assert_close(more.predict(theta)[1], plain.predict(theta)[1], rtol=1e-6, atol=1e-7)


def test_slopes_are_autograds() -> None:
    rng = np.random.default_rng(3)
    x = torch.from_numpy(rng.random((30, 4)))
    process = GaussianProcess(
        x, (x**2).sum(1), torch.tensor([0.3, 0.5, 1.0, 2.0], dtype=torch.float64), 1e-3, 0.2, 1.0, 0.7
    )
    theta = torch.from_numpy(rng.random((5, 4))).requires_grad_(True)
    mean, sd = process.predict(theta)
    expected = [torch.autograd.grad(v.sum(), theta, retain_graph=True)[0] for v in (mean, sd)]
    found = process.slopes(theta.detach())
    for there, here in zip((mean, sd, *expected), found, strict=True):
        torch.testing.assert_close(here, there.detach(), rtol=1e-8, atol=1e-10)


def test_fitted_hyper_parameters_predict() -> None:
    """Standardised errors at fresh points are of order one, and an idle parameter gets a long lengthscale."""
    rng = np.random.default_rng(0)
    x, fresh = (torch.from_numpy(rng.random((n, 3))) for n in (120, 200))
    value = lambda t: torch.sin(5 * t[:, 0]) + 2 * t[:, 1] ** 2  # noqa: E731
    process = fit_gaussian_process(x, value(x))
    mean, sd = process.predict(fresh)
    assert float(((mean - value(fresh)) / sd).square().mean().sqrt()) < 3
    assert float((mean - value(fresh)).abs().max()) < 0.05
    assert process.lengthscale.argmax() == 2
    again = fit_gaussian_process(x, value(x))
    assert torch.equal(process.lengthscale, again.lengthscale)


@pytest.mark.parametrize("n", [1, 2, 4])
def test_the_density_integrates_to_one_and_draws_agree(n: int, tmp_path: Path) -> None:
    """Five standard errors, of the normaliser too.

    The chains' means within five of theirs (effective draws as reported).
    """
    prior = uniform(space_of(n))
    posterior = SurrogatePosterior.sampled(
        bowl(n), math.log(0.1 + 0.03 * n), prior, options=EnsembleOptions(effective=500)
    )
    theta = torch.rand(60_000, n, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    density = posterior.log_prob(theta).exp()
    error = math.hypot(float(density.std()) / math.sqrt(60_000), posterior.normaliser_error)
    assert abs(float(density.mean()) - 1) < 5 * error
    mean = (density[:, None] * theta).mean(0) / density.mean()
    sd = ((density[:, None] * (theta - mean) ** 2).mean(0) / density.mean()).sqrt()
    error = sd * (1 / posterior.mixing["ess"] + float((density**2).mean()) / 60_000) ** 0.5
    print(posterior.mixing, (posterior.mean - mean) / error, posterior.stddev / sd)
    assert ((posterior.mean - mean).abs() < 5 * error).all()
    torch.testing.assert_close(posterior.stddev, sd, rtol=0.1, atol=0)
    posterior.save(tmp_path / "posterior")
    loaded = load_posterior(tmp_path / "posterior")
    assert isinstance(loaded, SurrogatePosterior)
    assert torch.equal(loaded.log_prob(theta[:100]), posterior.log_prob(theta[:100]))
    assert torch.equal(draws(loaded), draws(posterior))
    assert torch.equal(loaded.mode, posterior.mode)
    assert loaded.mixing == posterior.mixing


def test_the_mode_is_the_best_point() -> None:
    posterior = example_surrogate(space_of(2), 2000)
    values = posterior.process.y.tolist()
    assert torch.equal(posterior.mode, posterior.process.x[values.index(min(values))])


def test_the_density_is_the_probability_of_another_simulation_below_epsilon() -> None:
    """With a noise that counts: the process's own, on top of what it does not know of the mean."""
    process, theta = replace(bowl(2), noise=0.5), torch.rand(6, 2, dtype=torch.float64)
    mean, sd = (part.numpy() for part in process.predict(theta))
    expected = scipy.stats.norm.logcdf(-1.0, mean, np.sqrt(sd**2 + 0.5 * process.scale**2))
    posterior = SurrogatePosterior(process, -1.0, uniform(space_of(2)), theta, 1, 0.3, 0.0)
    np.testing.assert_allclose(posterior.log_prob(theta).numpy(), expected - 0.3, rtol=1e-9)


def test_epsilon_gives_a_quadratic_log_cost_its_gaussians_covariance() -> None:
    """``log C = log C_min + (theta - m)' S^-1 (theta - m) / n``: theta below epsilon have covariance S, to 8 %."""
    rng, sd, residuals = np.random.default_rng(0), np.array([0.03, 0.05]), 40.0
    theta = rng.uniform(0.2, 0.8, (200_000, 2))
    cost = 0.02 * np.exp((((theta - 0.5) / sd) ** 2).sum(1) / residuals)
    method = BayesOpt(pendulum(), floor=1e-9)
    process: Any = SimpleNamespace(x=theta, predict=lambda _: (torch.from_numpy(np.log(cost)), None))
    epsilon = method.threshold(BayesOptState("", theta, cost, np.ones(1), residuals), process)
    below = theta[np.log(cost) < epsilon]
    np.testing.assert_allclose(np.cov(below.T).diagonal(), sd**2, rtol=0.08)


def test_expected_improvement_is_that_of_its_definition() -> None:
    """By quadrature, over the lowest value less xi."""
    process, theta = bowl(2), torch.rand(4, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    acquisition = BayesOpt(pendulum(), acquisition="expected_improvement", xi=0.2).acquisition
    search = CandidateSearch(acquisition, np.zeros(2), np.ones(2), CandidateOptions())
    mean, sd = process.predict(theta)
    y = mean + sd * torch.linspace(-12, 12, 200_001, dtype=torch.float64)[:, None]
    gain = (process.y.min() - 0.2 - y).clamp_min(0) * torch.exp(-(((y - mean) / sd) ** 2) / 2) / (2 * math.pi) ** 0.5
    expected = gain.sum(0) * 24 / 200_000
    torch.testing.assert_close(search.merit(process, theta).exp(), expected, rtol=1e-4, atol=1e-300)


def test_hyper_parameters_are_fitted_where_the_data_have_grown(monkeypatch: pytest.MonkeyPatch) -> None:
    """By a fifth: 10 evaluations, then 12, 15 and 18."""
    fits: list[int] = []

    def fit(x: torch.Tensor, *_: Any) -> GaussianProcess:
        fits.append(len(x))
        return bowl(2)

    monkeypatch.setattr(bayesopt, "fit_gaussian_process", fit)
    method, rng = BayesOpt(pendulum()), np.random.default_rng(0)
    state = BayesOptState("", np.empty((0, 2)), np.empty(0), np.ones(1))
    for count in range(10, 20):
        state = method.fitted(replace(state, theta=rng.random((count, 2)), cost=rng.random(count)))
    assert fits == [10, 12, 15, 18]


def test_other_trajectories_start_a_new_process() -> None:
    simulator = pendulum()
    one, other = (log(simulator, list(TRUTH), k, steps=100) for k in (1, 2))
    method = BayesOpt(simulator, budget=200, **ROUGH)
    for _ in range(3):
        method.update_parameter_estimate(one)
    before = method.rollouts
    method.update_parameter_estimate(other)
    fresh = BayesOpt(simulator, budget=200, **ROUGH)
    fresh.update_parameter_estimate(other)
    assert np.array_equal(method.state.cost, fresh.state.cost)
    assert method.rollouts == before + fresh.rollouts
    method.get_parameter_estimate(other)
    assert not any("other trajectories" in w for w in method.warnings)
    method.get_parameter_estimate(one)
    assert any("other trajectories" in w for w in method.warnings)


@pytest.mark.parametrize("acquisition", ["upper_confidence_bound", "expected_improvement"])
def test_finds_the_optimum_within_the_budget(acquisition: str) -> None:
    """Two parameters, 60 rollouts, no noise.

    The best theta is good to 0.02, the truth within 4 sds of the mean and half of the posterior within 0.05 of it; a
    few far draws are what little was evaluated elsewhere.
    """
    simulator = pendulum()
    truth = simulator.space.normalise(TRUTH)
    estimator = BayesOpt(simulator, budget=BUDGET, acquisition=acquisition, effective_draws=200)
    posterior = estimator.fit(recorded(simulator))
    print(estimator.diagnostics, posterior.best.numpy() - truth, posterior.mean.numpy() - truth, posterior.stddev)
    assert estimator.rollouts == BUDGET
    assert np.abs(posterior.best.numpy() - truth).max() < 0.02
    assert (np.abs(posterior.mean.numpy() - truth) < 4 * posterior.stddev.numpy()).all()
    near = np.abs(posterior.draws.numpy() - truth).max(1) < 0.05
    assert near.mean() > 0.5


class Interrupted(Exception):
    """Stands for a killed process."""


def test_resumes_to_the_same_posterior(tmp_path: Path) -> None:
    simulator = pendulum()
    logs = [log(simulator, list(TRUTH), seed, f"log{seed}", steps=100) for seed in (1, 2)]
    undisturbed = BayesOpt(simulator, budget=51, seed=3, **ROUGH).fit(logs)
    steps = 0

    def interrupt(*_: Any) -> None:
        nonlocal steps
        steps += 1
        if steps == 3:
            raise Interrupted

    settings: dict[str, Any] = {"budget": 51, "seed": 3, "checkpoint": tmp_path / "checkpoint.safetensors", **ROUGH}
    first = BayesOpt(simulator, progress=interrupt, **settings)
    first.checkpoint_seconds = 0.0
    with pytest.raises(Interrupted):
        first.fit(logs)
    second = BayesOpt(pendulum(), **settings)
    resumed = second.fit(logs)
    assert second.rollouts == 50
    assert torch.equal(draws(undisturbed), draws(resumed))
    assert torch.equal(undisturbed.log_prob(draws(resumed)), resumed.log_prob(draws(resumed)))


def test_diverging_simulations_are_survived(monkeypatch: pytest.MonkeyPatch) -> None:
    simulator = pendulum()
    trajectory = recorded(simulator)
    original = Simulator.rollout

    def diverging(self: Simulator, theta: np.ndarray, *args: Any, **settings: Any) -> Any:
        result = original(self, theta, *args, **settings)
        result.valid[np.atleast_2d(theta)[:, 0] > 0.8, 5:] = False
        return result

    monkeypatch.setattr(Simulator, "rollout", diverging)
    estimator = BayesOpt(simulator, budget=40, **ROUGH)
    posterior = estimator.fit(trajectory)
    assert estimator.diagnostics["diverged"] > 0
    assert any("diverged" in warning for warning in estimator.warnings)
    assert np.abs(posterior.best.numpy() - simulator.space.normalise(TRUTH)).max() < 0.05
    assert torch.isfinite(posterior.log_prob(draws(posterior))).all()


def test_log_improvement_against_its_definition() -> None:
    z = torch.tensor([-2000.0, -1000.0, -30.0, -5.0, -1.0, 0.0, 3.0], dtype=torch.float64, requires_grad=True)
    value = log_improvement(z)
    plain = torch.exp(-(z**2) / 2) / math.sqrt(2 * math.pi) + z * torch.special.ndtr(z)
    torch.testing.assert_close(value[3:], plain[3:].log(), rtol=1e-8, atol=1e-8)
    assert (value[1:] > value[:-1]).all()
    (gradient,) = torch.autograd.grad(value.sum(), z)
    assert torch.isfinite(gradient).all()
    assert (gradient > 0).all()


def test_independent_residuals_count_correlation() -> None:
    """2,000 white residuals are worth 2,000; with rho .9 a nineteenth of it, within 20 %."""
    rng = np.random.default_rng(0)
    white = rng.standard_normal((1, 2000, 1))
    coloured = white.copy()
    for i in range(1, 2000):
        coloured[0, i] = 0.9 * coloured[0, i - 1] + math.sqrt(0.19) * white[0, i]
    seen = np.ones(white.shape, bool)
    assert independent_residuals(white, seen) == pytest.approx(2000, rel=0.1)
    assert independent_residuals(coloured, seen) == pytest.approx(2000 / 19, rel=0.2)


def test_wrong_input() -> None:
    simulator = pendulum()
    table: list[tuple[dict[str, Any], str]] = [
        ({"acquisition": "luck"}, "expected one of upper_confidence_bound"),
        ({"kappa": -1.0}, "kappa: expected at least 0"),
        ({"batch": 0}, "batch: expected at least 1"),
        ({"initial": 1}, "initial: expected at least 2"),
        ({"floor": 0.0}, "floor: expected a positive number"),
        ({"checks": 1.0}, "checks: expected a share"),
    ]
    for settings, words in table:
        with pytest.raises(ValueError, match=words):
            BayesOpt(simulator, **settings)
    with pytest.raises(ValueError, match="raise it"):
        BayesOpt(simulator, budget=3).fit(log(simulator, list(TRUTH), 1, steps=100))
