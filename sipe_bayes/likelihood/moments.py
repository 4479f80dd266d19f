"""Noise-free products of a linearisation's rows, from which the normal equations follow for any noise.

Linearised at (theta, starts), the residual of window w is r - J_theta dtheta - J_x dx_w. Sample j is whitened with
sample j-1, which may lie in the window before. So the whitened rows of w have the columns
[theta (N) | x_w (D) | x_{w-1} (D) | r]. Their products are sums of three moment matrices that do not depend on
(sigma, tau): the noise can be re-estimated without touching the samples again.
"""

from __future__ import annotations

import itertools

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.likelihood.noise import Noise
from sipe_bayes.likelihood.sequences import Sequence, coefficients


class Moments:
    """Noise-free products of the rows of a linearisation, per channel and gap.

    With x a row and y the row before it, each of the G pairs of channel and gap has the sums x x', x y' + y x' and
    y y' over its samples: ``products`` (3 G, W K K), K = N + 2 D + 1. ``gaps`` in seconds, ``owner`` (its channel) and
    ``counts`` are (G,). Without starts (D = 0) only sums over all windows matter: W is 1 then.

    Args:
        residual: (W, L, C).
        jacobian: (W, L, C, N + D), derivatives of the prediction by theta and the window's start.
        num_theta: N.
        all_sequences: the samples of each channel in a row.
        white: for white noise alone, quickly: one endless gap a channel.
    """

    def __init__(
        self,
        residual: FloatArray,
        jacobian: FloatArray,
        num_theta: int,
        all_sequences: list[Sequence],
        white: bool = False,
    ) -> None:
        windows, _, channels, columns = jacobian.shape
        self.num_theta, self.num_start = num_theta, columns - num_theta
        self.windows = windows if self.num_start else 1
        self.sequences = all_sequences
        rows = np.concatenate([jacobian, residual[..., None]], axis=-1).transpose(2, 0, 1, 3)
        if white:
            rows = rows.reshape(channels, self.windows, -1, columns + 1)
            self.gaps, self.owner = np.full(channels, np.inf), np.arange(channels)
            self.counts = np.array([len(s.index) for s in all_sequences])
            squares = np.zeros((channels, 2, self.windows, 2 * columns + 2, 2 * columns + 2))
            squares[:, 0, :, : columns + 1, : columns + 1] = np.swapaxes(rows, 2, 3) @ rows
        else:
            rows = rows.reshape(channels, -1, columns + 1)
            self.gaps = np.concatenate([s.gaps for s in all_sequences])
            self.owner = np.repeat(np.arange(channels), [len(s.gaps) for s in all_sequences])
            self.counts = np.concatenate([np.bincount(s.gap, minlength=len(s.gaps)) for s in all_sequences])
            squares = np.concatenate([self._squares(rows[c], s) for c, s in enumerate(all_sequences)])
        self.products = self._spread(squares).reshape(3 * len(self.gaps), -1)

    def _squares(self, rows: FloatArray, s: Sequence) -> FloatArray:
        """Sums of z z', z = (a row, the row before it), over a channel's samples (W L, q), q = N + D + 1.

        Of each of its gaps, each side of a window's edge and each window: (its gaps, 2, W, 2 q, 2 q).
        """
        before = np.where((s.previous >= 0)[:, None], rows[s.previous], 0.0)
        both = np.concatenate([rows[s.index], before], axis=1)
        out = np.zeros((len(s.gaps), 2, self.windows, both.shape[1], both.shape[1]))
        own = s.window if self.num_start else np.zeros_like(s.window)
        key = (own * len(s.gaps) + s.gap) * 2 + s.crosses
        order = np.argsort(key, kind="stable")
        edges = np.flatnonzero(np.diff(key[order], prepend=-1, append=-1)).tolist()
        sorted_rows = both[order]
        for begin, end in itertools.pairwise(edges):
            first, part = order[begin], sorted_rows[begin:end]
            out[s.gap[first], int(s.crosses[first]), own[first]] = part.T @ part
        return out

    def _spread(self, squares: FloatArray) -> FloatArray:
        """Products (G, 3, W, K, K) of ``squares`` (G, 2, W, 2 q, 2 q).

        The row before belongs to the window's own start or, across an edge, to the start of the window before.
        """
        n, d = self.num_theta, self.num_start
        size, width = n + d + 1, n + 2 * d + 1
        own = np.append(np.arange(n + d), width - 1)
        before = np.concatenate([np.arange(n), np.arange(n + d, width)])
        out = np.zeros((len(squares), 3, self.windows, width, width))
        for across, lag in enumerate((own, before)):
            part = squares[:, across]
            out[:, 0, :, own[:, None], own] += np.moveaxis(part[..., :size, :size], (2, 3), (0, 1))
            cross = np.moveaxis(part[..., :size, size:], (2, 3), (0, 1))
            out[:, 1, :, own[:, None], lag] += cross
            out[:, 1, :, lag[:, None], own] += np.swapaxes(cross, 0, 1)
            out[:, 2, :, lag[:, None], lag] += np.moveaxis(part[..., size:, size:], (2, 3), (0, 1))
        return out

    def correlation_times(self) -> FloatArray:
        """A first guess (C,) in seconds from the residual's autocorrelation over each channel's commonest gap."""
        corner = self.products.reshape(len(self.gaps), 3, self.windows, -1)[..., -1].sum(2)
        times = np.ones(len(self.sequences))
        for c in range(len(times)):
            mine = np.flatnonzero((self.owner == c) & np.isfinite(self.gaps))
            if len(mine):
                g = mine[np.argmax(self.counts[mine])]
                correlation = 0.5 * corner[g, 1] / max(corner[g, 0], 1e-300)
                times[c] = -self.gaps[g] / np.log(np.clip(correlation, 0.05, 0.999))
        return times

    def normal(self, noise: Noise) -> FloatArray:
        """Whitened products (W, K, K), K = N + 2 D + 1, summed over channels."""
        a = coefficients(self.gaps, noise.tau[self.owner])
        weight = 1 / (noise.sd[self.owner] ** 2 * (1 - a**2))
        width = self.num_theta + 2 * self.num_start + 1
        factors = np.stack([weight, -a * weight, a**2 * weight], axis=1)
        return (factors.ravel() @ self.products).reshape(self.windows, width, width)

    def log_determinant(self, noise: Noise) -> float:
        """log|V| of the residual covariance."""
        a = coefficients(self.gaps, noise.tau[self.owner])
        return float(self.counts @ np.log(noise.sd[self.owner] ** 2 * (1 - a**2)))

    def slopes(self, noise: Noise, inner: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Derivatives (C,) by log sd and by log tau of sum(inner * normal(noise)) + log|V|; inner (W, K, K)."""
        tau = noise.tau[self.owner]
        a = coefficients(self.gaps, tau)
        weight = 1 / (noise.sd[self.owner] ** 2 * (1 - a**2))
        xx, xy, yy = (self.products @ inner.ravel()).reshape(-1, 3).T
        by_sd = -2 * weight * (xx - a * xy + a**2 * yy) + 2 * self.counts
        by_weight = 2 * a * weight / (1 - a**2)
        by_a = by_weight * (xx - a * xy + a**2 * yy) + weight * (2 * a * yy - xy) - 2 * a * self.counts / (1 - a**2)
        with np.errstate(invalid="ignore", divide="ignore"):
            by_tau = np.where(a > 0, by_a * a * self.gaps / tau, 0.0)
        channels = np.eye(len(noise.sd))[self.owner]
        return by_sd @ channels, by_tau @ channels
