"""How uncertain an estimate of the noise is, and what that leaves uncertain in theta: weighted values, the sandwich."""

from __future__ import annotations

import numpy as np
from scipy.linalg import solve_banded

from sipe_bayes.core.arrays import FloatArray, IntArray
from sipe_bayes.likelihood.moments import Moments
from sipe_bayes.likelihood.noise import Noise, coefficients
from sipe_bayes.likelihood.restricted import Pulls, restricted, restricted_slopes
from sipe_bayes.likelihood.sequences import Sequence


def noise_covariance(moments: Moments, noise: Noise, pulls: Pulls, free: IntArray) -> FloatArray:
    """Inverse curvature (F, F) of the restricted likelihood by the ``free`` (F,) of (log sd (C), log tau (C)).

    Sds are held between 0.01 and 1: what is better known than a percent, or less than a factor e.
    """
    centre = np.log(np.maximum(np.concatenate([noise.sd, noise.tau]), 1e-300))

    def slopes(x: FloatArray) -> FloatArray:
        logs = centre.copy()
        logs[free] += x
        _, by_sd, by_tau = restricted_slopes(moments, _from_logs(logs, noise), pulls)
        return np.concatenate([by_sd, by_tau])[free]

    h, here = 1e-3, slopes(np.zeros(len(free)))  # of a logarithm
    curvature = np.array([(here - slopes(step)) / h for step in h * np.eye(len(free))])
    eigenvalues, axes = np.linalg.eigh(0.5 * (curvature + curvature.T))
    return (axes / np.clip(eigenvalues, 1.0, 1e4)) @ axes.T


def _from_logs(logs: FloatArray, like: Noise) -> Noise:
    """Noise of (log sd, log tau); channels that are white in ``like`` stay white."""
    channels = len(like.sd)
    return Noise(np.exp(logs[:channels]), np.where(like.tau > 0, np.exp(logs[channels:]), 0.0))


def noise_cloud(
    moments: Moments, noise: Noise, pulls: Pulls, free: IntArray, longest: float
) -> list[tuple[float, Noise]]:
    """Weighted points that stand for the uncertainty of the noise; the weights sum to one.

    Two along each principal axis of its covariance, at sqrt(dimensions) sds, weighted by the restricted likelihood
    against its normal approximation. free (F,): entries of (log sd (C), log tau (C)) that are unknown; longest: seconds
    of a correlation time at most.
    """
    if not len(free):
        return [(1.0, noise)]
    covariance, d = noise_covariance(moments, noise, pulls, free), len(free)
    eigenvalues, axes = np.linalg.eigh(covariance)
    best = restricted(moments, noise, pulls)[0]
    centre = np.log(np.maximum(np.concatenate([noise.sd, noise.tau]), 1e-300))
    points, along = [], axes.T * np.sqrt(d * eigenvalues)[:, None]
    for direction in np.concatenate([along, -along]):
        logs = centre.copy()
        logs[free] += direction
        logs[len(noise.sd) :] = np.minimum(logs[len(noise.sd) :], np.log(longest))
        point = _from_logs(logs, noise)
        surplus = restricted(moments, point, pulls)[0] - best + d / 2
        points.append((float(np.exp(np.clip(surplus, -2.0, 2.0))), point))
    total = sum(w for w, _ in points)
    return [(w / total, point) for w, point in points]


def coloured_square(rows: FloatArray, sequence: Sequence, sd: float, tau: float) -> FloatArray:
    """X' V X (N, N) of the rows X (n, N) of one channel, V its residual covariance.

    With V = (W' W)^-1 and W the bidiagonal whitening matrix this is Z' Z, W' Z = X.
    """
    a = coefficients(sequence.gaps, tau)[sequence.gap]
    scale = sd * np.sqrt(1 - a**2)
    z = solve_banded((0, 1), np.stack([-a / scale, 1 / scale]), rows)
    return np.asarray(z.T @ z)


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
        M (N, N).
    """
    n = slope.shape[2]
    projected = jacobian[..., :n] - np.einsum("wlcd,wdn->wlcn", jacobian[..., n:], slope)
    flat = projected.reshape(-1, projected.shape[2], n)
    return sum(  # type: ignore[return-value]
        coloured_square(flat[s.index, c] / white[c] ** 2, s, float(noise.sd[c]), float(noise.tau[c]))
        for c, s in enumerate(all_sequences)
    )
