"""Logs read as what a regression on the simulations makes of them; ensembles of networks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.stats import binom

from sipe_bayes.core.findings import Code
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.inference.amortised.bayessim import BayesSim
from sipe_bayes.inference.amortised.npe import NPE
from sipe_bayes.inference.amortised.outside import Outside
from sipe_bayes.likelihood import Segments
from sipe_bayes.models.regressed import Regressed, RegressionOfTheta
from sipe_bayes.models.training import Training
from sipe_bayes.posterior import Averaged, Flow
from sipe_bayes.simulation.simulator import Simulator
from tests.problems.linear_gaussian import function_problem
from tests.problems.pendulums import log, pendulum, repeated

STEPS = np.arange(40)[:, None] * 0.1


def motions(theta: np.ndarray, rng: np.random.Generator, further: float = 0.0) -> np.ndarray:
    """Two sines with the amplitudes theta (n, 2), and a ``further`` one of another period; noise of sd .1."""
    waves = theta[:, :1] * np.sin(STEPS[:, 0]) + theta[:, 1:] ** 2 * np.cos(2 * STEPS[:, 0])
    waves = waves + further * np.sin(5 * STEPS[:, 0])
    return np.asarray(waves + 0.1 * rng.standard_normal(waves.shape))


def squares(samples: np.ndarray) -> np.ndarray:
    """A statistic of each motion."""
    return np.asarray((samples**2).mean(1, keepdims=True))


def made(n: int, seed: int = 0) -> tuple[Regressed, np.ndarray, np.ndarray, np.random.Generator]:
    rng = np.random.default_rng(seed)
    theta = rng.uniform(size=(n, 2))
    samples = motions(theta, rng)
    regressed, left_out = Regressed.of(theta, samples, squares(samples), np.full(len(STEPS), 0.1))
    return regressed, left_out, theta, rng


def test_left_out_estimates_are_those_of_regressions_without_them() -> None:
    """Solved anew without the folds of three simulations, about the mean of all; and summaries are near theta."""
    regressed, left_out, theta, rng = made(60)
    kernel = (1 + regressed.points.astype(float) @ regressed.points.T.astype(float)) ** 2
    mean = theta.mean(0)
    for i in (0, 7, 31):
        others = np.delete(np.arange(60), np.arange(i % 10, 60, 10))
        for j in range(2):
            ridged = kernel[np.ix_(others, others)] + regressed.ridge[j] * np.eye(54)
            solved = np.linalg.solve(ridged, theta[others, j] - mean[j])
            assert mean[j] + kernel[i, others] @ solved == pytest.approx(left_out[i, j], abs=2e-3)
    fresh = rng.uniform(0.2, 0.9, (200, 2))
    samples = motions(fresh, rng)
    error = regressed.summaries(regressed.points_of(samples, squares(samples))) - fresh
    print(error.std(0))
    assert (error.std(0) < [0.05, 0.06]).all()  # least squares on the true waves: .022, and .022 / 2 theta


def test_left_out_estimates_do_not_give_away_what_a_log_does_not_tell() -> None:
    """Of a parameter that moves nothing: the mean. Ten simulations' worth of 400 come by chance once in 1,000."""
    rng = np.random.default_rng(2)
    theta = rng.uniform(size=(400, 3))
    samples = motions(theta[:, :2], rng)
    _, left_out = Regressed.of(theta, samples, squares(samples), np.full(len(STEPS), 0.1))
    np.testing.assert_allclose(left_out[:, 2], theta[:, 2].mean(), rtol=1e-12)
    assert np.corrcoef(left_out[:, 0], theta[:, 0])[0, 1] > 0.9


def test_logs_with_more_samples_than_simulations_that_tell_nothing_are_not_regressed_on() -> None:
    """Each is alone in its direction; of a kernel centred over all of them the others hold its trace, and its theta."""
    rng = np.random.default_rng(4)
    theta, samples = rng.uniform(size=(300, 2)), rng.standard_normal((300, 800))
    regressed, left_out = Regressed.of(theta, samples, squares(samples), np.zeros(800))
    assert np.isinf(regressed.ridge).all()
    np.testing.assert_allclose(left_out - theta.mean(0), 0, atol=1e-12)


def test_simulations_beyond_the_most_are_summarised_as_new_ones() -> None:
    rng = np.random.default_rng(1)
    theta = rng.uniform(size=(200, 2))
    samples = motions(theta, rng)
    few, noise = RegressionOfTheta(most=100), np.full(len(STEPS), 0.1)
    regressed, summaries = Regressed.of(theta, samples, squares(samples), noise, few)
    alone, left_out = Regressed.of(theta[:100], samples[:100], squares(samples[:100]), noise)
    beyond = alone.summaries(alone.points_of(samples[100:], squares(samples[100:])))
    np.testing.assert_array_equal(summaries, np.concatenate([left_out, beyond]))
    assert len(regressed.points) == 100


def test_logs_of_the_prior_are_within_the_simulations_and_others_are_not() -> None:
    """150 logs of the prior: at a rate of 1 % more alarms come once in ten thousand; every other log raises one.

    The others have a third sine, or are larger than any simulation.
    """
    rng = np.random.default_rng(3)
    samples = motions(rng.uniform(size=(300, 2)), rng)
    outside = Outside.of(samples, squares(samples), np.full(len(STEPS), 0.1), known_start=True)
    within = motions(rng.uniform(size=(150, 2)), rng)
    alarms = [outside.alarm(outside.p_value(x[None], squares(x[None]))) for x in within]
    print(sum(alarms))
    assert sum(alarms) <= binom.ppf(1 - 1e-4, 150, 0.01)
    for wrong in (motions(rng.uniform(size=(20, 2)), rng, further=0.8), motions(np.full((20, 2), 2.0), rng)):
        assert all(outside.alarm(outside.p_value(x[None], squares(x[None]))) for x in wrong)


@pytest.mark.parametrize("known", [True, False])
def test_a_pendulum_with_dry_friction_is_outside_a_model_without(known: bool) -> None:
    """Of 20 logs at least half raise an alarm, at a rate of 1 % once in 1e14; of right ones no more than 3 (5e-5)."""
    plain = pendulum()
    machine = pendulum(Parameter("friction", 0.0, 0.56, targets=("joint:hinge.frictionloss",)))
    actions = log(plain, [0.6, 0.05], 1, steps=200).actions
    method = BayesSim(plain, budget=200, training=Training(epochs=1), likelihood=Segments(noise_sd=(0.01,)), seed=1)
    start = plain.default_state()

    def recorded(simulator: Simulator, theta: np.ndarray, seed: int) -> Trajectories:
        motion = simulator.rollout(theta, actions, start, dt=0.01).observations[0]
        noisy = motion + 0.01 * np.random.default_rng(seed).standard_normal(motion.shape)
        states = np.tile(start, (len(noisy), 1)) if known else None
        return Trajectories.stack(Trajectory(noisy, actions, 0.01, states, channels=simulator.environment.channels))

    truths = np.random.default_rng(4).uniform(0.1, 0.9, (20, 2))
    method.fit(recorded(plain, truths[0], 0))
    alarms = {"right": 0, "wrong": 0}
    for k, truth in enumerate(truths):
        rubbing = recorded(machine, np.append(truth, 0.9), k)
        for what, one in (("right", recorded(plain, truth, k)), ("wrong", rubbing)):
            method.fit(one)
            alarms[what] += any(f.code is Code.UNLIKE_SIMULATIONS for f in method.findings)
    print(alarms)
    assert alarms["right"] <= 3
    assert alarms["wrong"] >= 10


@pytest.mark.parametrize("method", ["bayessim", "npe"])
def test_the_exact_posterior_from_regressed_summaries(method: str) -> None:
    """Half an sd in the means, as small networks of 1,500 simulations come; widths within a third."""
    simulator, recorded, exact, likelihood = function_problem()
    settings = {"budget": 1500, "likelihood": likelihood, "seed": 1, "calibration": 0.0}
    estimator = (
        BayesSim(simulator, summary="regressed", components=2, **settings)
        if method == "bayessim"
        else NPE(simulator, embedding="regressed", transforms=2, hidden=24, learning_rate=1e-2, patience=8, **settings)
    )
    posterior = estimator.fit(recorded)
    off = (posterior.mean - exact.mean) / exact.stddev
    print(off, posterior.stddev / exact.stddev)
    assert (off.abs() < 0.6).all()
    torch.testing.assert_close(posterior.stddev / exact.stddev, torch.ones(5, dtype=torch.float64), atol=0.35, rtol=0)


def test_an_ensemble_averages_its_members(tmp_path: Path) -> None:
    """Other networks than the first, which is the single one's; a checkpoint holds all of them."""
    simulator = pendulum()
    recorded = log(simulator, [0.6, 0.05], 1, steps=40)
    settings = {"budget": 100, "transforms": 1, "hidden": 16, "max_epochs": 5, "seed": 2, "calibration": 0.0}
    path = tmp_path / "fit.safetensors"
    both = NPE(simulator, members=2, checkpoint=path, **settings)
    posterior = both.fit(recorded)
    assert isinstance(posterior, Averaged)
    alone = NPE(simulator, **settings).fit(recorded)
    assert isinstance(alone, Flow)
    first, second = posterior.members
    torch.testing.assert_close(first.mean, alone.mean, rtol=0, atol=0)
    assert not torch.equal(first.mean, second.mean)
    again = NPE(simulator, members=2, checkpoint=path, **settings).fit(recorded)
    torch.testing.assert_close(again.mean, posterior.mean, rtol=0, atol=0)


def test_logs_of_another_size_are_read_as_far_as_they_go() -> None:
    simulator = pendulum()
    recorded = log(simulator, [0.6, 0.05], 1, steps=60)
    method = BayesSim(simulator, budget=300, summary="regressed", seed=1)
    method.fit(recorded)
    assert method.state is not None
    shorter = Trajectories.stack(repeated(simulator, recorded.actions[:50]))
    posterior = method.posterior(method.state, shorter)
    assert posterior.mean.isfinite().all()
    assert any("another experiment" in w for w in method.warnings)
