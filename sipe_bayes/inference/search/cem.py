"""The cross-entropy method: a Gaussian over theta, fitted again and again to its best draws.

R. Y. Rubinstein 1999, "The Cross-Entropy Method for Combinatorial and Continuous Optimization", Methodology and
Computing in Applied Probability 1, 127-190; P.-T. de Boer, D. P. Kroese, S. Mannor, R. Y. Rubinstein 2005, "A Tutorial
on the Cross-Entropy Method", Annals of Operations Research 134, 19-67.

Among the distributions q of a family, the one nearest to p(theta | cost <= gamma) in KL maximises the likelihood of the
draws below gamma, the elites: for Gaussians, their mean and covariance. gamma is the cost of the best fraction of a
generation; parameters move by a share, the smoothing, of the way to the elites', so that the spread does not collapse.

Deviations:

- The first generation comes from the prior.
- Elites stand against those of the generation before, since a cost computed once need not be computed again.
- The off-diagonal covariance is shrunk by the number of elites that there are for it.
- Draws are restricted to the cube.

The result is a search distribution: it says where the cost is least, and nothing of how sure one may be. Its particles
are the last elites, and not draws from a posterior.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.options import Options, option
from sipe_bayes.core.seeding import torch_generator_from
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.inference.search.base import PoolState, Search
from sipe_bayes.inference.search.gaussians import LEAST_VARIANCE, draw_in_cube
from sipe_bayes.posterior import Particles


@dataclass(frozen=True)
class CEMOptions(Options):
    """How the Gaussian follows its elites."""

    population: int | None = option(None, "simulated in each generation, 12 + 4 N by default", least=4)
    elites: float = option(0.25, "share of the population that counts as best", above=0, below=1)
    smoothing: float = option(0.6, "share of the way to the elites' moments that a generation goes", above=0, below=1)
    converged_sd: float = option(1e-4, "sd of every parameter where the search ends", "theta", above=0)


@dataclass(frozen=True, kw_only=True)
class CEMState(PoolState):
    """The elites, which are the pool, and the Gaussian.

    Args:
        mean: (N,), zero before the first generation.
        covariance: (N, N), zero before the first generation.
        generations: so far.
    """

    mean: FloatArray
    covariance: FloatArray
    generations: int = 0

    @property
    def variances(self) -> FloatArray:
        """Of the present Gaussian, (N,)."""
        return np.diag(self.covariance)


class CEM(Search[CEMState]):
    """Cross-entropy search, the baseline. The last elites as Particles of equal weight, the best one as mode."""

    name: ClassVar[str] = "cem"
    options_type = CEMOptions
    state_type = CEMState
    options: CEMOptions

    @property
    def population(self) -> int:
        """Simulated in each generation."""
        return self.options.population or 12 + 4 * len(self.space)

    def start(self, trajectories: Trajectories) -> CEMState:
        """No generation yet."""
        n = len(self.space)
        return CEMState(pool=self.empty_pool(trajectories), mean=np.zeros(n), covariance=np.zeros((n, n)))

    def describe(self, state: CEMState) -> str:
        """For the progress bar."""
        return f"cem: generation {state.generations}"

    def step(self, state: CEMState, trajectories: Trajectories) -> CEMState:
        """A generation, the last one as small as the budget wants it."""
        self.check_budget(state, trajectories)
        state = self.renewed(state, trajectories)
        count = self.affordable(self.population, trajectories)
        if not count:
            return replace(state, done=True)
        state = self.evaluated(state, self._draw(state, count), trajectories, count + len(state.pool.theta))
        pool, most = state.pool, max(2, round(self.options.elites * self.population))
        kept = np.argsort(-pool.reward, kind="stable")[:most]
        elites = replace(pool, theta=pool.theta[kept], reward=pool.reward[kept], draw=pool.draw[kept])
        state = self._fitted(replace(state, pool=elites))
        converged = bool(state.generations) and bool((state.variances < self.options.converged_sd**2).all())
        return replace(state, done=converged or not self.affordable(1, trajectories))

    def _draw(self, state: CEMState, count: int) -> FloatArray:
        """A generation (count, N): from the prior until there were elites."""
        random = self.random(state.draws)
        if state.generations:
            return draw_in_cube(state.mean, state.covariance, count, random)
        theta: FloatArray = self.prior.sample((count,), torch_generator_from(random)).numpy()
        return theta

    def _fitted(self, state: CEMState) -> CEMState:
        """The Gaussian moved to the valid elites, if there are at least two."""
        theta = state.pool.theta[state.pool.valid]
        if len(theta) < 2:
            return state
        mean, covariance = elite_moments(theta)
        if state.generations:
            share = self.options.smoothing
            mean = share * mean + (1 - share) * state.mean
            covariance = share * covariance + (1 - share) * state.covariance
        return replace(state, mean=mean, covariance=covariance, generations=state.generations + 1)

    def posterior(self, state: CEMState, trajectories: Trajectories) -> Particles:
        """The valid elites."""
        self.report(state)
        pool = state.pool
        if not pool.valid.any():
            return Particles(np.clip(state.mean, 0, 1)[None], self.space)
        largest_sd = float(np.sqrt(state.variances.max()))
        self.diagnostics["search"] = {
            "generations": state.generations,
            "largest_sd": largest_sd,
            "best_cost": float(-pool.reward[pool.valid].max()),
        }
        self.check_width(largest_sd)
        return Particles(pool.theta[pool.valid], self.space, best=pool.best)


def elite_moments(theta: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean (N,) and covariance (N, N) of elites (n, N), correlations shrunk by n / (n + N / 2)."""
    count, n = theta.shape
    mean = theta.mean(0)
    covariance = np.atleast_2d(np.cov(theta.T))
    diagonal = np.diag(np.diag(covariance))
    shrunk = diagonal + count / (count + 0.5 * n) * (covariance - diagonal)
    return mean, shrunk + LEAST_VARIANCE * np.eye(n)
