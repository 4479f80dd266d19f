"""The likelihood of residuals with the windows' starts integrated out (the model: ``sipe_bayes.noise``)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sipe_bayes.noise import Arrow, Moments, Noise, coefficients, eliminate, whiten
from sipe_bayes.sequences import Sequence

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


class Marginal:
    """Log-likelihood of residuals with the starts integrated out, for many residuals and noises at once.

    jacobian (W, L, C, D) of the prediction by the window's start, taken as constant; precision (D,) of the starts' prior.
    """

    def __init__(self, all_sequences: list[Sequence], jacobian: FloatArray, precision: FloatArray) -> None:
        self.sequences, self.precision = all_sequences, precision
        self.windows, self.length, _, self.num_start = jacobian.shape
        empty = np.zeros(jacobian.shape[:3])
        self.moments = Moments(empty, jacobian, 0, all_sequences)
        flat = jacobian.reshape(self.windows * self.length, jacobian.shape[2], self.num_start)
        self.rows = [flat[s.index, c] for c, s in enumerate(all_sequences)]
        self.before = [
            np.where((s.previous >= 0)[:, None], flat[s.previous, c], 0.0) for c, s in enumerate(all_sequences)
        ]
        self.edges = [np.searchsorted(s.window, np.arange(self.windows)) for s in all_sequences]

    def __call__(self, residual: FloatArray, starts: FloatArray, sd: FloatArray, tau: FloatArray) -> FloatArray:
        """(B,) for residuals (B, W, L, C) at starts (B, W, D) with sd and tau (B, C)."""
        values = np.empty(len(residual))
        for b in range(len(residual)):
            noise = Noise(sd[b], tau[b])
            arrow, square = self._eliminate(residual[b], starts[b], noise)
            pull = float((starts[b] ** 2 @ self.precision).sum())
            total = log_determinant(self.sequences, noise) + arrow.log_determinant + square - arrow.explained + pull
            values[b] = -0.5 * total
        return values

    def best(self, residual: FloatArray, starts: FloatArray, noise: Noise) -> FloatArray:
        """The change (W, D) of the starts that minimises the squares, for a residual (W, L, C)."""
        return self._eliminate(residual, starts, noise)[0].start_offset

    def _eliminate(self, residual: FloatArray, starts: FloatArray, noise: Noise) -> tuple[Arrow, float]:
        d, flat = self.num_start, residual.reshape(self.windows * self.length, -1)
        normal, square = self.moments.normal(noise) if d else np.empty(0), 0.0
        for c, s in enumerate(self.sequences):
            white = whiten(flat[:, c], s, float(noise.sd[c]), float(noise.tau[c]))
            square += float(white @ white)
            if not d:
                continue
            a = coefficients(s.gaps, float(noise.tau[c]))[s.gap]
            scaled = white / (noise.sd[c] * np.sqrt(1 - a**2))
            own = self.rows[c] * scaled[:, None]
            lagged = self.before[c] * (-a * scaled)[:, None]
            right = own + np.where(s.crosses[:, None], 0.0, lagged)
            normal[:, :d, -1] += _window_sums(right, self.edges[c], s.window, self.windows)
            crossing = np.where(s.crosses[:, None], lagged, 0.0)
            normal[:, d : 2 * d, -1] += _window_sums(crossing, self.edges[c], s.window, self.windows)
        if not d:  # recorded starts
            none = np.zeros((0, 0))
            starts, slopes = np.zeros((self.windows, 0)), np.zeros((self.windows, 0, 0))
            return Arrow(none, np.zeros(0), 0.0, 0.0, 0.0, starts, slopes, none), square
        return eliminate(normal, 0, self.precision, -self.precision * starts), square


def _window_sums(rows: FloatArray, edges: IntArray, window: IntArray, windows: int) -> FloatArray:
    """Sums (W, D) of rows (n, D) over the samples of each window; windows without samples give zero."""
    sums = np.add.reduceat(np.concatenate([rows, np.zeros((1, rows.shape[1]))]), edges, axis=0)
    sums[np.bincount(window, minlength=windows) == 0] = 0.0
    return sums


def log_determinant(all_sequences: list[Sequence], noise: Noise) -> float:
    """log|V| of the residual covariance."""
    total = 0.0
    for c, s in enumerate(all_sequences):
        a = coefficients(s.gaps, float(noise.tau[c]))
        counts = np.bincount(s.gap, minlength=len(s.gaps))
        total += float(counts @ np.log(noise.sd[c] ** 2 * (1 - a**2)))
    return total
