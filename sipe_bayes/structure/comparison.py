r"""Structures compared by what they predict of pieces that they have not seen, with standard errors.

The difference of two structures is the sum of the K pieces' differences d_k of log predictive density (A. Vehtari, A.
Gelman, J. Gabry 2017, https://doi.org/10.1007/s11222-016-9696-4). Its standard error is

.. math:: s^2 = \frac{1 + r}{1 - r} \Big( 2 \sum_k \varphi_k |d_k| + 2 \sum_{k: d_k < 0} d_k^2 \Big)

if the sum is positive: if the first structure is right, d_k has the mean m_k and the variance 2 m_k of a log likelihood
ratio of normal distributions; phi_k is the mean square of its whitened residuals in the piece, if that is above one. A
piece that speaks against the sum has a twin that speaks for it by chance. Neighbouring pieces of a log differ alike by
the correlation r: what counts is the effective number of pieces.

Deviation from Vehtari et al., whose s^2 = K var(d): motions differ in what they tell, and a sum of gains that all have
one sign, but differ, is no uncertain one.

Structures within two standard errors of the best are **ties**; ``choose_ties`` says which of these are reported.
**Stacking weights** of a set maximise the mean log of the weighted mixture (Y. Yao, A. Vehtari, D. Simpson, A. Gelman
2018, https://doi.org/10.1214/17-BA1091).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.structure.fitted import FittedStructure


class Difference(NamedTuple):
    """Of two structures, in nats: how much better the first one predicts, and the standard error of that."""

    nats: float
    error: float

    @property
    def clear(self) -> bool:
        """Whether the first one predicts better by more than two standard errors."""
        return self.nats > 2.0 * self.error


def rank(one: FittedStructure) -> tuple[int, float]:
    """How well a structure predicts, to sort by: pieces on which it diverges count first, then nats."""
    density = one.held.density
    lost = int(np.isneginf(density).sum())
    return -lost, float(density[np.isfinite(density)].sum())


def difference(one: FittedStructure, other: FittedStructure, since: int = 0) -> Difference:
    """How much better one predicts logs from ``since`` on than another; infinite where one diverges on more pieces."""
    if (kept := rank(one)[0] - rank(other)[0]) != 0:
        return Difference(kept * np.inf, 0.0)
    both = np.isfinite(one.held.density) & np.isfinite(other.held.density) & (one.held.log >= since)
    each, log = one.held.density[both] - other.held.density[both], one.held.log[both]
    total = float(each.sum())
    opposing, follows = each[each * total < 0], log[1:] == log[:-1]
    apart = each - each.mean() if len(each) else each
    alike = float(apart[1:][follows] @ apart[:-1][follows]) / max(float(apart @ apart), 1e-300)
    alike = min(max(alike, 0.0), 0.5)  # motions that tell more follow each other, too
    whitened = np.maximum((one if total > 0 else other).held.square[both], 1.0)
    square = 2 * float(whitened @ np.abs(each)) + 2 * float(opposing @ opposing)
    return Difference(total, float(np.sqrt(square * (1 + alike) / (1 - alike))))


def choose_ties(structures: Sequence[FittedStructure]) -> list[FittedStructure]:
    """The structures within two standard errors of the best one, without those of which a part does as well.

    A part does if it is a tie itself, or predicts no worse than the larger one.
    """
    best = max(structures, key=rank)
    ties = [one for one in structures if one is best or not difference(best, one).clear]
    ties = [one for one in ties if all(rank(part) < rank(one) for part in parts_of(one.labels, structures))]
    return [one for one in ties if not parts_of(one.labels, ties)]


def parts_of(labels: Sequence[str], structures: Sequence[FittedStructure]) -> list[FittedStructure]:
    """The structures with some of these extensions alone."""
    return [one for one in structures if set(one.labels) < set(labels)]


def stack(structures: Sequence[FittedStructure]) -> FloatArray:
    """Stacking weights (S,) of structures, each at least a hundredth: ties may all be right."""
    weight = np.full(len(structures), 1 / len(structures))
    densities = np.stack([one.held.density for one in structures], axis=1)
    densities = densities[np.isfinite(densities).all(1)]
    densities = np.exp(densities - densities.max(1, keepdims=True, initial=-np.inf))
    for _ in range(200 if len(densities) else 0):  # a round never lowers what it maximises
        weight = weight * (densities / (densities @ weight)[:, None]).mean(0)
    weight = np.maximum(weight / weight.sum(), 0.01)
    return weight / weight.sum()
