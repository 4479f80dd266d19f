"""Coloured residuals and the linear algebra of windows: whitening, restricted likelihood, start states marginalised.

Residual model, per channel c and along each log: e_j = a_j e_{j-1} + sqrt(1 - a_j^2) sigma_c z_j, z_j ~ N(0, 1), with
a_j = exp(-gap_j / tau_c) for the time since the previous sample there is (first-order autoregression, which carries
on across windows and across missing samples); e_0 ~ N(0, sigma_c^2). White noise is tau = 0.

Linearised at (theta, starts), the residual of window w is r - J_theta dtheta - J_x dx_w. Because sample j is whitened
with sample j-1, which may lie in the window before, the whitened rows of w have the columns
[theta (N) | x_w (D) | x_{w-1} (D) | r]. Their products are sums of three moment matrices that do not depend on (sigma,
tau), so the noise can be re-estimated without touching the samples again. The normal equations are an arrow: dense in
theta, block-tridiagonal in the starts, which a banded Cholesky factor eliminates in time linear in the log's length.

Restricted likelihood (Patterson & Thompson 1971, "Recovery of inter-block information when block sizes are unequal",
Biometrika 58): -2 l_R = log|V| + log|A| + r' V^-1 r - b' A^-1 b, A = J' V^-1 J + prior precision.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import scipy.linalg.lapack
from numpy.typing import NDArray

from sipe_bayes.likelihood.minimise import minimise
from sipe_bayes.likelihood.sequences import Sequence

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_RIDGE = 1e-12  # of a parameter's own precision
_SHORTEST_TAU = 0.1  # of a sample period; below it the noise is white to a part in 10^4


def coefficients(gaps: FloatArray, tau: float | FloatArray) -> FloatArray:
    """Autoregression coefficient of each gap in seconds; 0 for white noise (tau = 0) and infinite gaps."""
    return np.where(np.asarray(tau) > 0, np.exp(-gaps / np.maximum(tau, 1e-300)), 0.0)


@dataclass(frozen=True)
class Noise:
    """Stationary sd (C,) in the channels' units and correlation time tau (C,) in seconds, 0 for white."""

    sd: FloatArray
    tau: FloatArray


def chosen_sd(given: tuple[float | None, ...] | None, channels: list[int], names: tuple[str, ...]) -> FloatArray:
    """Noise sds (C,) of some channels, NaN where none is given; raises ValueError unless there is one for each of ``names``."""
    if given is None:
        return np.full(len(channels), np.nan)
    if len(given) != len(names):
        raise ValueError(
            f"noise_sd: expected one for each of the channels {list(names)}, got {len(given)}; None where unknown"
        )
    return np.array([np.nan if given[c] is None else given[c] for c in channels], float)


def whiten(residual: FloatArray, sequence: Sequence, sd: float, tau: float) -> FloatArray:
    """Whitened residuals (..., n) of one channel's residual (..., W * L)."""
    a = coefficients(sequence.gaps, tau)[sequence.gap]
    before = np.where(sequence.previous >= 0, residual[..., sequence.previous], 0.0)
    return (residual[..., sequence.index] - a * before) / (sd * np.sqrt(1 - a**2))


class Moments:
    """Noise-free products of the rows of a linearisation, per channel and gap.

    residual (W, L, C); jacobian (W, L, C, N + D): derivatives of the prediction by theta and the window's start.
    With x a row and y the row before it, each of the G pairs of channel and gap has the sums x x', x y' + y x' and
    y y' over its samples: ``products`` (3 G, W K K). gaps, owner (its channel) and counts are (G,). white: for white noise
    alone, quickly: one endless gap a channel. Without starts (D = 0) only sums over all windows matter: W is 1 then.
    """

    def __init__(
        self,
        residual: FloatArray,
        jacobian: FloatArray,
        num_theta: int,
        all_sequences: list[Sequence],
        white: bool = False,
    ) -> None:
        windows, length, channels, columns = jacobian.shape
        self.num_theta, self.num_start = num_theta, columns - num_theta
        self.windows = windows if self.num_start else 1
        self.sequences = all_sequences
        if white:
            rows = np.concatenate([jacobian, residual[..., None]], axis=-1).transpose(2, 0, 1, 3)
            rows = rows.reshape(channels, self.windows, -1, columns + 1)
            self.gaps, self.owner = np.full(channels, np.inf), np.arange(channels)
            self.counts = np.array([len(s.index) for s in all_sequences])
            squares = np.zeros((channels, 2, self.windows, 2 * columns + 2, 2 * columns + 2))
            squares[:, 0, :, : columns + 1, : columns + 1] = np.swapaxes(rows, 2, 3) @ rows
            self.products = self._spread(squares).reshape(3 * channels, -1)
            return
        self.gaps = np.concatenate([s.gaps for s in all_sequences])
        self.owner = np.repeat(np.arange(channels), [len(s.gaps) for s in all_sequences])
        self.counts = np.concatenate([np.bincount(s.gap, minlength=len(s.gaps)) for s in all_sequences])
        rows = np.empty((channels, windows * length, columns + 1))
        rows[:, :, :-1] = np.moveaxis(jacobian, 2, 0).reshape(channels, windows * length, columns)
        rows[:, :, -1] = np.moveaxis(residual, 2, 0).reshape(channels, windows * length)
        squares = np.concatenate([self._squares(rows[c], s) for c, s in enumerate(all_sequences)])
        self.products = self._spread(squares).reshape(3 * len(self.gaps), -1)

    def _squares(self, rows: FloatArray, s: Sequence) -> FloatArray:
        """Sums of z z', z = (a row, the row before it), of the samples of each of a channel's gaps, each window and each
        side of a window's edge: (its gaps, 2, W, 2 q, 2 q); rows (W L, q), q = N + D + 1."""
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
        """Products (G, 3, W, K, K) of ``squares`` (G, 2, W, 2 q, 2 q): the row before belongs to the window's own start or,
        across an edge, to the start of the window before."""
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


@dataclass(frozen=True)
class Arrow:
    """Normal equations with the starts eliminated.

    precision (N, N) and gradient (N,) of theta with the starts marginalised (no prior on theta in them);
    log_determinant of the starts' block; explained: b_x' A_xx^-1 b_x; square: r' V^-1 r; start_offset (W, D) and
    start_slope (W, D, N) give the starts' step; factor (2 D, W D): banded Cholesky factor of the starts' block.
    """

    precision: FloatArray
    gradient: FloatArray
    log_determinant: float
    explained: float
    square: float
    start_offset: FloatArray
    start_slope: FloatArray
    factor: FloatArray

    def starts(self, step: FloatArray) -> FloatArray:
        """Best change of the starts (W, D) for a change ``step`` (N,) of theta."""
        return self.start_offset - self.start_slope @ step


def eliminate(
    normal: FloatArray,
    num_theta: int,
    start_precision: FloatArray,
    start_pull: FloatArray,
    damping: float = 0.0,
) -> Arrow:
    """Eliminate the starts from the normal equations.

    normal (W, K, K) as Moments.normal gives; start_precision (D,): weak prior on the starts; start_pull (W, D): its
    gradient; damping: relative Levenberg-Marquardt damping of the starts' block. Without starts normal is (1, K, K).
    """
    windows, width, _ = normal.shape
    n, d = num_theta, (width - 1 - num_theta) // 2
    theta, own, prev, r = slice(0, n), slice(n, n + d), slice(n + d, n + 2 * d), width - 1
    if not d:  # recorded starts
        whole, none = normal[0], np.zeros((len(start_pull), 0))
        slope = np.zeros((len(start_pull), 0, n))
        return Arrow(whole[theta, theta], whole[theta, r], 0.0, 0.0, float(whole[r, r]), none, slope, np.zeros((0, 0)))
    diagonal = normal[:, own, own].copy()
    diagonal[:-1] += normal[1:, prev, prev]
    corner = normal[1:, prev, own]  # couples x_{w-1} (rows) with x_w (columns)
    right = np.empty((windows, d, n + 1))
    right[:, :, :n] = normal[:, own, theta]
    right[:-1, :, :n] += normal[1:, prev, theta]
    right[:, :, n] = normal[:, own, r] + start_pull
    right[:-1, :, n] += normal[1:, prev, r]
    index = np.arange(d)
    diagonal[:, index, index] = diagonal[:, index, index] * (1 + damping) + start_precision
    band = np.zeros((2 * d, windows, d))  # lower form: band[i - j, j] = A[i, j]
    i, j = np.tril_indices(d)
    band[i - j, :, j] = diagonal[:, i, j].T
    i, j = np.indices((d, d)).reshape(2, -1)
    band[d + i - j, :-1, j] = corner[:, j, i].T
    band = band.reshape(2 * d, windows * d)
    factor, failed = scipy.linalg.lapack.dpbtrf(band, lower=1)
    if failed:
        raise np.linalg.LinAlgError("the starts' block is not positive definite")
    solved, _ = scipy.linalg.lapack.dpbtrs(factor, right.reshape(windows * d, n + 1), lower=1)
    flat = right.reshape(windows * d, n + 1)
    reduced = flat.T @ solved
    precision = normal[:, theta, theta].sum(0) - reduced[:n, :n]
    gradient = normal[:, theta, r].sum(0) - reduced[:n, n]
    return Arrow(
        0.5 * (precision + precision.T),
        gradient,
        2 * float(np.log(factor[0]).sum()),
        float(reduced[n, n]),
        float(normal[:, r, r].sum()),
        solved[:, n].reshape(windows, d),
        solved[:, :n].reshape(windows, d, n),
        factor,
    )


def _start_covariance(factor: FloatArray, windows: int) -> tuple[FloatArray, FloatArray]:
    """Blocks (w, w) (W, D, D) and (w, w-1) (W, D, D; the first is zero) of the inverse of the starts' matrix.

    factor (2 D, W D): its banded Cholesky factor. Takahashi's recursion: the inverse is never formed as a whole."""
    d = len(factor) // 2
    band = factor.reshape(2 * d, windows, d)
    lower, below = np.zeros((windows, d, d)), np.zeros((windows, d, d))
    i, j = np.tril_indices(d)
    lower[:, i, j] = band[i - j, :, j].T
    i, j = np.indices((d, d)).reshape(2, -1)
    below[:, i, j] = band[d + i - j, :, j].T
    inverse = np.linalg.inv(lower)
    gain = below @ inverse  # L_{w+1,w} L_w^-1
    gain[-1] = 0.0
    same, apart = np.swapaxes(inverse, 1, 2) @ inverse, np.zeros((windows, d, d))
    for w in range(windows - 2, -1, -1):
        # the factor of what lies below, seen from this block
        apart[w + 1] = -same[w + 1] @ gain[w]
        same[w] -= gain[w].T @ apart[w + 1]
    return same, apart


@dataclass(frozen=True)
class Pulls:
    """What besides the data pulls at the linearisation point.

    prior (N, N) and prior_pull (N,): precision of theta's prior and its negative gradient; start_precision (D,) and
    start_pull (W, D) likewise; free (N,): parameters that may move. One held at a bound against its pull is no
    unknown of the linear model: with it the residuals would be credited with an optimum that is not allowed.
    """

    prior: FloatArray
    prior_pull: FloatArray
    start_precision: FloatArray
    start_pull: FloatArray
    free: NDArray[np.bool_]


def restricted(moments: Moments, noise: Noise, pulls: Pulls) -> float:
    """Restricted log-likelihood of the noise, up to a constant."""
    arrow = eliminate(moments.normal(noise), moments.num_theta, pulls.start_precision, pulls.start_pull)
    return _restricted(moments, noise, pulls, arrow)[0]


def _restricted(moments: Moments, noise: Noise, pulls: Pulls, arrow: Arrow) -> tuple[float, FloatArray, FloatArray]:
    """Restricted log-likelihood; best step (N,) and covariance (N, N) of theta, zero where it may not move."""
    value = moments.log_determinant(noise) + arrow.log_determinant + arrow.square - arrow.explained
    n = moments.num_theta
    move, covariance = np.zeros(n), np.zeros((n, n))
    if pulls.free.any():
        free = np.ix_(pulls.free, pulls.free)
        precision = arrow.precision[free] + pulls.prior[free]
        # what rounding leaves of two parameters that do the same may be negative
        factor = np.linalg.cholesky(precision + _RIDGE * np.diag(np.diag(precision)))
        inverse = np.linalg.inv(factor)
        half = inverse @ (arrow.gradient + pulls.prior_pull)[pulls.free]
        value += 2 * float(np.log(np.diag(factor)).sum()) - float(half @ half)
        move[pulls.free], covariance[free] = inverse.T @ half, inverse.T @ inverse
    return -0.5 * value, move, covariance


def restricted_slopes(moments: Moments, noise: Noise, pulls: Pulls) -> tuple[float, FloatArray, FloatArray]:
    """Restricted log-likelihood and its derivatives (C,) by log sd and by log tau.

    With A the precision of all unknowns u = (theta, starts), v_w = (u_w, -1) and dM_w the change of the products of
    window w, -2 dl = d log|V| + sum_w <A^-1 of that window + v_w v_w', dM_w>."""
    arrow = eliminate(moments.normal(noise), moments.num_theta, pulls.start_precision, pulls.start_pull)
    value, move, covariance = _restricted(moments, noise, pulls, arrow)
    n, d, windows = moments.num_theta, moments.num_start, moments.windows
    size = n + 2 * d
    by_start = np.zeros((windows, size, n))  # how the window's unknowns follow theta
    by_start[:, :n] = np.eye(n)
    v = np.zeros((windows, size + 1))
    v[:, :n], v[:, -1] = move, -1.0
    inner = np.zeros((windows, size + 1, size + 1))
    if d:
        slope, starts = arrow.start_slope, arrow.starts(move)
        by_start[:, n : n + d], by_start[1:, n + d :] = -slope, -slope[:-1]
        v[:, n : n + d], v[1:, n + d : size] = starts, starts[:-1]
        same, apart = _start_covariance(arrow.factor, windows)
        inner[:, n : n + d, n : n + d] += same
        inner[1:, n + d : size, n + d : size] += same[:-1]
        inner[1:, n : n + d, n + d : size] += apart[1:]
        inner[1:, n + d : size, n : n + d] += np.swapaxes(apart[1:], 1, 2)
    inner[:, :size, :size] += by_start @ covariance @ np.swapaxes(by_start, 1, 2)
    inner += v[:, :, None] * v[:, None, :]
    by_sd, by_tau = moments.slopes(noise, inner)
    return value, -0.5 * by_sd, -0.5 * by_tau


def estimate_noise(
    moments: Moments,
    noise: Noise,
    pulls: Pulls,
    fixed_sd: FloatArray,
    coloured: bool,
    shortest: float,
    longest: float,
) -> Noise:
    """Noise that maximises the restricted likelihood, started from ``noise``.

    fixed_sd (C,): given sds, NaN where to be estimated. coloured: whether tau is estimated, from a tenth of
    ``shortest`` to ``longest`` seconds. (log innovation sd, log tau) of all channels are searched, whose information
    is all but diagonal.
    """
    channels, estimated = len(noise.sd), np.isnan(fixed_sd)

    def unpack(x: FloatArray) -> Noise:
        tau = np.exp(x[channels:]) if coloured else np.zeros(channels)
        innovation = 1 - coefficients(np.full(channels, shortest), tau) ** 2 if coloured else np.ones(channels)
        return Noise(np.where(estimated, np.exp(x[:channels]) / np.sqrt(innovation), fixed_sd), tau)

    def loss(x: FloatArray) -> tuple[float, FloatArray]:
        here = unpack(x)
        try:
            value, by_sd, by_tau = restricted_slopes(moments, here, pulls)
        except np.linalg.LinAlgError:
            return 1e12, np.zeros_like(x)
        by_sd = np.where(estimated, by_sd, 0.0)
        slope = by_sd
        if coloured:
            ratio = shortest / here.tau
            a = np.exp(-ratio)
            slope = np.concatenate([by_sd, by_tau + by_sd * a**2 * ratio / (1 - a**2)])
        return (-value, -slope) if np.isfinite(value) and np.isfinite(slope).all() else (1e12, np.zeros_like(x))

    low, high = np.log(_SHORTEST_TAU * shortest), np.log(longest)
    tau = np.clip(np.log(np.maximum(noise.tau, 1e-12)), low, high)
    if coloured and (noise.tau <= 0).all():
        tau = np.clip(np.log(moments.correlation_times()), low, high)
    innovation = 1 - coefficients(np.full(channels, shortest), np.exp(tau)) ** 2 if coloured else np.ones(channels)
    x0 = np.concatenate([np.log(noise.sd * np.sqrt(innovation)), tau if coloured else []])
    free_sd, free_tau = np.full(channels, 12.0), np.tile([[low], [high]], channels if coloured else 0)
    bounds = np.concatenate([[x0[:channels] - free_sd, x0[:channels] + free_sd], free_tau], axis=1)
    counts = np.array([len(s.index) for s in moments.sequences], float)
    ratio = shortest / np.exp(tau)
    information = [2 * counts, counts * ratio**2 / np.maximum(np.expm1(2 * ratio), 1e-300)][: 1 + coloured]
    return unpack(minimise(loss, x0, bounds, np.concatenate(information)))
