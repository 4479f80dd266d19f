r"""Two scores of a fitted structure: its evidence, and the log predictive density of pieces that it has not seen.

Both come from one linearisation at the optimum, with the same coloured noise and the windows' starts marginalised, of
windows that are compared from the same samples on in all structures, as late as the latest sensor asks. With
H the information of theta (starts eliminated) plus the prior's, m the normal's mean and the cube as the prior's
support,

.. math::

    \log p(y) = \log L(\hat\theta) + \tfrac12 g^\top H^{-1} g - \tfrac12 \log|H| + \tfrac N2 \log 2\pi
        + \log P_{\mathcal N(m, H^{-1})}([0, 1]^N) - \log \int_{[0, 1]^N} e^{-E_{prior}} .

A piece k is a few adjacent windows of a training log, or of a log that no structure is fitted to. Its log predictive
density is log p(y_k | y without k) = log p(y) - log p(y without k), and log p(y_k | y) of a held-out log. The sum over
pieces is the expected log predictive density by cross-validation (A. Vehtari, A. Gelman, J. Gabry 2017, "Practical
Bayesian model evaluation", https://doi.org/10.1007/s11222-016-9696-4); it is what refitting gives where the model is
linear around its optimum.

Deviations:

- The noise is that of the fit to all training logs. Pieces are compared as if noise began anew in each.
- Directions that the data leave open get the flat normal of ``likelihood.quadratic_prior``.
- g is the slope less what it was where the search ended, but at a bound: where simulations are rough, slopes promise
  gains that the search did not find.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray
from sipe_bayes.likelihood import FLAT_PRECISION, BoundLikelihood, Noise, QuadraticPrior, damped_box_step
from sipe_bayes.posterior.truncated_normal import TruncatedNormal

_PIECES = 40  # of all logs together, at most


@dataclass(frozen=True)
class Pieces:
    """What was held out, piece by piece.

    Args:
        density: (K,), log predictive density in nats; minus infinity where the simulation diverges.
        log: (K,), which log each piece is of.
        square: (K,), mean square of the whitened residuals, by the density.
    """

    density: FloatArray
    log: IntArray
    square: FloatArray

    def beside(self, other: Pieces, first: int) -> Pieces:
        """These, and pieces of other logs, which are counted on from ``first``."""
        log = np.concatenate([self.log, other.log + first])
        both = zip((self.density, self.square), (other.density, other.square), strict=True)
        density, square = (np.concatenate(pair) for pair in both)
        return Pieces(density, log, square)


class Scores(NamedTuple):
    """Of one structure: its evidence log p(y) in nats, and its pieces; without pieces the evidence is one."""

    evidence: float
    pieces: Pieces


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
    linearisation = windows.linearise(theta, starts)
    if not linearisation.valid:
        raise ValueError("theta: the simulation diverges at the optimum")
    products, constants = windows.moments(linearisation).normal(noise), _log_determinants(windows, noise)
    linear = _Linear(windows, theta, starts, prior)
    linear = replace(linear, untaken=linear.step(products))
    evidence = linear.evidence(linear.centred(products), float(constants.sum()))
    parts = _parts(windows)
    if len(parts) < 2 or len(products) < len(windows.log):
        one = [np.ones(windows.num_windows, bool)]
        return Scores(evidence, _pieces(windows, one, np.array([evidence]), constants))
    windows = windows.cut(np.array([part.argmax() for part in parts]))
    products, constants = windows.moments(linearisation).normal(noise), _log_determinants(windows, noise)
    linear, products = replace(linear, windows=windows), linear.centred(products)
    every = linear.evidence(products, float(constants.sum()))
    without = [linear.evidence_of(products, constants, ~part) for part in parts]
    return Scores(evidence, _pieces(windows, parts, every - np.array(without), constants))


def predictive(windows: BoundLikelihood, theta: FloatArray, noise: Noise, posterior: QuadraticPrior) -> Pieces:
    """Pieces of held-out logs; minus infinity where a simulation diverges; costs two linearisations and more.

    The starts are those that fit best; the noise is that of the held-out logs themselves, since a model's error differs
    from motion to motion.

    Args:
        windows: the held-out logs.
        theta: (N,), the optimum.
        noise: (C,), there, at which the estimate of the held-out logs' begins.
        posterior: of theta, given the training logs.
    """
    parts = _parts(windows) if windows.num_start else [np.ones(windows.num_windows, bool)]  # known starts: one block
    starts = windows.fit_starts(theta, noise)[0] if windows.num_start else windows.no_starts()
    linearisation = windows.linearise(theta, starts)
    if not linearisation.valid:
        lost = np.full(len(parts), -np.inf)
        return Pieces(lost, np.array([windows.log[part][0] for part in parts]), np.ones(len(parts)))
    pulls = windows.pulls(posterior.precision, posterior.pull(theta), starts)
    noise = windows.estimate_noise(windows.moments(linearisation), noise, pulls, True)
    windows = windows.cut(np.array([part.argmax() for part in parts]))
    products, constants = windows.moments(linearisation).normal(noise), _log_determinants(windows, noise)
    linear = _Linear(windows, theta, starts, posterior)
    if not windows.num_start:
        return _pieces(windows, parts, np.array([linear.evidence(products, float(constants.sum()))]), constants)
    density = np.array([linear.evidence_of(products, constants, part) for part in parts])
    return _pieces(windows, parts, density, constants)


@dataclass(frozen=True)
class _Linear:
    """The linear model around theta (N,) and starts (W, D).

    untaken: steps (N,) and (W, D) that it asks for and the search did not take.
    """

    windows: BoundLikelihood
    theta: FloatArray
    starts: FloatArray
    prior: QuadraticPrior
    untaken: tuple[FloatArray, FloatArray] | None = None

    def centred(self, products: FloatArray) -> FloatArray:
        """Whitened products (W, K, K) by which the optimum within the cube is where the search ended."""
        if self.untaken is None:
            return products
        n, d, (move, own) = len(self.theta), self.windows.num_start, self.untaken
        step, change = np.tile(move, (len(products), 1)), np.zeros((len(products), n + 2 * d))
        if d:  # else products are of all windows together
            step = np.concatenate([step, own, np.roll(own, 1, axis=0)], axis=1)
            change[:, n : n + d] = own * self.windows.start_precision
        change += np.einsum("wij,wj->wi", products[:, :-1, :-1], step)
        products = products.copy()
        products[:, :-1, -1] -= change
        products[:, -1, :-1] -= change
        return products

    def step(self, products: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Of theta (N,), within the cube, and of the starts (W, D), that whitened products (W, K, K) ask for."""
        solved = self.windows.eliminate(products, len(self.theta), self.starts)
        move = np.zeros(len(self.theta))
        if len(move):
            move = damped_box_step(solved.precision + self._inner, solved.gradient + self._pull, self.theta, 0.0)
        return move, solved.blocks(move)

    @property
    def _inner(self) -> FloatArray:
        """Precision (N, N) of the prior, with directions closed."""
        return self.prior.precision + FLAT_PRECISION * np.eye(len(self.theta))

    @property
    def _pull(self) -> FloatArray:
        """Of the prior (N,)."""
        pull = self.prior.pull(self.theta) + FLAT_PRECISION * (0.5 - self.theta)
        return pull if self.untaken is None else pull - self._inner @ self.untaken[0]

    def evidence_of(self, products: FloatArray, constants: FloatArray, which: BoolArray) -> float:
        """Log p of the rows of some windows (W,) alone."""
        return self.evidence(np.where(which[:, None, None], products, 0.0), float(constants[which].sum()))

    def evidence(self, products: FloatArray, constant: float) -> float:
        """Log p of the rows behind whitened products (W, K, K); constant: their log|2 pi V|."""
        n, precision = len(self.theta), self.windows.start_precision
        solved = self.windows.eliminate(products, n, self.starts)
        starts = float((self.starts**2 @ precision).sum()) - solved.explained + solved.log_determinant
        starts -= len(self.starts) * float(np.log(precision).sum())
        level = -0.5 * (constant + float(products[:, -1, -1].sum()) + starts) - self.prior.energy(self.theta)
        precision = solved.precision + self._inner
        gradient = solved.gradient + self._pull
        covariance = np.linalg.inv(0.5 * (precision + precision.T))
        step = covariance @ gradient
        log_det = float(np.linalg.slogdet(precision)[1])
        mass = _log_mass(self.theta + step, 0.5 * (covariance + covariance.T))
        around = 0.5 * float(gradient @ step) - 0.5 * log_det + 0.5 * n * float(np.log(2 * np.pi)) + mass
        return level + around - self._log_prior_integral

    @functools.cached_property
    def _log_prior_integral(self) -> float:
        """Log of the integral of exp(-energy) over the cube; parameters without precision are uniform."""
        own = np.flatnonzero(np.diag(self.prior.precision) > 0)
        precision = self.prior.precision[np.ix_(own, own)]
        mass = _log_mass(self.prior.mean[own], np.asarray(np.linalg.inv(precision), float))
        return 0.5 * len(own) * float(np.log(2 * np.pi)) - 0.5 * float(np.linalg.slogdet(precision)[1]) + mass


def _log_mass(mean: FloatArray, covariance: FloatArray) -> float:
    """Log of a normal's mass in the cube, by the parameters (N,) of which that cuts off more than a thousandth."""
    sd = np.sqrt(np.diag(covariance))
    cut, shifted = np.zeros(0, int), mean
    for _ in range(len(mean)):  # what is cut off of one may push others against their bounds
        far = ndtr(-shifted / sd) + ndtr((shifted - 1) / sd) > 1e-3
        before, cut = cut, np.union1d(cut, np.flatnonzero(far)).astype(int)
        if len(cut) == len(before):
            break
        gap = np.clip(mean[cut], 0, 1) - mean[cut]
        shifted = mean + covariance[:, cut] @ np.linalg.solve(covariance[np.ix_(cut, cut)], gap)
    within = TruncatedNormal(mean[cut], covariance[np.ix_(cut, cut)])
    within.points = 2**8  # to a hundredth of a nat
    return within.log_mass


def _log_determinants(windows: BoundLikelihood, noise: Noise) -> FloatArray:
    """Of each window (W,) its rows' log|2 pi V|."""
    out = np.zeros(windows.num_windows)
    for s, sd, tau in zip(windows.sequences, noise.sd.tolist(), noise.tau.tolist(), strict=True):
        out += np.bincount(s.window, np.log(2 * np.pi * sd**2 * (1 - s.coefficients(tau) ** 2)), minlength=len(out))
    return out


def _parts(windows: BoundLikelihood) -> list[BoolArray]:
    """Which windows (W,) each piece has: adjacent ones of one log, those without samples left out."""
    numbers = np.flatnonzero(windows.observed.any((1, 2)))
    log = windows.log[numbers]
    most = max(_PIECES // max(len(np.unique(log)), 1), 1)
    split = [np.array_split(own, min(most, len(own))) for own in (numbers[log == k] for k in np.unique(log))]
    return [np.isin(np.arange(windows.num_windows), part) for parts in split for part in parts]


def _pieces(windows: BoundLikelihood, parts: list[BoolArray], density: FloatArray, constants: FloatArray) -> Pieces:
    """Pieces of densities (K,) whose windows have rows' log|2 pi V| (W,)."""
    samples = windows.observed.sum((1, 2))
    count = np.array([max(samples[part].sum(), 1) for part in parts])
    square = (-2 * density - np.array([constants[part].sum() for part in parts])) / count
    return Pieces(density, np.array([windows.log[part][0] for part in parts], np.int64), square)
