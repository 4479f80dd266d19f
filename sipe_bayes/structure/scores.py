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

Deviations: the noise is that of the fit to all training logs, and pieces are compared as if noise began anew in each;
directions that the data leave open get the flat normal of ``likelihood.quadratic_prior``; g is the slope less what it
was where the search ended, but at a bound: slopes of rough simulations promise gains that the search did not find.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray
from sipe_bayes.likelihood import FLAT_PRECISION, BoundLikelihood, Linearisation, Noise, QuadraticPrior, damped_box_step
from sipe_bayes.posterior.truncated_normal import TruncatedNormal


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
        density = np.concatenate([self.density, other.density])
        log = np.concatenate([self.log, other.log + first])
        return Pieces(density, log, np.concatenate([self.square, other.square]))


class Scores(NamedTuple):
    """Of one structure: its evidence log p(y) in nats, and its pieces; without pieces the evidence is one."""

    evidence: float
    pieces: Pieces


def scores(
    windows: BoundLikelihood, theta: FloatArray, starts: FloatArray, noise: Noise, prior: QuadraticPrior
) -> Scores:
    """Both scores of an optimum: theta (N,), starts (W, D) of the windows, noise (C,); costs a linearisation.

    Raises:
        ValueError: where the simulation diverges.
    """
    lin = windows.linearise(theta, starts)
    if not lin.valid:
        raise ValueError("theta: the simulation diverges at the optimum")
    linear, parts = _Linear(windows, theta, starts, prior), _parts(windows)
    products, constants = linear.whitened(lin, noise)
    linear = replace(linear, untaken=linear.step(products))
    evidence = linear.evidence(linear.centred(products), constants)
    if len(parts) < 2 or len(products) < len(windows.log):
        return Scores(evidence, _pieces(windows, [np.ones(windows.num_windows, bool)], [evidence], constants))
    linear = linear.cut(parts)
    products, constants = linear.whitened(lin, noise)
    products = linear.centred(products)
    every = linear.evidence(products, constants)
    density = [every - linear.evidence(products, constants, ~part) for part in parts]
    return Scores(evidence, _pieces(linear.windows, parts, density, constants))


def predictive(windows: BoundLikelihood, theta: FloatArray, noise: Noise, posterior: QuadraticPrior) -> Pieces:
    """Pieces of held-out logs by the posterior of theta (N,), given the training logs; two linearisations and more.

    The starts are those that fit best. The noise is that of the held-out logs themselves, since a model's error differs
    from motion to motion; its estimate begins at ``noise`` (C,).
    """
    starts = windows.fit_starts(theta, noise)[0] if windows.num_start else windows.no_starts()
    parts = _parts(windows) if windows.num_start else [np.ones(windows.num_windows, bool)]  # known starts: one block
    lin = windows.linearise(theta, starts)
    if not lin.valid:
        log = np.array([windows.log[part][0] for part in parts])
        return Pieces(np.full(len(parts), -np.inf), log, np.ones(len(parts)))
    pulls = windows.pulls(posterior.precision, posterior.pull(theta), starts)
    noise = windows.estimate_noise(windows.moments(lin), noise, pulls, True)
    linear = _Linear(windows, theta, starts, posterior).cut(parts)
    products, constants = linear.whitened(lin, noise)
    # without starts products are of all windows together
    density = [linear.evidence(products, constants, part if windows.num_start else None) for part in parts]
    return _pieces(linear.windows, parts, density, constants)


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

    def cut(self, parts: list[BoolArray]) -> _Linear:
        """The same with windows cut where each piece begins."""
        return replace(self, windows=self.windows.cut(np.array([part.argmax() for part in parts])))

    def whitened(self, lin: Linearisation, noise: Noise) -> tuple[FloatArray, FloatArray]:
        """Whitened products (W, K, K) of the windows' rows, and log|2 pi V| (W,) of these."""
        out = np.zeros(self.windows.num_windows)
        for s, sd, tau in zip(self.windows.sequences, noise.sd.tolist(), noise.tau.tolist(), strict=True):
            each = np.log(2 * np.pi * sd**2 * (1 - s.coefficients(tau) ** 2))
            out += np.bincount(s.window, each, minlength=len(out))
        return self.windows.moments(lin).normal(noise), out

    def centred(self, products: FloatArray) -> FloatArray:
        """Whitened products (W, K, K) by which the optimum within the cube is where the search ended."""
        assert self.untaken is not None
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
            precision, pull = self._belief
            move = damped_box_step(solved.precision + precision, solved.gradient + pull, self.theta, 0.0)
        return move, solved.blocks(move)

    @property
    def _belief(self) -> tuple[FloatArray, FloatArray]:
        """Precision (N, N) and pull (N,) of the prior, with open directions closed."""
        precision = self.prior.precision + FLAT_PRECISION * np.eye(len(self.theta))
        pull = self.prior.pull(self.theta) + FLAT_PRECISION * (0.5 - self.theta)
        return precision, pull if self.untaken is None else pull - precision @ self.untaken[0]

    def evidence(self, products: FloatArray, constants: FloatArray, which: BoolArray | None = None) -> float:
        """Log p of the rows behind whitened products (W, K, K), with log|2 pi V| (W,); of some windows (W,) alone."""
        if which is not None:
            products, constants = np.where(which[:, None, None], products, 0.0), constants[which]
        n, start_precision = len(self.theta), self.windows.start_precision
        solved = self.windows.eliminate(products, n, self.starts)
        starts = float((self.starts**2 @ start_precision).sum()) - solved.explained + solved.log_determinant
        starts -= len(self.starts) * float(np.log(start_precision).sum())
        square = float(constants.sum()) + float(products[:, -1, -1].sum()) + starts
        precision, gradient = (x + y for x, y in zip((solved.precision, solved.gradient), self._belief, strict=True))
        covariance = np.linalg.inv(0.5 * (precision + precision.T))
        step = covariance @ gradient
        around = 0.5 * float(gradient @ step) - 0.5 * float(np.linalg.slogdet(precision)[1])
        around += 0.5 * n * float(np.log(2 * np.pi))
        around += _log_mass(self.theta + step, 0.5 * (covariance + covariance.T))
        return -0.5 * square - self.prior.energy(self.theta) + around - self._log_prior_integral

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


def _parts(windows: BoundLikelihood) -> list[BoolArray]:
    """Which windows (W,) each piece has: adjacent ones of one log, those without samples left out."""
    numbers = np.flatnonzero(windows.observed.any((1, 2)))
    logs = np.unique(windows.log[numbers])
    most = max(40 // max(len(logs), 1), 1)  # forty pieces of all logs together
    own = [numbers[windows.log[numbers] == log] for log in logs]
    split = [part for each in own for part in np.array_split(each, min(most, len(each)))]
    return [np.isin(np.arange(windows.num_windows), part) for part in split]


def _pieces(windows: BoundLikelihood, parts: list[BoolArray], densities: list[float], constants: FloatArray) -> Pieces:
    """Pieces of densities (K,) whose windows have rows' log|2 pi V| (W,)."""
    samples, density = windows.observed.sum((1, 2)), np.array(densities)
    count = np.array([max(samples[part].sum(), 1) for part in parts])
    square = (-2 * density - np.array([constants[part].sum() for part in parts])) / count
    return Pieces(density, np.array([windows.log[part][0] for part in parts], np.int64), square)
