"""A linear regression turned round: theta given one observed estimate, the line known from R pairs of them alone.

With estimate m = a + B theta + e, e ~ N(0, V), and the flat prior |V|^(-(N+1)/2), (a, B, V) have a matrix-normal
inverse-Wishart posterior given the pairs (theta, estimate). Each draw of it makes a normal in theta, weighted by its
evidence N(m_0; a + B mu_0, V + B P_0^-1 B') under the prior N(mu_0, P_0^-1); together they are a mixture, whose tails
are as heavy as few pairs deserve.

P. Brown 1982, "Multivariate calibration" (JRSS B 44, https://doi.org/10.1111/j.2517-6161.1982.tb01209.x). Deviation:

- A mixture of 16 draws in place of his density in closed form, because a mixture can be cut off at the cube's faces
  exactly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.stats

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.likelihood import QuadraticPrior

_ROUNDING = 1e-9  # sd of an estimate, in the cube, below which its scatter is rounding


@dataclass(frozen=True)
class Line:
    """Regression of R estimates on theta.

    Args:
        middle: (N,), which standardises theta.
        scale: (N,), which standardises theta.
        design: (R, N + 1), a column of ones and theta, standardised.
        coefficients: (N + 1, N).
        residual: what the line leaves (R, N).
        square: its sum of squares (N, N).
    """

    middle: FloatArray
    scale: FloatArray
    design: FloatArray
    coefficients: FloatArray
    residual: FloatArray
    square: FloatArray

    @classmethod
    def fit(cls, theta: FloatArray, estimates: FloatArray) -> Line:
        """Of theta (R, N) and estimates (R, N)."""
        middle, scale = theta.mean(0), theta.std(0)
        design = np.concatenate([np.ones((len(theta), 1)), (theta - middle) / scale], axis=1)
        coefficients = np.linalg.lstsq(design, estimates, rcond=None)[0]
        residual = estimates - design @ coefficients
        square = residual.T @ residual + len(theta) * _ROUNDING**2 * np.eye(theta.shape[1])
        return cls(middle, scale, design, coefficients, residual, square)

    @property
    def freedom(self) -> int:
        """Degrees of freedom of the scatter."""
        return len(self.design) - self.design.shape[1]

    @property
    def scatter(self) -> FloatArray:
        """V (N, N), as large as the sum of squares makes it on average."""
        return self.square / max(1, self.freedom - len(self.square) - 1)

    def inverted(
        self, coefficients: FloatArray, scatter: FloatArray, observed: FloatArray, prior: QuadraticPrior
    ) -> tuple[float, FloatArray, FloatArray]:
        """Theta given an observed estimate, for one line.

        Args:
            coefficients: of the line (N + 1, N).
            scatter: V (N, N).
            observed: the estimate (N,).
            prior: of theta.

        Returns:
            Log evidence, mean (N,) and covariance (N, N).
        """
        slope = coefficients[1:].T / self.scale  # (estimate, theta)
        offset = observed - coefficients[0] + slope @ self.middle
        gain = slope.T @ np.linalg.inv(scatter)
        inverse = gain @ slope + prior.precision
        covariance = np.linalg.inv(0.5 * (inverse + inverse.T))
        mean = covariance @ (gain @ offset + prior.precision @ prior.mean)
        spread = scatter + slope @ np.linalg.inv(prior.precision) @ slope.T
        evidence = scipy.stats.multivariate_normal.logpdf(offset, slope @ prior.mean, spread, allow_singular=True)
        return float(evidence), mean, 0.5 * (covariance + covariance.T)

    def mixture(
        self, observed: FloatArray, prior: QuadraticPrior, rng: np.random.Generator, components: int = 16
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Theta given an observed estimate, for as many draws of the line and V.

        Args:
            observed: the estimate (N,).
            prior: of theta.
            rng: draws them.
            components: K, how many.

        Returns:
            Log weights (K,), means (K, N) and covariances (K, N, N).
        """
        root = np.linalg.cholesky(np.linalg.inv(self.design.T @ self.design))
        scatter = scipy.stats.invwishart(self.freedom, self.square)
        drawn = []
        for _ in range(components):
            v = np.atleast_2d(scatter.rvs(random_state=rng))
            noise = rng.standard_normal(self.coefficients.shape)
            line = self.coefficients + root @ noise @ np.linalg.cholesky(v).T
            drawn.append(self.inverted(line, v, observed, prior))
        weights, means, covariances = (np.stack(x) for x in zip(*drawn, strict=True))
        return weights, means, covariances

    def normality(self) -> float:
        """p-value of normal scatter about the line.

        Each estimate's distance from the line through the others has an F distribution then, compared by Kolmogorov and
        Smirnov's test.
        """
        n, freedom = len(self.square), self.freedom - 1
        inverse = np.linalg.inv(self.design.T @ self.design)
        lever = 1 - np.einsum("ri,ij,rj->r", self.design, inverse, self.design)
        within = np.einsum("ri,ij,rj->r", self.residual, np.linalg.inv(self.square), self.residual) / lever
        others = within / np.maximum(1 - within, 1e-12)
        values = scipy.stats.f.cdf(others * (freedom - n + 1) / n, n, freedom - n + 1)
        return float(scipy.stats.kstest(values, "uniform").pvalue)
