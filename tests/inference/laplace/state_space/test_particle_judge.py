"""The judge from another family, itself judged: bootstrap filters and SMC^2 against the exact Kalman filter."""

from __future__ import annotations

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.trajectory import Trajectory
from tests.problems.particle_judge import enough_particles, filtered, judge
from tests.problems.springs import DAMPING, HIGH, LOW, MASS, PROCESS, SD, SKIP, STEP, kalman, spring_logs

LOGS = spring_logs(1, count=1, steps=40)
FIRSTS = np.array([[LOGS[0].observations[0, 0], 0.0]])
LENGTHS = (0.02, 0.5)  # sds of the first state's prior, so that few particles begin far off
GRID = np.linspace(0, 1, 200)


class Spring:
    """The spring's log in numpy; process: sds of its process noise."""

    def __init__(self, log: Trajectory, process: FloatArray) -> None:
        self.log, self.process, self.samples = log, process, len(log) + 1

    def begins(self, k: int) -> bool:
        return k == 0

    def first(self, k: int, count: int, rng: np.random.Generator) -> FloatArray:
        precision = LENGTHS[0] ** -2 + SD**-2  # the first sample is the prior's mean, too
        return FIRSTS + rng.standard_normal((count, 2)) * [precision**-0.5, LENGTHS[1]]

    def step(self, theta: FloatArray, states: FloatArray, k: int) -> tuple[FloatArray, FloatArray]:
        seen = self.log.observations[k, 0]
        value = -0.5 * ((seen - states[:, 0]) / SD) ** 2 - np.log(SD * np.sqrt(2 * np.pi))
        action = 0.0 if k == len(self.log) else self.log.actions[k, 0]
        stiffness, ends = LOW + theta[:, 0] * (HIGH - LOW), states
        for _ in range(SKIP):
            force = action - stiffness * ends[:, 0] - DAMPING * ends[:, 1]
            velocity = ends[:, 1] + STEP / (MASS + STEP * DAMPING) * force
            ends = np.stack([ends[:, 0] + STEP * velocity, velocity], axis=1)
        return np.zeros(len(theta)) if np.isnan(seen) else value, ends

    def scattered(self, ends: FloatArray, k: int, rng: np.random.Generator) -> FloatArray:
        return ends + self.process * rng.standard_normal(ends.shape)


def exact(theta: FloatArray) -> FloatArray:
    """Log p(log | theta) but for the first sample's, which is every theta's."""
    first = -0.5 * np.log(2 * np.pi * (LENGTHS[0] ** 2 + SD**2))
    return np.array([kalman(LOGS, FIRSTS, LOW + t * (HIGH - LOW), start_sd=LENGTHS) - first for t in theta])


def test_filters_estimate_the_likelihood_without_bias() -> None:
    """Of 300 filters the mean ratio to the exact likelihood is one within four standard errors (1 in 16,000)."""
    theta = np.full((300, 1), 0.35)
    estimate, _ = filtered(Spring(LOGS[0], PROCESS), theta, 100, np.random.default_rng(1))
    ratio = np.exp(estimate - exact(np.array([0.35])))
    error = ratio.std(ddof=1) / np.sqrt(len(ratio))
    print(ratio.mean(), error, estimate.std())
    assert abs(ratio.mean() - 1) < 4 * error
    assert error < 0.1


def test_particles_are_doubled_until_the_likelihood_scatters_little() -> None:
    """To an sd of about one, by 16 filters, where the first few have one of three and more."""
    model, rng = Spring(LOGS[0], PROCESS), np.random.default_rng(3)
    count = enough_particles(model, np.array([0.35]), rng, first=2)
    few, many = (filtered(model, np.full((200, 1), 0.35), n, rng)[0].std(ddof=1) for n in (2, count))
    print(count, few, many)
    assert few > 3
    assert many < 1.5


def test_draws_are_the_exact_posteriors() -> None:
    """Mean and variance of 250 draws within four standard errors, were half of them independent (1 in 8,000).

    With process noise three times too large the draws are wider by more than that.
    """
    weight = np.exp(exact(GRID) - exact(GRID).max())
    mean = float(GRID @ weight / weight.sum())
    variance = float((GRID - mean) ** 2 @ weight / weight.sum())
    wrong = {}
    for factor in (1.0, 3.0):
        result = judge(Spring(LOGS[0], factor * PROCESS), 1, 250, 60, np.random.default_rng(0))
        theta = result.theta[:, 0]
        off = (theta.mean() - mean) / np.sqrt(variance / 125)
        spread = (theta.var(ddof=1) / variance - 1) / np.sqrt(2 / 125)
        print(factor, mean, np.sqrt(variance), theta.mean(), theta.std(), off, spread, result.moved, result.accepted)
        wrong[factor] = max(abs(off), abs(spread))
        assert result.moved > 0.8
    assert wrong[1.0] < 4
    assert wrong[3.0] > 4
