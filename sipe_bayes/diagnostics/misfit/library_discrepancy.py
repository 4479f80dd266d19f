r"""How far the values may be off where the whole library might be at work, each piece a little: no cause is chosen.

An effect that is too small to be told from noise may still be large enough to move the values by more than their
intervals; and where an effect is seen, the library may not hold it, only what moves theta alike. Both are asked of the
discrepancy between machine and model (M. Kennedy, A. O'Hagan, "Bayesian calibration of computer models", 2001,
https://doi.org/10.1111/1467-9868.00294), here spanned by the probes of all extensions. In the linear model of
``misfit.probed_logs``,

.. math:: r = J_\theta \delta + E b + J_x x + \varepsilon, \qquad b_k \sim \mathcal N(0, t^2 / (c_k i_k)),

with i_k the information of b_k once theta and the windows' starts are free, and c_k the number of extensions times that
of the columns that belong to k's: t^2 is about what the discrepancy adds to the residual's chi-square, shared out
evenly between extensions. t is zero with probability one half, else uniform in its logarithm. With theta flat and
integrated out, S the information of b and q its score,

.. math::

    p(r \mid t) \propto |I + D S D|^{-1/2} e^{q' D (I + D S D)^{-1} D q / 2}, \qquad
    D = \operatorname{diag}(t / \sqrt{c_k i_k}),

so that t's posterior is a sum over a grid, b is normal given t, and a b moves theta by its linear answer. The interval
widens as the evidence for a discrepancy grows, and is hardly widened where the residuals show none.

Deviations:

- Sizes of either sign, also of extensions that have but one: the columns stand for what no extension is, too.
- Columns that theta imitates almost wholly are left out: of those no residual tells the size (``misfit.tolerances``
  has those that matter). So are gains of single logs.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
import torch

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.options import Options, option
from sipe_bayes.diagnostics.misfit.probed_logs import ProbedLogs
from sipe_bayes.diagnostics.misfit.tolerances import IMITATED
from sipe_bayes.posterior import Particles, Posterior

_NOTHING = 1e-100  # information of a column that moves nothing


@dataclass(frozen=True)
class DiscrepancyOptions(Options):
    """What is believed of the discrepancy beforehand, and how many draws are made."""

    absent: float = option(0.5, "prior probability that there is none", least=0, most=1)
    smallest: float = option(0.3, "root of what it adds to chi-square", "sds", above=0)
    largest: float = option(3000.0, "the same, at most", "sds", above=0)
    sizes: int = option(25, "between these two, evenly in their logarithm", least=2)
    draws: int = option(4000, "of theta: quantiles to one or two percent of an sd", least=1)
    causes: int = option(3, "extensions that are named: those that move theta most", least=1)


_OPTIONS = DiscrepancyOptions()


@dataclass(frozen=True)
class Discrepancy:
    """What the library might do to the logs without being chosen.

    Args:
        shift: (M, N) draws of how far theta then is off.
        present: probability that there is a discrepancy.
        causes: extensions that move theta most, in words.
    """

    shift: FloatArray
    present: float
    causes: tuple[str, ...]

    def widened(self, posterior: Posterior, seed: int) -> Particles:
        """Draws of a posterior of theta, moved."""
        drawn = posterior.sample((len(self.shift),), generator=torch.Generator().manual_seed(seed)).numpy()
        return Particles(np.clip(drawn + self.shift, 0, 1), posterior.space)


def library_discrepancy(logs: ProbedLogs, seed: int = 0, options: DiscrepancyOptions = _OPTIONS) -> Discrepancy | None:
    """The discrepancy's posterior, in closed form; no simulation beside what ``logs`` took.

    Args:
        logs: linearised at the estimate.
        seed: of the draws.
        options: of the prior.

    Returns:
        None where no extension does what theta cannot.
    """
    seen, n = logs.seen(), logs.windows.num_theta
    whole, cross = seen.arrow.precision[n:, n:], seen.arrow.precision[n:, :n]
    information = whole - cross @ seen.answer
    size, most = np.diag(information), np.diag(whole)
    usable = [
        not p.by_log and m > _NOTHING and s > IMITATED * m for p, s, m in zip(logs.probes, size, most, strict=True)
    ]
    kept = np.flatnonzero(usable)
    if not len(kept):
        return None
    names = [logs.probes[k].name for k in kept]
    scale = shared_out(names, size[kept])
    size_posterior = SizePosterior.of(
        information[np.ix_(kept, kept)] * np.outer(scale, scale), seen.score[kept] * scale, options
    )
    drawn = size_posterior.draws(options.draws, np.random.default_rng(seed)) * scale
    moved = -seen.answer[:, kept]
    return Discrepancy(drawn @ moved.T, size_posterior.present, _largest(names, drawn, moved, seen.variance, options))


def shared_out(names: list[str], information: FloatArray) -> FloatArray:
    """Prior sds (K,) of columns at t = 1: the same of every extension, whatever number of columns (K,) it has."""
    columns = Counter(names)
    return np.asarray(1 / np.sqrt(information * len(columns) * np.array([columns[name] for name in names])))


def _largest(
    names: list[str],
    drawn: FloatArray,
    moved: FloatArray,
    variance: FloatArray,
    options: DiscrepancyOptions,
) -> tuple[str, ...]:
    """Of the extensions, those that move theta most: draws (M, K), answers (N, K)."""
    share = {}
    for name in dict.fromkeys(names):
        mine = np.array([other == name for other in names])
        share[name] = float((((drawn[:, mine] @ moved[:, mine].T) ** 2).mean(0) / np.maximum(variance, 1e-300)).sum())
    return tuple(sorted(share, key=lambda name: -share[name])[: options.causes])


@dataclass(frozen=True)
class SizePosterior:
    """Of K coefficients with standard normal priors times an unknown t, on a grid of t with zero among it.

    Args:
        sizes: (T,) of t.
        weights: (T,) their probabilities.
        values: (K,) eigenvalues of the coefficients' information.
        axes: (K, K) its axes.
        score: (K,) along them.
    """

    sizes: FloatArray
    weights: FloatArray
    values: FloatArray
    axes: FloatArray
    score: FloatArray

    @classmethod
    def of(cls, information: FloatArray, score: FloatArray, options: DiscrepancyOptions = _OPTIONS) -> SizePosterior:
        """From their information (K, K) and score (K,)."""
        values, axes = np.linalg.eigh(information)
        values, along = np.maximum(values, 0.0), axes.T @ score
        sizes = np.concatenate([[0.0], np.geomspace(options.smallest, options.largest, options.sizes)])
        grown = sizes[:, None] ** 2 / (1 + sizes[:, None] ** 2 * values)
        evidence = -0.5 * np.log1p(sizes[:, None] ** 2 * values).sum(1) + 0.5 * (grown * along**2).sum(1)
        believed = np.full(len(sizes), (1 - options.absent) / options.sizes)
        believed[0] = options.absent
        weights = believed * np.exp(evidence - evidence.max())
        return cls(sizes, weights / weights.sum(), values, axes, along)

    @property
    def present(self) -> float:
        """Probability that t is not zero."""
        return float(1 - self.weights[0])

    def draws(self, count: int, random: np.random.Generator) -> FloatArray:
        """Of the coefficients (count, K)."""
        t = random.choice(self.sizes, count, p=self.weights)[:, None]
        variance = t**2 / (1 + t**2 * self.values)
        along = variance * self.score + np.sqrt(variance) * random.standard_normal((count, len(self.values)))
        return np.asarray(along @ self.axes.T)
