"""Intervals for a model that lacks something: truths held where it is wrong, hardly wider where it is right."""

from __future__ import annotations

import copy
import functools

import numpy as np
import pytest
import scipy.stats

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.inference import get_estimator
from sipe_bayes.likelihood import Noise, Segments, bind
from sipe_bayes.posterior import GaussianMixture
from sipe_bayes.structure.augmented import AtNoise, AugmentedModel
from sipe_bayes.structure.discrepancy import (
    DIFFER,
    Discrepancy,
    LogEstimate,
    Spread,
    draw_differing,
    find_discrepancy,
    parts_of,
)
from sipe_bayes.structure.single_effects import size_grid
from tests.problems.pendulums import log, pendulum

SD = 0.01
ROOT = 0.01 * np.array([[1.0, 0.0], [0.8, 0.6]])  # of the covariance of what a log says by itself
DELAY = Parameter("delay", 0.0, 0.06, targets=("actuator:motor.delay",))
FRICTION = Parameter("coulomb", 0.0, 0.1, targets=("joint:hinge.frictionloss",))


def of_logs(logs: list[Trajectory]) -> tuple[Discrepancy, FloatArray, FloatArray]:
    """With plain 90 % intervals (2, 2) and these, of rod mass and damping alone."""
    simulator, recorded = pendulum(), Trajectories.stack(logs)
    method = get_estimator(simulator, "laplace", restarts=1, candidates=0)
    posterior = method.fit(recorded)
    theta = posterior.mode.numpy()
    noise = Noise(np.array(method.diagnostics["noise_sd"]), np.array(method.diagnostics["noise_tau"]))
    seen = find_discrepancy(AugmentedModel(bind(method.likelihood, simulator, recorded), theta, noise))
    return seen, *(p.quantile([0.05, 0.95]).numpy() for p in (posterior, seen.draw(posterior, 0)))


@pytest.mark.parametrize("logs", [1, 3])
def test_truths_are_held_where_the_model_lacks_dry_friction(logs: int) -> None:
    """The plain intervals do not hold the damping; the cause is named."""
    truth = np.array([0.6, 0.08])
    recorded = [log(pendulum(FRICTION), [*truth, 0.04], seed, name=f"log {seed}") for seed in range(2, 2 + logs)]
    seen, plain, wide = of_logs(recorded)
    theta = pendulum().space.normalise(truth)
    assert not plain[0, 1] <= theta[1] <= plain[1, 1]
    assert ((wide[0] <= theta) & (theta <= wide[1])).all()
    assert any("friction" in cause for cause in seen.causes)


def test_of_a_right_model_they_are_hardly_wider_and_hold_the_truth() -> None:
    recorded = [log(pendulum(), [0.6, 0.08], seed, name=f"log {seed}") for seed in range(6)]
    theta = pendulum().space.normalise(np.array([0.6, 0.08]))
    seen, plain, wide = of_logs(recorded)
    assert ((wide[0] <= theta) & (theta <= wide[1])).all()
    assert (wide[1] - wide[0] < 1.3 * (plain[1] - plain[0])).all()
    assert seen.causes == ()


def test_a_parameter_that_was_driven_to_its_bound_comes_away_from_it() -> None:
    """A delay takes damping away: where there is little of it the fit ends at none."""
    truth = np.array([0.6, 0.01])
    recorded = [log(pendulum(DELAY), [*truth, 0.06], seed, name=f"log {seed}") for seed in (2, 3)]
    seen, plain, wide = of_logs(recorded)
    theta = pendulum().space.normalise(truth)
    assert plain[1, 1] < theta[1]
    assert not seen.at.logs.seen.free[1]
    assert ((wide[0] <= theta) & (theta <= wide[1])).all()


def test_a_single_log_stands_in_pieces_of_whole_windows() -> None:
    one = log(pendulum(), [0.6, 0.08], 3)
    parts = parts_of(bind(Segments(0.5), pendulum(), Trajectories.stack([one])))
    assert [name for name, _ in parts] == [one.name] * 5
    assert np.concatenate([piece for _, piece in parts]).tolist() == list(range(8))
    both = parts_of(
        bind(Segments(0.5), pendulum(), Trajectories.stack([one, log(pendulum(), [0.6, 0.08], 4, name="b")]))
    )
    assert [(name, len(piece)) for name, piece in both] == [(one.name, 8), ("b", 8)]


@functools.cache
def linearised() -> AugmentedModel:
    """Two logs whose fit takes noise for white."""
    theta = pendulum().space.normalise(np.array([0.6, 0.08]))
    logs = Trajectories.stack([log(pendulum(), [0.6, 0.08], number, name=str(number)) for number in (2, 3)])
    return AugmentedModel(bind(Segments(2.0), pendulum(), logs), theta, Noise(np.array([SD]), np.zeros(1)))


def probed(memory: float, seed: int) -> AugmentedModel:
    """The same where what the fit leaves is AR(1), its autocorrelation time ``memory``."""
    out = copy.copy(linearised())
    rho, random = (memory - 1) / (memory + 1), np.random.default_rng(seed)
    flat = random.standard_normal(out.residual.size)
    for i in range(1, len(flat)):
        flat[i] = rho * flat[i - 1] + np.sqrt(1 - rho**2) * flat[i]
    out.residual = np.where(out.windows.observed, SD * flat.reshape(out.residual.shape), 0.0)
    out.seen = AtNoise(out, out.noise)
    return out


@pytest.mark.parametrize("memory", [1.0, 15.0])
def test_sds_are_the_scatter_whether_samples_remember_or_not(memory: float) -> None:
    """30 draws tell an sd to 13 %: three of that, and a tenth for frequencies at which parameters are told."""
    steps, plain, discounted = [], [], []
    for logs in (probed(memory, seed) for seed in range(30)):
        steps.append(logs.seen.projected.base)
        plain.append(np.sqrt(np.diag(logs.seen.projected.covariance)))
        discounted.append(np.sqrt(np.diag(logs.seen.discounted.projected.covariance)))
    told, ratio = (np.std(steps, axis=0) / np.mean(sds, axis=0) for sds in (discounted, plain))
    assert ((told > 0.6) & (told < 1.5)).all()
    assert (ratio > 2.5).all() if memory > 1 else (ratio < 1.3).all()


def test_of_logs_without_extensions_only_what_differs_is_allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sipe_bayes.structure.probes.EXTENSIONS", ())
    logs, theta = linearised().windows, linearised().theta
    bare = AugmentedModel(logs, theta, Noise(np.array([SD]), np.zeros(1)))
    seen = find_discrepancy(bare)
    assert (bare.probes, seen.effects, seen.causes) == ([], None, ())
    fitted = GaussianMixture(np.zeros(1), theta[None], 1e-4 * np.eye(2)[None], pendulum().space)
    assert np.isfinite(seen.draw(fitted, 0).theta.numpy()).all()


def agreeing(count: int, apart: float, seed: int) -> list[LogEstimate]:
    """Logs whose values scatter as they say, and by ``apart`` times that."""
    random = np.random.default_rng(seed)
    information = np.linalg.inv(ROOT @ ROOT.T)
    scatter = np.sqrt(1 + apart**2)
    return [LogEstimate(str(k), 0.5 + scatter * ROOT @ random.standard_normal(2), information) for k in range(count)]


def test_the_spread_between_logs_has_its_exact_posterior() -> None:
    """By the densities of the logs' values with a flat mean integrated out, written out."""
    logs = agreeing(4, 2.0, 0)
    grid, believed = size_grid()
    times = np.append(0.0, grid)
    prior = np.append(1 - DIFFER, DIFFER * believed)
    values, covariance = np.concatenate([one.mean for one in logs]), np.linalg.inv(logs[0].information)
    common = 1e4 * np.tile(np.eye(2), (4, 4))
    own = [np.kron(np.eye(4), (1 + t**2) * covariance) + common for t in times]
    level = np.array([scipy.stats.multivariate_normal.logpdf(values, np.full(8, 0.5), c) for c in own])
    exact = prior * np.exp(level - level.max())
    scores = [one.information @ (one.mean - 0.5) for one in logs]
    seen = Spread.between([one.information for one in logs], scores)
    np.testing.assert_allclose(seen.weights, exact / exact.sum(), atol=5e-3)
    np.testing.assert_allclose(seen.alone, 4.0, rtol=1e-2)


def test_a_further_log_is_held_as_often_as_it_says() -> None:
    """Logs that differ by twice what each leaves unknown: 100 draws of six, a seventh's values in 90 %."""
    held = []
    for seed in range(100):
        logs = agreeing(6, 2.0, seed)
        information = sum(one.information for one in logs)
        mean = np.linalg.solve(information, sum(one.information @ one.mean for one in logs))
        fitted = GaussianMixture(np.zeros(1), mean[None], np.linalg.inv(information)[None], pendulum().space)
        low, high = draw_differing(fitted, logs, seed).quantile([0.05, 0.95]).numpy()
        truth = 0.5 + 2 * ROOT @ np.random.default_rng(1000 + seed).standard_normal(2)
        held += ((low <= truth) & (truth <= high)).tolist()
    print(np.mean(held))
    assert abs(np.mean(held) - 0.9) < 0.09  # four standard errors of 100 pairs
