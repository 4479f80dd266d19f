r"""A log's summary by regression: what simulations say of E[theta | x].

P. Fearnhead, D. Prangle 2012, "Constructing summary statistics for approximate Bayesian computation: semi-automatic
approximate Bayesian computation" (https://arxiv.org/abs/1004.1112): of all summaries with as many numbers as
parameters, the posterior's mean loses least, and a regression of theta on what was simulated estimates it. With a
kernel k and K_ij = k(x_i, x_j) of n simulations,

.. math:: s(x) = \bar\theta + k(x)^T (K + \lambda I)^{-1} (\theta - \bar\theta) ,

whose ridge lambda is, for each parameter, that of least mean absolute error of the simulations when each is left out
(squares would follow the few that are far off); infinite where none is better than the mean by ``worth``. A network is
trained on the estimates of simulations whose ``folds`` were left out: it then sees summaries as far off as those of a
new log. (The mean is that of all. Without each simulation alone, estimates would give its theta away where x does not
determine it, being then the mean of the others, (n \bar\theta - \theta_i) / (n - 1). For the same reason k is not
centred over the simulations: all others would hold a trace of each, in its own direction, which gives its theta away.)

Deviations:

- Kernel ridge regression in place of a linear one: k = (1 + <a, a'> + <b, b'>)^2 of the samples a and BayesSim's
  statistics b, each standardised over the simulations, and scaled so that <a, a> and <b, b> are one on average.
- A sample counts by the share of its variance that is not the sensor's noise, and not at all below ``least``.
- ``most`` simulations are regressed on, and as many numbers of each, spread evenly, for time and memory.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from sipe_bayes.core.arrays import Float32Array, FloatArray
from sipe_bayes.core.options import Options, option


@dataclass(frozen=True)
class RegressionOfTheta(Options):
    """How theta is regressed on simulations."""

    most: int = option(2000, "simulations that are regressed on", least=10)
    numbers: int = option(4000, "samples of each that count", least=1)
    folds: int = option(10, "parts of the simulations that are left out in turn", least=2)
    worth: float = option(10.0, "what a summary takes from the sum of errors, at least, in those of one simulation")
    least: float = option(0.04, "share of a sample's variance that is no noise, below which it does not count", above=0)
    ridges: tuple[float, ...] = option(
        tuple(float(x) for x in np.logspace(-7, 1, 25)), "that are tried", "of the largest eigenvalue of K"
    )
    rounding: float = option(1e-7, "of a column's largest number, below which it does not vary", above=0)


_OPTIONS = RegressionOfTheta()


@dataclass(frozen=True)
class Columns:
    """Numbers of a log, standardised over n simulations.

    Attributes:
        kept: (F,), which.
        mean: (F,).
        weight: (F,), by which deviations from it are multiplied.
    """

    kept: NDArray[np.int64]
    mean: FloatArray
    weight: FloatArray

    @classmethod
    def of(cls, x: FloatArray, noise: FloatArray | float, options: RegressionOfTheta = _OPTIONS) -> Self:
        """Of x (n, D) with white noise of sd ``noise`` (D,): those that vary, so that the rows' mean square is one."""
        mean, sd = x.mean(0), x.std(0)
        varies = sd > options.rounding * (np.abs(x).max(0) + 1e-30)
        share = np.where(varies, 1 - (noise / np.where(varies, sd, 1.0)) ** 2, 0.0)
        kept = np.flatnonzero(share > options.least)
        if len(kept) > options.numbers:
            kept = kept[np.linspace(0, len(kept) - 1, options.numbers).round().astype(int)]
        weight = np.sqrt(share[kept]) / sd[kept]
        return cls(kept, mean[kept], weight / max(float(np.sqrt(share[kept].sum())), 1e-30))

    def __call__(self, x: FloatArray) -> Float32Array:
        """Standardised (n, F) of x (n, D); what was not measured counts as the simulations' mean."""
        centred = (x[:, self.kept] - self.mean) * self.weight
        # by rows, as a checkpoint gives them back: products of another order round otherwise
        return np.ascontiguousarray(np.nan_to_num(centred), dtype=np.float32)


@dataclass(frozen=True)
class Regressed:
    """A regression of theta (N,) on n simulations.

    Attributes:
        samples, statistics: columns of both.
        points: (n, F) of the simulations.
        ridge: (N,).
        coefficients: (n, N).
        theta: (N,), mean.
    """

    samples: Columns
    statistics: Columns
    points: Float32Array
    ridge: FloatArray
    coefficients: FloatArray
    theta: FloatArray

    @classmethod
    def of(
        cls,
        theta: FloatArray,
        samples: FloatArray,
        statistics: FloatArray,
        noise: FloatArray | float,
        options: RegressionOfTheta = _OPTIONS,
    ) -> tuple[Self, FloatArray]:
        """The regression, and summaries (n, N) of its simulations, in folds left out, beyond ``most`` as new ones.

        Args:
            theta: (n, N).
            samples: (n, D) with noise.
            statistics: (n, E) of them.
            noise: sd of the samples' noise (D,).
            options: of the regression.
        """
        used = slice(0, options.most)
        columns = Columns.of(samples[used], noise, options), Columns.of(statistics[used], 0.0, options)
        points = np.concatenate([columns[0](samples), columns[1](statistics)], axis=1)
        mean = theta[used].mean(0)
        eigenvalues, vectors = np.linalg.eigh(_kernel(points[used], points[used]))
        eigenvalues = np.maximum(eigenvalues, 0)
        ridge = _least_error(eigenvalues, vectors, theta[used] - mean, options)
        left_out = _left_out(eigenvalues, vectors, theta[used] - mean, ridge, options)
        coefficients = vectors @ ((vectors.T @ (theta[used] - mean)) / (eigenvalues[:, None] + ridge))
        regressed = cls(*columns, points[used], ridge, coefficients, mean)
        beyond = regressed.summaries(points[options.most :])
        return regressed, np.concatenate([mean + left_out, beyond])

    def points_of(self, samples: FloatArray, statistics: FloatArray) -> Float32Array:
        """Of logs (m, D) with statistics (m, E): (m, F)."""
        return np.concatenate([self.samples(samples), self.statistics(statistics)], axis=1)

    def summaries(self, points: Float32Array) -> FloatArray:
        """(m, N) of points (m, F)."""
        return np.asarray(self.theta + _kernel(points, self.points) @ self.coefficients)


def _kernel(one: Float32Array, other: Float32Array) -> FloatArray:
    return np.asarray((1 + (one @ other.T).astype(np.float64)) ** 2)


def _least_error(
    eigenvalues: FloatArray, vectors: FloatArray, theta: FloatArray, options: RegressionOfTheta
) -> FloatArray:
    """For each parameter, without its mean, the ridge (N,) of least error where each simulation is left out."""
    inside, squared = vectors.T @ theta, vectors**2
    best, ridge = (1 - options.worth / len(theta)) * np.abs(theta).mean(0), np.full(theta.shape[1], np.inf)
    for share in options.ridges:
        tried = max(share * float(eigenvalues.max()), 1e-12)
        kept = eigenvalues / (eigenvalues + tried)
        own = squared @ kept
        off = (theta - vectors @ (kept[:, None] * inside)) / np.maximum(1 - own, 1e-9)[:, None]
        error = np.abs(off).mean(0)
        better = error < best
        best[better], ridge[better] = error[better], tried
    return ridge


def _left_out(
    eigenvalues: FloatArray, vectors: FloatArray, theta: FloatArray, ridge: FloatArray, options: RegressionOfTheta
) -> FloatArray:
    """Estimates (n, N) of theta, which has no mean, by regressions without the fold of each simulation."""
    n, estimates = len(theta), np.zeros(theta.shape)
    folds = [np.arange(k, n, options.folds) for k in range(min(options.folds, n))]
    for one in np.unique(ridge[np.isfinite(ridge)]):
        columns = np.flatnonzero(ridge == one)
        kept = eigenvalues / (eigenvalues + one)
        fitted = vectors @ (kept[:, None] * (vectors.T @ theta[:, columns]))
        for fold in folds:
            own = (vectors[fold] * kept) @ vectors[fold].T
            others = fitted[fold] - own @ theta[np.ix_(fold, columns)]
            estimates[np.ix_(fold, columns)] = np.linalg.solve(np.eye(len(fold)) - own, others)
    return estimates
