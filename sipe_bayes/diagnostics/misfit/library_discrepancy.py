r"""How far the values may be off where the library might be at work: one piece of it, or all of it, each a little.

An effect that is too small to be told from noise may still be large enough to move the values by more than their
intervals; and where an effect is seen, the library may not hold it, only what moves theta alike. Both are asked of the
discrepancy between machine and model (M. Kennedy, A. O'Hagan, "Bayesian calibration of computer models", 2001,
https://doi.org/10.1111/1467-9868.00294), here spanned by the probes of all extensions. In the linear model of
``misfit.probed_logs``,

.. math:: r = J_\theta \delta + E b + J_x x + \varepsilon,

with S the information of b once theta and the windows' starts are free and q its score, three states of affairs are
averaged over by their evidence: nothing is missing (b = 0); one column k is at work, each extension as probable as
another, :math:`b_k \sim \mathcal N(0, t^2 / S_{kk})`, halved where its size may not be negative; or all are,
:math:`b_k \sim \mathcal N(0, t^2 / (c_k S_{kk}))` with c_k the number of extensions times that of the columns that
belong to k's. In both t^2 is about what the discrepancy adds to chi-square; t is half-Cauchy (A. Gelman, "Prior
distributions for variance parameters in hierarchical models", 2006, https://doi.org/10.1214/06-BA117A), on a grid. With
theta flat and integrated out,

.. math::

    p(r \mid t, k) &\propto (1 + t^2)^{-1/2} e^{z^2 t^2 / (2 (1 + t^2))} [2 \Phi(z t / \sqrt{1 + t^2})],
    \qquad z = q_k / \sqrt{S_{kk}}, \\
    p(r \mid t) &\propto |I + D S D|^{-1/2} e^{q' D (I + D S D)^{-1} D q / 2}, \qquad
    D = \operatorname{diag}(t / \sqrt{c_k S_{kk}}),

b is then (half) normal, and moves theta by its linear answer, and by the trade of a probe that takes from theta what it
adds (``structure.probes``), whose size is the root of b. The interval widens as the evidence for a discrepancy grows,
no alarm decides, and it is hardly widened where the residuals show none. All of it is asked of samples that count for
what they tell beside those around them (``misfit.probed_logs``), and the posterior is stretched as they are.

Deviations:

- Where all are at work nothing is traded: the root of a small size is not small, and a delay would be wide on any log.
  One at work, a lag is half normal in its square.
- All at work have sizes of either sign, also extensions that have but one: they stand for what no extension is, too.
- Columns that theta imitates almost wholly are left out: of those no residual tells the size (``misfit.tolerances``
  has those that matter). So are gains of single logs.
- What physics steps do, where there is a tolerance, is no piece that may be missing: its size is normal around zero, by
  ``Tolerances.physics_step``, between a machine's, which takes none, and that of a simulated log.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.special
import torch

from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray
from sipe_bayes.core.options import Options, option
from sipe_bayes.diagnostics.misfit.probed_logs import ProbedLogs
from sipe_bayes.diagnostics.misfit.tolerances import EXACT, IMITATED, Tolerances
from sipe_bayes.posterior import GaussianMixture, Particles, Posterior
from sipe_bayes.posterior.truncated_normal import interval_quantile
from sipe_bayes.structure.physics_step import PHYSICS_STEP
from sipe_bayes.structure.probes import Probe

_NOTHING = 1e-100  # information of a column that moves nothing
_FAR = 40.0  # sds beyond which a normal has no mass


@dataclass(frozen=True)
class DiscrepancyOptions(Options):
    """What is believed of the discrepancy beforehand, and how many draws are made."""

    absent: float = option(0.4, "prior probability that nothing is missing; one or all, half the rest each", least=0)
    scale: float = option(3.0, "of the half-Cauchy on the root of what it adds to chi-square", "sds", above=0)
    smallest: float = option(0.3, "of the grid of that root", "sds", above=0)
    largest: float = option(3000.0, "of the grid of that root", "sds", above=0)
    sizes: int = option(25, "between these two, evenly in their logarithm", least=2)
    draws: int = option(4000, "of theta: quantiles to one or two percent of an sd", least=1)
    causes: int = option(3, "extensions that are named: those that move theta most", least=1)

    @property
    def grid(self) -> tuple[FloatArray, FloatArray]:
        """The sizes t (T,) and their prior probabilities."""
        t = np.geomspace(self.smallest, self.largest, self.sizes)
        density = t / (1 + (t / self.scale) ** 2)  # by logarithm
        return t, density / density.sum()


_OPTIONS = DiscrepancyOptions()


@dataclass(frozen=True)
class Discrepancy:
    """What the library might do to the logs without being chosen.

    Args:
        shift: (M, N) draws of how far theta then is off.
        stretch: (N,) of the posterior's own sds, where samples tell less than it takes them for.
        causes: extensions that move theta most, in words.
    """

    shift: FloatArray
    stretch: FloatArray
    causes: tuple[str, ...]

    def widened(self, posterior: Posterior, seed: int) -> Particles:
        """Draws of a posterior of theta, stretched and moved."""
        normal = isinstance(posterior, GaussianMixture)
        wider = self._before_the_cube(posterior) if isinstance(posterior, GaussianMixture) else posterior
        drawn = wider.sample((len(self.shift),), generator=torch.Generator().manual_seed(seed)).numpy()
        if not normal:
            middle = posterior.mean.numpy()
            drawn = middle + self.stretch * (drawn - middle)
        return Particles(np.clip(drawn + self.shift, 0, 1), posterior.space)

    def _before_the_cube(self, posterior: GaussianMixture) -> GaussianMixture:
        """Stretched where the cube does not cut it off yet, each component as probable as before."""
        covariances = posterior.covariances.numpy() * np.outer(self.stretch, self.stretch)
        log_weights = posterior.log_weights + posterior.log_masses
        return GaussianMixture(log_weights, posterior.means, covariances, posterior.space).of_masses()


def library_discrepancy(
    logs: ProbedLogs, seed: int = 0, options: DiscrepancyOptions = _OPTIONS, tolerances: Tolerances = EXACT
) -> Discrepancy | None:
    """The discrepancy's posterior, in closed form; no simulation beside what ``logs`` took.

    Args:
        logs: linearised at the estimate.
        seed: of the draws.
        options: of the prior.
        tolerances: of which that of physics steps is asked.

    Returns:
        None where no extension does what theta cannot.
    """
    plain, logs = logs.seen.variance, logs.discounted
    seen, n = logs.seen, logs.windows.num_theta
    stretch = np.sqrt(np.where(plain > 0, seen.variance / np.where(plain > 0, plain, 1.0), 1.0))
    whole, cross = logs.arrow.precision[n:, n:], logs.arrow.precision[n:, :n]
    information = whole - cross @ seen.answer
    size, full = np.diag(information), np.diag(whole)
    steps = [k for k, probe in enumerate(logs.probes) if probe.extension is PHYSICS_STEP and tolerances.of(probe)]
    able = [not p.by_log and f > _NOTHING and s > IMITATED * f for p, s, f in zip(logs.probes, size, full, strict=True)]
    kept = np.array([k for k in np.flatnonzero(able) if k not in steps], int)
    if not len(kept) and not steps:
        return None
    beside = [_Beside.of(logs.probes[k], tolerances, kept, k, information, seen.score, able[k]) for k in steps]
    shared, score = information[np.ix_(kept, kept)], seen.score[kept]
    for step in beside:
        shared, score = step.without(shared, score)
    names, random = [logs.probes[k].name for k in kept], np.random.default_rng(seed)
    drawn, one = np.zeros((options.draws, 0)), np.zeros(options.draws, bool)
    if len(kept):
        drawn, _, one = Columns(names, shared, score, logs.one_sided[kept]).draws(options, random)
    sizes = np.zeros((len(drawn), len(logs.probes)))
    sizes[:, kept] = drawn
    for k, step in zip(steps, beside, strict=True):
        sizes[:, k] = step.draws(drawn, random)
        names.append(logs.probes[k].name)

    def moved(name: str | None = None) -> FloatArray:
        """Theta (M, N), by all extensions or by one."""
        some = np.flatnonzero([name in (None, probe.name) for probe in logs.probes])
        own = sizes[:, some]
        return np.asarray(logs.traded(np.where(one[:, None], own, 0.0), some) - own @ seen.answer[:, some].T)

    square = {name: (moved(name) ** 2).mean(0) / np.maximum(seen.variance, 1e-300) for name in dict.fromkeys(names)}
    most = sorted(square, key=lambda name: -float(square[name].sum()))
    return Discrepancy(moved(), stretch, tuple(most[: options.causes]))


@dataclass(frozen=True)
class _Beside:
    """What physics steps do, a column whose size is known beforehand, beside K others whose are not.

    Args:
        score: its own.
        precision: of its size, told and known.
        shared: (K,) information with the others.
    """

    score: float
    precision: float
    shared: FloatArray

    @classmethod
    def of(
        cls,
        probe: Probe,
        tolerances: Tolerances,
        kept: IntArray,
        k: int,
        information: FloatArray,
        score: FloatArray,
        determined: bool,
    ) -> _Beside:
        """Of column k; the logs are not asked where theta imitates it almost wholly, as of all such columns."""
        known = 1 / (probe.whole * tolerances.of(probe)) ** 2
        if not determined:
            return cls(0.0, known, np.zeros(len(kept)))
        return cls(float(score[k]), known + float(information[k, k]), information[k, kept])

    def without(self, information: FloatArray, score: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Information (K, K) and score (K,) of the others where this one is integrated out."""
        share = self.shared / self.precision
        return information - np.outer(share, self.shared), score - share * self.score

    def draws(self, others: FloatArray, random: np.random.Generator) -> FloatArray:
        """Of its size (M,), beside sizes (M, K) of the others."""
        mean = (self.score - others @ self.shared) / self.precision
        return np.asarray(mean + random.standard_normal(len(others)) / np.sqrt(self.precision))


@dataclass(frozen=True)
class Columns:
    """K columns of a discrepancy, all else integrated out.

    Args:
        names: (K,) of the extensions that they belong to.
        information: (K, K).
        score: (K,).
        one_sided: (K,) those whose size may not be negative.
    """

    names: Sequence[str]
    information: FloatArray
    score: FloatArray
    one_sided: BoolArray

    @property
    def parts(self) -> FloatArray:
        """Each column's share (K,) of its extension's, where all extensions have the same; they add up to one."""
        count = Counter(self.names)
        return np.array([1 / (len(count) * count[name]) for name in self.names])

    def draws(self, options: DiscrepancyOptions, random: np.random.Generator) -> tuple[FloatArray, float, BoolArray]:
        """Of their sizes (M, K), the probability that there is any, and of which draws (M,) one alone is at work."""
        one, every = _OneAtWork(self, options), _AllAtWork(self, options)
        states = np.array([0.0, one.log_evidence, every.log_evidence])
        believed = np.array([options.absent, *[(1 - options.absent) / 2] * 2])
        weights = believed * np.exp(states - states.max())
        weights /= weights.sum()
        counts = random.multinomial(options.draws, weights)
        none = np.zeros((counts[0], len(self.score)))
        drawn = np.concatenate([none, one.draws(counts[1], random), every.draws(counts[2], random)])
        return drawn, float(1 - weights[0]), np.repeat([False, True, False], counts)


class _OneAtWork:
    """One column, of any size."""

    def __init__(self, columns: Columns, options: DiscrepancyOptions) -> None:
        t, believed = options.grid
        self.precision, self.one_sided = np.diag(columns.information), columns.one_sided
        self.z, self.shrunk = columns.score / np.sqrt(self.precision), t**2 / (1 + t**2)
        square = self.shrunk[:, None] * self.z**2
        evidence = -0.5 * np.log1p(t**2)[:, None] + 0.5 * square
        half = np.log(2) + scipy.special.log_ndtr(np.sqrt(self.shrunk)[:, None] * self.z)
        evidence = evidence + np.where(self.one_sided, half, 0.0) + np.log(believed)[:, None] + np.log(columns.parts)
        self.log_evidence = float(scipy.special.logsumexp(evidence))
        self.weights = np.exp(evidence - self.log_evidence)

    def draws(self, count: int, random: np.random.Generator) -> FloatArray:
        """Of the sizes (count, K)."""
        weights = self.weights.ravel() / self.weights.sum()
        t, k = np.divmod(random.choice(len(weights), count, p=weights), len(self.z))
        sd = np.sqrt(self.shrunk[t])
        mean = sd**2 * self.z[k]
        low = np.where(self.one_sided[k], -mean / sd, -_FAR)
        own = mean + sd * interval_quantile(low, np.maximum(low, 0.0) + _FAR, random.uniform(size=count))
        sizes = np.zeros((count, len(self.z)))
        sizes[np.arange(count), k] = own / np.sqrt(self.precision[k])
        return sizes


class _AllAtWork:
    """All columns at once, each a little."""

    def __init__(self, columns: Columns, options: DiscrepancyOptions) -> None:
        self.t, believed = options.grid
        self.scale = np.sqrt(columns.parts / np.diag(columns.information))
        values, self.axes = np.linalg.eigh(columns.information * np.outer(self.scale, self.scale))
        self.values, self.along = np.maximum(values, 0.0), self.axes.T @ (self.scale * columns.score)
        square = self.t[:, None] ** 2
        grown = square / (1 + square * self.values)
        evidence = 0.5 * (grown * self.along**2 - np.log1p(square * self.values)).sum(1) + np.log(believed)
        self.log_evidence = float(scipy.special.logsumexp(evidence))
        self.weights = np.exp(evidence - self.log_evidence)

    def draws(self, count: int, random: np.random.Generator) -> FloatArray:
        """Of the sizes (count, K)."""
        square = random.choice(self.t, count, p=self.weights / self.weights.sum())[:, None] ** 2
        variance = square / (1 + square * self.values)
        along = variance * self.along + np.sqrt(variance) * random.standard_normal((count, len(self.values)))
        return np.asarray(along @ self.axes.T * self.scale)
