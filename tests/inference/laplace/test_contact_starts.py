"""Windows from known states through contact: one control step first, and what is left against the starts' noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import sipe_bayes as sipe
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.findings import Code
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.datasets import acting
from sipe_bayes.inference.laplace.estimator import Laplace
from sipe_bayes.inference.laplace.windows.contact_starts import begins_in_contact, grown_starts
from sipe_bayes.inference.laplace.windows.energy import (
    beyond_start_noise,
    present_noise,
    start_noise,
    unevenly_left,
)
from sipe_bayes.likelihood.settings import Segments
from sipe_bayes.likelihood.windows import Windows
from tests.problems.bouncing import bouncing, bouncing_log

STEPS = 5


def running(seed: int, level: float = 0.01) -> tuple[sipe.Simulator, FloatArray, Trajectories, Segments]:
    """A half-cheetah whose links have unknown lengths, 50 control steps with noise, windows of five from known states.

    Returns the simulator, the truth, the log and the likelihood.
    """
    simulator = sipe.Simulator(sipe.make_task("HalfCheetahLinks"), num_threads=1)
    rng = np.random.default_rng([seed, 5])
    theta = rng.uniform(0.1, 0.9, len(simulator.space))
    behaviour = acting.excitation(simulator.environment, simulator.dt)
    motion = acting.simulate(simulator, theta, behaviour, acting.Recording("reference", 1, seed, 50))[0]
    spread = motion.observations.std(1, keepdims=True)
    observations = motion.observations + level * spread * rng.standard_normal(motion.observations.shape)
    return (
        simulator,
        theta,
        replace(motion, observations=observations),
        Segments(STEPS * simulator.dt, starts="recorded"),
    )


def test_single_control_steps_lead_through_contact() -> None:
    """Within half a hundredth of the truth, with no finding against it; a search of whole windows ends .06 off."""
    for seed in range(3):
        simulator, theta, log, likelihood = running(seed)
        estimator = Laplace(simulator, likelihood=likelihood, budget=2000, seed=seed)
        posterior = estimator.fit(log)
        error = np.abs(posterior.mean.numpy() - theta).max()
        print(seed, "error", error, "sd", posterior.stddev.numpy(), estimator.warnings, estimator.rollouts)
        assert error < 5e-3


def test_the_noise_of_known_starts_tells_a_wrong_valley() -> None:
    """The truth leaves no more than it (by chance one log in a thousand), a hundredth from the truth does."""
    simulator, theta, log, likelihood = running(0)
    windows = Windows(likelihood, simulator, log)
    assert begins_in_contact(windows)
    noise = start_noise(windows)
    assert np.isfinite(noise).all()
    ratio = noise.std(0) / (0.01 * log.observations[0].std(0))
    assert ratio.mean() == pytest.approx(1, abs=4 / np.sqrt(2 * noise.size))
    thetas = np.stack([theta, theta + 0.01])
    residuals, _ = windows.residuals(thetas, np.tile(windows.no_starts(), (2, 1, 1)))
    right, wrong = (beyond_start_noise(windows, present_noise(windows, residual).sd) for residual in residuals)
    assert right is None
    assert wrong is not None
    assert wrong > 2


def test_windows_that_are_left_with_more_than_others_are_seen() -> None:
    """One of ten with half as much again, or off by one and a half sds; noise with tails or memory is none.

    Of 200 residuals each: false alarms are a thousandth or less by design and up to two hundredths with Student's t of
    five degrees, so that fourteen or more come with probability 1e-4.
    """
    simulator, theta, log, likelihood = running(0)
    windows, rng = Windows(likelihood, simulator, log), np.random.default_rng(0)
    residual = windows.residuals(theta[None], windows.no_starts()[None])[0][0]
    assert unevenly_left(windows, residual) is None
    shape = residual.shape
    seen = dict.fromkeys(("alike", "tails", "memory", "larger", "off"), 0)
    for _ in range(200):
        white = rng.standard_normal(shape)
        larger, off = white.copy(), white.copy()
        larger[3] *= 1.5
        off[3] += 1.5
        slow = white.copy()
        for k in range(1, shape[1]):
            slow[:, k] = 0.8 * slow[:, k - 1] + 0.6 * white[:, k]
        for name, one in zip(seen, (white, rng.standard_t(5, shape), slow, larger, off), strict=True):
            seen[name] += unevenly_left(windows, one * windows.observed) is not None
    print(seen)
    assert max(seen["alike"], seen["tails"], seen["memory"]) < 14
    assert min(seen["larger"], seen["off"]) > 160


def test_one_candidate_that_fits_to_the_end_is_enough() -> None:
    """A fifth of a budget of 1000 leads to the truth; following several together takes a third."""
    used = []
    for seed in range(3):
        simulator, theta, log, likelihood = running(seed)
        windows = Windows(likelihood, simulator, log)
        windows.budget = 1000
        points = grown_starts(Laplace(simulator, likelihood=likelihood, seed=seed).problem, windows)
        assert points is not None
        error = np.abs(points[0] - theta).max()
        used.append(windows.rollouts)
        print(seed, error, used)
        assert error < 5e-3
    assert sum(used) < 750


def test_what_a_search_leaves_beyond_it_blocks() -> None:
    simulator, theta, log, likelihood = running(1)
    estimator = Laplace(simulator, likelihood=likelihood, initial=np.full((1, 5), 0.02), budget=400)
    posterior = estimator.fit(log)
    error = np.abs(posterior.mean.numpy() - theta).max()
    print("error", error, estimator.warnings)
    assert error > 0.05  # a wrong valley, or this shows nothing
    assert Code.BEYOND_START_NOISE in {f.code for f in estimator.findings.blocking}


def test_a_small_budget_leaves_it_to_the_plain_screening() -> None:
    simulator, _, log, likelihood = running(0)
    windows = Windows(likelihood, simulator, log)
    estimator = Laplace(simulator, likelihood=likelihood)
    windows.budget = 10
    assert grown_starts(estimator.problem, windows) is None
    assert windows.rollouts <= 10


def test_where_nothing_touches_or_starts_are_unknown_nothing_begins_so() -> None:
    log = Trajectories.stack([bouncing_log(np.full(3, 0.5), 0, 20)])
    assert begins_in_contact(Windows(Segments(0.1, starts="recorded"), bouncing(), log))
    assert not begins_in_contact(Windows(Segments(0.1), bouncing(), log))
