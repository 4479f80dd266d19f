"""A discrepancy that the library spans: its posterior is the exact one, its intervals hold as often as they say."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.stats

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.diagnostics.misfit.library_discrepancy import Columns, DiscrepancyOptions, library_discrepancy
from sipe_bayes.diagnostics.misfit.probed_logs import ProbedLogs
from sipe_bayes.likelihood import Noise, Segments
from sipe_bayes.likelihood.windows import Windows
from tests.problems.pendulums import log, pendulum

OPTIONS = DiscrepancyOptions(draws=40_000)
NAMES = ["a", "b", "b", "c", "c", "c"]
PARTS = np.array([1 / 3, 1 / 6, 1 / 6, 1 / 9, 1 / 9, 1 / 9])
ONE_SIDED = np.array([True, False, False, False, True, False])


def regression(seed: int, size: float) -> tuple[FloatArray, FloatArray]:
    """60 samples of noise, a parameter's column, and one of six others, alike to it, in this size; columns and y."""
    random = np.random.default_rng(seed)
    columns = random.standard_normal((60, 7))
    columns[:, 1:] += 0.7 * columns[:, :1]
    return columns, columns @ np.array([1.0, size, 0, 0, 0, 0, 0]) + random.standard_normal(60)


def projected(columns: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Information (6, 6) of the others with the first free, score (6,), and the first's answer to them (6,)."""
    first, rest = columns[:, :1], columns[:, 1:]
    free = np.eye(len(y)) - first @ first.T / (first.T @ first)
    return rest.T @ free @ rest, rest.T @ free @ y, -(first.T @ rest / (first.T @ first))[0]


@pytest.mark.parametrize("size", [0.0, 0.4, 4.0, -0.4])
def test_the_posterior_is_the_exact_one_of_a_linear_model(size: float) -> None:
    """Evidence of each state from normals of y written out, a half normal's by quadrature; then the first's shift."""
    columns, y = regression(3, size)
    information, score, answer = projected(columns, y)
    rest, (grid, believed) = columns[:, 1:], OPTIONS.grid
    flat = np.eye(60) + 1e4 * np.outer(columns[:, 0], columns[:, 0])
    inverse, sds = np.linalg.inv(flat), 1 / np.sqrt(np.diag(information))

    def level(left: FloatArray) -> FloatArray:
        return np.asarray(-0.5 * np.einsum("...i,ij,...j->...", left, inverse, left))

    log_weights, means, squares = [np.log(OPTIONS.absent)], [0.0], [0.0]
    for t, probable in zip(grid, believed, strict=True):
        for k in range(6):
            b = (sds[k] * (y @ inverse @ rest[:, k]) * sds[k]) + sds[k] * np.linspace(-10, 10, 1001)
            sizes = scipy.stats.norm.pdf(b, scale=t * sds[k]) * np.where(ONE_SIDED[k], 2.0 * (b > 0), 1.0)
            values = sizes * np.exp(level(y - b[:, None] * rest[:, k]) - level(y)) * (b[1] - b[0])
            total = max(float(values.sum()), 1e-300)
            log_weights.append(np.log(0.3 * probable * PARTS[k] * total))
            means.append(float(answer[k] * (values @ b) / total))
            squares.append(float(answer[k] ** 2 * (values @ b**2) / total))
        own = np.diag(PARTS * (t * sds) ** 2)
        whole = flat + rest @ own @ rest.T
        gain = own @ rest.T @ np.linalg.inv(whole)
        normal = scipy.stats.multivariate_normal
        log_weights.append(np.log(0.3 * probable) + normal.logpdf(y, cov=whole) - normal.logpdf(y, cov=flat))
        means.append(float(answer @ gain @ y))
        squares.append(float(answer @ (own - gain @ rest @ own) @ answer) + means[-1] ** 2)
    weights = np.exp(np.array(log_weights) - max(log_weights))
    weights /= weights.sum()

    columns_seen = Columns(NAMES, information, score, ONE_SIDED)
    np.testing.assert_allclose(columns_seen.parts, PARTS)
    drawn, present, _ = columns_seen.draws(OPTIONS, np.random.default_rng(0))
    shifts, mean, square = drawn @ answer, weights @ np.array(means), weights @ np.array(squares)
    print(present, 1 - weights[0], shifts.mean(), mean, (shifts**2).mean(), square)
    np.testing.assert_allclose(present, 1 - weights[0], atol=1e-3)
    assert abs(shifts.mean() - mean) < 5 * np.sqrt(square / 40_000) + 2e-3 * abs(mean)
    np.testing.assert_allclose((shifts**2).mean(), square, rtol=0.1)


def test_intervals_hold_as_often_as_they_say_and_are_hardly_wider_where_nothing_is_missing() -> None:
    """300 logs, discrepancies drawn from the prior: 90 % but for three standard errors of 1.7 %."""
    random, (grid, believed), options = np.random.default_rng(0), OPTIONS.grid, DiscrepancyOptions(draws=2000)
    hits, plain, widths, missing = [], [], [], []
    for seed in range(300):
        columns, y = regression(seed, 0.0)
        information, _, answer = projected(columns, y)
        t, state = random.choice(grid, p=believed), random.choice(3, p=[0.4, 0.3, 0.3])
        sizes = t / np.sqrt(np.diag(information)) * random.standard_normal(6)
        if state == 1:
            sizes = np.where(ONE_SIDED, np.abs(sizes), sizes) * (np.arange(6) == random.choice(6, p=PARTS))
        y = y + columns[:, 1:] @ (sizes * (np.sqrt(PARTS) if state == 2 else state))
        made = Columns(NAMES, information, projected(columns, y)[1], ONE_SIDED).draws(options, random)[0]
        square = columns[:, 0] @ columns[:, 0]
        drawn = columns[:, 0] @ y / square + random.standard_normal(2000) / np.sqrt(square)
        ends = [np.quantile(d, [0.05, 0.95]) for d in (drawn, drawn + made @ answer)]
        plain.append(ends[0][0] <= 1.0 <= ends[0][1])
        hits.append(ends[1][0] <= 1.0 <= ends[1][1])
        widths.append(np.diff(ends[1])[0] / np.diff(ends[0])[0])
        missing.append(state > 0)
    wrong = np.array(missing)
    print(np.mean(hits), np.mean(np.array(plain)[wrong]), np.median(np.array(widths)[~wrong]))
    assert abs(np.mean(hits) - 0.9) < 0.051
    assert np.mean(np.array(plain)[wrong]) < 0.7
    assert np.median(np.array(widths)[~wrong]) < 1.3


def probed(theta: FloatArray, gain: float = 1.0) -> ProbedLogs:
    logs = Trajectories.stack([log(pendulum(), [0.6, 0.08 * gain], seed, name=str(seed)) for seed in (2, 3)])
    return ProbedLogs(Windows(Segments(0.5), pendulum(), logs), theta, Noise(np.array([0.01]), np.zeros(1)))


def test_of_logs_without_extensions_nothing_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    theta = pendulum().space.normalise(np.array([0.6, 0.08]))
    one = library_discrepancy(probed(theta))
    assert one is not None
    assert len(one.causes) == 3
    assert one.shift.shape == (4000, 2)
    monkeypatch.setattr("sipe_bayes.structure.probes.EXTENSIONS", {})
    monkeypatch.setattr("sipe_bayes.structure.probes.step_error", lambda *_: None)
    assert library_discrepancy(probed(theta)) is None
