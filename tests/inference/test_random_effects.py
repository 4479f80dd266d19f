"""Random effects between logs against the integrals of a model of one parameter, and against simple limits."""

from __future__ import annotations

import numpy as np
import pytest

from sipe_bayes.core.parameters import Parameter, ParameterSpace
from sipe_bayes.inference.random_effects import LogEstimate, RandomEffectsOptions, random_effects
from sipe_bayes.posterior import prior as default_prior

SCALE = RandomEffectsOptions().spread


def space(n: int) -> ParameterSpace:
    """N parameters."""
    return ParameterSpace([Parameter(f"p{j}", 0.0, 1.0) for j in range(n)])


def logs(means: list[float], sds: list[float]) -> list[LogEstimate]:
    """Estimates of one parameter."""
    pairs = enumerate(zip(means, sds, strict=True))
    return [LogEstimate(f"log{k}", np.array([m]), np.array([[1 / s**2]])) for k, (m, s) in pairs]


def by_quadrature(estimates: list[LogEstimate]) -> tuple[float, float, float, float]:
    """Mean and sd of mu, and of tau, of one parameter on a fine grid."""
    mu, tau = np.linspace(0, 1, 801)[:, None], np.geomspace(1e-5, 2.0, 1200)[None]
    level = -0.5 * (tau / SCALE) ** 2 + np.log(tau)  # the grid's spacing grows with tau
    for log in estimates:
        variance = 1 / log.information[0, 0] + tau**2
        level = level - 0.5 * np.log(variance) - 0.5 * (mu - log.mean[0]) ** 2 / variance
    weight = np.exp(level - level.max())
    weight /= weight.sum()
    m, t = float((weight * mu).sum()), float((weight * tau).sum())
    return (
        m,
        float(np.sqrt((weight * (mu - m) ** 2).sum())),
        t,
        float(np.sqrt((weight * (tau - t) ** 2).sum())),
    )


@pytest.mark.parametrize(
    ("means", "sds"),
    [
        ([0.5, 0.51, 0.49, 0.5], [0.02] * 4),  # agree
        ([0.3, 0.5, 0.55, 0.4, 0.62, 0.45], [0.01] * 6),  # differ
        ([0.05, 0.02, 0.3], [0.01, 0.05, 0.2]),  # beside a bound, of unequal worth
        ([0.5, 0.5, 0.9], [0.01, 0.01, 0.01]),  # one is odd
        ([1.3, 1.32, 1.29, 1.3], [0.01] * 4),  # agree on what is beyond the bounds
    ],
)
def test_one_parameter_is_as_by_quadrature(means: list[float], sds: list[float]) -> None:
    """Within a twelfth of an sd: some 1,000 independent draws at 3 of their standard errors."""
    estimates = logs(means, sds)
    effects = random_effects(estimates, default_prior(space(1)), seed=1)
    mean, sd, tau, tau_sd = by_quadrature(estimates)
    print(mean, sd, tau, tau_sd, effects.common.mean, effects.common.stddev, effects.spread.mean())
    assert float(effects.common.mean) == pytest.approx(mean, abs=sd / 12)
    assert float(effects.common.stddev) == pytest.approx(sd, rel=0.12)
    assert effects.spread.mean() == pytest.approx(tau, abs=tau_sd / 8)


def test_logs_that_agree_are_hardly_wider_than_pooled() -> None:
    rng = np.random.default_rng(0)
    information = np.diag([1e4, 4e4, 1e3])
    cholesky = np.linalg.cholesky(np.linalg.inv(information))
    estimates = [LogEstimate(f"log{k}", 0.5 + cholesky @ rng.standard_normal(3), information) for k in range(12)]
    effects = random_effects(estimates, default_prior(space(3)))
    pooled = 1 / np.sqrt(12 * np.diag(information))
    ratio = effects.common.stddev.numpy() / pooled
    print(ratio)
    assert (ratio > 0.9).all()
    assert (ratio < 1.6).all()


def test_a_parameter_that_differs_leaves_the_others_alone() -> None:
    """Correlated with it in every log, though."""
    rng = np.random.default_rng(1)
    information = np.array([[2e4, 1e4], [1e4, 2e4]])
    cholesky = np.linalg.cholesky(np.linalg.inv(information))
    values = rng.normal(0.5, 0.1, 8)
    estimates = [
        LogEstimate(f"log{k}", np.array([values[k], 0.4]) + cholesky @ rng.standard_normal(2), information)
        for k in range(8)
    ]
    effects = random_effects(estimates, default_prior(space(2)))
    print(effects.common.stddev, effects.spread.mean(0), effects.new_log.stddev)
    assert abs(float(effects.common.mean[1]) - 0.4) < 4 * float(effects.common.stddev[1])
    assert float(effects.common.stddev[1]) < 0.01
    assert 0.05 < effects.spread[:, 0].mean() < 0.2
    assert float(effects.new_log.stddev[0]) > 0.8 * np.std(values)


def test_what_no_log_knows_keeps_its_prior() -> None:
    information = np.diag([1e4, 0.0])
    estimates = [LogEstimate(f"log{k}", np.array([0.5, 0.5]), information) for k in range(3)]
    effects = random_effects(estimates, default_prior(space(2)))
    assert float(effects.common.mean[1]) == pytest.approx(0.5, abs=0.03)
    assert float(effects.common.stddev[1]) == pytest.approx(1 / np.sqrt(12), rel=0.05)


def test_where_a_ridge_ends_in_a_linear_model_does_not_count() -> None:
    """A gain and a mass whose ratio each log tells, to first order ranges off along it; a known load in one tells both.

    The first three tell 2 mass - gain, the last mass + gain.
    """
    along, across = np.array([1.0, 2.0]) / np.sqrt(5), np.array([2.0, -1.0]) / np.sqrt(5)
    loaded = np.array([1.0, 1.0]) / np.sqrt(2)
    ridge = 1e6 * np.outer(across, across) + 0.8 * np.outer(along, along)
    other = 1e6 * np.outer(loaded, loaded)
    truth = np.array([0.3, 0.6])
    estimates = [LogEstimate(f"log{k}", truth + far * along, ridge) for k, far in enumerate((15.0, 10.0, 6.0))]
    estimates.append(LogEstimate("loaded", truth + 20 * np.array([1.0, -1.0]), other))
    effects = random_effects(estimates, default_prior(space(2)))
    print(effects.common.mean, effects.common.stddev, effects.spread.mean(0))
    assert np.abs(effects.common.mean.numpy() - truth).max() < 0.05
    assert float(effects.common.stddev.max()) < 0.1


@pytest.mark.parametrize("precision", [11.9, 12.1])
def test_many_logs_that_each_say_little_say_much_together(precision: float) -> None:
    """With no cliff where one says as much as a uniform prior does."""
    means = np.random.default_rng(3).normal(0.4, 0.1, 20).tolist()
    effects = random_effects(logs(means, [precision**-0.5] * 20), default_prior(space(1)))
    print(effects.common.mean, effects.common.stddev)
    assert float(effects.common.mean) == pytest.approx(np.mean(means), abs=0.03)
    assert float(effects.common.stddev) < 0.1


def test_one_log_is_refused() -> None:
    with pytest.raises(ValueError, match=r"logs: expected two or more, got 1"):
        random_effects(logs([0.5], [0.1]), default_prior(space(1)))


def test_the_same_seed_gives_the_same_draws() -> None:
    estimates = logs([0.4, 0.6], [0.01, 0.02])
    first, second = (random_effects(estimates, default_prior(space(1)), seed=3) for _ in range(2))
    assert (first.common.theta == second.common.theta).all()


def test_what_is_known_beforehand_is_the_same_in_every_log() -> None:
    """A mass that was weighed stands still where the logs do not tell it, whatever a gain beside it does."""
    parameters = [Parameter("mass", 0.0, 1.0, prior_mean=0.6, prior_sd=0.004), Parameter("gain", 0.0, 1.0)]
    known = default_prior(ParameterSpace(parameters))
    ridge = np.array([[1.0, -1.0], [-1.0, 1.0]]) * 1e4  # only mass - gain is told
    estimates = [LogEstimate(str(k), np.array([0.5, gain]), ridge) for k, gain in enumerate((0.48, 0.52, 0.5, 0.49))]
    low, high = random_effects(estimates, known, 0).new_log.quantile([0.05, 0.95]).numpy()
    print(low, high)
    assert 0.59 < low[0] < high[0] < 0.61
    assert 0.5 < low[1] < high[1] < 0.75
