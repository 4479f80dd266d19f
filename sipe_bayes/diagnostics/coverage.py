"""Is an estimator calibrated? Many truths drawn from the prior, a posterior for each.

Three transforms of (posterior, truth) are uniform on [0, 1] when the posteriors are right; each is compared with
uniform by the least binomial tail probability on 99 levels, calibrated by simulation, with the simultaneous band of
T. Sailynoja, P.-C. Burkner, A. Vehtari 2022, https://arxiv.org/abs/2103.10522.

- Ranks u_j = P(theta_j < theta*_j), by parameter: simulation-based calibration (S. Talts, M. Betancourt, D. Simpson,
  A. Vehtari, A. Gelman 2018, https://arxiv.org/abs/1804.06788). They see shift and width.
- abs(2 u_j - 1): the level of the smallest central interval that holds the truth. The share of these at or below a
  level is the coverage of that level. They see width.
- TARP: the posterior's mass nearer to a random reference point than the truth is (P. Lemos, A. Coogan, Y. Hezaveh, L.
  Perreault-Levasseur 2023, https://arxiv.org/abs/2302.03026). It sees the parameters jointly.

Masses are those of draws, ties broken at random, which makes them exactly uniform for a right posterior. TARP's
references are uniform in the cube. A method that returns the prior passes all three: look at contraction too.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy.stats
import torch
from numpy.typing import ArrayLike
from scipy.special import betaln

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.posterior import Posterior

Verdict = Literal["calibrated", "too narrow", "too wide", "shifted"]

LEVELS = np.arange(1, 100) / 100
FEWEST = 20  # pairs: fewer show nothing at the level of the check


@dataclass(frozen=True)
class Uniformity:
    """Values (R,) that should be uniform, and the probability p of a larger deviation.

    ``curve`` (L,) is the share at or below each of ``LEVELS``; the band (L,) holds all of it in 99 % of cases.
    """

    values: FloatArray
    curve: FloatArray
    low: FloatArray
    high: FloatArray
    p: float

    def share(self, level: float) -> float:
        """Of the values at or below a level."""
        return float(np.mean(self.values <= level))

    @property
    def lean(self) -> float:
        """By how many standard errors the mean of the values is above 1/2."""
        return float((self.values.mean() - 0.5) * np.sqrt(12 * len(self.values)))


@dataclass(frozen=True)
class CalibrationCheck:
    """What R pairs (posterior, truth) say: of each of N parameters by ranks and by levels of intervals, and by TARP."""

    names: tuple[str, ...]
    ranks: tuple[Uniformity, ...]
    intervals: tuple[Uniformity, ...]
    tarp: Uniformity

    @property
    def truths(self) -> int:
        """R."""
        return len(self.tarp.values)

    def coverage(self, level: float) -> FloatArray:
        """The share (N,) of central intervals of ``level`` that hold the truth."""
        return np.array([interval.share(level) for interval in self.intervals])

    @property
    def _alarm(self) -> float:
        """The p-value below which one of the two checks of one parameter fails."""
        return THRESHOLDS.miscalibrated / (2 * len(self.names))

    def verdict(self, name: str) -> Verdict:
        """Of one parameter; over all of them a false alarm is as rare as the threshold says."""
        j = self.names.index(name)
        rank, interval = self.ranks[j], self.intervals[j]
        if min(rank.p, interval.p) >= self._alarm:
            return "calibrated"
        if interval.p >= self._alarm or abs(rank.lean) > abs(interval.lean):
            return "shifted"
        return "too narrow" if interval.lean > 0 else "too wide"

    @property
    def calibrated(self) -> bool:
        """Whether no check gives cause for alarm."""
        each = all(self.verdict(name) == "calibrated" for name in self.names)
        return each and self.tarp.p >= THRESHOLDS.miscalibrated

    def sentences(self) -> list[str]:
        """One for the ranks, one for the coverage, one for TARP; each names what is wrong and by how much."""
        level = THRESHOLDS.shown_interval
        name, rank = min(zip(self.names, self.ranks, strict=True), key=lambda pair: pair[1].p)
        ranks = f"uniform for all parameters (smallest p = {rank.p:.2g}, {self.truths} truths)"
        if wrong := sum(one.p < self._alarm for one in self.ranks):
            above, also = np.mean(rank.values > 0.5), f", and for {wrong - 1} more" if wrong > 1 else ""
            ranks = f"not uniform for {name} (p = {rank.p:.1g}){also}: the truth lies above the median {above:.0%} of"
            ranks += " the time"
        rows = zip(self.names, self.intervals, strict=True)
        name, interval = min(rows, key=lambda pair: (pair[1].p, -abs(pair[1].lean)))
        held = f"as they should (smallest p = {interval.p:.2g})"
        if interval.p < self._alarm:
            held = f"{self.verdict(name)}, worst {name} with {interval.share(level):.0%} (p = {interval.p:.1g})"
        tarp = f"hold the truth as often as they should (p = {self.tarp.p:.2g})"
        if self.tarp.p < THRESHOLDS.miscalibrated:
            tarp = f"do not hold the truth as often as they say (p = {self.tarp.p:.1g})"
        return [
            f"ranks: {ranks}",
            f"coverage: {level:.0%} intervals hold the truth {self.coverage(level).mean():.0%} of the time: {held}",
            f"TARP: regions about random points {tarp}",
        ]

    def to_dict(self) -> dict[str, object]:
        """Plain data, for JSON."""
        parameters = []
        for name, rank, interval in zip(self.names, self.ranks, self.intervals, strict=True):
            coverage = {str(level): interval.share(level) for level in (0.5, 0.9, 0.95)}
            row = {"name": name, "verdict": self.verdict(name), "p_ranks": rank.p, "p_coverage": interval.p}
            parameters.append({**row, "coverage": coverage, "above_median": float(np.mean(rank.values > 0.5))})
        said = {"truths": self.truths, "calibrated": self.calibrated, "sentences": self.sentences()}
        return {**said, "parameters": parameters, "tarp": {"p": self.tarp.p}}


def check_calibration(
    posteriors: Sequence[Posterior], truths: ArrayLike, *, draws: int = 999, seed: int = 0
) -> CalibrationCheck:
    """Check R posteriors of the same N parameters, ``draws`` of each, against their truths (R, N) in theta.

    Raises:
        ValueError: for fewer than 20 pairs or other shapes.
    """
    names, generator = {posterior.space.names for posterior in posteriors}, torch.Generator().manual_seed(seed)
    if len(names) > 1:
        raise ValueError(f"posteriors: expected the same parameters in all, got {sorted(names)}")
    points = [posterior.sample((draws,), generator=generator).numpy() for posterior in posteriors]
    return check_draws(names.pop() if names else (), points, truths, seed=seed)


def check_draws(
    names: tuple[str, ...], draws: Sequence[FloatArray], truths: ArrayLike, *, seed: int = 0
) -> CalibrationCheck:
    """As ``check_calibration``, of R draws (M, N) of the posteriors of N named parameters in theta."""
    theta = np.asarray(truths, float)
    if len(draws) < FEWEST:
        raise ValueError(f"posteriors: expected at least {FEWEST} of as many truths, got {len(draws)}")
    if theta.shape != (len(draws), len(names)) or not np.isfinite(theta).all():
        raise ValueError(f"truths: expected finite theta ({len(draws)}, {len(names)}), got shape {theta.shape}")
    rng = np.random.default_rng(seed)
    ranks = np.stack([mass_below(drawn, truth, rng) for drawn, truth in zip(draws, theta, strict=True)])
    tarp = tarp_values(draws, theta, rng.random(theta.shape), rng)
    intervals = tuple(uniformity(np.abs(2 * column - 1)) for column in ranks.T)
    return CalibrationCheck(names, tuple(uniformity(column) for column in ranks.T), intervals, uniformity(tarp))


def clearly_wrong(ranks: FloatArray) -> bool:
    """Whether ranks (R, N) of truths leave no doubt that posteriors are wrong: a test that may look after every log.

    Under right posteriors the truth lies in a 90 % interval, and below the median, as independent coins of .9 and of a
    half fall. Against such a coin of chance p the mixture of all others, e_n = B(k + 1/2, n - k + 1/2) / B(1/2, 1/2) /
    (p^k (1 - p)^(n - k)) for k of n, ever reaches 1 / alpha with probability alpha at most (J. Ville 1939).
    """
    level, n = THRESHOLDS.shown_interval, len(ranks)
    k = np.stack([np.abs(2 * ranks - 1) <= level, ranks < 0.5]).sum(1)
    chance = np.array([[level], [0.5]])
    mixture = betaln(k + 0.5, n - k + 0.5) - betaln(0.5, 0.5)
    evidence = mixture - k * np.log(chance) - (n - k) * np.log1p(-chance)
    return bool((evidence >= np.log(evidence.size / THRESHOLDS.miscalibrated)).any())  # shared out among the coins


def mass_below(draws: FloatArray, truth: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Mass (N,) below a truth (N,) of draws (M, N): uniform if the truth is one more draw; ``rng`` breaks ties."""
    below, equal = (draws < truth).sum(0), (draws == truth).sum(0)
    return np.asarray((below + rng.random(len(truth)) * (equal + 1)) / (len(draws) + 1))


def tarp_values(
    draws: Sequence[FloatArray], truths: FloatArray, references: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """TARP's credibilities (R,): the mass of R draws (M, N) nearer to references (R, N) than truths (R, N) are."""
    masses = []
    for points, truth, reference in zip(draws, truths, references, strict=True):
        far, near = (np.linalg.norm(x - reference, axis=1, keepdims=True) for x in (points, truth[None]))
        masses.append(mass_below(far, near[0], rng))
    return np.concatenate(masses)


def uniformity(values: FloatArray) -> Uniformity:
    """Compare values (R,) in [0, 1] with uniform."""
    count = len(values)
    below = np.searchsorted(np.sort(values), LEVELS, side="right")
    tails, smallest = _null(count)
    least = tails[np.arange(len(LEVELS)), below].min()
    simulated = (1 + int((smallest <= least).sum())) / (1 + len(smallest))
    p = min(simulated, 2 * len(LEVELS) * float(least))  # Bonferroni's bound reaches below what simulation resolves
    inside = tails >= np.quantile(smallest, THRESHOLDS.miscalibrated)
    low = inside.argmax(1) / count
    high = (count - inside[:, ::-1].argmax(1)) / count
    return Uniformity(values, below / count, low, high, p)


@functools.lru_cache(maxsize=8)
def _null(count: int) -> tuple[FloatArray, FloatArray]:
    """The smaller tail probability (L, count + 1) of values at or below levels; its least in simulations (4000,)."""
    k, level = np.arange(count + 1), LEVELS[:, None]
    tails = np.minimum(scipy.stats.binom.cdf(k, count, level), scipy.stats.binom.sf(k - 1, count, level))
    rng, smallest = np.random.default_rng(count), np.empty(4000)
    for i in range(len(smallest)):
        below = np.searchsorted(np.sort(rng.random(count)), LEVELS, side="right")
        smallest[i] = tails[np.arange(len(LEVELS)), below].min()
    return tails, smallest
