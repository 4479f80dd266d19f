"""Scores of a posterior against a known truth, on one scale for points and distributions.

The SiPE paper (Mehta, Handa, Fox, Ramos 2020, https://arxiv.org/abs/2011.08985) scores accuracy_j = 1 - abs(E theta_j -
theta*_j), which sees the mean alone. Beside it stand strictly proper scores (T. Gneiting, A. Raftery 2007, "Strictly
Proper Scoring Rules, Prediction, and Estimation", JASA 102, https://doi.org/10.1198/016214506000001437), the smaller
the better, for a point its plain error:

    CRPS_j = E|theta_j - theta*_j| - 1/2 E|theta_j - theta_j'|,      energy = E|theta - theta*| - 1/2 E|theta - theta'|,

theta, theta' independent draws. Particles are the discrete distribution that they are. Otherwise CRPS_j is that of the
quantiles at 400 midpoints, and the energy score from draws, without bias (C. Ferro 2014, "Fair scores for ensemble
forecasts"). Where the truth lies outside the support only these, ``distance`` and ``noticed`` mean anything.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import asdict, dataclass

import numpy as np
import scipy.stats
import torch
from numpy.typing import ArrayLike
from scipy.spatial.distance import cdist

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.posterior import Dirac, Particles, Posterior
from sipe_bayes.posterior import prior as default_prior

Numbers = ArrayLike | torch.Tensor

LEVELS = (0.5, 0.9, 0.95)  # of the central intervals


@dataclass(frozen=True)
class Scores:
    """Scores in theta units; smaller CRPS and energy, larger everything else, is better.

    Args:
        accuracy: (N,) 1 - absolute error of the mean.
        crps, energy: (N,) continuous ranked probability score, and the energy score.
        nats: log p(truth) - log prior(truth); None without a density, minus infinity outside the support.
        covered: level -> (N,) whether the central interval holds the truth.
        contraction: (N,) 1 - sd / prior sd.
        skill_over_prior_mean: 1 - CRPS / CRPS of the prior's mean, over parameters; None where that is exact. And
            ``skill_over_prior``, the same of the prior.
        distance: (N,) of a truth outside [0, 1] to the nearest bound, else 0; and whether the posterior's median sits
            on that bound (``noticed``), None inside.
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
        summaries = ("mean_accuracy", "mean_crps", "mean_contraction")
        coverage = {level: self.coverage(float(level)) for level in self.covered}
        return {**asdict(self), **{name: getattr(self, name) for name in summaries}, "coverage": coverage}


def score(posterior: Posterior, truth: Numbers, prior: Posterior | None = None) -> Scores:
    """Scores of a posterior of N parameters against the truth (N,) in theta, which may lie outside [0, 1].

    Warns of a truth more than a whole range away, which most often holds physical values. ``prior`` is by default what
    the parameters say.

    Raises:
        ValueError: for a truth of another shape, or a prior of other parameters.
    """
    theta = _checked(posterior, truth)
    j = int(np.abs(theta - 0.5).argmax())
    if abs(theta[j] - 0.5) > 1.5:  # a whole range beyond a bound
        far = f"theta of {posterior.space.names[j]} is {theta[j]:.4g}, far outside [0, 1]"
        warnings.warn(f"truth: {far}; physical values become theta by space.normalise(values)", stacklevel=2)
    before = default_prior(posterior.space) if prior is None else prior
    if before.space.names != posterior.space.names:
        raise ValueError(f"prior: expected parameters {list(posterior.space.names)}, got {list(before.space.names)}")
    error, median, beyond = crps(posterior, theta), posterior.quantile(0.5).numpy(), np.abs(theta - 0.5) - 0.5
    at_bound = np.where(theta < 0, median, 1 - median) < THRESHOLDS.at_bound
    ends = {level: posterior.quantile([(1 - level) / 2, (1 + level) / 2]).numpy() for level in LEVELS}
    return Scores(
        names=posterior.space.names,
        accuracy=tuple((1 - np.abs(posterior.mean.numpy() - theta)).tolist()),
        crps=tuple(error.tolist()),
        energy=energy_score(posterior, theta),
        nats=nats(posterior, theta, before),
        covered={str(x): tuple(((low <= theta) & (theta <= high)).tolist()) for x, (low, high) in ends.items()},
        contraction=tuple((1 - posterior.stddev.numpy() / before.stddev.numpy()).tolist()),
        skill_over_prior_mean=_skill(error, crps(Dirac(before.mean, posterior.space), theta)),
        skill_over_prior=_skill(error, crps(before, theta)),
        distance=tuple(np.maximum(beyond, 0.0).tolist()),
        noticed=tuple(bool(at) if out else None for at, out in zip(at_bound, beyond > 0, strict=True)),
    )


def crps(posterior: Posterior, truth: Numbers) -> FloatArray:
    """Continuous ranked probability score (N,) against the truth (N,), each parameter by itself."""
    theta = _checked(posterior, truth)
    if isinstance(posterior, Dirac | Particles):
        points, weights = _points(posterior)
    else:
        points, weights = posterior.quantile((np.arange(400) + 0.5) / 400).numpy(), np.full(400, 1 / 400)
    pairs = zip(points.T, theta, strict=True)  # Cramer's distance to the point: half of the energy distance's square
    return np.array([0.5 * scipy.stats.energy_distance(x, [true], weights) ** 2 for x, true in pairs])


def energy_score(posterior: Posterior, truth: Numbers, draws: int = 2000, seed: int = 0) -> float:
    """Energy score against the truth (N,); draws: that stand for the posterior, of more particles picked evenly."""
    theta = _checked(posterior, truth)
    points, weights = _points(posterior, draws, seed)
    error, spread = weights @ np.linalg.norm(points - theta, axis=1), weights @ cdist(points, points) @ weights
    if not isinstance(posterior, Dirac | Particles):
        spread *= len(points) / (len(points) - 1)  # a draw is not its own partner
    return float(error - 0.5 * spread)


def _points(posterior: Posterior, draws: int | None = None, seed: int = 0) -> tuple[FloatArray, FloatArray]:
    """Points (M, N) and weights (M,) that stand for a posterior: those that it has, else or of more so many draws."""
    if isinstance(posterior, Dirac):
        return posterior.theta.numpy()[None], np.ones(1)
    if isinstance(posterior, Particles):
        theta, weights = posterior.theta.numpy(), posterior.weights.numpy()
        if draws is None or len(theta) <= draws:
            return theta, weights
        cumulative = weights.cumsum()
        rows = np.searchsorted(cumulative, (np.arange(draws) + 0.5) / draws * cumulative[-1])
        return theta[rows], np.full(draws, 1 / draws)
    drawn = posterior.sample((draws or 1,), generator=torch.Generator().manual_seed(seed)).numpy()
    return drawn, np.full(len(drawn), 1 / len(drawn))


def nats(posterior: Posterior, truth: Numbers, prior: Posterior) -> float | None:
    """Log density of the truth over the prior's; None without a density, minus infinity outside the support."""
    theta = torch.from_numpy(_checked(posterior, truth))
    if not (posterior.has_density and prior.has_density):
        return None
    after = float(posterior.log_prob(theta).detach())
    return after if math.isinf(after) else after - float(prior.log_prob(theta).detach())


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


def _skill(error: FloatArray, reference: FloatArray) -> float | None:
    return None if reference.mean() < 1e-12 else 1 - float(error.mean()) / float(reference.mean())
