r"""Two scores of a fitted structure: its evidence, and how well it foretells pieces of the logs that it has not seen.

Both come from one linearisation at the optimum, with the same coloured noise and the windows' starts marginalised, of
windows that are compared from the same samples on in all structures, as late as the latest sensor asks. With
H the information of theta (starts eliminated) plus the prior's, m the normal's mean and the cube as the prior's
support,

.. math::

    \log p(y) = \log L(\hat\theta) + \tfrac12 g^\top H^{-1} g - \tfrac12 \log|H| + \tfrac N2 \log 2\pi
        + \log P_{\mathcal N(m, H^{-1})}([0, 1]^N) - \log \int_{[0, 1]^N} e^{-E_{prior}} .

The log score of held-out pieces is the sum over pieces k of log p(y_k | y without k) = log p(y) - log p(y without k): a
log each, or a fifth of the windows of a single log. It is what cross-validation by refitting gives where the model is
linear around its optimum.

Deviations:

- The noise is that of the fit to all pieces.
- Across a piece's edge the first sample behind it is still whitened with the last one of the piece.
- Directions that the data leave open get the flat normal of ``likelihood.quadratic_prior``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sipe_bayes.core.arrays import BoolArray, FloatArray
from sipe_bayes.likelihood import FLAT_PRECISION, BoundLikelihood, Noise, QuadraticPrior
from sipe_bayes.posterior.truncated_normal import TruncatedNormal

_PIECES = 5  # of a single log


@dataclass(frozen=True)
class Scores:
    """Of one structure, in nats.

    Args:
        evidence: log p(y).
        held_out: log score of held-out pieces; None where the logs are one window.
    """

    evidence: float
    held_out: float | None


def scores(
    windows: BoundLikelihood, theta: FloatArray, starts: FloatArray, noise: Noise, prior: QuadraticPrior
) -> Scores:
    """Both scores of an optimum; costs a linearisation.

    Args:
        windows: the logs, W windows.
        theta: (N,), the optimum.
        starts: (W, D), there.
        noise: (C,), there.
        prior: of theta.

    Raises:
        ValueError: where the simulation diverges.
    """
    own, windows = windows, windows.compared_late()
    linearisation = windows.linearise(theta, starts)
    own.rollouts += windows.rollouts if windows is not own else 0
    if not linearisation.valid:
        raise ValueError("theta: the simulation diverges at the optimum")
    # one block for each window also where starts are known
    moments = windows.moments(linearisation)
    products, constants = moments.normal(noise), _log_determinants(windows, noise)
    linear = _Linear(windows, theta, starts, prior)
    whole = linear.evidence(products, float(constants.sum()))
    pieces = _pieces(windows)
    if len(pieces) < 2 or len(products) < len(windows.log):
        return Scores(whole, None)
    without = [
        linear.evidence(np.where(piece[:, None, None], 0.0, products), float(constants[~piece].sum()))
        for piece in pieces
    ]
    return Scores(whole, float(sum(whole - other for other in without)))


@dataclass(frozen=True)
class _Linear:
    """The linear model around theta (N,) and starts (W, D)."""

    windows: BoundLikelihood
    theta: FloatArray
    starts: FloatArray
    prior: QuadraticPrior

    def evidence(self, products: FloatArray, constant: float) -> float:
        """Log p of the rows behind whitened products (W, K, K); constant: their log|2 pi V|."""
        n, precision = len(self.theta), self.windows.start_precision
        solved = self.windows.eliminate(products, n, self.starts)
        starts = float((self.starts**2 @ precision).sum()) - solved.explained + solved.log_determinant
        starts -= len(self.starts) * float(np.log(precision).sum())
        level = -0.5 * (constant + float(products[:, -1, -1].sum()) + starts) - self.prior.energy(self.theta)
        flat = FLAT_PRECISION * np.eye(n)
        precision = solved.precision + self.prior.precision + flat
        gradient = solved.gradient + self.prior.pull(self.theta) + FLAT_PRECISION * (0.5 - self.theta)
        covariance = np.linalg.inv(0.5 * (precision + precision.T))
        step = covariance @ gradient
        log_det = float(np.linalg.slogdet(precision)[1])
        mass = TruncatedNormal(self.theta + step, 0.5 * (covariance + covariance.T)).log_mass if n else 0.0
        around = 0.5 * float(gradient @ step) - 0.5 * log_det + 0.5 * n * float(np.log(2 * np.pi)) + mass
        return level + around - _log_prior_integral(self.prior)


def _log_prior_integral(prior: QuadraticPrior) -> float:
    """Log of the integral of exp(-energy) over the cube; parameters without precision are uniform."""
    own = np.flatnonzero(np.diag(prior.precision) > 0)
    if not len(own):
        return 0.0
    precision = prior.precision[np.ix_(own, own)]
    covariance: FloatArray = np.asarray(np.linalg.inv(precision), float)
    mass = TruncatedNormal(prior.mean[own], covariance).log_mass
    return 0.5 * len(own) * float(np.log(2 * np.pi)) - 0.5 * float(np.linalg.slogdet(precision)[1]) + mass


def _log_determinants(windows: BoundLikelihood, noise: Noise) -> FloatArray:
    """Of each window (W,) its rows' log|2 pi V|."""
    out = np.zeros(windows.num_windows)
    for s, sd, tau in zip(windows.sequences, noise.sd.tolist(), noise.tau.tolist(), strict=True):
        out += np.bincount(s.window, np.log(2 * np.pi * sd**2 * (1 - s.coefficients(tau) ** 2)), minlength=len(out))
    return out


def _pieces(windows: BoundLikelihood) -> list[BoolArray]:
    """Which windows (W,) each held-out piece has."""
    logs = np.unique(windows.log)
    if len(logs) > 1:
        return [windows.log == k for k in logs]
    count = min(_PIECES, windows.num_windows)
    return [
        np.isin(np.arange(windows.num_windows), part) for part in np.array_split(np.arange(windows.num_windows), count)
    ]
