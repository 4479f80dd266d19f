"""Which few columns are at work: the posterior is the exact one, its intervals hold as often as they say."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.stats

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.structure.single_effects import ABSENT, AllEffects, Columns, SingleEffect, find_effects, size_grid

DRAWS = 40_000
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
def test_the_posterior_of_one_or_of_all_is_the_exact_one_of_a_linear_model(size: float) -> None:
    """Evidence of each state from normals of y written out, a half normal's by quadrature; then the first's shift."""
    columns, y = regression(3, size)
    information, score, answer = projected(columns, y)
    rest, (grid, believed) = columns[:, 1:], size_grid()
    flat = np.eye(60) + 1e4 * np.outer(columns[:, 0], columns[:, 0])
    inverse, sds = np.linalg.inv(flat), 1 / np.sqrt(np.diag(information))

    def level(left: FloatArray) -> FloatArray:
        return np.asarray(-0.5 * np.einsum("...i,ij,...j->...", left, inverse, left))

    one, every = [[(ABSENT, 0.0, 0.0)] for _ in range(2)]
    for t, probable in zip(grid, (1 - ABSENT) * believed, strict=True):
        for k in range(6):
            b = (sds[k] * (y @ inverse @ rest[:, k]) * sds[k]) + sds[k] * np.linspace(-10, 10, 1001)
            sizes = scipy.stats.norm.pdf(b, scale=t * sds[k]) * np.where(ONE_SIDED[k], 2.0 * (b > 0), 1.0)
            values = sizes * np.exp(level(y - b[:, None] * rest[:, k]) - level(y)) * (b[1] - b[0])
            total = max(float(values.sum()), 1e-300)
            moments = float(answer[k] * (values @ b) / total), float(answer[k] ** 2 * (values @ b**2) / total)
            one.append((probable * PARTS[k] * total, *moments))
        own = np.diag(PARTS * (t * sds) ** 2)
        whole = flat + rest @ own @ rest.T
        gain = own @ rest.T @ np.linalg.inv(whole)
        normal, mean = scipy.stats.multivariate_normal, float(answer @ gain @ y)
        odds = probable * np.exp(normal.logpdf(y, cov=whole) - normal.logpdf(y, cov=flat))
        every.append((odds, mean, float(answer @ (own - gain @ rest @ own) @ answer) + mean**2))

    columns_seen = Columns(NAMES, information, score, ONE_SIDED)
    np.testing.assert_allclose(columns_seen.parts, PARTS)
    for rows, made in ((one, SingleEffect.of), (every, AllEffects)):
        weights, means, squares = (np.array(column) for column in zip(*rows, strict=True))
        weights = weights / weights.sum()
        seen = made(columns_seen, score)
        assert isinstance(seen, SingleEffect | AllEffects)
        np.testing.assert_allclose(seen.weights.sum(), 1 - weights[0], atol=1e-3)
        shifts, mean, square = seen.draws(DRAWS, np.random.default_rng(0)) @ answer, weights @ means, weights @ squares
        assert abs(shifts.mean() - mean) < 5 * np.sqrt(square / DRAWS) + 2e-3 * abs(mean)
        np.testing.assert_allclose((shifts**2).mean(), square, rtol=0.1)
        if isinstance(seen, SingleEffect):
            np.testing.assert_allclose(seen.sizes @ answer, mean, rtol=2e-3, atol=1e-4)


def test_intervals_hold_as_often_as_they_say_and_are_hardly_wider_where_nothing_is_missing() -> None:
    """300 logs, one effect or none drawn from the prior: 90 % but for three standard errors of 1.7 %."""
    random, (grid, believed) = np.random.default_rng(0), size_grid()
    hits, plain, widths, missing = [], [], [], []
    for seed in range(300):
        columns, y = regression(seed, 0.0)
        information, _, answer = projected(columns, y)
        t, present = random.choice(grid, p=believed), random.uniform() > ABSENT
        sizes = t / np.sqrt(np.diag(information)) * random.standard_normal(6)
        sizes = np.where(ONE_SIDED, np.abs(sizes), sizes) * (np.arange(6) == random.choice(6, p=PARTS))
        y = y + columns[:, 1:] @ (sizes * present)
        seen = find_effects(Columns(NAMES, information, projected(columns, y)[1], ONE_SIDED))
        made = sum(effect.draws(2000, random) for effect in seen.single) + seen.every.draws(2000, random)
        square = columns[:, 0] @ columns[:, 0]
        drawn = columns[:, 0] @ y / square + random.standard_normal(2000) / np.sqrt(square)
        ends = [np.quantile(d, [0.05, 0.95]) for d in (drawn, drawn + made @ answer)]
        plain.append(ends[0][0] <= 1.0 <= ends[0][1])
        hits.append(ends[1][0] <= 1.0 <= ends[1][1])
        widths.append(np.diff(ends[1])[0] / np.diff(ends[0])[0])
        missing.append(present)
    wrong = np.array(missing)
    assert abs(np.mean(hits) - 0.9) < 0.051
    assert np.mean(np.array(plain)[wrong]) < 0.8
    assert np.median(np.array(widths)[~wrong]) < 1.2


def test_columns_that_are_alike_share_an_effect_and_two_that_are_not_are_two() -> None:
    """Of a column and its copy neither is chosen; one that is useless is not at work."""
    random = np.random.default_rng(0)
    columns = random.standard_normal((200, 4))
    columns[:, 1] = columns[:, 0]
    y = columns @ np.array([2.0, 0.0, -2.0, 0.0]) + random.standard_normal(200)
    names, two_sided = ["a", "copy", "b", "useless"], np.zeros(4, bool)
    seen = find_effects(Columns(names, columns.T @ columns, columns.T @ y, two_sided))
    strong = [effect for effect in seen.single if effect.present > 0.5]
    assert len(strong) == 2
    (both,) = (effect for effect in strong if effect.by_column[0] > 0.1)
    np.testing.assert_allclose(both.by_column, [0.5, 0.5, 0.0, 0.0], atol=1e-3)
    np.testing.assert_allclose(seen.sizes, [1.0, 1.0, -2.0, 0.0], atol=0.2)
    assert sum(effect.by_column[3] for effect in seen.single) < 0.2
