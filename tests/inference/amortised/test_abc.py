"""Rejection ABC against exact posteriors, and the summary statistics it looks at."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.inference.amortised.abc import ABC
from sipe_bayes.models.statistics import step_statistics
from sipe_bayes.models.transitions import control_steps
from sipe_bayes.posterior import Particles, load_posterior
from tests.problems.noisy_sums import QUIET, exact, linear, seen
from tests.problems.pendulums import log, pendulum


def test_statistics_against_a_plain_loop() -> None:
    rng = np.random.default_rng(0)
    observations, actions = rng.standard_normal((3, 1, 6, 2)), rng.standard_normal((1, 5, 2))
    observations[1, 0, 2] = np.nan
    found = step_statistics(control_steps(observations, actions, np.array([5])), 2, 2)
    for i, row in enumerate(observations[:, 0]):
        tau = [(row[t + 1] - row[t], actions[0, t]) for t in range(5) if np.isfinite(row[t : t + 2]).all()]
        change = np.array([c for c, _ in tau])
        products = sum(np.outer(c, a) for c, a in tau) / len(tau)
        expected = np.concatenate([change.mean(0), change.var(0), products.ravel()])
        np.testing.assert_allclose(found[i], expected, rtol=1e-5, atol=1e-6)
    assert np.isnan(step_statistics(np.full((1, 4, 6), np.nan), 2, 2)).all()
    with pytest.raises(ValueError, match="use control_steps"):
        step_statistics(np.zeros((1, 4, 5)), 2, 2)


@pytest.mark.parametrize("x", [(0.4, 0.5), (0.05, 0.3)])
def test_rejection_is_near_the_exact_posterior_and_wider(x: tuple[float, float]) -> None:
    """400 draws of 20,000: means within 4 standard errors (false alarm 0.03 % in all) and 0.1 sd for the bandwidth."""
    method = ABC(linear(), budget=20_000, accepted=0.02, likelihood=QUIET, calibration=0.0)
    posterior = method.fit(seen(*x))
    assert isinstance(posterior, Particles)
    mean, sd = exact(*x)
    print((posterior.mean.numpy() - mean) / sd, posterior.stddev.numpy() / sd, method.diagnostics)
    assert len(posterior.theta) == 400
    assert method.rollouts == 20_000
    np.testing.assert_array_less(np.abs(posterior.mean.numpy() - mean), (4 / np.sqrt(400) + 0.1) * sd)
    np.testing.assert_allclose(posterior.stddev.numpy(), sd, rtol=0.25)


def test_regression_takes_the_acceptance_window_away() -> None:
    """With a fifth accepted, plain rejection is far too wide; adjusted, it is not."""
    mean, sd = exact(0.4, 0.5)
    width = {}
    for regression in (False, True):
        method = ABC(linear(), budget=4000, accepted=0.2, regression=regression, likelihood=QUIET, calibration=0.0)
        posterior = method.fit(seen(0.4, 0.5))
        width[regression] = posterior.stddev.numpy() / sd
        assert ((posterior.theta >= 0) & (posterior.theta <= 1)).all()
    print(width, (posterior.mean.numpy() - mean) / sd)
    assert width[False].max() > 1.4
    np.testing.assert_allclose(width[True], 1, atol=0.2)
    np.testing.assert_array_less(np.abs(posterior.mean.numpy() - mean), 0.3 * sd)


def test_the_pendulum(tmp_path: Path) -> None:
    simulator = pendulum()
    logs = [log(simulator, [0.6, 0.05], 1, "a", steps=200), log(simulator, [0.6, 0.05], 2, "b", steps=150)]
    logs[0].observations[20:40] = np.nan
    before = torch.get_rng_state()
    fits = [ABC(simulator, budget=1000, seed=2).fit(logs) for _ in range(2)]
    assert torch.equal(before, torch.get_rng_state())
    assert torch.equal(fits[0].theta, fits[1].theta)
    truth = simulator.space.normalise(np.array([0.6, 0.05]))
    print(fits[0].mean, fits[0].stddev, truth)
    assert (np.abs(fits[0].mean.numpy() - truth) < 4 * fits[0].stddev.numpy()).all()
    fits[0].save(tmp_path / "posterior")
    assert torch.equal(load_posterior(tmp_path / "posterior").theta, fits[0].theta)


def test_other_logs_need_no_other_simulations() -> None:
    method = ABC(linear(), budget=2000, likelihood=QUIET, calibration=0.0)
    method.fit(seen(0.4, 0.5))
    assert method.state is not None
    other = method.posterior(method.state, Trajectories.stack(seen(0.7, 0.6)))
    mean, sd = exact(0.7, 0.6)
    assert (np.abs(other.mean.numpy() - mean) < sd).all()
    assert method.rollouts == 2000


def test_an_interrupted_fit_resumes_to_the_same_posterior(tmp_path: Path) -> None:
    def interrupt(*_: Any) -> None:
        raise KeyboardInterrupt

    settings: dict[str, Any] = {"budget": 200, "likelihood": QUIET, "accepted": 0.2}
    whole = ABC(linear(), **settings).fit(seen(0.4, 0.5))
    first = ABC(linear(), checkpoint=tmp_path / "state.safetensors", progress=interrupt, **settings)
    first.checkpoint_seconds = 0.0
    with pytest.raises(KeyboardInterrupt):
        first.fit(seen(0.4, 0.5))
    resumed = ABC(linear(), checkpoint=tmp_path / "state.safetensors", **settings).fit(seen(0.4, 0.5))
    assert torch.equal(whole.theta, resumed.theta)


def test_doubts_and_wrong_input() -> None:
    simulator = linear()
    method = ABC(simulator, budget=100, likelihood=QUIET)
    method.fit(seen(5.0, 0.5))
    assert any("unlike every simulation (p <= 0.0099)" in w for w in method.warnings)
    assert any("only 5 simulations" in w for w in method.warnings)
    table: list[tuple[Any, str]] = [
        (lambda: ABC(simulator, accepted=0.0), "accepted: expected a share above 0 and at most 1, got 0.0"),
        (lambda: ABC(simulator, accepted=1.5), "accepted: expected a share above 0 and at most 1, got 1.5"),
        (
            lambda: ABC(simulator, budget=50, regression=True, likelihood=QUIET).fit(seen(0.4, 0.5)),
            "leave the regression",
        ),
    ]
    for call, words in table:
        with pytest.raises(ValueError, match=words):
            call()
