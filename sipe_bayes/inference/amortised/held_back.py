"""Posteriors of a trained network, mended by simulations that it was not trained on.

G. Rodrigues, D. Prangle, S. Sisson 2018, "Recalibration: a post-processing method for approximate Bayesian computation"
(Computational Statistics & Data Analysis 126, https://doi.org/10.1016/j.csda.2018.04.004): where truths of simulations
like the log lie among their posteriors' draws at ranks that are not uniform, the log's draws are moved, parameter by
parameter, so that they would be. L. M. Cabezas et al. 2025, "CP4SBI: local conformal calibration of credible sets in
simulation-based inference" (https://arxiv.org/abs/2508.17077) weigh the simulations by how near they are to the log, as
is done here.

For a parameter of a posterior, z = Phi^-1(theta) and p the posterior's distribution function, t = Phi^-1(p(z)) is
standard normal for truths that are draws. G is the distribution of the held-back simulations' t, weighted by the
distance of their medians from the log's; the log's t become G^-1(Phi(t)), a map of each parameter that keeps the order,
so that dependencies between parameters remain, and the density with it (``posterior.quantile_mapped``).

Deviations:

- t, not ranks, so that truths beyond all draws have a place; beyond the 1 % and 99 % quantiles p goes on as a normal's.
- Distances of posterior medians in place of a partition of the observations (CP4SBI), and distributions, not sets.
- The largest score counts as if there were one more beyond it, as in conformal prediction: few simulations widen.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import torch
from scipy.special import ndtri

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.options import Options, option
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.inference.amortised.simulations import Simulations
from sipe_bayes.posterior import Particles, Posterior, QuantileMapped
from sipe_bayes.posterior.flow import to_line
from sipe_bayes.posterior.quantile_mapped import mapped

DRAWS = 500  # of each simulation's posterior
_KEPT = 4000  # draws of the log's own
_LEVELS = np.arange(1, 100) / 100
_KNOTS = np.linspace(ndtri(_LEVELS[0]), ndtri(_LEVELS[-1]), 25)  # t that G goes through; scores jump between more
_APART = 1e-9  # of points that a map goes through, in z
_NEAREST, _SHARE = 100, 0.5  # simulations that count at least, and as a share of all
_DEFAULT = 0.2  # of the simulations


@dataclass(frozen=True)
class HeldBack:
    """What M simulations say of posteriors of N parameters.

    Args:
        medians: (M, N) of their posteriors, in z.
        scores: (M, N), t of their truths.
    """

    medians: FloatArray
    scores: FloatArray

    @classmethod
    def of(cls, posterior: Callable[[int], Posterior], truths: FloatArray, generator: torch.Generator) -> Self:
        """Of the posteriors of simulations 0 to M-1, and their truths (M, N) in theta."""
        medians, scores = np.empty(truths.shape), np.empty(truths.shape)
        line = to_line(torch.from_numpy(truths)).numpy()
        for i in range(len(truths)):
            quantiles = _quantiles(posterior(i).sample((DRAWS,), generator=generator))
            medians[i] = quantiles[len(_LEVELS) // 2]
            scores[i] = [_through(q, ndtri(_LEVELS), z) for q, z in zip(quantiles.T, line[i], strict=True)]
        return cls(medians, scores)

    def mended(self, posterior: Posterior, generator: torch.Generator) -> Posterior:
        """A log's posterior, moved; draws where it has no density."""
        theta = posterior.sample((_KEPT,), generator=generator)
        quantiles = _quantiles(theta)
        weights, before, after = self._weights(quantiles[len(_LEVELS) // 2]), [], []
        for j, q in enumerate(quantiles.T):
            t = _through(_KNOTS, _through(*self._distribution(j, weights), _KNOTS), ndtri(_LEVELS))
            before.append(q)
            after.append(_through(ndtri(_LEVELS), q, t))
        ends = [torch.from_numpy(_apart(np.stack(points, axis=1))) for points in (before, after)]
        if not posterior.has_density:
            return Particles(mapped(theta, *ends), posterior.space)
        return QuantileMapped(posterior, *ends)

    def _weights(self, median: FloatArray) -> FloatArray:
        """Of the simulations (M,), by the distance of their medians from the log's (N,): tricube."""
        spread = np.maximum(self.medians.std(0), 1e-9)
        distance = np.linalg.norm((self.medians - median) / spread, axis=1)
        count = min(len(distance), max(_NEAREST, int(_SHARE * len(distance))))
        reach = max(float(np.partition(distance, count - 1)[count - 1]), 1e-9)
        return np.asarray((1 - np.clip(distance / (1.01 * reach), 0, 1) ** 3) ** 3)

    def _distribution(self, parameter: int, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Scores (K,) that count, in order, and the normal scores (K,) of their places in the distribution."""
        order = np.argsort(self.scores[:, parameter])
        order = order[weights[order] > 0]
        weight = weights[order]
        further = (weight**2).sum() / weight.sum()  # of one more simulation
        place = (np.cumsum(weight) - 0.5 * weight + 0.5 * further) / (weight.sum() + further)
        return ndtri(place), self.scores[order, parameter]


@dataclass(frozen=True)
class HeldBackOptions(Options):
    """Options of methods whose posteriors are mended."""

    calibration: float | None = option(
        None,
        "share of the simulations that is not trained on and mends the posteriors' widths; default a fifth of a "
        "single round's, where that is a hundred or more",
        least=0,
        below=1,
    )

    def held_back(self, count: int) -> float:
        """The share of so many simulations."""
        if self.calibration is not None:
            return self.calibration
        return _DEFAULT if _DEFAULT * count >= _NEAREST else 0.0


def parted(simulations: Simulations, options: Options) -> tuple[Simulations, Simulations]:
    """Those to train on and those that are held back; raises ValueError where the latter are too few."""
    if not isinstance(options, HeldBackOptions):
        return simulations, simulations[:0]
    share = options.held_back(len(simulations))
    count = int(share * len(simulations))
    if share and count < THRESHOLDS.few_valid:
        raise ValueError(
            f"calibration: {share:g} of {len(simulations)} simulations are {count}, {THRESHOLDS.few_valid} are the "
            "least; raise it, or the budget"
        )
    kept = len(simulations) - count
    return simulations[:kept], simulations[kept:]


def scored(
    infer: Callable[[Trajectories], Posterior],
    simulations: Simulations,
    trajectories: Trajectories,
    generator: torch.Generator,
) -> HeldBack | None:
    """What simulations, as the log would have recorded them, say of the posteriors; None where there are none."""
    seen = np.isfinite(trajectories.observations)

    def inferred(number: int) -> Posterior:
        observations = np.where(seen, simulations.observations[number].astype(float), np.nan)
        return infer(replace(trajectories, observations=observations))

    return HeldBack.of(inferred, simulations.theta, generator) if len(simulations) else None


def _quantiles(theta: torch.Tensor) -> FloatArray:
    """Of draws (D, N) at the levels, in z, strictly increasing (99, N)."""
    return _apart(np.quantile(to_line(theta).numpy(), _LEVELS, axis=0))


def _apart(points: FloatArray) -> FloatArray:
    """Increasing rows, strictly so."""
    return np.asarray(np.maximum.accumulate(points, axis=0) + _APART * np.arange(len(points))[:, None])


def _through(x: FloatArray, y: FloatArray, at: FloatArray) -> FloatArray:
    """The increasing piecewise linear map of x (K,) onto y (K,), beyond its ends as steep as from its middle."""
    middle = len(x) // 2
    out = np.interp(at, x, y)
    for end in (0, -1):
        slope = (y[end] - y[middle]) / (x[end] - x[middle])
        beyond = at < x[0] if end == 0 else at > x[-1]
        out = np.where(beyond, y[end] + slope * (at - x[end]), out)
    return np.asarray(out)
