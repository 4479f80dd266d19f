"""Whether a posterior is the normal that Laplace's method makes of it, and what it is where it is not.

``is_normal``: along each parameter's direction, two of its sds to either side of the optimum, the log posterior should
fall by two nats. Where it falls by less than half or more than twice as much, draws take the normal's place: adaptive
multiple importance sampling (J.-M. Cornuet, J.-M. Marin, A. Mira, C. Robert 2012, "Adaptive Multiple Importance
Sampling", Scand. J. Stat. 39, https://arxiv.org/abs/0907.1254).

The first batch comes in equal parts from the widened normal and from the prior; later ones from a normal with the
weighted draws' moments, widened, and to a tenth from the prior, which keeps the weights bounded (T. Hesterberg 1995,
"Weighted Average Importance Sampling and Defensive Mixture Distributions", Technometrics 37). What widening costs in
effective draws grows with the dimension and the square of what is added, which therefore shrinks with the dimension's
root. A draw's weight is the posterior's density by that of all batches together. They end with enough effective draws,
and become a mixture of kernels, drawn together so that mean and covariance stay those of the draws away from bounds (M.
West 1993, "Approximating Posterior Distributions by Mixtures", J. R. Stat. Soc. B 55). Of several normals each has its
own draws, those that most likely come from it: the next batch is about the one where a draw has the most mass, and
kernels are made of each alone.

``judged``: how far draws from a normal are from the posterior that it stands for, by the shape k of the Pareto
distribution of their largest weights (A. Vehtari, D. Simpson, A. Gelman, Y. Yao, J. Gabry, "Pareto Smoothed Importance
Sampling", JMLR 25, 2024, https://arxiv.org/abs/1507.02646).

Deviation: the batches' covariance is drawn towards the first normal's by the effective draws there are, so that few do
not make it singular.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import ClassVar

import numpy as np
import torch

from sipe_bayes.core.arrays import FloatArray, IntArray
from sipe_bayes.core.options import Options, option
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.inference.search.gaussians import log_normal
from sipe_bayes.posterior import GaussianMixture, Posterior
from sipe_bayes.posterior.storage import ready_arviz


@dataclass(frozen=True)
class ImportanceTuning(Options):
    """When draws take the normal's place, how they are drawn, and when they are enough."""

    wanted: bool = option(True, "whether an optimum's normal is held against the posterior, and draws take its place")
    probe: ClassVar[float] = 2.0  # how far from the optimum the log posterior is looked at (sd)
    slack: ClassVar[float] = 0.5  # by which falls of the log posterior may differ for rounding's sake (nats)
    least_fall: ClassVar[float] = 0.6  # a fall, over that of the normal, with which it stands
    most_fall: ClassVar[float] = 2.0  # the same above
    batch: ClassVar[int] = 24  # draws of a batch, or two for each dimension
    most_batches: ClassVar[int] = 20  # batches at most
    hopeless_after: ClassVar[int] = 6  # batches with less than one effective draw each after which it ends
    first_share: ClassVar[float] = 0.5  # share of the first batch that comes from the prior
    share: ClassVar[float] = 0.1  # share of later ones: bounds the weights
    first_wider: ClassVar[float] = 1.5  # width of the first proposal over the normal's
    wider: ClassVar[float] = 0.3  # by how much wider than the draws' later ones are, over the root of N
    elsewhere: ClassVar[float] = 3.0  # by which a draw is better than an optimum that is none (nats)
    enough: ClassVar[float] = 100.0  # effective draws with which it ends
    least: ClassVar[float] = 30.0  # effective draws that may be relied on
    judges: ClassVar[int] = 120  # draws that judge a normal: 33 of them are the tail that its k is fitted to
    most_share: ClassVar[float] = 0.25  # of the budget that a search leaves to them, at most
    at_once: ClassVar[int] = 50_000  # control steps simulated at a time when a normal is judged: memory
    kernels: ClassVar[int] = 60  # kernels of the posterior
    narrower: ClassVar[float] = 0.5  # width of kernels over Silverman's rule, for the bounds' sake

    def width(self, size: int) -> float:
        """Of later proposals over the draws' in ``size`` dimensions."""
        return float(1 + self.wider / np.sqrt(size))


@dataclass(frozen=True)
class Draws:
    """Draws in S batches of all kinds.

    Args:
        points: (M, N).
        values: (M,), the target there.
        share: (S,), of each batch that of the prior.
        mass: (S,), log of what lies of each batch's normal in the cube.
        means: (S, N), of those normals.
        covariances: (S, N, N).
    """

    points: FloatArray
    values: FloatArray
    share: FloatArray
    mass: FloatArray
    means: FloatArray
    covariances: FloatArray

    @classmethod
    def none(cls, size: int) -> Draws:
        """Before the first batch, in ``size`` dimensions."""
        return cls(*(np.empty((0, *shape)) for shape in ((size,), (), (), (), (size,), (size, size))))

    @property
    def batches(self) -> int:
        """How many."""
        return len(self.share)


Target = Callable[[FloatArray], FloatArray]
"""Log densities (B,) of points (B, N)."""


def probe_size(size: int) -> int:
    """Points that ``is_normal`` looks at in ``size`` dimensions, at most."""
    return 1 + 2 * size


def is_normal(
    target: Target, theta: FloatArray, mean: FloatArray, covariance: FloatArray, tuning: ImportanceTuning
) -> bool:
    """Whether a log density is about that of N(mean, covariance) around its optimum theta (N,); all in the cube."""
    sd, precision = np.sqrt(np.diag(covariance)), np.linalg.inv(covariance)
    along = (covariance / sd).T
    steps = tuning.probe * np.concatenate([along, -along])  # a row for each parameter and side
    room = np.where(steps > 0, 1 - theta, theta) / np.maximum(np.abs(steps), 1e-300)
    points = np.clip(theta + np.minimum(1.0, room.min(1))[:, None] * steps, 0.0, 1.0)
    all_points = np.concatenate([theta[None], points])
    values = target(all_points)
    gaps = all_points - mean
    energies = 0.5 * np.einsum("bi,ij,bj->b", gaps, precision, gaps)
    ratios = (values[0] - values[1:] + tuning.slack) / (energies[1:] - energies[0] + tuning.slack)
    return bool((ratios > tuning.least_fall).all() and (ratios < tuning.most_fall).all())


@dataclass(frozen=True)
class Judgement:
    """What draws say of a normal: the Pareto shape k of their weights, and how many of them are effective."""

    pareto_k: float
    effective: float
    draws: int

    @property
    def normal(self) -> bool:
        """Whether it stands; weights that are nearly alike have a tail of any shape.

        Of draws that all lie far from the posterior, few weights rule, and k is no large one.
        """
        if self.effective < THRESHOLDS.least_effective_share * self.draws:
            return False
        return self.pareto_k <= THRESHOLDS.pareto_k or self.effective >= THRESHOLDS.effective_share * self.draws


def judged(target: Target, normal: GaussianMixture, seed: int, tuning: ImportanceTuning, steps: int) -> Judgement:
    """Hold draws from a normal against the log density that it stands for; steps: control steps of the logs."""
    generator = torch.Generator().manual_seed(int(np.random.default_rng([seed, 1]).integers(2**31)))
    points = normal.sample((tuning.judges,), generator=generator)
    ratios = in_chunks(target, steps, tuning)(points.numpy()) - normal.log_prob(points).numpy()
    valid = np.isfinite(ratios)
    if not valid.any():
        return Judgement(np.inf, 0.0, tuning.judges)
    # arviz takes no infinity; what is 50 nats below the others counts for nothing
    ratios = np.where(valid, ratios, ratios[valid].min() - 50.0)
    relative = np.exp(ratios - ratios.max())
    return Judgement(pareto_shape(ratios), effective(relative / relative.sum()), tuning.judges)


def in_chunks(target: Target, steps: int, tuning: ImportanceTuning) -> Target:
    """The same log density by as many points at a time as memory holds; steps: control steps of the logs."""

    def values(points: FloatArray) -> FloatArray:
        chunks = np.array_split(points, max(1, round(len(points) * steps / tuning.at_once)))
        return np.concatenate([target(chunk) for chunk in chunks])

    return values


def pareto_shape(log_ratios: FloatArray) -> float:
    """Shape k of the generalised Pareto distribution of the largest of exp(log_ratios (M,))."""
    psislw = ready_arviz().psislw
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it warns of what is returned
        return float(psislw(log_ratios - log_ratios.max())[1])


def batch_size(size: int, tuning: ImportanceTuning) -> int:
    """Draws of a batch in ``size`` dimensions."""
    return max(tuning.batch, 2 * size)


def draw(
    draws: Draws, target: Target, normals: GaussianMixture, prior: Posterior, seed: int, tuning: ImportanceTuning
) -> Draws:
    """One more batch; ``normals`` are those of Laplace's method, ``target`` gives log densities.

    Of several normals it is about the one whose draws have the most mass each.
    """
    mean, covariance = _moments(draws, normals, prior, tuning)
    return drawn_from(draws, target, mean, covariance, tuning.share, prior, seed, tuning)


def drawn_from(
    draws: Draws,
    target: Target,
    mean: FloatArray,
    covariance: FloatArray,
    share: float,
    prior: Posterior,
    seed: int,
    tuning: ImportanceTuning,
) -> Draws:
    """One more batch, from N(mean (N,), covariance (N, N)) in the cube and to ``share`` from the prior."""
    batches, size = draws.batches, batch_size(len(mean), tuning)
    proposal = GaussianMixture([0.0], mean[None], covariance[None], prior.space)
    rng = np.random.default_rng([seed, batches])
    generator, count = torch.Generator().manual_seed(int(rng.integers(2**31))), int(rng.binomial(size, share))
    drawn = [one.sample((n,), generator=generator) for one, n in ((proposal, size - count), (prior, count))]
    points = torch.cat(drawn).numpy()
    mass = np.array([proposal.log_normaliser])
    new = Draws(points, target(points), np.array([share]), mass, mean[None], covariance[None])
    return Draws(*(np.concatenate([getattr(draws, f.name), getattr(new, f.name)]) for f in fields(Draws)))


def weights(draws: Draws, prior: Posterior) -> FloatArray:
    """Of the draws (M,), which sum to one; all zero where no draw is worth anything."""
    if not draws.batches:
        return np.zeros(0)
    points, terms = draws.points, []
    base = prior.log_prob(torch.from_numpy(points)).numpy()
    batches = zip(draws.share, draws.mass, draws.means, draws.covariances, strict=True)
    for share, mass, mean, covariance in batches:
        own = log_normal(points, mean, covariance) - mass
        terms.append(np.logaddexp(np.log1p(-share) + own, np.log(share) + base))
    ratios = draws.values - np.logaddexp.reduce(terms, axis=0)
    if not np.isfinite(ratios.max()):
        return np.zeros(len(ratios))
    relative = np.exp(ratios - ratios.max())
    return np.asarray(relative / relative.sum())


def ended(draws: Draws, prior: Posterior, tuning: ImportanceTuning, given: int = 0) -> bool:
    """Whether there are draws enough, or no more are worth it.

    given: batches whose proposals do not come from the draws.
    """
    count = effective(weights(draws, prior))
    hopeless = draws.batches >= tuning.hopeless_after + given and count < draws.batches
    return count >= tuning.enough or draws.batches >= tuning.most_batches or hopeless


def effective(weight: FloatArray) -> float:
    """The number of draws of equal weight with the same sum of squares."""
    return float(1 / (weight**2).sum()) if weight.any() else 0.0


def kernels(
    points: FloatArray,
    weight: FloatArray,
    normals: GaussianMixture,
    seed: int,
    tuning: ImportanceTuning,
    blur: FloatArray | float = 0.0,
) -> GaussianMixture:
    """The posterior that draws (M, N) with weights (M,) stand for; of normals each with its own draws.

    Around one of several that has too few of them, a normal of their moments as far as these tell, else its own.

    blur: covariance (N, N) that each kernel has in addition.
    """
    nearest, parts = _nearest(points, normals), []
    for k in np.unique(nearest[weight > 0]):
        own = nearest == k
        mass = weight[own].sum()
        if len(normals.means) > 1 and effective(weight[own] / mass) < tuning.least:
            mean, spread = _blended(points[own], weight[own] / mass, normals, k)
            parts.append((np.array([mass]), mean[None], (spread + blur)[None]))
        else:
            parts.append(_kernels(points[own], weight[own] / mass, mass, seed, tuning, blur))
    shares, means, spreads = (np.concatenate(of_parts) for of_parts in zip(*parts, strict=True))
    return GaussianMixture(np.log(shares), means, spreads, normals.space).of_masses()  # at a bound not whole


def _kernels(
    points: FloatArray, weight: FloatArray, mass: float, seed: int, tuning: ImportanceTuning, blur: FloatArray | float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Shares (K,) of the mass, means (K, N) and covariances (K, N, N) of the kernels of draws (M, N)."""
    n, number = points.shape[1], tuning.kernels
    mean = weight @ points
    covariance = (points - mean).T @ ((points - mean) * weight[:, None])
    silverman = (4 / (effective(weight) * (n + 2))) ** (1 / (n + 4))  # of the sds
    width = tuning.narrower * silverman
    shrunk = mean + np.sqrt(1 - width**2) * (points - mean)
    order = np.argsort((points - mean) @ np.linalg.eigh(covariance)[1][:, -1], kind="stable")
    comb = (np.arange(number) + np.random.default_rng([seed, 0, 1]).random()) / number
    picked = order[np.minimum(np.searchsorted(np.cumsum(weight[order]), comb), len(weight) - 1)]
    which, counts = np.unique(picked, return_counts=True)
    # rounding leaves some kernels' covariance singular
    spread = width**2 * covariance + 1e-9 * np.diag(np.diag(covariance))
    return mass * counts / number, shrunk[which], np.tile(spread + blur, (len(which), 1, 1))


def _nearest(points: FloatArray, normals: GaussianMixture) -> IntArray:
    """Which normal each of points (M, N) most likely comes from (M,)."""
    own = zip(normals.means.numpy(), normals.covariances.numpy(), strict=True)
    return np.argmax([log_normal(points, mean, covariance) for mean, covariance in own], axis=0)


def _moments(
    draws: Draws, normals: GaussianMixture, prior: Posterior, tuning: ImportanceTuning
) -> tuple[FloatArray, FloatArray]:
    """Mean (N,) and covariance (N, N) of the next proposal."""
    weight, nearest = weights(draws, prior), _nearest(draws.points, normals)
    count = np.bincount(nearest, minlength=len(normals.means))
    chosen = int(np.argmax(np.bincount(nearest, weight, len(count)) / np.maximum(count, 1)))
    own = (nearest == chosen) & (weight > 0)
    if not own.any():
        return normals.means.numpy()[chosen], normals.covariances.numpy()[chosen]
    mean, covariance = _blended(draws.points[own], weight[own] / weight[own].sum(), normals, chosen)
    return mean, tuning.width(len(mean)) ** 2 * covariance


def _blended(
    points: FloatArray, weight: FloatArray, normals: GaussianMixture, which: int
) -> tuple[FloatArray, FloatArray]:
    """Mean (N,) of draws (M, N), and their covariance (N, N), the fewer the more that of the normal ``which``."""
    number, mean = effective(weight), weight @ points
    trust = number / (number + 2 * points.shape[1])
    covariance = (points - mean).T @ ((points - mean) * weight[:, None])
    return mean, trust * covariance + (1 - trust) * normals.covariances.numpy()[which]
