"""Posteriors with wrong widths and places, which differ over the logs, are mended by simulations with known truths."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.stats import binom

from sipe_bayes.core.parameters import Parameter, ParameterSpace
from sipe_bayes.inference.amortised.abc import ABC
from sipe_bayes.inference.amortised.bayessim import BayesSim
from sipe_bayes.inference.amortised.held_back import HeldBack
from sipe_bayes.inference.amortised.npe import NPE
from sipe_bayes.posterior import Flow, GaussianMixture, Particles, Posterior, QuantileMapped
from tests.problems.linear_gaussian import function_problem

SPACE = ParameterSpace([Parameter("a", low=0.0, high=1.0), Parameter("b", low=0.0, high=1.0)])
SD = 0.04


def claimed(x: np.ndarray) -> Posterior:
    """Of truths x + N(0, SD^2): half as wide where a is below .5, a sd off in b, elsewhere."""
    low = x[0] < 0.5
    mean = x + np.array([0.0, 0.0 if low else SD])
    sd = SD * np.array([0.5 if low else 1.0, 1.0])
    return normal(mean, sd)


def normal(mean: np.ndarray, sd: np.ndarray | float) -> Posterior:
    draws = mean + sd * np.random.default_rng(2).standard_normal((1000, 2))
    return Particles(np.clip(draws, 0, 1), SPACE)


def test_each_half_of_the_logs_is_mended_by_its_own_like() -> None:
    """300 logs a half; a coverage of .9 lies within these bounds but for one in ten thousand cases, by Bonferroni.

    The bounds are wider by two standard errors of what 400 simulations a half can tell.
    """
    rng, generator = np.random.default_rng(0), torch.Generator().manual_seed(0)
    x = rng.uniform(0.15, 0.85, (1400, 2))
    truths = x + SD * rng.standard_normal(x.shape)
    held_back = HeldBack.of(lambda i: claimed(x[i]), truths[:800], generator)
    inside, plain = np.empty((600, 2), bool), np.empty((600, 2), bool)
    levels = torch.tensor([0.05, 0.95], dtype=torch.float64)
    for row, i in enumerate(range(800, 1400)):
        for kept, posterior in ((plain, claimed(x[i])), (inside, held_back.mended(claimed(x[i]), generator))):
            low, high = posterior.quantile(levels).numpy()
            kept[row] = (truths[i] >= low) & (truths[i] <= high)
    half = x[800:, 0] < 0.5
    assert plain[half, 0].mean() < 0.75
    assert plain[~half, 1].mean() < 0.85
    slack = 2 * np.sqrt(0.9 * 0.1 / 200)
    for part in (half, ~half):
        low, high = binom.ppf([1e-4 / 8, 1 - 1e-4 / 8], part.sum(), 0.9) / part.sum()
        for j in range(2):
            assert low - slack <= inside[part, j].mean() <= high + slack


def test_posteriors_that_are_right_stay_as_they_are() -> None:
    rng, generator = np.random.default_rng(1), torch.Generator().manual_seed(1)
    x = rng.uniform(0.2, 0.8, (400, 2))
    held_back = HeldBack.of(lambda i: normal(x[i], SD), x + SD * rng.standard_normal(x.shape), generator)
    mended = held_back.mended(normal(np.array([0.4, 0.6]), SD), generator)
    np.testing.assert_allclose(mended.mean.numpy(), [0.4, 0.6], atol=0.4 * SD)
    np.testing.assert_allclose(mended.stddev.numpy(), SD, rtol=0.25)


def test_two_modes_stay_apart() -> None:
    """Posteriors that are right, of modes twenty sds apart: what the scores' scatter moves hardly lies between."""
    rng, generator = np.random.default_rng(2), torch.Generator().manual_seed(2)
    means = np.array([[0.3], [0.7]])
    right = GaussianMixture(np.zeros(2), means, np.full((2, 1, 1), 0.02**2), ParameterSpace(list(SPACE)[:1]))
    truths = means[rng.integers(0, 2, 400)] + 0.02 * rng.standard_normal((400, 1))
    mended = HeldBack.of(lambda i: right, truths, generator).mended(right, generator)
    theta = mended.sample((20000,), generator=generator).numpy()
    assert (np.abs(theta - 0.5) < 0.1).mean() < 0.02


def test_a_fifth_is_held_back_where_it_is_enough() -> None:
    """A hundred of 500 are; of fewer, none. A network is trained on the others alone; ABC's draws are moved."""
    simulator, log, _, likelihood = function_problem()
    settings = {"likelihood": likelihood, "max_epochs": 2, "transforms": 1, "hidden": 8}
    for budget, family in ((499, Flow), (500, QuantileMapped)):
        npe = NPE(simulator, budget=budget, **settings)
        assert type(npe.fit(log)) is family
        assert npe.diagnostics["simulations"] == (budget if family is Flow else 400)
    assert isinstance(NPE(simulator, budget=500, calibration=0.0, **settings).fit(log), Flow)
    abc = ABC(simulator, budget=600, likelihood=likelihood, accepted=0.2)
    posterior = abc.fit(log)
    assert abc.diagnostics["accepted"] == 96  # of 480
    assert isinstance(posterior, Particles)


def test_a_method_keeps_simulations_back_by_option(tmp_path: Path) -> None:
    """The same answer from a checkpoint; too few simulations are refused by name."""
    simulator, log, exact, likelihood = function_problem()
    method = BayesSim(
        simulator, budget=400, likelihood=likelihood, calibration=0.05, checkpoint=tmp_path / "fit.safetensors"
    )
    posterior = method.fit(log)
    assert isinstance(posterior, QuantileMapped)
    assert ((posterior.mean - exact.mean).abs() < 2 * exact.stddev + 0.1).all()
    again = BayesSim(
        simulator, budget=400, likelihood=likelihood, calibration=0.05, checkpoint=tmp_path / "fit.safetensors"
    )
    torch.testing.assert_close(again.fit(log).mean, posterior.mean, rtol=0, atol=0)
    with pytest.raises(ValueError, match=r"calibration: 0\.01 of 400 simulations are 4, 10 are the least"):
        BayesSim(simulator, budget=400, likelihood=likelihood, calibration=0.01).fit(log)
