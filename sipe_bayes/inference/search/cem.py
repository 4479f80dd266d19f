"""The cross-entropy method: a Gaussian over theta, fitted again and again to its best draws.

R. Y. Rubinstein 1999, "The Cross-Entropy Method for Combinatorial and Continuous Optimization", Methodology and Computing in
Applied Probability 1, 127-190; P.-T. de Boer, D. P. Kroese, S. Mannor, R. Y. Rubinstein 2005, "A Tutorial on the
Cross-Entropy Method", Annals of Operations Research 134, 19-67.

Among the distributions q of a family, the one nearest to p(theta | cost <= gamma) in KL maximises the likelihood of the draws
below gamma, the elites: for Gaussians, their mean and covariance. gamma is the cost of the best fraction of a generation;
parameters move by a share, the smoothing, of the way to the elites', so that the spread does not collapse.

Deviations: the first generation comes from the prior; elites stand against those of the generation before, since a cost
computed once need not be computed again; the off-diagonal covariance is shrunk by the number of elites that there are
for it. Draws are restricted to the cube.

The result is a search distribution: it says where the cost is least, and nothing of how sure one may be. Its particles are
the last elites, and not draws from a posterior.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray

from sipe_bayes.core.checkpoint import State
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.core.validation import positive, share, whole
from sipe_bayes.inference.search.gaussian_search import Search, draw_in_cube
from sipe_bayes.posterior import Particles

FloatArray = NDArray[np.float64]

_LEAST_VARIANCE = 1e-10


class CEM(Search):
    """The last elites as Particles of equal weights, the best of them as mode.

    population: simulated in each generation, default 12 + 4 N. elites: share of the population. smoothing: share of the way to the
    elites' mean and covariance that a generation goes. converged_sd: of every parameter, in theta, where the search ends.
    """

    name: ClassVar[str] = "cem"

    def __init__(
        self,
        simulator: Any,
        *,
        population: int | None = None,
        elites: float = 0.25,
        smoothing: float = 0.6,
        converged_sd: float = 1e-4,
        **settings: Any,
    ) -> None:
        super().__init__(simulator, **settings)
        for name, value in (("elites", elites), ("smoothing", smoothing)):
            if value != 1:
                share(name, value)
        self.population = whole("population", 12 + 4 * len(self.space) if population is None else population, 4)
        self.elites, self.smoothing = elites, smoothing
        self.converged_sd = positive("converged_sd", converged_sd)

    def settings(self) -> dict[str, Any]:
        own = ("population", "elites", "smoothing", "converged_sd")
        return {**super().settings(), **{name: getattr(self, name) for name in own}}

    def start(self, trajectories: Trajectories) -> State:
        n = len(self.space)
        return {
            **self.empty_pool(trajectories),
            "mean": np.zeros(n),
            "covariance": np.zeros((n, n)),
            "means": np.empty((0, n)),
            "generations": 0,
            "done": False,
        }

    def describe(self, state: State) -> str:
        return f"cem: generation {state['generations']}"

    def step(self, state: State, trajectories: Trajectories) -> State:
        """A generation, the last one as small as the budget wants it."""
        self.check_budget(state, trajectories)
        state = self.renewed(state, trajectories)
        count = self.affordable(self.population, trajectories)
        if not count:
            return {**state, "done": True}
        state = self.evaluated(state, self._draw(state, count), trajectories, count + len(state["pool_theta"]))
        kept = np.argsort(-state["pool_reward"], kind="stable")[: max(2, round(self.elites * self.population))]
        for name in ("pool_theta", "pool_reward", "pool_draw"):
            state = {**state, name: state[name][kept]}
        state = self._fit(state)
        converged = bool(state["generations"]) and bool((np.diag(state["covariance"]) < self.converged_sd**2).all())
        return {**state, "done": converged or not self.affordable(1, trajectories)}

    def _draw(self, state: State, count: int) -> FloatArray:
        """A generation (count, N): from the prior until there were elites."""
        random = self.random(state)
        if state["generations"]:
            return draw_in_cube(state["mean"], state["covariance"], count, random)
        generator = torch.Generator().manual_seed(int(random.integers(2**62)))
        draws: FloatArray = self.prior.sample((count,), generator=generator).numpy()
        return draws

    def _fit(self, state: State) -> State:
        """The Gaussian moved to the valid elites, if there are at least two."""
        theta = state["pool_theta"][np.isfinite(state["pool_reward"])]
        if len(theta) < 2:
            return state
        mean, covariance = elite_moments(theta)
        if state["generations"]:
            share = self.smoothing
            mean = share * mean + (1 - share) * state["mean"]
            covariance = share * covariance + (1 - share) * state["covariance"]
        means = np.concatenate([state["means"], mean[None]])
        generations = state["generations"] + 1
        return {**state, "mean": mean, "covariance": covariance, "means": means, "generations": generations}

    def posterior(self, state: State, trajectories: Trajectories) -> Particles:
        self.report(state)
        good = np.isfinite(state["pool_reward"])
        if not good.any():
            return Particles(np.clip(state["mean"], 0, 1)[None], self.space)
        theta, reward = state["pool_theta"][good], state["pool_reward"][good]
        self.diagnostics["search"] = {
            "generations": state["generations"],
            "largest_sd": float(np.sqrt(np.diag(state["covariance"]).max())),
            "best_cost": float(-reward.max()),
        }
        self.warn_if_wide(self.diagnostics["search"]["largest_sd"])
        return Particles(theta, self.space, best=theta[reward.argmax()])


def elite_moments(theta: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean (N,) and covariance (N, N) of elites (n, N), correlations shrunk by n / (n + N / 2)."""
    count, n = theta.shape
    mean = theta.mean(0)
    covariance = np.atleast_2d(np.cov(theta.T))
    diagonal = np.diag(np.diag(covariance))
    shrunk = diagonal + count / (count + 0.5 * n) * (covariance - diagonal)
    return mean, shrunk + _LEAST_VARIANCE * np.eye(n)
