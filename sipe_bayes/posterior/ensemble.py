"""Draws of an unnormalised density over the unit cube, and its normaliser, by an ensemble of walkers.

D. Foreman-Mackey et al. 2013, "emcee: The MCMC Hammer", https://arxiv.org/abs/1202.3665. Walkers move over z with
theta = Phi(z), which has no walls and in which the uniform prior is the standard normal:

1. Warm-up by differential evolution (C. J. F. ter Braak, J. A. Vrugt 2008) and stretches.
2. A defensive mixture q = 0.2 prior + 0.4 N(m, C) + 0.4 kernels on warm-up draws, with m and C the draws' moments, in
   z. Importance sampling from q gives the normaliser Z and the standard error of log Z; where its weights are even
   enough they also redraw the walkers and q's centres, so that none stays behind in a far corner.
3. Blocks of moves, half of them independent proposals from q, until the chains have mixed.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy.special import ndtr, ndtri
from torch import Tensor

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.options import Options, option
from sipe_bayes.core.seeding import torch_generator_from
from sipe_bayes.posterior.base import Posterior
from sipe_bayes.posterior.storage import ready_arviz

if TYPE_CHECKING:
    import emcee

LogDensity = Callable[[FloatArray], FloatArray]
"""Unnormalised log density (n,) of z (n, N), with respect to z."""
_EDGE = 1e-12  # theta is kept this far inside the cube where it becomes z, which is finite then


@dataclass(frozen=True)
class EnsembleOptions(Options):
    """How long the ensemble walks, and what its proposals are made of."""

    warm_up: int = option(400, "steps before proposals are made of the draws, at most half of all", least=1)
    block: int = option(400, "steps between looks at the mixing", least=1)
    most_steps: int = option(2400, "steps after which it ends, mixed or not", least=2)
    mixed_rhat: float = option(1.02, "R-hat at which it has mixed", above=1)
    effective: float = option(2000.0, "effective draws at which it has enough", above=0)
    kept: int = option(8000, "draws that are kept at most", least=1)
    importance: int = option(20_000, "draws for the normaliser", least=4)
    kernels: int = option(200, "centres of the defensive mixture", least=1)
    trusted: float = option(0.05, "share of effective importance draws from which on they place walkers", least=0)
    shares: tuple[float, float, float] = option((0.2, 0.4, 0.4), "of prior, one Gaussian and kernels in the mixture")


@dataclass(frozen=True)
class EnsembleDraws:
    """What an ensemble gives.

    Args:
        z: kept draws (chains, M, N).
        log_normaliser: log Z.
        normaliser_error: its standard error.
        mixing: of the whole chain, see ``mixing_of``, with ``acceptance`` and ``steps``.
    """

    z: FloatArray
    log_normaliser: float
    normaliser_error: float
    mixing: dict[str, float]


def sample_ensemble(
    log_density: LogDensity,
    walkers: FloatArray,
    prior: Posterior,
    random: np.random.RandomState,
    options: EnsembleOptions,
) -> EnsembleDraws:
    """Walk until mixed.

    Args:
        log_density: what is drawn from.
        walkers: where they begin, z (W, N).
        prior: a part of the defensive mixture.
        random: the generator, of the kind that emcee wants.
        options: how long.
    """
    # warm up
    warm_up = min(options.warm_up, options.most_steps // 2)
    warm, state = _walk(log_density, walkers, None, warm_up, random)
    points = warm[warm_up // 2 :].reshape(-1, walkers.shape[1])
    # the normaliser, and better places for the walkers
    for count in (options.importance // 4, options.importance):
        proposal = DefensiveMixture(points, prior, random, options)
        log_normaliser, error, drawn = _importance(log_density, proposal, count, random, options.trusted)
        if drawn is not None:
            points, state = drawn, drawn[: len(walkers)]
    # walk
    chain, mixing = np.empty((0, *walkers.shape)), {"rhat": math.inf, "ess": 0.0}
    while len(chain) + warm_up < options.most_steps and not (
        mixing["rhat"] <= options.mixed_rhat and mixing["ess"] >= options.effective
    ):
        steps = min(options.block, options.most_steps - warm_up - len(chain))
        more, state = _walk(log_density, state, proposal, steps, random)
        chain = np.concatenate([chain, more])
        moved = float((np.diff(chain, axis=0) != 0).any(2).mean())
        mixing = {**mixing_of(chain), "acceptance": moved, "steps": float(len(chain))}
    thin = max(1, math.ceil(chain.shape[0] * chain.shape[1] / options.kept))
    return EnsembleDraws(np.swapaxes(chain[::-thin][::-1], 0, 1), log_normaliser, error, mixing)


def mixing_of(chain: FloatArray) -> dict[str, float]:
    """How well an ensemble has mixed; its walkers are taken for chains, which is optimistic.

    A. Vehtari, A. Gelman, D. Simpson, B. Carpenter, P.-C. Burkner 2021, "Rank-normalization, folding, and localization:
    an improved R-hat", Bayesian Analysis 16, as ArviZ has it.

    Args:
        chain: (steps, W, N).

    Returns:
        Over the parameters the largest R-hat ``rhat``, and the fewest effective draws ``ess`` of bulk and tails; the
        autocorrelation time ``autocorrelation_steps`` is that of the bulk.
    """
    arviz = ready_arviz()
    draws = [column.T for column in np.moveaxis(chain, 2, 0)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        rhat = np.array([arviz.rhat(x) for x in draws])
        bulk, tail = (np.array([arviz.ess(x, method=method) for x in draws]) for method in ("bulk", "tail"))
    if not (np.isfinite(rhat).all() and np.isfinite(bulk).all()):  # walkers that have not moved
        return {"rhat": math.inf, "ess": 0.0, "autocorrelation_steps": float(len(chain))}
    tau = max(1.0, chain.shape[0] * chain.shape[1] / float(bulk.min()))
    return {"rhat": float(rhat.max()), "ess": float(min(bulk.min(), tail.min())), "autocorrelation_steps": tau}


def from_line(z: FloatArray) -> Tensor:
    """The theta = Phi(z) of z."""
    return torch.from_numpy(ndtr(z))


def onto_line(theta: FloatArray) -> FloatArray:
    """The z = Phi^-1(theta) of theta, finite."""
    return np.asarray(ndtri(np.clip(theta, _EDGE, 1 - _EDGE)))


def log_jacobian(z: FloatArray) -> FloatArray:
    """The log |d theta / d z| (n,) of z (n, N)."""
    return -0.5 * (z**2).sum(1) - z.shape[1] / 2 * math.log(2 * math.pi)


def draws_on_line(distribution: Posterior, count: int, random: np.random.RandomState) -> FloatArray:
    """Draws z (count, N) of a distribution over theta."""
    return onto_line(distribution.sample((count,), generator=torch_generator_from(random)).numpy())


class DefensiveMixture:
    """The mixture q: draws, log density, and a Metropolis-Hastings proposal of emcee.

    Args:
        warm: draws z (n, N) whose moments and places it takes.
        prior: its defensive part.
        random: picks the kernels' centres.
        options: ``kernels`` and ``shares`` of them.
    """

    def __init__(
        self, warm: FloatArray, prior: Posterior, random: np.random.RandomState, options: EnsembleOptions
    ) -> None:
        self.prior, self.shares, n = prior, options.shares, warm.shape[1]
        self.mean, self.factor = warm.mean(0), _factor(warm)
        self.centres = warm[random.randint(len(warm), size=options.kernels)]
        self.kernel = max(len(warm) ** (-1 / (n + 4)), 0.1) * _factor(_core(warm))

    def draw(self, count: int, random: np.random.RandomState) -> FloatArray:
        """Draws z (count, N)."""
        kind = random.choice(3, size=count, p=self.shares)[:, None]
        normal = self.mean + self._normal(count, self.factor, random)
        kernels = self.centres[random.randint(len(self.centres), size=count)] + self._normal(count, self.kernel, random)
        prior = draws_on_line(self.prior, count, random)
        return np.where(kind == 0, prior, np.where(kind == 1, normal, kernels))

    def _normal(self, count: int, factor: FloatArray, random: np.random.RandomState) -> FloatArray:
        return random.standard_normal((count, len(self.mean))) @ factor.T

    def log_density(self, z: FloatArray) -> FloatArray:
        """Log density (n,) of z (n, N)."""
        half = z.shape[1] / 2 * math.log(2 * math.pi)
        white = np.linalg.solve(self.factor, (z - self.mean).T)
        normal = -0.5 * (white**2).sum(0) - np.log(np.diag(self.factor)).sum() - half
        points, centres = (np.linalg.solve(self.kernel, (a - self.mean).T).T for a in (z, self.centres))
        far = (points**2).sum(1)[:, None] + (centres**2).sum(1) - 2 * points @ centres.T
        kernels = np.logaddexp.reduce(-0.5 * np.maximum(far, 0), axis=1) - math.log(len(centres))
        kernels -= np.log(np.diag(self.kernel)).sum() + half
        with torch.no_grad():
            prior = self.prior.log_prob(from_line(z)).numpy() + log_jacobian(z)
        parts = zip((prior, normal, kernels), self.shares, strict=True)
        return np.asarray(np.logaddexp.reduce([part + np.log(share) for part, share in parts], axis=0))

    def __call__(self, walkers: FloatArray, random: np.random.RandomState) -> tuple[FloatArray, FloatArray]:
        """Proposals for walkers z (W, N), and the logarithms (W,) of their Hastings ratios."""
        proposed = self.draw(len(walkers), random)
        return proposed, self.log_density(walkers) - self.log_density(proposed)


def _walk(
    log_density: LogDensity,
    begin: FloatArray | emcee.State,
    proposal: DefensiveMixture | None,
    steps: int,
    random: np.random.RandomState,
) -> tuple[FloatArray, emcee.State]:
    """Chain (steps, W, N) and the ensemble's last state, from walkers (W, N) or a state."""
    import emcee

    from sipe_bayes.posterior.snooker import SnookerMove

    moves = [(emcee.moves.DEMove(), 0.6), (SnookerMove(), 0.1), (emcee.moves.StretchMove(), 0.3)]
    if proposal is not None:
        moves = [(move, share / 2) for move, share in moves] + [(emcee.moves.MHMove(proposal), 0.5)]
    state = emcee.State(getattr(begin, "coords", begin), random_state=random.get_state())
    sampler = emcee.EnsembleSampler(*state.coords.shape, log_density, vectorize=True, moves=moves)
    end = sampler.run_mcmc(state, steps, skip_initial_state_check=True, progress=False)
    random.set_state(end.random_state)
    return sampler.get_chain(), end


def _factor(z: FloatArray) -> FloatArray:
    """Cholesky factor (N, N) of the covariance of z (n, N), kept positive definite."""
    covariance = np.atleast_2d(np.cov(z.T))
    n = len(covariance)
    return np.linalg.cholesky(covariance + (1e-12 + 1e-9 * np.trace(covariance) / n) * np.eye(n))


def _core(z: FloatArray) -> FloatArray:
    """The half of z (n, N) that lies closest together: kernels as wide as far tails would miss a narrow peak."""
    kept = z
    for _ in range(3):
        white = np.linalg.solve(_factor(kept), (z - np.median(kept, axis=0)).T)
        square = (white**2).sum(0)
        kept = z[square <= np.median(square)]
    return kept


def _importance(
    log_density: LogDensity, proposal: DefensiveMixture, count: int, random: np.random.RandomState, trusted: float
) -> tuple[float, float, FloatArray | None]:
    """The normaliser log Z by importance sampling, and its standard error.

    The third is z (count, N) drawn by the weights; None where a few points have all the weight.
    """
    z = proposal.draw(count, random)
    log_weight = log_density(z) - proposal.log_density(z)
    top = log_weight.max()
    weight = np.exp(log_weight - top)
    mean, error = weight.mean(), weight.std() / weight.mean() / math.sqrt(count)
    effective = weight.sum() ** 2 / (weight**2).sum()
    drawn = z[random.choice(count, size=count, p=weight / weight.sum())] if effective > trusted * count else None
    return float(top + np.log(mean)), float(error), drawn
