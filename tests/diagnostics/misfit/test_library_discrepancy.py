"""A discrepancy that the whole library spans: its posterior against the exact one, and values off in silence."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.stats

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.diagnostics.misfit.library_discrepancy import (
    DiscrepancyOptions,
    SizePosterior,
    library_discrepancy,
    shared_out,
)
from sipe_bayes.diagnostics.misfit.probed_logs import ProbedLogs
from sipe_bayes.likelihood.noise import Noise
from sipe_bayes.likelihood.settings import Segments
from sipe_bayes.likelihood.windows import Windows
from tests.problems.pendulums import log, pendulum

OPTIONS = DiscrepancyOptions()
SIGMAS = [0.0, *np.geomspace(OPTIONS.smallest, OPTIONS.largest, OPTIONS.sizes)]


def regression(seed: int, size: float) -> tuple[FloatArray, FloatArray]:
    """60 samples of noise, a parameter's column, and one of six others, alike to it, in this size; columns and y."""
    random = np.random.default_rng(seed)
    columns = random.standard_normal((60, 7))
    columns[:, 1:] += columns[:, :1]
    return columns, columns @ np.array([1.0, size, 0, 0, 0, 0, 0]) + random.standard_normal(60)


def projected(columns: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Information (6, 6) of the others with the first free, score (6,), and the first's answer to them (6,)."""
    first, rest = columns[:, :1], columns[:, 1:]
    free = np.eye(len(y)) - first @ first.T / (first.T @ first)
    return rest.T @ free @ rest, rest.T @ free @ y, -(first.T @ rest / (first.T @ first))[0]


@pytest.mark.parametrize("size", [0.0, 0.4, 4.0])
def test_the_posterior_is_the_exact_one_of_a_linear_model(size: float) -> None:
    """Of a normal y whose covariance is written out; probabilities of t, then mean and sd of the parameter's shift."""
    columns, y = regression(3, size)
    information, score, answer = projected(columns, y)
    scale = shared_out(["a", "b", "b", "c", "c", "c"], np.diag(information))
    np.testing.assert_allclose((1 / scale**2 / np.diag(information)).tolist(), [3, 6, 6, 9, 9, 9])
    made = SizePosterior.of(information * np.outer(scale, scale), score * scale)

    believed = np.array([OPTIONS.absent, *[(1 - OPTIONS.absent) / OPTIONS.sizes] * OPTIONS.sizes])
    evidence, means, squares = [], [], []
    for t in SIGMAS:
        own = columns[:, 1:] @ np.diag((t * scale) ** 2) @ columns[:, 1:].T
        whole = np.eye(60) + 1e4 * np.outer(columns[:, 0], columns[:, 0]) + own
        evidence.append(scipy.stats.multivariate_normal.logpdf(y, cov=whole))
        gain = np.diag((t * scale) ** 2) @ columns[:, 1:].T @ np.linalg.inv(whole)
        left = np.diag((t * scale) ** 2) - gain @ columns[:, 1:] @ np.diag((t * scale) ** 2)
        means.append(answer @ gain @ y)
        squares.append(answer @ left @ answer + means[-1] ** 2)
    weights = believed * np.exp(np.array(evidence) - max(evidence))
    weights /= weights.sum()
    np.testing.assert_allclose(made.weights, weights, atol=2e-4)

    shifts = made.draws(40_000, np.random.default_rng(0)) * scale @ answer
    mean, square = weights @ np.array(means), weights @ np.array(squares)
    print(made.present, shifts.mean(), mean, (shifts**2).mean(), square)
    assert abs(shifts.mean() - mean) < 5 * np.sqrt(square / 40_000) + 1e-3 * abs(mean)
    np.testing.assert_allclose((shifts**2).mean(), square, rtol=0.1)


def test_intervals_hold_as_often_as_they_say_and_are_hardly_wider_where_nothing_is_missing() -> None:
    """400 logs, discrepancies drawn from the prior, half of them none: 90 % but for three standard errors of 1.5 %."""
    random = np.random.default_rng(0)
    hits, plain, widths, sizes = [], [], [], []
    for seed in range(400):
        columns, y = regression(seed, 0.0)
        information, _, answer = projected(columns, y)
        scale = shared_out([*"abcdef"], np.diag(information))
        t = random.choice(SIGMAS[1:]) if random.uniform() > OPTIONS.absent else 0.0
        y = y + columns[:, 1:] @ (t * scale * random.standard_normal(6))
        made = SizePosterior.of(information * np.outer(scale, scale), projected(columns, y)[1] * scale)
        square = columns[:, 0] @ columns[:, 0]
        drawn = columns[:, 0] @ y / square + random.standard_normal(2000) / np.sqrt(square)
        ends = [np.quantile(d, [0.05, 0.95]) for d in (drawn, drawn + made.draws(2000, random) * scale @ answer)]
        plain.append(ends[0][0] <= 1.0 <= ends[0][1])
        hits.append(ends[1][0] <= 1.0 <= ends[1][1])
        widths.append(np.diff(ends[1])[0] / np.diff(ends[0])[0])
        sizes.append(t)
    wrong = np.array(sizes) > 0
    print(np.mean(hits), np.mean(np.array(plain)[wrong]), np.median(np.array(widths)[~wrong]))
    assert abs(np.mean(hits) - 0.9) < 0.045
    assert np.mean(np.array(plain)[wrong]) < 0.7
    assert np.median(np.array(widths)[~wrong]) < 1.3


def probed(theta: FloatArray, gain: float = 1.0) -> ProbedLogs:
    logs = Trajectories.stack([log(pendulum(), [0.6, 0.08 * gain], seed, name=str(seed)) for seed in (2, 3)])
    return ProbedLogs(Windows(Segments(0.5), pendulum(), logs), theta, Noise(np.array([0.01]), np.zeros(1)))


def test_of_logs_without_extensions_nothing_is_said() -> None:
    seen = probed(pendulum().space.normalise(np.array([0.6, 0.08])))
    one = library_discrepancy(seen)
    assert one is not None
    assert len(one.causes) == 3
    assert one.shift.shape == (OPTIONS.draws, 2)
    seen.probes = [p for p in seen.probes if False]
    seen.jacobian = np.delete(seen.jacobian, np.arange(2, seen.count), axis=-1)
    seen.one_sided, seen.count = seen.one_sided[:0], 2
    assert library_discrepancy(seen) is None
