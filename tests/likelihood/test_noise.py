"""Coloured residuals and windows against plain dense linear algebra: the full covariance, the full Jacobian.

Statistical tests use fixed seeds; their tolerances are five standard errors of the estimate itself (false
alarms 6e-7 each over reseeding, were the errors normal).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import scipy.linalg

from sipe_bayes.likelihood import Noise
from sipe_bayes.likelihood.moments import Moments
from sipe_bayes.likelihood.noise import whiten
from sipe_bayes.likelihood.restricted import (
    Pulls,
    eliminate_starts,
    estimate_noise,
    marginal,
    restricted,
    restricted_slopes,
)
from sipe_bayes.likelihood.sequences import coefficients, sequences

N, D = 3, 2
SIGMAS = 5.0


@dataclass(frozen=True)
class Problem:
    """W windows of at most L samples of C channels: residual (W, L, C), jacobian (W, L, C, N + D)."""

    observed: Any
    sample: Any
    log: Any
    dt: Any
    residual: Any
    jacobian: Any

    @property
    def sequences(self) -> list[Any]:
        return sequences(self.observed, self.sample, self.log, self.dt)

    def moments(self) -> Moments:
        return Moments(self.residual, self.jacobian, N, self.sequences)


def problem(windows: tuple[int, ...], steps: int, missing: float = 0.0, channels: int = 2, seed: int = 0) -> Problem:
    """Logs of so many windows of ``steps`` control steps; a log's last window owns its last sample."""
    rng = np.random.default_rng(seed)
    log = np.repeat(np.arange(len(windows)), windows)
    number = np.concatenate([np.arange(w) for w in windows])
    last = np.append(log[1:] != log[:-1], True)
    sample = (number * steps)[:, None] + np.arange(steps + 1)
    owned = np.arange(steps + 1) < (steps + last)[:, None]
    observed = owned[:, :, None] & (rng.random((*owned.shape, channels)) >= missing)
    residual = np.where(observed, rng.normal(size=observed.shape), 0.0)
    jacobian = np.where(observed[..., None], rng.normal(size=(*observed.shape, N + D)), 0.0)
    return Problem(observed, sample, log, np.array([0.01, 0.02, 0.004])[log], residual, jacobian)


def without(base: Problem, channel: int, window: int, samples: slice) -> Problem:
    observed = base.observed.copy()
    observed[window, samples, channel] = False
    residual = np.where(observed, base.residual, 0.0)
    jacobian = np.where(observed[..., None], base.jacobian, 0.0)
    return Problem(observed, base.sample, base.log, base.dt, residual, jacobian)


PROBLEMS = {
    "one window": problem((1,), 9),
    "windows": problem((4,), 6),
    "two logs": problem((3, 2), 6),
    "one-step windows": problem((9,), 1),
    "gaps": problem((3, 2, 2), 7, missing=0.4),
    "three channels": problem((2, 3), 5, missing=0.2, channels=3),
    "a window missing in one channel": without(problem((4, 1), 6), 1, 1, slice(None)),
    "a gap across windows": without(without(problem((3,), 6), 0, 0, slice(3, None)), 0, 1, slice(0, 3)),
    "a long gap": without(problem((2,), 40), 0, 0, slice(5, 30)),
    "the longest gap": without(problem((2,), 40), 0, 0, slice(5, 24)),
    "a channel never measured": without(problem((1,), 9), 1, 0, slice(None)),
}
NOISES = {
    "coloured": Noise(np.array([0.5, 1.5, 0.9]), np.array([0.03, 0.004, 0.2])),
    "white": Noise(np.array([0.5, 1.5, 0.9]), np.zeros(3)),
    "mixed": Noise(np.array([0.5, 1.5, 0.9]), np.array([0.0, 5.0, 0.001])),
}
ALL = pytest.mark.parametrize("name", PROBLEMS)
EVERY_NOISE = pytest.mark.parametrize("noise", NOISES.values(), ids=NOISES)


def dense(case: Problem, noise: Noise) -> tuple[Any, Any, Any]:
    """Covariance V (n, n), Jacobian (n, N + W D) and residual (n,) of all samples, channel after channel."""
    covariances, jacobians, residuals = [], [], []
    for c in range(case.observed.shape[2]):
        window, place = np.nonzero(case.observed[:, :, c])
        number, log = case.sample[window, place], case.log[window]
        new = (np.diff(log) != 0) | (np.diff(window) > 1) | (np.diff(number) > 20)
        piece, time = np.concatenate([[0], np.cumsum(new)])[: len(window)], number * case.dt[window]
        apart = np.abs(time[:, None] - time)
        correlation = np.exp(-apart / noise.tau[c]) if noise.tau[c] > 0 else np.eye(len(window))
        covariances.append(noise.sd[c] ** 2 * correlation * (piece[:, None] == piece))
        rows = np.zeros((len(window), N + len(case.log) * D))
        rows[:, :N] = case.jacobian[window, place, c, :N]
        for d in range(D):
            rows[np.arange(len(window)), N + window * D + d] = case.jacobian[window, place, c, N + d]
        jacobians.append(rows)
        residuals.append(case.residual[window, place, c])
    return scipy.linalg.block_diag(*covariances), np.concatenate(jacobians), np.concatenate(residuals)


def close(value: Any, expected: Any) -> None:
    np.testing.assert_allclose(value, expected, rtol=1e-8, atol=1e-8)


@ALL
@EVERY_NOISE
def test_whitening_is_the_inverse_root_of_the_covariance(name: str, noise: Noise) -> None:
    case = PROBLEMS[name]
    covariance, _, residual = dense(case, noise)
    flat = case.residual.reshape(-1, case.residual.shape[2])
    batch = np.stack([flat, 2 * flat])
    total = np.zeros(2)
    for c, s in enumerate(case.sequences):
        white = whiten(batch[..., c], s, float(noise.sd[c]), float(noise.tau[c]))
        assert white.shape == (2, case.observed[:, :, c].sum())
        total += (white**2).sum(-1)
    chi_square = residual @ np.linalg.solve(covariance, residual)
    close(total, [chi_square, 4 * chi_square])
    close(case.moments().log_determinant(noise), np.linalg.slogdet(covariance)[1])


def test_whitening_makes_the_noise_white() -> None:
    """Applied to the columns of the covariance's root, whitening gives an orthogonal matrix."""
    case, noise = PROBLEMS["a gap across windows"], NOISES["coloured"]
    covariance, _, _ = dense(case, noise)
    first = case.sequences[0]
    n = len(first.index)
    root = np.linalg.cholesky(covariance[:n, :n])
    columns = np.zeros((n, case.observed[:, :, 0].size))
    columns[:, first.index] = root.T
    white = whiten(columns, first, float(noise.sd[0]), float(noise.tau[0]))
    close(white.T @ white, np.eye(n))


@ALL
@EVERY_NOISE
def test_moments_are_the_products_of_whitened_rows(name: str, noise: Noise) -> None:
    case = PROBLEMS[name]
    covariance, jacobian, residual = dense(case, noise)
    normal = case.moments().normal(noise)
    joined = np.column_stack([jacobian, residual])
    expected = joined.T @ np.linalg.solve(covariance, joined)
    total, theta, r = np.zeros_like(expected), np.arange(N), jacobian.shape[1]
    for w, block in enumerate(normal):
        own, before = N + w * D + np.arange(D), N + (w - 1) * D + np.arange(D if w else 0)
        columns, kept = np.concatenate([theta, own, before, [r]]), np.ones(len(block), bool)
        if w == 0:  # no window before: its columns are zero
            kept[N + D : N + 2 * D] = False
            assert not block[~kept].any()
        total[np.ix_(columns, columns)] += block[np.ix_(kept, kept)]
    close(total, expected)


def system(case: Problem, noise: Noise, precision: Any, pull: Any, damping: float = 0.0) -> tuple[Any, ...]:
    """Normal matrix and right side of (theta, starts), the log determinant of V and r' V^-1 r."""
    covariance, jacobian, residual = dense(case, noise)
    matrix = jacobian.T @ np.linalg.solve(covariance, jacobian)
    right = jacobian.T @ np.linalg.solve(covariance, residual)
    starts = np.arange(N, len(matrix))
    matrix[starts, starts] = matrix[starts, starts] * (1 + damping) + np.tile(precision, len(case.log))
    right[N:] += pull.ravel()
    return matrix, right, np.linalg.slogdet(covariance)[1], residual @ np.linalg.solve(covariance, residual)


PRECISION = np.array([0.3, 2.0])


@ALL
@EVERY_NOISE
@pytest.mark.parametrize("damping", [0.0, 0.5])
def test_elimination_is_the_schur_complement(name: str, noise: Noise, damping: float) -> None:
    case = PROBLEMS[name]
    pull = np.random.default_rng(1).normal(size=(len(case.log), D))
    matrix, right, _, square = system(case, noise, PRECISION, pull, damping)
    products = case.moments().normal(noise)
    solved = eliminate_starts(products, N, PRECISION, pull, damping)
    inner, border = matrix[N:, N:], matrix[N:, :N]
    close(solved.precision, matrix[:N, :N] - border.T @ np.linalg.solve(inner, border))
    close(solved.gradient, right[:N] - border.T @ np.linalg.solve(inner, right[N:]))
    close(solved.explained, right[N:] @ np.linalg.solve(inner, right[N:]))
    close(solved.log_determinant, np.linalg.slogdet(inner)[1])
    close(products[:, -1, -1].sum(), square)
    step = np.array([0.3, -1.0, 0.2])
    close(solved.blocks(step).ravel(), np.linalg.solve(inner, right[N:] - border @ step))
    best = np.linalg.solve(matrix + 1e-3 * np.eye(len(matrix)) * (np.arange(len(matrix)) < N), right)
    found = np.linalg.solve(solved.precision + 1e-3 * np.eye(N), solved.gradient)
    close(found, best[:N])
    close(solved.blocks(found).ravel(), best[N:])


@ALL
@EVERY_NOISE
@pytest.mark.parametrize("free", [(True, True, True), (True, False, True), (False, False, False)])
def test_restricted_likelihood_is_the_dense_one(name: str, noise: Noise, free: tuple[bool, ...]) -> None:
    case, rng = PROBLEMS[name], np.random.default_rng(2)
    pull, prior_pull = rng.normal(size=(len(case.log), D)), rng.normal(size=N)
    root = rng.normal(size=(N, N))
    prior, moving = root @ root.T + 0.1 * np.eye(N), np.array(free)
    pulls = Pulls(prior, prior_pull, PRECISION, pull, moving)
    matrix, right, log_covariance, square = system(case, noise, PRECISION, pull)
    matrix[:N, :N] += prior
    right[:N] += prior_pull
    unknown = np.concatenate([np.flatnonzero(moving), np.arange(N, len(matrix))])
    matrix, right = matrix[np.ix_(unknown, unknown)], right[unknown]
    explained = right @ np.linalg.solve(matrix, right)
    expected = -0.5 * (log_covariance + np.linalg.slogdet(matrix)[1] + square - explained)
    close(restricted(case.moments(), noise, pulls)[0], expected)


@ALL
@EVERY_NOISE
@pytest.mark.parametrize("free", [(True, True, True), (True, False, True), (False, False, False)])
def test_without_starts_the_windows_are_summed(name: str, noise: Noise, free: tuple[bool, ...]) -> None:
    """Normal equations, restricted likelihood and its slopes against dense algebra; white noise also the quick way."""
    case, rng = PROBLEMS[name], np.random.default_rng(6)
    channels, (covariance, jacobian, residual) = case.observed.shape[2], dense(case, noise)
    jacobian, moving = jacobian[:, :N], np.array(free)
    prior, prior_pull, none = np.diag([0.5, 1.0, 2.0]), rng.normal(size=N), np.zeros((len(case.log), 0))
    pulls = Pulls(prior, prior_pull, np.zeros(0), none, moving)
    noise = Noise(noise.sd[:channels], noise.tau[:channels])

    def expected(noise: Noise) -> float:
        covariance = dense(case, noise)[0]
        matrix = jacobian.T @ np.linalg.solve(covariance, jacobian) + prior
        right = jacobian.T @ np.linalg.solve(covariance, residual) + prior_pull
        matrix, right = matrix[np.ix_(moving, moving)], right[moving]
        square = residual @ np.linalg.solve(covariance, residual) - right @ np.linalg.solve(matrix, right)
        return float(-0.5 * (np.linalg.slogdet(covariance)[1] + np.linalg.slogdet(matrix)[1] + square))

    coloured = bool(noise.tau.any())
    for white in (False,) if coloured else (False, True):
        moments = Moments(case.residual, case.jacobian[..., :N], N, case.sequences, white)
        assert moments.windows == 1
        solved = eliminate_starts(moments.normal(noise), N, np.zeros(0), none)
        close(solved.precision, jacobian.T @ np.linalg.solve(covariance, jacobian))
        close(solved.gradient, jacobian.T @ np.linalg.solve(covariance, residual))
        assert (solved.blocks(np.ones(N)).shape, solved.slope.shape) == (none.shape, (*none.shape, N))
        value, by_sd, by_tau = restricted_slopes(moments, noise, pulls)
        close([value, restricted(moments, noise, pulls)[0]], expected(noise))
        h = 1e-6
        for c in range(channels):
            up = np.exp(h * np.eye(channels)[c])
            for slope, more, less in (
                (by_sd[c], Noise(noise.sd * up, noise.tau), Noise(noise.sd / up, noise.tau)),
                (by_tau[c], Noise(noise.sd, noise.tau * up), Noise(noise.sd, noise.tau / up)),
            ):
                np.testing.assert_allclose(slope, (expected(more) - expected(less)) / (2 * h), rtol=1e-5, atol=1e-5)


@ALL
@EVERY_NOISE
def test_the_slopes_are_those_of_the_restricted_likelihood(name: str, noise: Noise) -> None:
    """With starts, and whether or not the linear model's gain counts."""
    case, rng = PROBLEMS[name], np.random.default_rng(4)
    channels, h = case.observed.shape[2], 1e-6
    noise = Noise(noise.sd[:channels], noise.tau[:channels])
    pulls = Pulls(np.eye(N), rng.normal(size=N), PRECISION, rng.normal(size=(len(case.log), D)), np.ones(N, bool))
    moments = case.moments()
    value, by_sd, _ = restricted_slopes(moments, noise, pulls)
    assert value == restricted(moments, noise, pulls)[0]
    for c in range(channels):
        up = np.exp(h * np.eye(channels)[c])
        more, less = (restricted(moments, Noise(sd, noise.tau), pulls)[0] for sd in (noise.sd * up, noise.sd / up))
        np.testing.assert_allclose(by_sd[c], (more - less) / (2 * h), rtol=1e-5, atol=1e-5)


@ALL
@EVERY_NOISE
def test_marginal_likelihood_integrates_the_starts_out(name: str, noise: Noise) -> None:
    """At its reference the residual is normal with covariance V + J P^-1 J', whatever the starts."""
    case, rng = PROBLEMS[name], np.random.default_rng(3)
    windows = len(case.log)
    covariance, jacobian, residual = dense(case, noise)
    starts = rng.normal(size=(3, windows, D))
    moved = case.residual - np.einsum("wlcd,bwd->bwlc", case.jacobian[..., N:], starts)
    spread = covariance + jacobian[:, N:] @ np.diag(np.tile(1 / PRECISION, windows)) @ jacobian[:, N:].T
    constant = windows * np.log(PRECISION).sum()
    expected = -0.5 * (np.linalg.slogdet(spread)[1] + constant + residual @ np.linalg.solve(spread, residual))
    found = []
    for one, start in zip(moved, starts, strict=True):
        moments = Moments(one, case.jacobian[..., N:], 0, case.sequences)
        found.append(marginal(moments, noise, start, PRECISION)[0])
    close(np.array(found), np.full(3, expected))


@ALL
@EVERY_NOISE
def test_best_starts_solve_the_dense_equations(name: str, noise: Noise) -> None:
    case, starts = PROBLEMS[name], np.random.default_rng(4).normal(size=(len(PROBLEMS[name].log), D))
    matrix, right, _, _ = system(case, noise, PRECISION, -PRECISION * starts)
    moments = Moments(case.residual, case.jacobian[..., N:], 0, case.sequences)
    found = marginal(moments, noise, starts, PRECISION)[1]
    close(found.ravel(), np.linalg.solve(matrix[N:, N:], right[N:]))


def test_sequences_begin_anew_where_memory_ends() -> None:
    first, second = without(problem((2, 1), 30), 0, 0, slice(4, 26)).sequences
    assert (first.previous == -1).sum() == 3  # log 1, after the gap of 23 samples, log 2
    assert (second.previous == -1).sum() == 2
    assert second.crosses.sum() == 1
    assert np.isinf(second.gaps).sum() == 1
    gap = without(problem((1,), 30), 0, 0, slice(4, 23)).sequences[0]
    assert (gap.previous == -1).sum() == 1  # 20 samples are bridged
    assert sorted(gap.gaps[np.isfinite(gap.gaps)]) == pytest.approx([0.01, 0.2])


def test_coefficients() -> None:
    gaps = np.array([0.01, 0.02, np.inf])
    close(coefficients(gaps, 0.01), [np.exp(-1), np.exp(-2), 0])
    close(coefficients(gaps, 0.0), [0, 0, 0])


# estimation from simulated residuals


def simulated(rho: float, sd: float, rng: Any, samples: int) -> Any:
    noise = rng.normal(size=samples) * sd * np.sqrt(1 - rho**2)
    noise[0] = rng.normal() * sd
    for t in range(1, samples):
        noise[t] += rho * noise[t - 1]
    return noise


def estimate(rho: tuple[float, ...], sd: tuple[float, ...], seed: int, **more: Any) -> tuple[Noise, int]:
    """Noise estimated from 40 windows of 50 samples, each with unknown starts, and the number of samples."""
    case, rng = problem((40,), 50, channels=len(rho), seed=seed), np.random.default_rng(1000 + seed)
    samples = int(case.observed[:, :, 0].sum())
    residual = np.zeros_like(case.residual)
    for c in range(len(rho)):
        residual[:, :, c][case.observed[:, :, c]] = simulated(rho[c], sd[c], rng, samples)
    case = Problem(case.observed, case.sample, case.log, case.dt, residual, case.jacobian)
    pulls = Pulls(np.eye(N) * 1e-6, np.zeros(N), np.full(D, 1e-6), np.zeros((40, D)), np.ones(N, bool))
    start = Noise(np.full(len(rho), 0.3), np.zeros(len(rho)))
    settings = {"fixed_sd": np.full(len(rho), np.nan), "coloured": True, **more}
    return estimate_noise(case.moments(), start, pulls, shortest=0.01, longest=10.0, **settings), samples


def errors(found: Noise, samples: int, rho: Any, sd: Any) -> Any:
    """Errors of rho and log sd in their asymptotic standard errors, one row a channel."""
    rho, estimated = np.asarray(rho), np.exp(-0.01 / found.tau)
    rho_error = np.sqrt((1 - rho**2) / samples)
    sd_error = np.sqrt((1 + rho**2) / (1 - rho**2) / (2 * samples))
    return np.column_stack([(estimated - rho) / rho_error, np.log(found.sd / sd) / sd_error])


@pytest.mark.parametrize("seed", range(3))
def test_noise_is_recovered(seed: int) -> None:
    """Within five standard errors; rho .99 is skewed: the worst of 240 numbers over 40 seeds was 4.9."""
    rho, sd = (0.9, 0.5, 0.99), (0.1, 2.0, 1.0)
    found, samples = estimate(rho, sd, seed)
    scores = errors(found, samples, rho, sd)
    assert (np.abs(scores) < SIGMAS).all(), f"rho and log sd off by {scores} standard errors"


def test_noise_is_not_biased() -> None:
    """The mean of 8 seeds stays within five of its standard errors (three means: a false alarm in 5e5)."""
    rho, sd = (0.8, 0.0), (0.5, 1.0)
    scores = np.stack([errors(*estimate(rho, sd, seed), rho, sd) for seed in range(8)])
    white = scores[:, 1, 0]
    assert (np.abs(scores.mean(0)[[0, 0, 1], [0, 1, 1]]) * np.sqrt(8) < SIGMAS).all(), scores.mean(0)
    assert (white > -0.1).all(), "a negative correlation is no correlation time"
    assert (white < SIGMAS).all()


def test_given_noise_is_kept() -> None:
    found, _ = estimate((0.9, 0.5), (0.1, 2.0), 0, fixed_sd=np.array([0.2, np.nan]))
    assert found.sd[0] == 0.2
    assert found.sd[1] == pytest.approx(2.0, rel=0.2)
    white, samples = estimate((0.0, 0.0), (0.1, 2.0), 0, coloured=False)
    assert not white.tau.any()
    assert (np.abs(np.log(white.sd / [0.1, 2.0])) < SIGMAS / np.sqrt(2 * samples)).all()
