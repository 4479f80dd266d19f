"""The cache of simulations, and what BayesSim, MAML and the rest learn from it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from sipe_bayes.core.findings import Code
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.inference import ESTIMATORS, get_estimator
from sipe_bayes.inference.amortised.abc import ABC
from sipe_bayes.inference.amortised.bayessim import BayesSim
from sipe_bayes.inference.amortised.prior_sampling import PriorSampling
from sipe_bayes.inference.amortised.simulations import BLOCK, Cache, Simulations, place_of_invalid
from sipe_bayes.inference.registry import arguments
from sipe_bayes.likelihood import first_states
from sipe_bayes.models.mixture_density import MixtureDensity, RandomFourier
from sipe_bayes.models.statistics import step_statistics
from sipe_bayes.models.training import Training
from sipe_bayes.models.transitions import control_steps
from sipe_bayes.posterior import GaussianMixture, prior
from sipe_bayes.simulation.simulator import Simulator
from tests.problems.counted import TRUTH, Breaking, Counting
from tests.problems.pendulums import log, pendulum
from tests.problems.quick import FORM


def cache(simulator: Simulator, folder: Path | None = None, seed: int = 0) -> Cache:
    recorded = Trajectories.stack(log(simulator, TRUTH, 1, steps=60))
    return Cache(simulator, prior(simulator.space), recorded, first_states(simulator, recorded), seed, folder)


def same(a: Simulations, b: Simulations) -> bool:
    pairs = ((a.theta, b.theta), (a.observations, b.observations), (a.valid, b.valid))
    return all(np.array_equal(x, y, equal_nan=True) for x, y in pairs)


def test_rows_are_the_same_however_many_are_made(tmp_path: Path) -> None:
    """All at once, bit by bit, read from disk, and made again where a file is broken."""
    simulator = Counting()
    whole = cache(simulator).first(120)
    grown = cache(simulator, tmp_path)
    for count in (10, 70, 120):
        assert len(grown.first(count)) == count
    assert same(grown.first(120), whole)
    again = cache(simulator, tmp_path)
    simulator.lanes = 0
    assert same(again.first(120), whole)
    assert simulator.lanes == 0
    next(tmp_path.glob("*/block-000001.npz")).write_bytes(b"torn")
    again = cache(simulator, tmp_path)
    simulator.lanes = 0
    assert same(again.first(120), whole)
    assert simulator.lanes == BLOCK
    assert not same(cache(simulator, tmp_path, seed=1).first(120), whole)


def test_two_estimators_share_one_cache_and_its_simulations_count(tmp_path: Path) -> None:
    simulator = Counting()
    recorded = log(simulator, TRUTH, 1, steps=60)
    simulator.lanes = 0
    for name in ("abc", "bayessim"):
        estimator = get_estimator(simulator, name, budget=130, cache=tmp_path)
        estimator.fit(recorded)
        assert estimator.rollouts == 130
    assert simulator.lanes == 130


@pytest.mark.parametrize("every", [1, 3])
@pytest.mark.parametrize("name", ESTIMATORS)
def test_no_more_is_simulated_than_the_budget_says(name: str, every: int) -> None:
    """Two logs in turn, each for one step or for three, counted where they are simulated; in two rounds if it can."""
    simulator = Counting()
    logs = [log(simulator, TRUTH, k, steps=60) for k in (1, 2)]
    settings = {"budget": 150, **FORM.get(name, {}), **({"rounds": 2} if "rounds" in arguments(name) else {})}
    estimator = get_estimator(simulator, name, **{**settings, "budget": min(150, settings["budget"])})
    simulator.steps = 0
    windows = 1 if isinstance(estimator, PriorSampling) else -(-60 // 50)  # of half a second, a lane each
    for k in range(30):
        estimator.update_parameter_estimate(logs[k // every % 2])
    assert 0 < simulator.steps <= estimator.budget * windows * 60
    assert estimator.rollouts <= estimator.budget


def test_rounds_begin_anew_with_another_log() -> None:
    """What was simulated and proposed for one log is not joined with the other's, which is fitted with what is left."""
    simulator = Counting()
    one, other = (log(simulator, TRUTH, k, steps=60) for k in (1, 2))
    estimator = get_estimator(simulator, "bayessim", rounds=2, budget=200, **FORM["bayessim"])
    while estimator.state is None or estimator.state.round == 1:
        estimator.update_parameter_estimate(one)
    estimator.update_parameter_estimate(one)
    assert estimator.rollouts == 150
    simulator.lanes = 0
    while not estimator.ended:
        estimator.update_parameter_estimate(other)
    assert simulator.lanes == 50
    estimator.get_parameter_estimate(other)
    fresh = get_estimator(simulator, "bayessim", rounds=2, budget=50, **FORM["bayessim"])
    assert torch.equal(estimator.get_parameter_estimate(other).mean, fresh.fit(other).mean)
    with pytest.raises(ValueError, match="trained for other ones"):
        estimator.get_parameter_estimate(one)


@pytest.mark.parametrize("rounds", [1, 2])
def test_invalid_simulations_of_all_rounds_are_described_together(rounds: int) -> None:
    recorded, simulator = log(pendulum(), TRUTH, 1, steps=60), Breaking()
    estimator = get_estimator(simulator, "bayessim", rounds=rounds, budget=160, **FORM["bayessim"])
    estimator.fit(recorded)
    said = [w for w in estimator.warnings if "diverged" in w]
    assert len(said) == 1, said
    assert said[0].startswith(f"{simulator.broken} of 160 simulations diverged, mostly at high rod_mass")
    assert estimator.diagnostics["invalid_simulations"] == simulator.broken


@pytest.mark.parametrize(
    ("name", "settings", "words"),
    [
        ("bayessim", {"training": Training(epochs=2)}, "after 2 epochs; raise training.epochs"),
        ("maml", {"iterations": 20}, "after 20 iterations; raise iterations"),
        ("npe", {"max_epochs": 2}, "after 2 epochs; raise max_epochs"),
        ("regression", {"iterations": 30}, "after 30 gradient steps; raise iterations"),
    ],
)
def test_a_training_that_was_cut_short_says_so(name: str, settings: dict[str, Any], words: str) -> None:
    """And no other does: patience of one step ends it."""
    simulator = pendulum()
    recorded = log(simulator, TRUTH, 1, steps=60)
    estimator = get_estimator(simulator, name, budget=100, **{**FORM[name], **settings})
    estimator.fit(recorded)
    assert any(f"still improving {words}" in w for w in estimator.warnings), estimator.warnings
    enough = {"training": Training(patience=1)} if name == "bayessim" else {"patience": 1}
    if name == "maml":
        enough["look_every"] = 1
    patient = get_estimator(simulator, name, budget=100, **enough)
    patient.fit(recorded)
    assert not any("still improving" in w for w in patient.warnings)


def test_where_the_invalid_simulations_lie_is_said() -> None:
    rng, space = np.random.default_rng(0), pendulum().space
    theta = rng.random((300, 2))
    some = Simulations(theta, np.zeros((300, 1, 2, 1), np.float32), theta[:, 1] < 0.8)
    assert "mostly at high damping" in place_of_invalid(some, space)
    scattered = Simulations(theta, some.observations, np.arange(300) % 10 > 0)
    assert "all over the prior" in place_of_invalid(scattered, space)
    estimator = ABC(pendulum())
    estimator.judge(scattered)
    assert Code.INVALID_SIMULATIONS in estimator.findings
    estimator.judge(Simulations(theta, some.observations, np.ones(300, bool)))
    assert Code.INVALID_SIMULATIONS not in estimator.findings


def test_statistics_against_plain_loops() -> None:
    rng = np.random.default_rng(0)
    observations, actions = rng.standard_normal((2, 1, 6, 2)), rng.standard_normal((1, 5, 1))
    observations[0, 0, 2, 0] = np.nan
    found = step_statistics(control_steps(observations, actions, np.array([5])), 2, 1)
    for k in range(2):
        change = np.diff(observations[k, 0], axis=0)
        good = np.isfinite(observations[k, 0]).all(1)
        keep = good[:-1] & good[1:]
        cross = [(change[keep, c] * actions[0, keep, 0]).mean() for c in range(2)]
        expected = [*change[keep].mean(0), *change[keep].var(0), *cross]
        np.testing.assert_allclose(found[k], expected, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("settings", [{}, {"features": "random_fourier"}, {"summary": "learned"}, {"rounds": 2}])
def test_bayessim_narrows_around_the_truth(settings: dict[str, Any]) -> None:
    """Each variant: the truth within 3 sd, both sds below the prior's."""
    simulator = pendulum()
    estimator = get_estimator(
        simulator, "bayessim", budget=400, seed=0, training=Training(learning_rate=3e-3), **settings
    )
    posterior = estimator.fit(log(simulator, TRUTH, 1, steps=150))
    truth = simulator.space.normalise(np.array(TRUTH))
    print(settings, posterior.mean, posterior.stddev, truth)
    assert (np.abs(posterior.mean.numpy() - truth) < 3 * posterior.stddev.numpy()).all()
    assert (posterior.stddev.numpy() < 0.2).all()
    assert estimator.amortised == ("rounds" not in settings)


@pytest.mark.parametrize(("truncated", "count"), [(1e-2, 500), (1e-4, 500), (1e-4, 5000)])
def test_proposals_of_a_tiny_region_have_the_priors_density(truncated: float, count: int) -> None:
    """A posterior of sd 0.002: uniform over the ellipse, whose squared radius is uniform then.

    Its mean is within 5 standard errors of half the largest, of as many as are different. Weighted draws without
    replacement are not (measured: 0.36 and 0.26 at 1e-4).
    """
    simulator = pendulum()
    found = GaussianMixture([0.0], [[0.5, 0.5]], [0.002**2 * np.eye(2)], simulator.space)
    estimator = get_estimator(simulator, "bayessim", rounds=2, truncated=truncated)
    assert isinstance(estimator, BayesSim)
    theta = estimator._propose(found, 1, count)
    square = ((theta - 0.5) ** 2).sum(1)
    different = len(np.unique(theta, axis=0))
    print(truncated, different, square.mean() / square.max())
    assert abs(square.mean() / square.max() - 0.5) < 5 * np.sqrt(1 / 12 / different)
    assert (different < count) == any("different ones" in w for w in estimator.warnings)


def test_the_mixture_density_is_that_of_its_mixture() -> None:
    torch.manual_seed(0)
    network = MixtureDensity(3, 4, 2).double()
    theta, inputs = torch.rand(50, 4, dtype=torch.float64), torch.randn(1, 3, dtype=torch.float64)
    log_weights, means, covariances = network.mixture(inputs[0])
    parts = [
        w + torch.distributions.MultivariateNormal(torch.from_numpy(m), torch.from_numpy(c)).log_prob(theta)
        for w, m, c in zip(log_weights, means, covariances, strict=True)
    ]
    with torch.no_grad():
        found = network.log_prob(inputs.expand(50, -1), theta)
    torch.testing.assert_close(found, torch.logsumexp(torch.stack(parts), 0), rtol=1e-6, atol=1e-6)


def test_random_features_approximate_their_kernel() -> None:
    """Matern-5/2 at four distances, to 0.05 with 2,000 features."""
    features = RandomFourier(3, 4000, seed=0)
    x = torch.tensor([[0.0, 0, 0], [0.3, 0, 0], [0, 1.0, 0], [0.5, -0.5, 0.5], [2.0, 1, -1]])
    with torch.no_grad():
        kernel = features(x) @ features(x[:1]).T
    r = np.sqrt(5) * x.norm(dim=1).numpy()
    np.testing.assert_allclose(kernel[:, 0].numpy(), (1 + r + r**2 / 3) * np.exp(-r), atol=0.05)


def test_an_estimate_in_between_simulates_nothing_more() -> None:
    """Trained on what was simulated, it speaks of another log, and says that it is of another experiment."""
    simulator = Counting()
    one, other = (log(simulator, TRUTH, k, steps=60) for k in (1, 2))
    estimator = get_estimator(simulator, "abc", budget=150)
    estimator.update_parameter_estimate(one)
    simulator.lanes = 0
    estimator.get_parameter_estimate(other)
    assert simulator.lanes == 0
    assert any("the log's actions differ" in w for w in estimator.warnings)
