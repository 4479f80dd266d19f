r"""How far theta may be off, for what the model lacks or may lack: the discrepancy-aware posterior.

In the linear model of ``structure.augmented`` three things are unknown beside theta:

- *What is missing.* What extensions would do spans the discrepancy between machine and model (M. Kennedy, A. O'Hagan,
  "Bayesian calibration of computer models", 2001, https://doi.org/10.1111/1467-9868.00294); the sizes of their probes
  have the prior of ``structure.single_effects``.
- *Numbers that no machine has exactly* (``structure.tolerances``): normal around the model's, of the sd that is stated.
- *What differs between logs*, or pieces of one. Log g asks for theta_g ~ N(mu, t^2 C_g), C_g what it leaves unknown by
  itself, with evidence from Cochran's Q of nu degrees of freedom

  .. math:: p(Q \mid t) \propto (1 + t^2)^{-\nu / 2} e^{-Q / (2 (1 + t^2))},

  an integrated Birge ratio (R. Birge, "The calculation of errors by the method of least squares", Physical Review 40
  (1932), https://doi.org/10.1103/PhysRev.40.207). Theta is that of a further log.

Deviations:

- The noise is estimated anew with the effects that are seen, in turns; where the fit takes far more for noise than
  samples scatter by, also from that scatter on, and the higher likelihood counts: slow noise passes for slow forces.
- Columns that theta imitates but for a twentieth of their information, to which linearised dry friction is right, are
  not asked of the logs: with a tolerance they keep it, without one they are left out.
- The share of a first-order move that is made in truth is normal around one, of sd one half, and not negative.
- A number with a tolerance that the logs do not show moves theta only where something else is more likely missing than
  not; elsewhere it is named (``contributions``).
- A trade (``structure.probes``) moves theta by the root of its size; where all are at work nothing is traded.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.special
import torch

from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray
from sipe_bayes.likelihood import UNIFORM_PRECISION, BoundLikelihood, Noise
from sipe_bayes.posterior import GaussianMixture, Particles, Posterior
from sipe_bayes.structure.augmented import AtNoise, AugmentedModel
from sipe_bayes.structure.probes import Probe
from sipe_bayes.structure.single_effects import Columns, Effects, find_effects, size_grid
from sipe_bayes.structure.tolerances import EXACT, Tolerances

DIFFER = 0.2  # prior probability that logs ask for different values
_DRAWS = 4000  # of theta: quantiles to one or two percent of an sd
_ENDS = (0.05, 0.95)  # of the intervals that are printed


@dataclass(frozen=True)
class Discrepancy:
    """What a model may lack, to first order, by the linear model beside the noise that is left (``at``).

    ``effects`` are of the probes ``usable`` (R,); ``known`` are numbers with a tolerance, ``spread`` is of logs.
    """

    at: AtNoise
    usable: IntArray
    effects: Effects | None
    known: Known
    spread: Spread
    tolerances: Tolerances = EXACT

    def draw(self, posterior: Posterior, seed: int) -> Particles:
        """Theta, from a posterior that takes the model for right, whose 90 % intervals lie within."""
        random, logs, made = np.random.default_rng(seed), self.at.logs, self.at.projected
        single, every = np.zeros((2, _DRAWS, len(logs.probes)))
        if self.effects is not None:
            single[:, self.usable] = sum(effect.draws(_DRAWS, random) for effect in self.effects.single)
            every[:, self.usable] = self.effects.every.draws(_DRAWS, random)
        sizes = single + every
        known = self.known.draws(sizes, random)
        if not self.is_doubted:
            steps = np.array([probe.is_step for probe in logs.probes], bool)
            known[:, ~_asked(self.at) & ~steps] = 0.0
        sizes += known
        share = np.maximum(1 + 0.5 * random.standard_normal((_DRAWS, 1)), 0.0)
        released = made.base - logs.seen.projected.base  # of parameters that come away from their bounds
        moved = released + share * (logs.traded(single) - sizes @ made.answer.T + made.pressed)
        return _holding(self._stretched(posterior, random) + moved, posterior)

    def _stretched(self, posterior: Posterior, random: np.random.Generator) -> FloatArray:
        """Draws (M, N) of a posterior, stretched by what samples tell less and by what logs differ."""
        before, after = (np.diag(at.projected.covariance) for at in (self.at.logs.seen, self.at))
        both = (before > 0) & (after > 0)  # else a bound holds the parameter
        stretch = np.sqrt(np.where(both, after / np.where(both, before, 1.0), 1.0))
        if isinstance(posterior, GaussianMixture):  # before the cube cuts it off, each component as probable as before
            covariances = posterior.covariances.numpy() * np.outer(stretch, stretch)
            log_weights = posterior.log_weights + posterior.log_masses
            wider = GaussianMixture(log_weights, posterior.means, covariances, posterior.space).of_masses()
            theta = _draws(wider, random)
        else:
            middle = posterior.mean.numpy()
            theta = middle + stretch * (_draws(posterior, random) - middle)
        apart = self.spread.draws(len(theta), random) * np.sqrt(np.maximum(after, 0.0))
        return np.asarray(theta + apart * random.standard_normal(theta.shape))

    @property
    def is_doubted(self) -> bool:
        """Whether it is more likely than not that an effect is at work, or that logs differ."""
        return bool(self.causes) or self.spread.weights[0] < 0.5

    def contributions(self) -> list[Contribution]:
        """What each number with a tolerance adds to what is not known of theta."""
        out = []
        for k, sd in zip(self.known.columns, np.sqrt(np.diag(self.known.covariance)).tolist(), strict=True):
            probe = self.at.logs.probes[k]
            share, shift = self.tolerances.of(probe), -self.at.projected.answer[:, k] * math.copysign(sd, probe.whole)
            off = probe.placed.extension.off(probe.placed.site, share)
            out.append(Contribution(probe, off, shift, sd / abs(share * probe.whole)))
        return out

    @property
    def causes(self) -> tuple[str, ...]:
        """Extensions that are more likely at work than not, in words; those that no log tells apart as one."""
        seen = [] if self.effects is None else self.effects.seen
        return tuple(dict.fromkeys(" or ".join(effect.alike()) for effect in seen))


@dataclass(frozen=True)
class LogEstimate:
    """One log by itself: mean (N,) and information (N, N) in theta."""

    name: str
    mean: FloatArray
    information: FloatArray


def parts_of(windows: BoundLikelihood) -> list[tuple[str, IntArray]]:
    """Each log's name and windows; of a single one pieces that stand for several, of whole windows."""
    logs = windows.trajectories
    if len(logs) > 1:
        own = [(name, np.flatnonzero(windows.log == k)) for k, name in enumerate(logs.names)]
        return [(name, mine) for name, mine in own if len(mine)]
    pieces = np.array_split(np.argsort(windows.start), min(5, windows.num_windows))
    return [(logs.names[0], piece) for piece in pieces]


@dataclass(frozen=True)
class Contribution:
    """What a number with a tolerance adds, that a probe changes, and a ``sentence`` of what it is where it is off.

    Theta has a ``shift`` (N,) where it is an sd larger than the logs tell; ``left`` is that sd over the tolerance.
    """

    probe: Probe
    sentence: str
    shift: FloatArray
    left: float

    def moves(self, sd: FloatArray) -> BoolArray:
        """Which values (N,) it moves by more than their sd (N,); none of a number that the logs tell themselves."""
        return np.asarray((np.abs(self.shift) > sd) & (self.left > 0.5))


def draw_differing(posterior: Posterior, logs: Sequence[LogEstimate], seed: int) -> Particles:
    """Theta of a further log, from a posterior and what several logs say by themselves, where nothing is probed."""
    middle, random = posterior.mean.numpy(), np.random.default_rng(seed)
    scores = [log.information @ (log.mean - middle) for log in logs]
    apart = Spread.between([log.information for log in logs], scores).draws(_DRAWS, random)
    theta = _draws(posterior, random)
    return _holding(theta + apart * posterior.stddev.numpy() * random.standard_normal(theta.shape), posterior)


def _draws(posterior: Posterior, random: np.random.Generator) -> FloatArray:
    generator = torch.Generator().manual_seed(int(random.integers(2**31)))
    return np.asarray(posterior.sample((_DRAWS,), generator=generator).numpy())


def _holding(theta: FloatArray, posterior: Posterior) -> Particles:
    """Draws (M, N), each parameter's mapped so that its 90 % interval holds the posterior's."""
    # what lies beyond a bound by so much lies as far within: by that much at least the linear model is wrong
    theta = np.clip(np.where(theta > 1, 2 - theta, np.abs(theta)), 0, 1)
    inner = posterior.quantile(torch.tensor(_ENDS, dtype=torch.float64)).numpy()
    for j, (low, high) in enumerate(inner.T):
        own = np.quantile(theta[:, j], _ENDS)
        theta[:, j] = np.interp(theta[:, j], [0.0, *own, 1.0], [0.0, min(low, own[0]), max(high, own[1]), 1.0])
    return Particles(theta, posterior.space)


def find_discrepancy(logs: AugmentedModel, tolerances: Tolerances = EXACT) -> Discrepancy:
    """What the model lacks, or may lack, by its linear model at an estimate; nothing is simulated for it."""
    sds = np.array([tolerances.of(probe) * probe.whole for probe in logs.probes])
    sds = np.where(np.isfinite(sds), sds, 0.0)
    noises = [logs.noise, *([] if logs.scatter is None else [logs.scatter])]
    told, usable, effects = max((_explained(logs, noise, sds) for noise in noises), key=lambda one: _level(*one))
    return Discrepancy(told, usable, effects, Known.of(told, sds), Spread.of(told), tolerances)


def _explained(logs: AugmentedModel, noise: Noise, sds: FloatArray) -> tuple[AtNoise, IntArray, Effects | None]:
    """Effects and the noise that they leave, in turns from a noise on; the probes that were asked for."""
    at = logs.seen if noise is logs.noise else AtNoise(logs, noise)
    for _ in range(3):
        before, told = at.sizes, at.discounted
        usable, effects = _effects(told, sds)
        sizes = np.zeros(len(logs.probes))
        if effects is not None:
            sizes[usable] = effects.sizes
        if not (sizes.any() or before.any()):
            break
        at = AtNoise(logs, logs.estimate_noise(at.noise, sizes), sizes)
    return AtNoise(logs, told.noise, sizes), usable, effects


def _level(at: AtNoise, usable: IntArray, effects: Effects | None) -> float:
    """The log-likelihood with effects that are more likely at work than not, less what is against each beforehand."""
    seen = [] if effects is None else effects.seen
    columns = usable[[int(effect.by_column.argmax()) for effect in seen]]
    return at.logs.fitted(columns.astype(int), at.noise)[0] - sum(effect.against for effect in seen)


def _asked(at: AtNoise) -> BoolArray:
    """Whether the logs are asked for the size of each probe (K,): theta does not imitate almost all of it."""
    made = at.projected
    # the square of a column that moves nothing is no number
    return (made.whole > 1e-150) & (np.diag(made.information) > 0.05 * made.whole)


def _effects(at: AtNoise, sds: FloatArray) -> tuple[IntArray, Effects | None]:
    """The probes that may be missing, and what is told of them beside numbers of known sds (K,)."""
    probes, made = at.logs.probes, at.projected
    able = [not probe.placed.by_log and not (probe.is_step and sd) for probe, sd in zip(probes, sds, strict=True)]
    usable = np.flatnonzero(_asked(at) & np.array(able, bool))
    known = Known.of(at, sds)  # and integrated out
    information = made.information - known.cross.T @ known.covariance @ known.cross
    score = made.score - known.cross.T @ known.mean
    # not those that are the same as a number with a tolerance
    usable = usable[np.diag(information)[usable] > 1e-3 * np.diag(made.information)[usable]]
    if not len(usable):
        return usable, None
    names, one_sided = [probes[k].name for k in usable], at.logs.one_sided[usable]
    return usable, find_effects(Columns(names, information[np.ix_(usable, usable)], score[usable], one_sided))


@dataclass(frozen=True)
class Known:
    """Numbers with a tolerance: their sizes are normal around zero, and told by the logs where theta leaves that.

    Of the probes ``columns`` (J,) the information ``cross`` (J, K) with all probes, zero where the logs are not asked,
    the covariance (J, J) of the sizes and their mean (J,) beside no other probe.
    """

    columns: IntArray
    cross: FloatArray
    covariance: FloatArray
    mean: FloatArray

    @classmethod
    def of(cls, at: AtNoise, sds: FloatArray) -> Known:
        """Of sds (K,) in sizes, zero without a tolerance."""
        columns, made = np.flatnonzero(sds), at.projected
        told = _asked(at)[columns]
        cross = np.where(told[:, None], made.information[columns], 0.0)
        own = np.where(np.outer(told, told), cross[:, columns], 0.0)
        covariance = np.linalg.inv(own + np.diag(1 / sds[columns] ** 2))
        return cls(columns, cross, covariance, covariance @ np.where(told, made.score[columns], 0.0))

    def draws(self, sizes: FloatArray, random: np.random.Generator) -> FloatArray:
        """(M, K) of them alone, beside sizes (M, K) of others."""
        out, variances = np.zeros_like(sizes), np.diag(np.diag(self.covariance))
        root = np.linalg.cholesky(self.covariance + 1e-12 * variances)
        away = random.standard_normal((len(sizes), len(self.columns))) @ root.T
        out[:, self.columns] = self.mean - sizes @ (self.covariance @ self.cross).T + away
        return out


@dataclass(frozen=True)
class Spread:
    """By how much logs differ: how many times what a log leaves unknown by itself (T,), with probabilities (T,).

    ``alone`` (N,) is the variance by a log itself over that by all.
    """

    times: FloatArray
    weights: FloatArray
    alone: FloatArray

    @classmethod
    def of(cls, at: AtNoise) -> Spread:
        """Of logs, or of pieces of one, in the linear model."""
        n, among = at.logs.windows.num_theta, np.ix_(at.free, at.free)
        parts = [at.of_part(mine) for _, mine in parts_of(at.logs.windows)]
        scores = [(gradient[:n] - precision[:n, n:] @ at.sizes)[at.free] for precision, gradient in parts]
        own = cls.between([precision[:n, :n][among] for precision, _ in parts], scores)
        alone = np.zeros(n)
        alone[at.free] = own.alone
        return replace(own, alone=alone)

    @classmethod
    def between(cls, precisions: Sequence[FloatArray], scores: Sequence[FloatArray]) -> Spread:
        """Of G logs with (N, N) and (N,) at a common theta each; none of a single one."""
        n = len(scores[0]) if scores else 0
        if len(scores) < 2 or not n:
            return cls(np.zeros(1), np.ones(1), np.zeros(n))
        belief = UNIFORM_PRECISION * np.eye(n)
        own, whole = [np.linalg.inv(one + belief) for one in precisions], np.linalg.inv(sum(precisions) + belief)
        pull = np.sum(scores, axis=0)
        square = sum(float(s @ c @ s) for s, c in zip(scores, own, strict=True)) - float(pull @ whole @ pull)
        left = UNIFORM_PRECISION * (sum(np.trace(c) for c in own) - np.trace(whole))
        freedom = max((len(scores) - 1) * n - left, 0.0)
        grid, believed = size_grid()
        times = np.append(0.0, grid)
        prior = np.log(np.append(1 - DIFFER, DIFFER * believed))
        evidence = prior - 0.5 * freedom * np.log1p(times**2) - 0.5 * max(square, 0.0) / (1 + times**2)
        alone = np.mean([np.diag(c) for c in own], axis=0) / np.diag(whole)
        return cls(times, scipy.special.softmax(evidence), np.minimum(alone, 2 * len(scores)))

    def draws(self, count: int, random: np.random.Generator) -> FloatArray:
        """(M, N): sds that are added, in those that all logs leave."""
        times = random.choice(self.times, count, p=self.weights)
        return np.asarray(times[:, None] * np.sqrt(1 + self.alone))
