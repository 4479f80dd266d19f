"""Whether a posterior is the normal that Laplace's method makes of it, and what it is where it is not.

``normal``: along each parameter's direction, two of its sds to either side of the optimum, the log posterior should fall by two nats.
Where it falls by less than half or more than twice as much, draws take the normal's place: adaptive multiple importance sampling (J.-M. Cornuet, J.-M. Marin, A.
Mira, C. Robert 2012, "Adaptive Multiple Importance Sampling", Scand. J. Stat. 39, https://arxiv.org/abs/0907.1254). The first
batch comes in equal parts from the widened normal and from the prior; later ones from a normal with the weighted draws' moments, widened, and to a fifth from the
prior, which keeps the weights bounded (T. Hesterberg 1995, "Weighted Average Importance Sampling and Defensive Mixture Distributions", Technometrics 37). A
draw's weight is the posterior's density by that of all batches together. They end with enough effective draws, and become a mixture of
kernels, drawn together so that mean and covariance stay those of the draws away from bounds (M. West 1993, "Approximating Posterior Distributions by Mixtures", J. R. Stat. Soc. B 55).

Deviation: the batches' covariance is drawn towards the first normal's by the effective draws there are, so that few do not make it singular.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray

from sipe_bayes.core.checkpoint import State
from sipe_bayes.core.parameters import ParameterSpace
from sipe_bayes.inference.search.gaussians import log_normal
from sipe_bayes.posterior import GaussianMixture, Posterior

FloatArray = NDArray[np.float64]

_SDS = 2.0  # of a parameter, to which the probe goes
_SLACK, _RANGE = 0.5, (0.6, 2.0)  # nats; how falls may compare, both with the slack
_BATCH, _FIRST_SHARE, _SHARE = 24, 0.5, 0.2  # draws; of the prior
_FIRST_WIDER, _WIDER = 1.5, 1.3  # times the sds
ENOUGH, LEAST = 100, 30  # effective draws: with which it ends, and with which it may be relied on
MOST = 20  # batches
_KERNELS, _NARROWER, _JITTER = 60, 0.5, 1e-9  # the last of the variances

Target = Callable[[FloatArray], FloatArray]
"""Log densities (B,) of points (B, N)."""


def cost(size: int) -> int:
    """Points that ``normal`` looks at in ``size`` dimensions, at most."""
    return 1 + 2 * size


def normal(target: Target, theta: FloatArray, mean: FloatArray, cov: FloatArray) -> bool:
    """Whether a log density is about that of N(mean, cov) around its optimum theta (N,); all in the cube."""
    sd, precision = np.sqrt(np.diag(cov)), np.linalg.inv(cov)
    steps = _SDS * np.concatenate([(cov / sd).T, -(cov / sd).T])  # a row for each parameter and side
    room = np.where(steps > 0, 1 - theta, theta) / np.maximum(np.abs(steps), 1e-300)
    points = np.clip(theta + np.minimum(1.0, room.min(1))[:, None] * steps, 0.0, 1.0)
    all_points = np.concatenate([theta[None], points])
    values = target(all_points)
    gaps = all_points - mean
    energies = 0.5 * np.einsum("bi,ij,bj->b", gaps, precision, gaps)
    ratios = (values[0] - values[1:] + _SLACK) / (energies[1:] - energies[0] + _SLACK)
    return bool((ratios > _RANGE[0]).all() and (ratios < _RANGE[1]).all())


def begin(size: int) -> State:
    """A state without draws: points (S, N) and the target there (S,); of each batch its share of the prior, its normal's mean and covariance, and
    the log of what lies of that in the cube."""
    shapes = {"points": (0, size), "values": (0,), "share": (0,), "mass": (0,)}
    shapes |= {"mean": (0, size), "covariance": (0, size, size)}
    return {f"draws_{name}": np.empty(shape) for name, shape in shapes.items()}


def batch(size: int) -> int:
    """Draws of a batch in ``size`` dimensions."""
    return max(_BATCH, 2 * size)


def draw(state: State, target: Target, found: GaussianMixture, prior: Posterior, seed: int) -> State:
    """One more batch; found: Laplace's normal."""
    done, size, share = len(state["draws_share"]), batch(len(found.space)), _SHARE
    if done:
        mean, covariance = _moments(state, found, prior)
    else:
        mean, covariance, share = found.means.numpy()[0], _FIRST_WIDER**2 * found.covariances.numpy()[0], _FIRST_SHARE
    proposal = GaussianMixture([0.0], mean[None], covariance[None], found.space)
    rng = np.random.default_rng([seed, done])
    generator, count = torch.Generator().manual_seed(int(rng.integers(2**31))), int(rng.binomial(size, share))
    drawn = [one.sample((n,), generator=generator) for one, n in ((proposal, size - count), (prior, count))]
    points = torch.cat(drawn).numpy()
    new = {
        "points": points,
        "values": target(points),
        "share": np.array([share]),
        "mass": np.array([proposal.log_normaliser]),
    }
    new |= {"mean": mean[None], "covariance": covariance[None]}
    return {**state, **{f"draws_{k}": np.concatenate([state[f"draws_{k}"], v]) for k, v in new.items()}}


def weights(state: State, prior: Posterior) -> FloatArray:
    """Of the draws (S,), which sum to one; all zero where no draw is worth anything."""
    points, terms = state["draws_points"], []
    base = prior.log_prob(torch.from_numpy(points)).numpy()
    batches = (state[f"draws_{name}"] for name in ("share", "mass", "mean", "covariance"))
    for share, mass, mean, covariance in zip(*batches, strict=True):
        own = log_normal(points, mean, covariance) - mass
        terms.append(np.logaddexp(np.log1p(-share) + own, np.log(share) + base))
    ratios = state["draws_values"] - np.logaddexp.reduce(terms, axis=0)
    if not np.isfinite(ratios.max()):
        return np.zeros(len(ratios))
    relative = np.exp(ratios - ratios.max())
    return np.asarray(relative / relative.sum())


def effective(weight: FloatArray) -> float:
    """The number of draws of equal weight with the same sum of squares."""
    return float(1 / (weight**2).sum()) if weight.any() else 0.0


def kernels(state: State, weight: FloatArray, space: ParameterSpace, seed: int) -> GaussianMixture:
    """The posterior that weighted draws stand for."""
    points, n = state["draws_points"], len(space)
    mean = weight @ points
    covariance = (points - mean).T @ ((points - mean) * weight[:, None])
    silverman = (4 / (effective(weight) * (n + 2))) ** (1 / (n + 4))  # of the sds
    width = _NARROWER * silverman  # for the bounds' sake
    shrunk = mean + np.sqrt(1 - width**2) * (points - mean)
    order = np.argsort((points - mean) @ np.linalg.eigh(covariance)[1][:, -1], kind="stable")
    comb = (np.arange(_KERNELS) + np.random.default_rng([seed, 0, 1]).random()) / _KERNELS
    picked = order[np.minimum(np.searchsorted(np.cumsum(weight[order]), comb), len(weight) - 1)]
    which, counts = np.unique(picked, return_counts=True)
    spread = width**2 * covariance + _JITTER * np.diag(np.diag(covariance))
    means, spreads = shrunk[which], np.tile(spread, (len(which), 1, 1))
    masses = GaussianMixture(np.log(counts), means, spreads, space).log_masses.numpy()  # at a bound not whole
    return GaussianMixture(np.log(counts) - masses, means, spreads, space)


def _moments(state: State, found: GaussianMixture, prior: Posterior) -> tuple[FloatArray, FloatArray]:
    """Mean (N,) and covariance (N, N) of the next proposal."""
    weight, points = weights(state, prior), state["draws_points"]
    base, count = found.covariances.numpy()[0], effective(weight)
    if not count:
        return found.means.numpy()[0], base
    mean, trust = weight @ points, count / (count + 2 * points.shape[1])
    covariance = (points - mean).T @ ((points - mean) * weight[:, None])
    return mean, _WIDER**2 * (trust * covariance + (1 - trust) * base)
