"""Is an estimator calibrated? Many truths drawn from the prior, a posterior for each.

Three transforms of (posterior, truth) are uniform on [0, 1] when the posteriors are right, and each is compared with
uniform in one way.

- Ranks u_j = P(theta_j < theta*_j), by parameter: simulation-based calibration (S. Talts, M. Betancourt, D. Simpson,
  A. Vehtari, A. Gelman 2018, https://arxiv.org/abs/1804.06788). They see shift and width.
- abs(2 u_j - 1): the level of the smallest central interval that holds the truth. The share of these at or below a
  level is the coverage of that level. They see width.
- TARP: the posterior's mass nearer to a random reference point than the truth is (P. Lemos, A. Coogan, Y. Hezaveh, L.
  Perreault-Levasseur 2023, "Sampling-Based Accuracy Testing of Posterior Estimators for General Inference",
  https://arxiv.org/abs/2302.03026). It sees the parameters jointly: correlations, and nested boxes that the others
  miss.

Compared with uniform by the largest deviation of the empirical distribution, on 99 levels, in terms of the binomial
tail probability there, calibrated by simulation; its simultaneous band is that of T. Sailynoja, P.-C. Burkner, A.
Vehtari 2022, "Graphical test for discrete uniformity", https://arxiv.org/abs/2103.10522.

sbi has these checks too (``sbi.diagnostics``) and is not called, because it would lose what is said here. Its
``run_sbc`` and ``run_tarp`` draw from sbi's own posteriors and x; under them, ranks are counts without ties broken, so
that particles of unequal weights and points pile up, and TARP is a histogram between the smallest and the largest
credibility, whose ``check_tarp`` compares two curves of bins by Kolmogorov-Smirnov as if bins were independent draws:
its p-value does not depend on the number of truths. On the same draws ours are theirs (tested): the counts of ranks
exactly, TARP's curve up to its bins.

Deviations:

- Masses are those of ``draws`` draws, a tie or a gap between draws broken at random, which makes them exactly uniform
  for a right posterior.
- TARP's references are uniform in the cube.
- A method that returns the prior passes all three: look at contraction too. Draws of an ill-mixed chain fail though
  their distribution be right.
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

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.posterior import Posterior

Verdict = Literal["calibrated", "too narrow", "too wide", "shifted"]

LEVELS = np.arange(1, 100) / 100
_SIMULATED = 4000  # samples of the null: p resolves a quarter of a thousandth
FEWEST = 20  # pairs: fewer show nothing at the level of the check


@dataclass(frozen=True)
class Uniformity:
    """Values that should be uniform, compared with that.

    Args:
        values: (R,).
        curve: (L,) the share at or below each of ``LEVELS``.
        low: (L,) of the band that holds the whole curve of uniform values in all but one per cent of cases.
        high: (L,) of the same band.
        p: the probability of a larger deviation.
    """

    values: FloatArray
    curve: FloatArray
    low: FloatArray
    high: FloatArray
    p: float


@dataclass(frozen=True)
class CalibrationCheck:
    """What R pairs (posterior, truth) say.

    Args:
        names: of the N parameters.
        ranks: of each parameter.
        intervals: of each parameter, the levels of the intervals that hold the truth.
        tarp: of all together.
    """

    names: tuple[str, ...]
    ranks: tuple[Uniformity, ...]
    intervals: tuple[Uniformity, ...]
    tarp: Uniformity

    @property
    def truths(self) -> int:
        """R."""
        return len(self.tarp.values)

    @property
    def p_values(self) -> tuple[float, ...]:
        """Of the ranks, by parameter."""
        return tuple(u.p for u in self.ranks)

    def coverage(self, level: float) -> FloatArray:
        """The share (N,) of central intervals of ``level`` that hold the truth."""
        return np.array([np.mean(u.values <= level) for u in self.intervals])

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
        off, out = _lean(rank), _lean(interval)
        if interval.p >= self._alarm or abs(off) > abs(out):
            return "shifted"
        return "too narrow" if out > 0 else "too wide"

    def sentences(self) -> list[str]:
        """One for the ranks, one for the coverage, one for TARP; each names what is wrong and by how much."""
        return [self._ranks_sentence(), self._coverage_sentence(), self._tarp_sentence()]

    @property
    def calibrated(self) -> bool:
        """Whether no check gives cause for alarm."""
        each = all(self.verdict(name) == "calibrated" for name in self.names)
        return each and self.tarp.p >= THRESHOLDS.miscalibrated

    def _ranks_sentence(self) -> str:
        wrong = [(name, u) for name, u in zip(self.names, self.ranks, strict=True) if u.p < self._alarm]
        if not wrong:
            return f"ranks: uniform for all parameters (smallest p = {min(self.p_values):.2g}, {self.truths} truths)"
        name, worst = min(wrong, key=lambda pair: pair[1].p)
        above = float(np.mean(worst.values > 0.5))
        also = f", and for {len(wrong) - 1} more" if len(wrong) > 1 else ""
        return (
            f"ranks: not uniform for {name} (p = {worst.p:.1g}){also}: the truth lies above the median "
            f"{_percent(above)} of the time, {_tails(worst)}"
        )

    def _coverage_sentence(self) -> str:
        level = THRESHOLDS.shown_interval
        held = f"{_percent(level)} intervals hold the truth {_percent(self.coverage(level).mean())} of the time"
        wrong = [(name, u) for name, u in zip(self.names, self.intervals, strict=True) if u.p < self._alarm]
        if not wrong:
            return f"coverage: {held}: as they should (smallest p = {min(u.p for u in self.intervals):.2g})"
        name, worst = min(wrong, key=lambda pair: (pair[1].p, -abs(_lean(pair[1]))))
        share = float(np.mean(worst.values <= level))
        return f"coverage: {held}: {self.verdict(name)}, worst {name} with {_percent(share)} (p = {worst.p:.1g})"

    def _tarp_sentence(self) -> str:
        if self.tarp.p >= THRESHOLDS.miscalibrated:
            return f"TARP: regions about random points hold the truth as often as they should (p = {self.tarp.p:.2g})"
        wrong = f"do not hold the truth as often as they say (p = {self.tarp.p:.1g}), {_tails(self.tarp)}"
        return f"TARP: regions about random points {wrong}"

    def to_dict(self) -> dict[str, object]:
        """Plain data, for JSON."""
        return {
            "truths": self.truths,
            "calibrated": self.calibrated,
            "sentences": self.sentences(),
            "parameters": [
                {
                    "name": name,
                    "verdict": self.verdict(name),
                    "p_ranks": rank.p,
                    "p_coverage": interval.p,
                    "coverage": {str(x): float(np.mean(interval.values <= x)) for x in (0.5, 0.9, 0.95)},
                    "above_median": float(np.mean(rank.values > 0.5)),
                }
                for name, rank, interval in zip(self.names, self.ranks, self.intervals, strict=True)
            ],
            "tarp": {"p": self.tarp.p},
        }


def check_calibration(
    posteriors: Sequence[Posterior], truths: ArrayLike, *, draws: int = 999, seed: int = 0
) -> CalibrationCheck:
    """Check posteriors against their truths, drawn from the prior.

    Args:
        posteriors: R of them, of the same N parameters.
        truths: (R, N) in theta.
        draws: of each posterior.
        seed: the same one gives the same answer.

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
    return CalibrationCheck(
        names,
        tuple(uniformity(column) for column in ranks.T),
        tuple(uniformity(np.abs(2 * column - 1)) for column in ranks.T),
        uniformity(tarp),
    )


def mass_below(draws: FloatArray, truth: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Mass (N,) below a truth (N,) of draws (M, N): uniform if the truth is one more draw; ``rng`` breaks ties."""
    below, equal = (draws < truth).sum(0), (draws == truth).sum(0)
    return np.asarray((below + rng.random(len(truth)) * (equal + 1)) / (len(draws) + 1))


def tarp_values(
    draws: Sequence[FloatArray], truths: FloatArray, references: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """TARP's credibilities: the mass of draws nearer to a reference than the truth is.

    Args:
        draws: R of (M, N).
        truths: (R, N).
        references: (R, N).
        rng: breaks ties.

    Returns:
        (R,).
    """
    masses = [
        mass_below(np.linalg.norm(d - r, axis=1, keepdims=True), np.linalg.norm(t - r, axis=0, keepdims=True), rng)
        for d, t, r in zip(draws, truths, references, strict=True)
    ]
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
    """Binomial tail probabilities (L, count + 1), the smaller side, of so many values at or below each level.

    With them their least over the levels in simulations of uniform values.
    """
    k = np.arange(count + 1)
    level = LEVELS[:, None]
    tails = np.minimum(scipy.stats.binom.cdf(k, count, level), scipy.stats.binom.sf(k - 1, count, level))
    rng = np.random.default_rng(count)
    smallest = np.empty(_SIMULATED)
    for i in range(_SIMULATED):
        below = np.searchsorted(np.sort(rng.random(count)), LEVELS, side="right")
        smallest[i] = tails[np.arange(len(LEVELS)), below].min()
    return tails, smallest


def _lean(seen: Uniformity) -> float:
    """By how many standard errors the mean of the values is above 1/2."""
    return float((seen.values.mean() - 0.5) * np.sqrt(12 * len(seen.values)))


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %"


def _tails(seen: Uniformity) -> str:
    outer = float(np.mean(np.abs(seen.values - 0.5) > 0.45))
    return f"and {_percent(outer)} instead of 10 % of the values are in the outer tenth"
