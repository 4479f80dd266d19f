"""The rows of a linearisation whitened by one noise: products of many columns, or of many residuals.

``moments`` sums products once for every channel, gap and window, from which those of any noise follow; the sums grow
with the square of the columns. Where there are many columns (a probe for each place of each extension) and few noises,
it is cheaper to whiten the rows for each noise, and to form only the products that are asked for.
"""

from __future__ import annotations

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.likelihood import BoundLikelihood, Noise


class WhitenedRows:
    """Rows of N + K columns and D of the window's start, and the row before each.

    Args:
        jacobian: (W, L, C, N + K + D).
        windows: the logs, whose samples follow one another.
    """

    def __init__(self, jacobian: FloatArray, windows: BoundLikelihood) -> None:
        self.shape, self.num_theta = jacobian.shape[:3], jacobian.shape[-1] - windows.num_start
        self.sequences = windows.sequences
        self._crosses = self._placed([s.crosses.astype(float) for s in self.sequences]) > 0
        self._rows, self._before = self._both(jacobian)

    def normal(self, residual: FloatArray, noise: Noise) -> FloatArray:
        """Products (W, K', K') of all columns with a residual (W, L, C), as ``Moments.normal`` gives them."""
        weight, lag, _ = self._weights(noise)
        left, before = self._both(residual[..., None])
        rows = np.concatenate([*self._whitened(noise), weight * left - lag * before], axis=-1)
        return np.swapaxes(rows, 1, 2) @ rows

    def scores(self, residuals: FloatArray, noise: Noise) -> tuple[FloatArray, FloatArray]:
        """Products of all columns but the residual's with residuals (W, L, C, S), each by itself.

        Returns:
            Those of the N + K columns (N + K, S), and those of each window's start (W, D, S).
        """
        weight, lag, _ = self._weights(noise)
        left, before = self._both(residuals)
        theta, starts = self._whitened(noise)
        d = starts.shape[-1] // 2
        white = weight * left - lag * before
        each = np.swapaxes(starts, 1, 2) @ white
        force = each[:, :d].copy()
        force[:-1] += each[1:, d:]
        return np.einsum("wrk,wrs->ks", theta, white, optimize=True), force

    def _weights(self, noise: Noise) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(W, C L, 1) of each row, of the row before it, and of that inside a window; zero where nothing was seen."""
        weights, lags = [], []
        for s, sd, tau in zip(self.sequences, noise.sd.tolist(), noise.tau.tolist(), strict=True):
            a = s.coefficients(tau)
            weights.append(1 / (sd * np.sqrt(1 - a**2)))
            lags.append(a * weights[-1])
        lag = self._placed(lags)[..., None]
        return self._placed(weights)[..., None], lag, np.where(self._crosses[..., None], 0.0, lag)

    def _whitened(self, noise: Noise) -> tuple[FloatArray, FloatArray]:
        """Rows (W, C L, N + K), and (W, C L, 2 D) of [x_w | x_{w-1}]; zero where nothing was observed."""
        n = self.num_theta
        weight, lag, inside = self._weights(noise)
        theta = weight * self._rows[..., :n] - lag * self._before[..., :n]
        own = weight * self._rows[..., n:] - inside * self._before[..., n:]
        # across an edge the row before belongs to the start of the window before
        earlier = (inside - lag) * self._before[..., n:]
        return theta, np.concatenate([own, earlier], axis=-1)

    def _both(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Observed rows (W, C L, q) of values (W, L, C, q), and what is in the row before each."""
        windows, length, channels, width = values.shape
        flat = np.moveaxis(values, 2, 0).reshape(channels, windows * length, width)
        rows, before = np.zeros((2, *flat.shape))
        for c, s in enumerate(self.sequences):
            linked = s.previous >= 0
            rows[c, s.index] = flat[c, s.index]
            before[c, s.index[linked]] = flat[c, s.previous[linked]]
        return self._by_window(rows), self._by_window(before)

    def _placed(self, values: list[FloatArray]) -> FloatArray:
        """Numbers of each channel's samples at their rows (W, C L)."""
        windows, length, channels = self.shape
        out = np.zeros((channels, windows * length))
        for row, s, own in zip(out, self.sequences, values, strict=True):
            row[s.index] = own
        return self._by_window(out[..., None])[..., 0]

    def _by_window(self, rows: FloatArray) -> FloatArray:
        """(W, C L, q) of (C, W L, q)."""
        windows, length, channels = self.shape
        turned = np.moveaxis(rows.reshape(channels, windows, length, -1), 0, 1)
        return turned.reshape(windows, channels * length, -1)
