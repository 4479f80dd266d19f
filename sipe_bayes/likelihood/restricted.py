"""Restricted likelihood of the windows' noise, the normal equations with the starts marginalised, the sandwich.

The normal equations of (theta, starts) are dense in theta and block-tridiagonal in the starts, as a window's first
sample is whitened with the last of the window before (``likelihood.block_tridiagonal``).

Restricted likelihood (Patterson & Thompson 1971, "Recovery of inter-block information when block sizes are unequal",
Biometrika 58): -2 l_R = log|V| + log|A| + r' V^-1 r - b' A^-1 b, A = J' V^-1 J + prior precision.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_banded
from scipy.optimize import minimize

from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray
from sipe_bayes.likelihood.block_tridiagonal import Border, Eliminated, eliminate
from sipe_bayes.likelihood.moments import Moments
from sipe_bayes.likelihood.noise import Noise
from sipe_bayes.likelihood.sequences import Sequence, coefficients


@dataclass(frozen=True)
class Pulls:
    """What besides the data pulls at the linearisation point.

    Args:
        prior: (N, N), precision of theta's prior.
        prior_pull: (N,), its negative gradient.
        start_precision: (D,), of the starts' prior.
        start_pull: (W, D), its negative gradient.
        free: (N,), parameters that may move. One held at a bound against its pull is no unknown of the linear model:
            with it the residuals would be credited with an optimum that is not allowed.
    """

    prior: FloatArray
    prior_pull: FloatArray
    start_precision: FloatArray
    start_pull: FloatArray
    free: BoolArray


def eliminate_starts(
    normal: FloatArray,
    num_theta: int,
    start_precision: FloatArray,
    start_pull: FloatArray,
    damping: float | FloatArray = 0.0,
) -> Eliminated:
    """Normal equations of theta with the windows' starts marginalised.

    Args:
        normal: products (W, K, K) as ``Moments.normal`` gives them; (1, K, K) without starts.
        num_theta: N.
        start_precision: (D,) of the starts' weak prior.
        start_pull: its negative gradient (W, D).
        damping: Levenberg and Marquardt's, relative, of the starts' block; of each window's (W, 1).

    Raises:
        numpy.linalg.LinAlgError: where the starts' block is not positive definite.
    """
    width = normal.shape[1]
    n, d = num_theta, (width - 1 - num_theta) // 2
    theta, own, prev, r = slice(0, n), slice(n, n + d), slice(n + d, n + 2 * d), width - 1
    precision, gradient = normal[:, theta, theta].sum(0), normal[:, theta, r].sum(0)
    if not d:  # recorded starts
        none = np.zeros((len(start_pull), 0, n))
        return eliminate(none, none, none, start_pull[:, :0], precision, gradient)
    # a window's start is in its own rows, and in the first ones of the next window
    diagonal, force = normal[:, own, own].copy(), normal[:, own, r] + start_pull
    diagonal[:-1] += normal[1:, prev, prev]
    force[:-1] += normal[1:, prev, r]
    coupling = normal[:, own, theta].copy()
    coupling[:-1] += normal[1:, prev, theta]
    index = np.arange(d)
    diagonal[:, index, index] = diagonal[:, index, index] * (1 + damping) + start_precision
    below = np.swapaxes(normal[1:, prev, own], 1, 2)
    return eliminate(diagonal, below, coupling, force, precision, gradient)


def marginal(
    moments: Moments, noise: Noise, starts: FloatArray, precision: FloatArray
) -> tuple[float, FloatArray, float]:
    """Log-likelihood of residuals with the windows' starts integrated out, theta as it is.

    ``moments`` are of the residuals at ``starts`` (W, D) and their Jacobian by the starts alone, ``precision`` (D,)
    of the starts' prior. Returns the value up to a constant, the change (W, D) of the starts that fits best, and nats
    that it promises.
    """
    normal = moments.normal(noise)
    solved = eliminate_starts(normal, 0, precision, -precision * starts)
    pull, square = float((starts**2 @ precision).sum()), float(normal[:, -1, -1].sum())
    total = moments.log_determinant(noise) + solved.log_determinant + square - solved.explained + pull
    return -0.5 * total, solved.shift, 0.5 * solved.explained


def restricted(moments: Moments, noise: Noise, pulls: Pulls) -> tuple[float, FloatArray, FloatArray, Eliminated]:
    """Restricted log-likelihood of the noise, up to a constant, and what it is made of.

    Returns:
        The value; best step (N,) and covariance (N, N) of theta, zero where it may not move; the starts eliminated.
    """
    normal = moments.normal(noise)
    solved = eliminate_starts(normal, moments.num_theta, pulls.start_precision, pulls.start_pull)
    move, covariance, determinant = Border(pulls.prior, pulls.prior_pull, pulls.free).solve(solved)
    value = moments.log_determinant(noise) + solved.log_determinant + determinant + float(normal[:, -1, -1].sum())
    gained = solved.explained + float((solved.gradient + pulls.prior_pull) @ move)
    return -0.5 * (value - gained), move, covariance, solved


def restricted_slopes(moments: Moments, noise: Noise, pulls: Pulls) -> tuple[float, FloatArray, FloatArray]:
    """Restricted log-likelihood up to a constant, and its derivatives (C,) by log sd and by log tau.

    With A the precision of all unknowns u = (theta, starts), v_w = (u_w, -1) and dM_w the change of the products of
    window w, -2 dl = d log|V| + sum_w <A^-1 of that window + v_w v_w', dM_w>.
    """
    value, move, covariance, solved = restricted(moments, noise, pulls)
    n, d, windows = moments.num_theta, moments.num_start, moments.windows
    size = n + 2 * d
    by_start = np.zeros((windows, size, n))  # how the window's unknowns follow theta
    by_start[:, :n] = np.eye(n)
    v = np.zeros((windows, size + 1))
    v[:, :n], v[:, -1] = move, -1.0
    inner = np.zeros((windows, size + 1, size + 1))
    if d:
        slope = solved.slope
        starts = solved.blocks(move)
        by_start[:, n : n + d], by_start[1:, n + d :] = -slope, -slope[:-1]
        v[:, n : n + d], v[1:, n + d : size] = starts, starts[:-1]
        same, apart = solved.covariances()
        inner[:, n : n + d, n : n + d] += same
        inner[1:, n + d : size, n + d : size] += same[:-1]
        inner[1:, n : n + d, n + d : size] += apart
        inner[1:, n + d : size, n : n + d] += np.swapaxes(apart, 1, 2)
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
    scales: IntArray | None = None,
) -> Noise:
    """Noise that maximises the restricted likelihood, by SciPy's SLSQP, to a ten thousandth of a nat.

    (log innovation sd, log tau) of all scales are searched, whose information is all but diagonal.

    Args:
        moments: of the linearisation.
        noise: where to begin.
        pulls: what holds theta and the starts besides the data.
        fixed_sd: (C,), given sds, NaN where to be estimated.
        coloured: whether tau is estimated.
        shortest: seconds, of which tau is a tenth at least.
        longest: seconds, which tau is at most.
        scales: (C,), which of G noise scales each channel has; default one each.
    """
    channels, estimated = len(noise.sd), np.isnan(fixed_sd)
    scales = np.arange(channels) if scales is None else scales
    first = np.unique(scales, return_index=True)[1]
    groups = len(first)

    def unpack(x: FloatArray) -> Noise:
        tau = np.exp(x[groups:][scales]) if coloured else np.zeros(channels)
        innovation = 1 - coefficients(np.full(channels, shortest), tau) ** 2 if coloured else np.ones(channels)
        return Noise(np.where(estimated, np.exp(x[:groups][scales]) / np.sqrt(innovation), fixed_sd), tau)

    def summed(values: FloatArray) -> FloatArray:
        return np.asarray(np.bincount(scales, values), float)

    def loss(x: FloatArray) -> tuple[float, FloatArray]:
        tried = unpack(x)
        try:
            value, by_sd, by_tau = restricted_slopes(moments, tried, pulls)
        except np.linalg.LinAlgError:
            return 1e12, np.zeros_like(x)
        by_sd = np.where(estimated, by_sd, 0.0)
        slope = summed(by_sd)
        if coloured:
            ratio = shortest / tried.tau
            a = np.exp(-ratio)
            slope = np.concatenate([slope, summed(by_tau + by_sd * a**2 * ratio / (1 - a**2))])
        return (-value, -slope) if np.isfinite(value) and np.isfinite(slope).all() else (1e12, np.zeros_like(x))

    # with tau a tenth of a sample period the noise is white to a part in 10^4
    low, high = np.log(0.1 * shortest), np.log(longest)
    tau = np.clip(np.log(np.maximum(noise.tau, 1e-12)), low, high)
    if coloured and (noise.tau <= 0).all():
        tau = np.clip(np.log(moments.correlation_times()), low, high)
    innovation = 1 - coefficients(np.full(channels, shortest), np.exp(tau)) ** 2 if coloured else np.ones(channels)
    x0 = np.concatenate([np.log(noise.sd * np.sqrt(innovation))[first], tau[first] if coloured else []])
    free_tau = np.tile([[low], [high]], groups if coloured else 0)
    bounds = np.concatenate([[x0[:groups] - 12.0, x0[:groups] + 12.0], free_tau], axis=1)
    counts = np.array([len(s.index) for s in moments.sequences], float)
    ratio = shortest / np.exp(tau)
    information = [2 * counts, counts * ratio**2 / np.maximum(np.expm1(2 * ratio), 1e-300)][: 1 + coloured]
    unit = np.maximum(np.concatenate([summed(part) for part in information]), 1.0) ** -0.5  # an identity then

    def scaled(y: FloatArray) -> tuple[float, FloatArray]:
        value, slope = loss(y * unit)
        return value, slope * unit

    best = minimize(
        scaled, x0 / unit, jac=True, method="SLSQP", bounds=(bounds / unit).T, options={"ftol": 1e-4, "maxiter": 100}
    )
    return unpack(best.x * unit if best.fun <= loss(x0)[0] else x0)  # it accepts a step that does not gain


def noise_cloud(
    moments: Moments, noise: Noise, pulls: Pulls, free: IntArray, longest: float
) -> list[tuple[float, Noise]]:
    """Weighted points that stand for the uncertainty of the noise; the weights sum to one.

    Two along each principal axis of its covariance, at sqrt(dimensions) sds, weighted by the restricted likelihood
    against its normal approximation. Sds are held between .01 and 1: what is better known than a percent, or less than
    a factor e. It widens intervals by 5 % where noise is slow (``pendulum_coverage``, rho .99).

    free: (F,), unknown entries of (log sd (C), log tau (C)). longest: seconds of a correlation time at most.
    """
    if not len(free):
        return [(1.0, noise)]
    centre, d, h = np.log(np.maximum(np.concatenate([noise.sd, noise.tau]), 1e-300)), len(free), 1e-3

    def moved(x: FloatArray, most: float = np.inf) -> Noise:
        logs = centre.copy()
        logs[free] += x
        sd, tau = np.exp(logs.reshape(2, -1))
        return Noise(sd, np.where(noise.tau > 0, np.minimum(tau, most), 0.0))  # white channels stay white

    def slopes(x: FloatArray) -> FloatArray:
        _, by_sd, by_tau = restricted_slopes(moments, moved(x), pulls)
        return np.concatenate([by_sd, by_tau])[free]

    here = slopes(np.zeros(d))
    curvature = np.array([(here - slopes(step)) / h for step in h * np.eye(d)])
    eigenvalues, axes = np.linalg.eigh(0.5 * (curvature + curvature.T))
    along = axes.T * np.sqrt(d / np.clip(eigenvalues, 1.0, 1e4))[:, None]
    points = [moved(x, longest) for x in np.concatenate([along, -along])]
    surplus = np.array([restricted(moments, one, pulls)[0] for one in points]) + d / 2
    weights = np.exp(np.clip(surplus - restricted(moments, noise, pulls)[0], -2.0, 2.0))
    return list(zip((weights / weights.sum()).tolist(), points, strict=True))


def sandwich(
    jacobian: FloatArray, slope: FloatArray, white: FloatArray, all_sequences: list[Sequence], noise: Noise
) -> FloatArray:
    """The middle of the sandwich covariance H^-1 M H^-1 of plain least squares under coloured noise.

    P. Huber 1967, "The behavior of maximum likelihood estimates under nonstandard conditions", Berkeley Symposium 5.

    Args:
        jacobian: (W, L, C, N + D).
        slope: (W, D, N), how the starts answer to theta.
        white: (C,), sds by which least squares weighs the channels.
        all_sequences: of the C channels.
        noise: what the residuals really look like.

    Returns:
        M (N, N), the sum of X' V X over channels, of rows X and the residual covariance V = (W' W)^-1 of the bidiagonal
        whitening matrix W: Z' Z with W' Z = X.
    """
    n = slope.shape[2]
    projected = jacobian[..., :n] - np.einsum("wlcd,wdn->wlcn", jacobian[..., n:], slope)
    flat, middle = projected.reshape(-1, projected.shape[2], n), np.zeros((n, n))
    for c, sequence in enumerate(all_sequences):
        a = coefficients(sequence.gaps, float(noise.tau[c]))[sequence.gap]
        scale = float(noise.sd[c]) * np.sqrt(1 - a**2)
        above = np.append(0.0, -a[1:] / scale[1:]) if len(a) else a
        z = solve_banded((0, 1), np.stack([above, 1 / scale]), flat[sequence.index, c] / white[c] ** 2)
        middle += z.T @ z
    return middle
