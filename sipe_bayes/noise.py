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

from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.optimize
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_LONGEST_GAP = 20  # samples; after a longer gap a new sequence begins
_RESTARTS, _GAIN = 5, 1e-3  # of the search for the noise; nats
_SHORTEST_TAU = 0.1  # of a sample period; below it the noise is white to a part in 10^4


@dataclass(frozen=True)
class Sequence:
    """The observed samples of one channel in order of time: rows of the flattened (W * L) samples.

    index (n,), previous (n,; -1 begins a sequence), window (n,), gap (n,) an index into ``gaps`` seconds
    (ascending; inf where a sequence begins).
    """

    index: IntArray
    previous: IntArray
    window: IntArray
    crosses: NDArray[np.bool_]
    gap: IntArray
    gaps: FloatArray


def sequences(observed: NDArray[np.bool_], sample: IntArray, log: IntArray, dt: FloatArray) -> list[Sequence]:
    """One Sequence per channel. observed (W, L, C): samples that count; sample (W, L): their number within the log;
    log (W,): the log of each window; dt (W,): seconds per sample."""
    windows, length, channels = observed.shape
    found = []
    for c in range(channels):
        index = np.flatnonzero(observed[:, :, c].ravel())
        window, number = index // length, sample.ravel()[index]
        steps = np.diff(number, prepend=0)
        linked = np.zeros(len(index), bool)
        if len(index) > 1:
            linked[1:] = (
                (log[window[1:]] == log[window[:-1]]) & (np.diff(window) <= 1) & (steps[1:] <= _LONGEST_GAP)
            )
        previous = np.where(linked, np.concatenate([[-1], index[:-1]])[: len(index)], -1)
        seconds = np.where(linked, steps * dt[window], np.inf)
        gaps, gap = np.unique(np.round(seconds, 12), return_inverse=True)
        crosses = linked & (window != np.concatenate([[-1], window[:-1]])[: len(index)])
        found.append(Sequence(index, previous, window, crosses, gap, gaps))
    return found


def coefficients(gaps: FloatArray, tau: float | FloatArray) -> FloatArray:
    """Autoregression coefficient of each gap in seconds; 0 for white noise (tau = 0) and infinite gaps."""
    return np.where(np.asarray(tau) > 0, np.exp(-gaps / np.maximum(tau, 1e-300)), 0.0)


@dataclass(frozen=True)
class Noise:
    """Stationary sd (C,) in the channels' units and correlation time tau (C,) in seconds, 0 for white."""

    sd: FloatArray
    tau: FloatArray


def whiten(residual: FloatArray, sequence: Sequence, sd: float, tau: float) -> FloatArray:
    """Whitened residuals (..., n) of one channel's residual (..., W * L)."""
    a = coefficients(sequence.gaps, tau)[sequence.gap]
    before = np.where(sequence.previous >= 0, residual[..., sequence.previous], 0.0)
    return (residual[..., sequence.index] - a * before) / (sd * np.sqrt(1 - a**2))


def log_determinant(all_sequences: list[Sequence], noise: Noise) -> float:
    """log|V| of the residual covariance."""
    total = 0.0
    for c, s in enumerate(all_sequences):
        a = coefficients(s.gaps, float(noise.tau[c]))
        counts = np.bincount(s.gap, minlength=len(s.gaps))
        total += float(counts @ np.log(noise.sd[c] ** 2 * (1 - a**2)))
    return total


class Moments:
    """Noise-free products of the rows of a linearisation, per channel and gap.

    residual (W, L, C); jacobian (W, L, C, N + D): derivatives of the prediction by theta and the window's start.
    """

    def __init__(
        self, residual: FloatArray, jacobian: FloatArray, num_theta: int, all_sequences: list[Sequence]
    ) -> None:
        windows, length, _channels, columns = jacobian.shape
        self.num_theta, self.num_start, self.windows = num_theta, columns - num_theta, windows
        self.sequences = all_sequences
        width = num_theta + 2 * self.num_start + 1
        own = slice(num_theta, num_theta + self.num_start)
        prev = slice(num_theta + self.num_start, width - 1)
        self.blocks: list[list[tuple[FloatArray, FloatArray, FloatArray]]] = []
        flat_r = residual.reshape(windows * length, -1)
        flat_j = jacobian.reshape(windows * length, -1, columns)
        for c, s in enumerate(all_sequences):
            rows = np.zeros((len(s.index), width))
            rows[:, :num_theta], rows[:, own], rows[:, -1] = (
                flat_j[s.index, c, :num_theta],
                flat_j[s.index, c, num_theta:],
                flat_r[s.index, c],
            )
            lagged = np.zeros_like(rows)
            has = s.previous >= 0
            before = s.previous[has]
            lagged[has, :num_theta], lagged[has, -1] = flat_j[before, c, :num_theta], flat_r[before, c]
            same = has & ~s.crosses
            lagged[same, own] = flat_j[s.previous[same], c, num_theta:]
            lagged[s.crosses, prev] = flat_j[s.previous[s.crosses], c, num_theta:]
            self.blocks.append([self._products(rows, lagged, s, g) for g in range(len(s.gaps))])

    def _products(self, rows: FloatArray, lagged: FloatArray, s: Sequence, g: int) -> tuple[FloatArray, ...]:
        """Sums over the samples with gap g of x x', x y' + y x', y y' per window; x a row, y the row before."""
        chosen = np.flatnonzero(s.gap == g)
        bounds = np.searchsorted(s.window[chosen], np.arange(self.windows + 1))
        width = rows.shape[1]
        out = np.zeros((3, self.windows, width, width))
        for w in range(self.windows):
            part = chosen[bounds[w] : bounds[w + 1]]
            if len(part):
                x, y = rows[part], lagged[part]
                cross = x.T @ y
                out[0, w], out[1, w], out[2, w] = x.T @ x, cross + cross.T, y.T @ y
        return out[0], out[1], out[2]

    def normal(self, noise: Noise) -> FloatArray:
        """Whitened products (W, K, K), K = N + 2 D + 1, summed over channels."""
        total = 0.0
        for c, s in enumerate(self.sequences):
            a = coefficients(s.gaps, float(noise.tau[c]))
            for g, (xx, xy, yy) in enumerate(self.blocks[c]):
                total = total + (xx - a[g] * xy + a[g] ** 2 * yy) / (noise.sd[c] ** 2 * (1 - a[g] ** 2))
        return np.asarray(total)


@dataclass(frozen=True)
class Arrow:
    """Normal equations with the starts eliminated.

    precision (N, N) and gradient (N,) of theta with the starts marginalised (no prior on theta in them);
    log_determinant of the starts' block; explained: b_x' A_xx^-1 b_x; square: r' V^-1 r; solve gives the starts' step.
    """

    precision: FloatArray
    gradient: FloatArray
    log_determinant: float
    explained: float
    square: float
    start_offset: FloatArray
    start_slope: FloatArray

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
    gradient; damping: relative Levenberg-Marquardt damping of the starts' block.
    """
    windows, width, _ = normal.shape
    n, d = num_theta, (width - 1 - num_theta) // 2
    theta, own, prev, r = slice(0, n), slice(n, n + d), slice(n + d, n + 2 * d), width - 1
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
    band = np.zeros((2 * d, windows * d))  # lower form: band[i - j, j] = A[i, j]
    for i in range(d):
        for j in range(i + 1):
            band[i - j, j::d] = diagonal[:, i, j]
        for j in range(d):
            band[d + i - j, j : (windows - 1) * d : d] = corner[:, j, i]
    factor = scipy.linalg.cholesky_banded(band, lower=True, check_finite=False)
    solved = scipy.linalg.cho_solve_banded(
        (factor, True), right.reshape(windows * d, n + 1), check_finite=False
    )
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
    )


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
    value = log_determinant(moments.sequences, noise) + arrow.log_determinant + arrow.square - arrow.explained
    if pulls.free.any():
        free = np.ix_(pulls.free, pulls.free)
        factor = np.linalg.cholesky(arrow.precision[free] + pulls.prior[free])
        pull = (arrow.gradient + pulls.prior_pull)[pulls.free]
        half = scipy.linalg.solve_triangular(factor, pull, lower=True)
        value += 2 * float(np.log(np.diag(factor)).sum()) - float(half @ half)
    return -0.5 * value


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
    ``shortest`` to ``longest`` seconds. (log innovation sd, log tau) of all channels are searched by L-BFGS.
    """
    channels, estimated = len(noise.sd), np.isnan(fixed_sd)

    def unpack(x: FloatArray) -> Noise:
        tau = np.exp(x[channels:]) if coloured else np.zeros(channels)
        innovation = (
            1 - coefficients(np.full(channels, shortest), tau) ** 2 if coloured else np.ones(channels)
        )
        return Noise(np.where(estimated, np.exp(x[:channels]) / np.sqrt(innovation), fixed_sd), tau)

    def loss(x: FloatArray) -> float:
        try:
            value = -restricted(moments, unpack(x), pulls)
        except np.linalg.LinAlgError:
            return 1e12
        return value if np.isfinite(value) else 1e12

    low, high = np.log(_SHORTEST_TAU * shortest), np.log(longest)
    tau = np.clip(np.log(np.maximum(noise.tau, 1e-12)), low, high)
    if coloured and (noise.tau <= 0).all():
        tau = np.full(channels, np.clip(np.log(10 * shortest), low, high))
    innovation = (
        1 - coefficients(np.full(channels, shortest), np.exp(tau)) ** 2 if coloured else np.ones(channels)
    )
    x0 = np.concatenate([np.log(noise.sd * np.sqrt(innovation)), tau if coloured else []])
    bounds = [(x - 12, x + 12) for x in x0[:channels]] + [(low, high)] * (channels if coloured else 0)
    x, value = x0, loss(x0)
    for _ in range(_RESTARTS):  # L-BFGS may stop early with a large gradient; from its own result it goes on
        result = scipy.optimize.minimize(loss, x, method="L-BFGS-B", bounds=bounds, options={"eps": 1e-4})
        gain, x, value = value - result.fun, result.x, result.fun
        if gain < _GAIN:
            break
    return unpack(x)


def noise_covariance(moments: Moments, noise: Noise, pulls: Pulls, free: IntArray) -> FloatArray:
    """Covariance of the ``free`` entries of (log sd (C), log tau (C)): inverse curvature of the restricted likelihood
    at ``noise``, sds held between 0.01 and 1."""
    centre = np.log(np.maximum(np.concatenate([noise.sd, noise.tau]), 1e-300))

    def value(x: FloatArray) -> float:
        logs = centre.copy()
        logs[free] += x
        return restricted(moments, _from_logs(logs, noise), pulls)

    unit, h = np.eye(len(free)), 0.05
    curvature = np.empty((len(free), len(free)))
    for i, a in enumerate(unit):
        for j, b in enumerate(unit):
            corners = value(h * (a + b)) - value(h * (a - b)) - value(h * (b - a)) + value(-h * (a + b))
            curvature[i, j] = -corners / (4 * h**2)
    eigenvalues, axes = np.linalg.eigh(0.5 * (curvature + curvature.T))
    return (axes / np.clip(eigenvalues, 1.0, 1e4)) @ axes.T


def _from_logs(logs: FloatArray, like: Noise) -> Noise:
    """Noise of (log sd, log tau); channels that are white in ``like`` stay white."""
    channels = len(like.sd)
    return Noise(np.exp(logs[:channels]), np.where(like.tau > 0, np.exp(logs[channels:]), 0.0))


def noise_cloud(
    moments: Moments, noise: Noise, pulls: Pulls, free: IntArray, longest: float
) -> list[tuple[float, Noise]]:
    """Weighted points that stand for the uncertainty of the noise: two along each principal axis of its covariance, at
    sqrt(dimensions) sds, weighted by the restricted likelihood against its normal approximation."""
    if not len(free):
        return [(1.0, noise)]
    covariance, d = noise_covariance(moments, noise, pulls, free), len(free)
    eigenvalues, axes = np.linalg.eigh(covariance)
    best = restricted(moments, noise, pulls)
    centre = np.log(np.maximum(np.concatenate([noise.sd, noise.tau]), 1e-300))
    points = []
    for direction in np.concatenate(
        [axes.T * np.sqrt(d * eigenvalues)[:, None], -axes.T * np.sqrt(d * eigenvalues)[:, None]]
    ):
        logs = centre.copy()
        logs[free] += direction
        logs[len(noise.sd) :] = np.minimum(logs[len(noise.sd) :], np.log(longest))
        point = _from_logs(logs, noise)
        surplus = restricted(moments, point, pulls) - best + d / 2
        points.append((float(np.exp(np.clip(surplus, -2.0, 2.0))), point))
    total = sum(w for w, _ in points)
    return [(w / total, point) for w, point in points]


def coloured_square(rows: FloatArray, sequence: Sequence, sd: float, tau: float) -> FloatArray:
    """X' V X (N, N) of the rows X (n, N) of one channel, V its residual covariance.

    With V = (W' W)^-1 and W the bidiagonal whitening matrix this is Z' Z, W' Z = X, one backward recursion."""
    a = coefficients(sequence.gaps, tau)[sequence.gap]
    scale = sd * np.sqrt(1 - a**2)
    z = np.empty_like(rows)
    carried = np.zeros(rows.shape[1])
    for i in range(len(rows) - 1, -1, -1):
        z[i] = scale[i] * (rows[i] + carried)
        carried = a[i] / scale[i] * z[i]
    return z.T @ z


def sandwich(
    jacobian: FloatArray, slope: FloatArray, white: FloatArray, all_sequences: list[Sequence], noise: Noise
) -> FloatArray:
    """The middle (N, N) of the sandwich covariance H^-1 M H^-1 of plain least squares under coloured noise.

    jacobian (W, L, C, N + D); slope (W, D, N): how the starts answer to theta; white (C,): the sds by which least squares
    weighs the channels; noise: what the residuals really look like. (Huber 1967, "The behavior of maximum likelihood
    estimates under nonstandard conditions", Berkeley Symposium 5.)"""
    n = slope.shape[2]
    projected = jacobian[..., :n] - np.einsum("wlcd,wdn->wlcn", jacobian[..., n:], slope)
    flat = projected.reshape(-1, projected.shape[2], n)
    return sum(  # type: ignore[return-value]
        coloured_square(flat[s.index, c] / white[c] ** 2, s, float(noise.sd[c]), float(noise.tau[c]))
        for c, s in enumerate(all_sequences)
    )


class Marginal:
    """Log-likelihood of residuals with the starts integrated out, for many residuals and noises at once.

    jacobian (W, L, C, D) of the prediction by the window's start, taken as constant; precision (D,) of the starts' prior.
    """

    def __init__(self, all_sequences: list[Sequence], jacobian: FloatArray, precision: FloatArray) -> None:
        self.sequences, self.precision = all_sequences, precision
        self.windows, self.length, _, self.num_start = jacobian.shape
        empty = np.zeros(jacobian.shape[:3])
        self.moments = Moments(empty, jacobian, 0, all_sequences)
        flat = jacobian.reshape(self.windows * self.length, -1, self.num_start)
        self.rows = [flat[s.index, c] for c, s in enumerate(all_sequences)]
        self.before = [
            np.where((s.previous >= 0)[:, None], flat[s.previous, c], 0.0)
            for c, s in enumerate(all_sequences)
        ]
        self.edges = [np.searchsorted(s.window, np.arange(self.windows)) for s in all_sequences]

    def __call__(
        self, residual: FloatArray, starts: FloatArray, sd: FloatArray, tau: FloatArray
    ) -> FloatArray:
        """(B,) for residuals (B, W, L, C) at starts (B, W, D) with sd and tau (B, C)."""
        values = np.empty(len(residual))
        for b in range(len(residual)):
            noise = Noise(sd[b], tau[b])
            arrow, square = self._eliminate(residual[b], starts[b], noise)
            pull = float((starts[b] ** 2 @ self.precision).sum())
            total = (
                log_determinant(self.sequences, noise)
                + arrow.log_determinant
                + square
                - arrow.explained
                + pull
            )
            values[b] = -0.5 * total
        return values

    def best(self, residual: FloatArray, starts: FloatArray, noise: Noise) -> FloatArray:
        """The change (W, D) of the starts that minimises the squares, for a residual (W, L, C)."""
        return self._eliminate(residual, starts, noise)[0].start_offset

    def _eliminate(self, residual: FloatArray, starts: FloatArray, noise: Noise) -> tuple[Arrow, float]:
        d, flat = self.num_start, residual.reshape(self.windows * self.length, -1)
        normal, square = self.moments.normal(noise), 0.0
        for c, s in enumerate(self.sequences):
            white = whiten(flat[:, c], s, float(noise.sd[c]), float(noise.tau[c]))
            square += float(white @ white)
            a = coefficients(s.gaps, float(noise.tau[c]))[s.gap]
            scaled = white / (noise.sd[c] * np.sqrt(1 - a**2))
            own = self.rows[c] * scaled[:, None]
            lagged = self.before[c] * (-a * scaled)[:, None]
            right = own + np.where(s.crosses[:, None], 0.0, lagged)
            normal[:, :d, -1] += _window_sums(right, self.edges[c], s.window, self.windows)
            crossing = np.where(s.crosses[:, None], lagged, 0.0)
            normal[:, d : 2 * d, -1] += _window_sums(crossing, self.edges[c], s.window, self.windows)
        return eliminate(normal, 0, self.precision, -self.precision * starts), square


def _window_sums(rows: FloatArray, edges: IntArray, window: IntArray, windows: int) -> FloatArray:
    """Sums (W, D) of rows (n, D) over the samples of each window; windows without samples give zero."""
    sums = np.add.reduceat(np.concatenate([rows, np.zeros((1, rows.shape[1]))]), edges, axis=0)
    sums[np.bincount(window, minlength=windows) == 0] = 0.0
    return sums
