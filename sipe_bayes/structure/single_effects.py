r"""Which few of many columns are at work, and how surely: a sum of single effects, and all of them, each a little.

The coefficients of K correlated columns are a sum of effects of one column each (SuSiE: G. Wang, A. Sarkar, P.
Carbonetto, M. Stephens, "A simple new approach to variable selection in regression", J. R. Stat. Soc. B 82 (2020),
1273-1300, https://doi.org/10.1111/rssb.12388). Beside them all may be at work, each a little (SuSiE-inf: R. Cui et al.,
"Improving fine-mapping by modeling infinitesimal effects", Nature Genetics 56 (2024), 162-169,
https://doi.org/10.1038/s41588-023-01597-3).

With S the information of the columns and q their score, an effect of column k has b_k ~ N(0, t^2 / S_kk), halved where
its size may not be negative; all columns have N(0, t^2 / (c_k S_kk)), c_k the number of extensions times that of the
columns that belong to k's. In both t^2 is about what is added to chi-square; t is half-Cauchy (A. Gelman, "Prior
distributions for variance parameters in hierarchical models", 2006, https://doi.org/10.1214/06-BA117A), on a grid:

.. math::

    p(q \mid t, k) &\propto (1 + t^2)^{-1/2} e^{z^2 t^2 / (2 (1 + t^2))} [2 \Phi(z t / \sqrt{1 + t^2})],
    \qquad z = q_k / \sqrt{S_{kk}}, \\
    p(q \mid t) &\propto |I + D S D|^{-1/2} e^{q' D (I + D S D)^{-1} D q / 2}, \qquad
    D = \operatorname{diag}(t / \sqrt{c_k S_{kk}}).

Deviations:

- The size of an effect is integrated over a grid, not estimated, and each effect may be none.
- Effects are added one at a time, while the last one is more likely there than not; then follow all columns at work.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.special

from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray
from sipe_bayes.posterior.truncated_normal import interval_quantile

ABSENT = 0.75  # prior probability that an effect is none; that not all columns are at work
_FAR = 40.0  # sds beyond which a normal has no mass


def size_grid() -> tuple[FloatArray, FloatArray]:
    """The sizes t (25,), in sds, evenly in their logarithm, and their prior probabilities: half-Cauchy of scale 3."""
    t = np.geomspace(0.3, 3000.0, 25)
    density = t / (1 + (t / 3.0) ** 2)  # by logarithm
    return t, density / density.sum()


@dataclass(frozen=True)
class Columns:
    """K columns of extensions, all else projected out: information (K, K), score (K,), which (K,) are not negative."""

    names: Sequence[str]
    information: FloatArray
    score: FloatArray
    one_sided: BoolArray

    @cached_property
    def parts(self) -> FloatArray:
        """Each column's share (K,) of its extension's, where all extensions have the same; they add up to one."""
        count = Counter(self.names)
        return np.array([1 / (len(count) * count[name]) for name in self.names])

    @cached_property
    def root(self) -> FloatArray:
        """(K,) by which sizes become z."""
        return np.sqrt(np.diag(self.information))


def _probabilities(evidence: FloatArray) -> FloatArray:
    """Of log evidences (...) beside that of none."""
    evidence = evidence + np.log1p(-ABSENT)
    return np.exp(evidence - np.logaddexp(np.log(ABSENT), scipy.special.logsumexp(evidence)))


def _chosen(probabilities: FloatArray, count: int, random: np.random.Generator) -> IntArray:
    """So many draws of numbers of probabilities (J,), and J for none."""
    every = np.append(probabilities, max(1 - probabilities.sum(), 0.0))
    return random.choice(len(every), count, p=every / every.sum())


@dataclass(frozen=True)
class SingleEffect:
    """One of some columns at work, of any size, or none: ``weights`` (T, K) are the probabilities of size and column.

    ``mean`` (T, K) and ``sd`` (T, 1) are those of the normal of the column's z, before it is cut off.
    """

    weights: FloatArray
    mean: FloatArray
    sd: FloatArray
    columns: Columns

    @classmethod
    def of(cls, columns: Columns, score: FloatArray) -> SingleEffect:
        """By what other effects leave of the score (K,)."""
        t, believed = size_grid()
        z, shrunk = score / columns.root, (t**2 / (1 + t**2))[:, None]
        evidence = -0.5 * np.log1p(t**2)[:, None] + 0.5 * shrunk * z**2
        half = np.log(2) + scipy.special.log_ndtr(np.sqrt(shrunk) * z)
        evidence = evidence + np.where(columns.one_sided, half, 0.0) + np.log(believed)[:, None]
        return cls(_probabilities(evidence + np.log(columns.parts)), shrunk * z, np.sqrt(shrunk), columns)

    @property
    def present(self) -> float:
        """The probability that it is not none."""
        return float(self.weights.sum())

    def alike(self) -> list[str]:
        """What it may be: of the columns' names the likeliest, and two at most of a fifth of its probability."""
        chance = Counter[str]()
        for name, own in zip(self.columns.names, self.by_column.tolist(), strict=True):
            chance[name] += own
        ranked = sorted(chance, key=lambda name: -chance[name])
        return [name for name in ranked if chance[name] >= 0.2 * chance[ranked[0]]][:3]

    @property
    def against(self) -> float:
        """Nats that are against its likeliest column beforehand, rather than none."""
        parts = self.columns.parts[int(self.by_column.argmax())]
        return float(np.log(ABSENT / ((1 - ABSENT) * parts)))

    @property
    def by_column(self) -> FloatArray:
        """(K,) that it is which."""
        return np.asarray(self.weights.sum(0))

    @property
    def sizes(self) -> FloatArray:
        """(K,) means."""
        cut = -self.mean / self.sd
        tail = np.exp(-0.5 * cut**2 - 0.5 * np.log(2 * np.pi) - scipy.special.log_ndtr(-cut))
        mean = np.where(self.columns.one_sided, self.mean + self.sd * tail, self.mean)
        return np.asarray((self.weights * mean).sum(0) / self.columns.root)

    def draws(self, count: int, random: np.random.Generator) -> FloatArray:
        """Of the sizes (count, K)."""
        chosen = _chosen(self.weights.ravel(), count, random)
        there = np.flatnonzero(chosen < self.weights.size)
        t, column = np.divmod(chosen[there], len(self.columns.root))
        mean, sd = self.mean[t, column], self.sd[t, 0]
        low = np.where(self.columns.one_sided[column], -mean / sd, -_FAR)
        own = mean + sd * interval_quantile(low, np.maximum(low, 0.0) + _FAR, random.uniform(size=len(there)))
        sizes = np.zeros((count, len(self.columns.root)))
        sizes[there, column] = own / self.columns.root[column]
        return sizes


class AllEffects:
    """All columns at once, each a little, or none."""

    def __init__(self, columns: Columns, score: FloatArray) -> None:
        self.t, believed = size_grid()
        self.scale = np.sqrt(columns.parts / np.diag(columns.information))
        values, self.axes = np.linalg.eigh(columns.information * np.outer(self.scale, self.scale))
        self.values, self.along = np.maximum(values, 0.0), self.axes.T @ (self.scale * score)
        square = self.t[:, None] ** 2
        grown = square / (1 + square * self.values)
        evidence = 0.5 * (grown * self.along**2 - np.log1p(square * self.values)).sum(1) + np.log(believed)
        self.weights = _probabilities(evidence)

    def draws(self, count: int, random: np.random.Generator) -> FloatArray:
        """Of the sizes (count, K)."""
        square = np.append(self.t, 0.0)[_chosen(self.weights, count, random)][:, None] ** 2
        variance = square / (1 + square * self.values)
        along = variance * self.along + np.sqrt(variance) * random.standard_normal((count, len(self.values)))
        return np.asarray(along @ self.axes.T * self.scale)


@dataclass(frozen=True)
class Effects:
    """What is at work: single effects, the strongest first, and all columns a little."""

    single: tuple[SingleEffect, ...]
    every: AllEffects

    @property
    def seen(self) -> list[SingleEffect]:
        """Those that are more likely there than not."""
        return [effect for effect in self.single if effect.present > 0.5]

    @property
    def sizes(self) -> FloatArray:
        """(K,) means of these."""
        return np.sum([effect.sizes for effect in self.seen], axis=0) if self.seen else np.zeros(len(self.every.scale))


def find_effects(columns: Columns) -> Effects:
    """Their posterior by coordinate ascent: each is fitted to what the others leave (Wang et al., section 3.2)."""
    effects = list[SingleEffect]()
    for _ in range(5):  # a dozen small ones together explain anything
        more = _settled(columns, effects)
        if sum(effect.present <= 0.5 for effect in more) > 1:  # the new one shares what another had
            break
        effects = more
        if min(effect.present for effect in effects) <= 0.5:
            break
    left = columns.score - columns.information @ sum(effect.sizes for effect in effects)
    return Effects(tuple(sorted(effects, key=lambda e: -e.present)), AllEffects(columns, left))


def _settled(columns: Columns, effects: Sequence[SingleEffect]) -> list[SingleEffect]:
    """These and a new one, each fitted to what the others leave, until all stay within a thousandth of an sd."""
    made = list(effects)
    sizes = np.array([*(effect.sizes for effect in effects), np.zeros(len(columns.score))])
    for _ in range(30):
        before = sizes.copy()
        for k in reversed(range(len(sizes))):
            rest = sizes.sum(0) - sizes[k]
            made[k : k + 1] = [SingleEffect.of(columns, columns.score - columns.information @ rest)]
            sizes[k] = made[k].sizes
        if (np.abs(sizes - before) * columns.root).max() < 1e-3:
            break
    return made
