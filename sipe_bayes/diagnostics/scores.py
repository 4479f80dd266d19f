"""Scores of a posterior against a known truth, on one scale for points and distributions.

The SiPE paper (Mehta, Handa, Fox, Ramos 2020, https://arxiv.org/abs/2011.08985) scores accuracy_j = 1 - abs(E theta_j -
theta*_j), which sees the mean alone. Beside it stand strictly proper scores (T. Gneiting, A. Raftery 2007, "Strictly
Proper Scoring Rules, Prediction, and Estimation", JASA 102, https://doi.org/10.1198/016214506000001437), smallest in
expectation for the true posterior, and for a point its plain error, so that points and distributions share an axis:

    CRPS_j = E|theta_j - theta*_j| - 1/2 E|theta_j - theta_j'|,      energy = E|theta - theta*| - 1/2 E|theta - theta'|,

theta, theta' independent draws, | | Euclidean. Dirac: absolute and Euclidean error. Particles are the discrete
distribution that they are, weights included. Otherwise CRPS_j = 2 int (1[theta*_j < q_a] - a) (q_a - theta*_j) da with
the quantiles q_a by the midpoint rule, and the energy score from draws, without bias (C. Ferro 2014, "Fair scores for
ensemble forecasts").

Mind: the prior's mean is a perfect guess of a truth at the centre of the range, and out of distribution, where the
truth lies outside the support, only CRPS, energy score, ``distance`` and ``noticed`` mean anything. A truth more than a
whole range away is scored with a warning: it is most often physical values where theta is expected.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import asdict, dataclass

import numpy as np
import torch
from numpy.typing import ArrayLike
from scipy.spatial.distance import cdist

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.models.sbi_tools import import_sbi
from sipe_bayes.posterior import Dirac, Particles, Posterior, SurrogatePosterior
from sipe_bayes.posterior import prior as default_prior

Numbers = ArrayLike | torch.Tensor

LEVELS = (0.5, 0.9, 0.95)  # of the central intervals
_QUANTILES = 400
_DRAWS = 2000
_FAR = 1.5  # from the centre: a whole range beyond a bound


@dataclass(frozen=True)
class Scores:
    """Scores in theta units; smaller CRPS and energy, larger everything else, is better.

    Args:
        names: of the N parameters.
        accuracy: (N,) 1 - absolute error of the mean.
        crps: (N,) continuous ranked probability score.
        energy: the energy score.
        nats: log p(truth) - log prior(truth); None without a density, minus infinity outside the support.
        covered: level -> (N,) whether the central interval holds the truth.
        contraction: (N,) 1 - sd / prior sd.
        skill_over_prior_mean: 1 - CRPS / CRPS of the prior's mean, over parameters; None where that is exact.
        skill_over_prior: the same of the prior.
        distance: (N,) of a truth outside [0, 1] to the nearest bound, else 0.
        noticed: (N,) of a truth outside, whether the posterior's median sits on that bound; None inside.
    """

    names: tuple[str, ...]
    accuracy: tuple[float, ...]
    crps: tuple[float, ...]
    energy: float
    nats: float | None
    covered: dict[str, tuple[bool, ...]]
    contraction: tuple[float, ...]
    skill_over_prior_mean: float | None
    skill_over_prior: float | None
    distance: tuple[float, ...]
    noticed: tuple[bool | None, ...]

    @property
    def mean_accuracy(self) -> float:
        """Over parameters."""
        return float(np.mean(self.accuracy))

    @property
    def min_accuracy(self) -> float:
        """Of the worst parameter."""
        return min(self.accuracy)

    @property
    def max_accuracy(self) -> float:
        """Of the best parameter."""
        return max(self.accuracy)

    @property
    def mean_crps(self) -> float:
        """Over parameters."""
        return float(np.mean(self.crps))

    @property
    def mean_contraction(self) -> float:
        """Over parameters."""
        return float(np.mean(self.contraction))

    def coverage(self, level: float) -> float:
        """The share of parameters whose interval of ``level`` holds the truth; raises ValueError for another level."""
        if str(level) not in self.covered:
            raise ValueError(f"level: expected one of {', '.join(self.covered)}, got {level}")
        return float(np.mean(self.covered[str(level)]))

    def to_dict(self) -> dict[str, object]:
        """Plain data, for JSON, with the summaries over parameters."""
        summaries = ("mean_accuracy", "min_accuracy", "max_accuracy", "mean_crps", "mean_contraction")
        coverage = {level: self.coverage(float(level)) for level in self.covered}
        return {**asdict(self), **{name: getattr(self, name) for name in summaries}, "coverage": coverage}


def score(posterior: Posterior, truth: Numbers, prior: Posterior | None = None) -> Scores:
    """Scores of a posterior against the truth; the same posterior has the same scores.

    Warns of a truth that is more than the range of a parameter away from its bounds.

    Args:
        posterior: of N parameters.
        truth: (N,) in theta; it may lie outside [0, 1].
        prior: what was believed before; default what the parameters say.

    Raises:
        ValueError: for a truth of another shape, or a prior of other parameters.
    """
    theta = _checked(posterior, truth)
    _warn_if_far(posterior, theta)
    before = default_prior(posterior.space) if prior is None else prior
    if before.space.names != posterior.space.names:
        raise ValueError(f"prior: expected parameters {list(posterior.space.names)}, got {list(before.space.names)}")
    error = crps(posterior, theta)
    return Scores(
        names=posterior.space.names,
        accuracy=tuple((1 - np.abs(posterior.mean.numpy() - theta)).tolist()),
        crps=tuple(error.tolist()),
        energy=energy_score(posterior, theta),
        nats=nats(posterior, theta, before),
        covered={str(level): _covered(posterior, theta, level) for level in LEVELS},
        contraction=tuple((1 - posterior.stddev.numpy() / before.stddev.numpy()).tolist()),
        skill_over_prior_mean=_skill(error, crps(Dirac(before.mean, posterior.space), theta)),
        skill_over_prior=_skill(error, crps(before, theta)),
        distance=tuple(np.maximum(np.maximum(-theta, theta - 1), 0.0).tolist()),
        noticed=_noticed(posterior, theta),
    )


def crps(posterior: Posterior, truth: Numbers) -> FloatArray:
    """Continuous ranked probability score (N,) against the truth (N,), each parameter by itself."""
    theta = _checked(posterior, truth)
    if isinstance(posterior, Dirac):
        return np.abs(posterior.theta.numpy() - theta)
    if isinstance(posterior, Particles):
        points, weights = posterior.theta.numpy(), posterior.weights.numpy()
        return weights @ np.abs(points - theta) - 0.5 * _spread(points, weights)
    level = (np.arange(_QUANTILES) + 0.5) / _QUANTILES
    quantile = posterior.quantile(level).numpy()
    return np.asarray(2 * np.mean(((theta < quantile) - level[:, None]) * (quantile - theta), axis=0))


def _spread(points: FloatArray, weights: FloatArray) -> FloatArray:
    """E|x - x'| (N,) of weighted points (M, N).

    That is 2 sum_i w_i x_i (2 W_i - w_i - 1) with W the cumulative weight in order.
    """
    order = np.argsort(points, axis=0)
    sorted_points, sorted_weights = np.take_along_axis(points, order, 0), weights[order]
    middle = np.cumsum(sorted_weights, axis=0) - sorted_weights / 2
    return np.asarray(2 * (sorted_weights * sorted_points * (2 * middle - 1)).sum(0))


def energy_score(posterior: Posterior, truth: Numbers, draws: int = _DRAWS, seed: int = 0) -> float:
    """Energy score against the truth.

    Args:
        posterior: of N parameters.
        truth: (N,) in theta.
        draws: that stand for the posterior; of more particles as many are picked evenly.
        seed: of the draws.
    """
    theta = _checked(posterior, truth)
    points, weights = _points(posterior, draws, seed)
    error = float(weights @ np.linalg.norm(points - theta, axis=1))
    if len(points) == 1:
        return error
    spread = float(weights @ cdist(points, points) @ weights)
    if not isinstance(posterior, Particles):
        spread *= len(points) / (len(points) - 1)  # a draw is not its own partner
    return error - 0.5 * spread


def _points(posterior: Posterior, draws: int, seed: int) -> tuple[FloatArray, FloatArray]:
    """Points (M, N) and weights (M,) that stand for a posterior."""
    if isinstance(posterior, Dirac):
        return posterior.theta.numpy()[None], np.ones(1)
    if isinstance(posterior, Particles) and len(posterior.theta) <= draws:
        return posterior.theta.numpy(), posterior.weights.numpy()
    if isinstance(posterior, Particles):
        cumulative = posterior.weights.numpy().cumsum()
        rows = np.searchsorted(cumulative, (np.arange(draws) + 0.5) / draws * cumulative[-1])
        return posterior.theta.numpy()[rows], np.full(draws, 1 / draws)
    theta = posterior.sample((draws,), generator=torch.Generator().manual_seed(seed)).numpy()
    return theta, np.full(draws, 1 / draws)


def nats(posterior: Posterior, truth: Numbers, prior: Posterior) -> float | None:
    """What was learnt about the truth: log p(truth) - log prior(truth).

    Args:
        posterior: of N parameters.
        truth: (N,) in theta.
        prior: what was believed before.

    Returns:
        None where either has no density, minus infinity where the posterior excludes the truth.
    """
    theta = torch.from_numpy(_checked(posterior, truth))
    if not (posterior.has_density and prior.has_density):
        return None
    after = float(posterior.log_prob(theta).detach())
    return after if math.isinf(after) else after - float(prior.log_prob(theta).detach())


def c2st(posterior: Posterior, reference: Numbers, seed: int = 0) -> float:
    """Accuracy of a classifier that tells draws of the posterior from others: 0.5 when it cannot, 1 when it always can.

    D. Lopez-Paz, M. Oquab 2017, "Revisiting Classifier Two-Sample Tests" (https://arxiv.org/abs/1610.06545), by
    ``sbi.utils.metrics.c2st`` with its random forest.

    Args:
        posterior: of N parameters.
        reference: draws (M, N) in theta.
        seed: of the draws.

    Raises:
        ValueError: for fewer than 20 reference draws.
    """
    given = posterior.space.check_shape(reference)
    if given.ndim != 2 or len(given) < 20:
        raise ValueError(f"reference: expected at least 20 draws (M, {len(posterior.space)}), got {given.shape}")
    generator = torch.Generator().manual_seed(seed)
    stored = _stored(posterior)
    if stored is not None:  # without replacement: a repeated draw gives itself away
        own = stored[torch.randperm(len(stored), generator=generator)[: len(given)]]
    else:
        own = posterior.sample((len(given),), generator=generator)
    other = torch.from_numpy(given)[: len(own)].float()
    return float(import_sbi("utils.metrics").c2st(other, own.float(), seed=seed + 1))


def _stored(posterior: Posterior) -> torch.Tensor | None:
    """The equally likely draws (M, N) that ``sample`` repeats; None where it makes new ones."""
    if isinstance(posterior, SurrogatePosterior):
        return posterior.draws
    if isinstance(posterior, Particles) and float(posterior.weights.max() - posterior.weights.min()) < 1e-12:
        return posterior.theta
    return None


def _checked(posterior: Posterior, truth: Numbers) -> FloatArray:
    if not isinstance(posterior, Posterior):
        raise ValueError(f"posterior: expected one, as fit(...) returns, got a {type(posterior).__name__}")
    try:
        theta = posterior.space.check_shape(truth.numpy() if isinstance(truth, torch.Tensor) else truth)
    except ValueError as error:
        raise ValueError(f"truth: {error}; give theta, space.normalise(values)") from None
    if theta.ndim != 1 or not np.isfinite(theta).all():
        raise ValueError(f"truth: expected {len(posterior.space)} finite numbers in theta, got {theta.tolist()}")
    return theta


def _warn_if_far(posterior: Posterior, theta: FloatArray) -> None:
    j = int(np.abs(theta - 0.5).argmax())
    if abs(theta[j] - 0.5) > _FAR:
        warnings.warn(
            f"truth: theta of {posterior.space.names[j]} is {theta[j]:.4g}, far outside [0, 1]; physical values become "
            "theta by space.normalise(values)",
            UserWarning,
            stacklevel=3,
        )


def _covered(posterior: Posterior, theta: FloatArray, level: float) -> tuple[bool, ...]:
    low, high = posterior.quantile([(1 - level) / 2, (1 + level) / 2]).numpy()
    return tuple(((low <= theta) & (theta <= high)).tolist())


def _skill(error: FloatArray, reference: FloatArray) -> float | None:
    worst = float(reference.mean())
    return None if worst < 1e-12 else 1 - float(error.mean()) / worst


def _noticed(posterior: Posterior, theta: FloatArray) -> tuple[bool | None, ...]:
    median = posterior.quantile(0.5).numpy()
    to_bound = np.where(theta < 0, median, 1 - median)
    outside = (theta < 0) | (theta > 1)
    return tuple(bool(d < THRESHOLDS.at_bound) if out else None for d, out in zip(to_bound, outside, strict=True))
