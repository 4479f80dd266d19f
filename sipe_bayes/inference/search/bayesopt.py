"""Bayesian optimisation of the discrepancy, and the posterior of its Gaussian process.

Each theta is simulated once and its cost C(theta) is the mean squared difference of states
(``discrepancy.StateDifference``). A Gaussian process (``models.gaussian_process``) over y = log(C + ``floor``) has mean
mu and sd s. The next theta minimises the lower confidence bound (as one minimises, what the field calls the upper
confidence bound; N. Srinivas et al. 2010, "Gaussian Process Optimization in the Bandit Setting",
https://arxiv.org/abs/0912.3995)

    mu(theta) - kappa s(theta),

or maximises the expected improvement E[max(y_best - xi - y(theta), 0)] (D. R. Jones, M. Schonlau, W. J. Welch 1998,
"Efficient Global Optimization of Expensive Black-Box Functions", https://doi.org/10.1023/A:1008306431147; computed as a
logarithm). ``batch`` candidates are chosen one after the other, each as if the ones before it had given the mean
predicted there, which leaves mu and narrows s (T. Desautels, A. Krause, J. W. Burdick 2014, "Parallelizing
Exploration-Exploitation Tradeoffs in Gaussian Process Bandit Optimization",
https://jmlr.org/papers/v15/desautels14a.html). How a candidate is looked for stands in ``search.acquisition``.

The posterior is ``SurrogatePosterior`` with the threshold

    epsilon = min_i mu(theta_i) + log[(C_min exp((N + 2) / n) + floor) / (C_min + floor)].

For Gaussian noise of unknown sd and n independent residuals, log p(y | theta) = -(n / 2) log C(theta): the posterior's
covariance S is that of a quadratic log C, and {log C < min log C + r^2 / n} is the ellipsoid of radius r in S. A
uniform distribution on it has covariance r^2 S / (N + 2), which r^2 = N + 2 makes S. So epsilon needs no truth: it is
the best cost and what the residuals there leave open. n counts residuals less what their autocorrelation takes,
sum_c n_c (1 - rho_c) / (1 + rho_c), at the best theta; within windows, so that wrong starts and a wrong model widen the
posterior. The autocorrelation between channels is not counted.

Deviations from the SiPE paper (B. Mehta, A. Handa, D. Fox, F. Ramos 2020, "A User's Guide to Calibrating Robotics
Simulators", https://arxiv.org/abs/2011.08985), which runs the package ``bayesopt`` with kappa 2.5 and xi 0 and returns
the best point:

- The logarithm of the cost; channels in units of their spread and windows of half a second (``Segments(None)`` for
  whole trajectories).
- Batches.
- A posterior, for whose sake a share ``checks`` of the evaluations is drawn from it: optimisation alone never looks at
  the wide regions of little, but together too much, probability.
- Trajectories without recorded states start each window at states estimated from the measurements, whose errors the
  posterior does not know: a finding says so.
- A diverged simulation counts as the worst finite cost.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from sipe_bayes.core.arrays import BoolArray, FloatArray
from sipe_bayes.core.budget import BudgetExhausted
from sipe_bayes.core.findings import Code
from sipe_bayes.core.options import option
from sipe_bayes.core.seeding import seed_integer, torch_generator
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.inference.base import Estimator
from sipe_bayes.inference.recorded import digest
from sipe_bayes.inference.search.acquisition import (
    Acquisition,
    CandidateOptions,
    CandidateSearch,
    ConfidenceBound,
    ExpectedImprovement,
)
from sipe_bayes.inference.search.discrepancy import StateDifference, channel_scale
from sipe_bayes.likelihood import BoundLikelihood
from sipe_bayes.models.gaussian_process import GaussianProcess, fit_gaussian_process
from sipe_bayes.posterior import IndependentPrior, SurrogatePosterior
from sipe_bayes.posterior.ensemble import EnsembleOptions
from sipe_bayes.posterior.surrogate import log_acceptance
from sipe_bayes.simulation.callable_simulator import CallableSimulator

ACQUISITIONS = ("upper_confidence_bound", "expected_improvement")


@dataclass(frozen=True)
class BayesOptOptions(CandidateOptions):
    """What is evaluated, and how the posterior is drawn from."""

    acquisition: str = option("upper_confidence_bound", "what a candidate maximises", among=ACQUISITIONS)
    kappa: float = option(2.5, "of upper_confidence_bound", least=0)
    xi: float = option(0.0, "of expected_improvement", "nats of the cost", least=0)
    initial: int | None = option(
        None, "evaluations of the design that comes first, 2 (N + 1) by default; at most half of all", least=2
    )
    fewest: int = option(4, "evaluations below which there is nothing to fit a process to", least=2)
    batch: int = option(4, "evaluations of one step", least=1)
    checks: float = option(0.25, "share of a batch that is drawn from the posterior", least=0, below=1)
    checked: int = option(2000, "draws of the prior from which one of the posterior is picked", least=1)
    floor: float = option(
        1e-2,
        "added to the cost before its logarithm: without it the valley is so sharp that the process's lengthscales "
        "become short and the posterior's tails heavy",
        "squared spreads of the channels",
        above=0,
    )
    tail: float = option(1e-4, "of the prior on each side, where nothing is looked for", "mass", above=0, below=0.5)
    epsilon: float | None = option(None, "the posterior's threshold, by default from the residuals", "cost", above=0)
    growth: float = option(1.2, "of the data between two fits of the process's hyper-parameters", least=1)
    effective_draws: float = option(EnsembleOptions.effective, "of the posterior, at which its chains end", above=0)
    most_steps: int = option(EnsembleOptions.most_steps, "of the posterior's chains at most", least=20)


@dataclass(frozen=True)
class BayesOptState:
    """The evaluations and the process over them.

    Args:
        trajectories: digest of those that were evaluated.
        theta: (n, N).
        cost: (n,), inf where the simulation diverged.
        units: (C,), what differences of states are divided by; NaN before the first valid simulation.
        independent: independent residuals at the best theta.
        fitted: evaluations that the hyper-parameters were fitted to.
        process: the one that was fitted; None before the first fit.
        done: whether the budget is spent.
    """

    trajectories: str
    theta: FloatArray
    cost: FloatArray
    units: FloatArray
    independent: float = 0.0
    fitted: int = 0
    process: GaussianProcess | None = None
    done: bool = False


class BayesOpt(Estimator[BayesOptState]):
    """Gaussian process (BoTorch) over the log discrepancy. A SurrogatePosterior."""

    name: ClassVar[str] = "bayesopt"
    options_type = BayesOptOptions
    state_type = BayesOptState
    options: BayesOptOptions

    def start(self, trajectories: Trajectories) -> BayesOptState:
        """No evaluation yet."""
        fewest = self.options.fewest
        windows = self.windows(trajectories)
        if self._affordable(trajectories) < fewest:
            raise BudgetExhausted(
                f"{fewest} evaluations take {fewest * len(trajectories)} rollouts, the budget is {self.budget}"
            )
        none = np.empty((0, len(self.space)))
        return BayesOptState(digest(trajectories), none, np.empty(0), np.full(len(windows.channels), np.nan))

    def step(self, state: BayesOptState, trajectories: Trajectories) -> BayesOptState:
        """The initial design, or a batch of candidates; costs of other trajectories are of another scale, and left."""
        if state.trajectories != digest(trajectories):
            state = self.start(trajectories)
        affordable = self._affordable(trajectories)
        if not affordable:
            return replace(state, done=True)
        if not len(state.theta):
            design = self.options.initial or 2 * (len(self.space) + 1)
            theta = self._design(min(design, max(2, affordable // 2)))
        else:
            theta = self._candidates(state, min(self.options.batch, affordable))
        state = self.fitted(self._evaluated(state, theta, self.windows(trajectories)))
        return replace(state, done=not self._affordable(trajectories))

    def describe(self, state: BayesOptState) -> str:
        """For the progress bar."""
        cost = state.cost
        return f"bayesopt: {len(cost)} evaluations" + (f", lowest cost {cost.min():.3g}" if len(cost) else "")

    def posterior(self, state: BayesOptState, trajectories: Trajectories) -> SurrogatePosterior:
        """Drawn from by an ensemble of walkers; nothing is simulated."""
        if not np.isfinite(state.cost).any():
            raise ValueError(
                f"bayesopt: all of {len(state.cost)} simulations {self.simulator.failure}; narrow the bounds, or mend "
                "the simulation"
            )
        process = self._process(state)
        epsilon = self.threshold(state, process)
        ensemble = EnsembleOptions(effective=self.options.effective_draws, most_steps=self.options.most_steps)
        posterior = SurrogatePosterior.sampled(process, epsilon, self.prior, self.seed, ensemble)
        self._report(state, posterior, trajectories)
        return posterior

    def _affordable(self, trajectories: Trajectories) -> int:
        return (self.budget - self.windows(trajectories).rollouts) // len(trajectories)

    def _design(self, count: int) -> FloatArray:
        """Quasi-random theta (count, N), spread as the prior is; plain draws where its parameters are dependent."""
        seed = seed_integer([self.seed, 0])
        if not isinstance(self.prior, IndependentPrior):
            return self.prior.sample((count,), generator=torch.Generator().manual_seed(seed)).numpy()
        sobol = torch.quasirandom.SobolEngine(len(self.space), scramble=True, seed=seed)
        return self.prior.inverse(sobol.draw(count, dtype=torch.float64)).numpy()

    def _evaluated(self, state: BayesOptState, theta: FloatArray, windows: BoundLikelihood) -> BayesOptState:
        """The state with the costs of theta (q, N), and independent residuals where a new one is the best."""
        predicted = windows.simulate(theta)
        units = state.units if np.isfinite(state.units).all() else channel_scale(windows, predicted)
        cost = StateDifference(windows, units)(predicted)
        best = int(cost.argmin())
        independent = state.independent
        if cost[best] < state.cost.min(initial=np.inf):
            independent = independent_residuals(predicted[best] - windows.measured, windows.observed)
        return replace(
            state,
            theta=np.concatenate([state.theta, theta]),
            cost=np.concatenate([state.cost, cost]),
            units=units,
            independent=independent,
        )

    def _values(self, state: BayesOptState) -> Tensor:
        """Log costs y (n,), the worst finite one where a simulation diverged."""
        finite = np.isfinite(state.cost)
        worst = state.cost[finite].max() if finite.any() else 1.0
        return torch.from_numpy(np.log(np.where(finite, state.cost, worst) + self.options.floor))

    def _process(self, state: BayesOptState) -> GaussianProcess:
        assert state.process is not None  # fitted to the initial design
        return state.process.with_data(torch.from_numpy(state.theta), self._values(state))

    def fitted(self, state: BayesOptState) -> BayesOptState:
        """The state with new hyper-parameters where the data have grown enough."""
        count = len(state.theta)
        if count < self.options.growth * state.fitted:
            return state
        previous = None if state.process is None else self._process(state)
        process = fit_gaussian_process(torch.from_numpy(state.theta), self._values(state), self.seed, previous)
        return replace(state, process=process, fitted=count)

    @property
    def acquisition(self) -> Acquisition:
        """What candidates maximise."""
        options = self.options
        by_bound = options.acquisition == "upper_confidence_bound"
        return ConfidenceBound(options.kappa) if by_bound else ExpectedImprovement(options.xi)

    def _candidates(self, state: BayesOptState, count: int) -> FloatArray:
        """Candidates (count, N) chosen one after the other, the first of a batch's checks drawn from the posterior."""
        process, done, options = self._process(state), len(state.theta), self.options
        rng = np.random.default_rng([self.seed, done])
        low, high = self.prior.quantile(torch.tensor([options.tail, 1 - options.tail])).numpy()
        search = CandidateSearch(self.acquisition, low, high, options)
        checks = int((done + count) * options.checks) - int(done * options.checks)
        chosen = self._drawn(process, self.threshold(state, process), checks, done) if checks else []
        for theta in chosen:
            process = process.imagined(theta)
        while len(chosen) < count:
            theta = search.best(process, rng)
            chosen.append(theta)
            process = process.imagined(theta)
        return torch.stack(chosen).numpy()

    def _drawn(self, process: GaussianProcess, epsilon: float, count: int, number: int) -> list[Tensor]:
        """Rough draws (N,) of the posterior: draws of the prior picked by how probably they are below epsilon."""
        generator = torch_generator([self.seed, number, 1])
        theta = self.prior.sample((self.options.checked,), generator=generator)
        with torch.no_grad():
            weight = torch.softmax(log_acceptance(process, epsilon, theta), 0)
        return list(theta[torch.multinomial(weight, count, generator=generator)])

    def threshold(self, state: BayesOptState, process: GaussianProcess) -> float:
        """epsilon, on the log cost."""
        floor = self.options.floor
        if self.options.epsilon is not None:
            return math.log(self.options.epsilon + floor)
        with torch.no_grad():
            mean, _ = process.predict(process.x)
        lowest = state.cost.min()
        if not np.isfinite(lowest):
            return float(mean.min())
        allowed = lowest * math.exp((len(self.space) + 2) / max(state.independent, 1.0))
        return float(mean.min()) + math.log((allowed + floor) / (lowest + floor))

    def _report(self, state: BayesOptState, posterior: SurrogatePosterior, trajectories: Trajectories) -> None:
        """Diagnostics, and what there is to doubt of the posterior."""
        process, mixing, best = posterior.process, posterior.mixing, posterior.best.tolist()
        diverged, count = int((~np.isfinite(state.cost)).sum()), len(state.cost)
        with torch.no_grad():
            likely = float(log_acceptance(process, posterior.epsilon, posterior.draws[::10]).median().exp())
        self.diagnostics = {
            "mixing": mixing,
            "median_acceptance": likely,
            "evaluations": count,
            "diverged": diverged,
            "lowest_cost": float(state.cost.min()),
            "best": best,
            "epsilon": posterior.epsilon,
            "independent_residuals": float(state.independent),
            "log_normaliser": posterior.log_normaliser,
            "normaliser_error": posterior.normaliser_error,
            "lengthscale": process.lengthscale.tolist(),
            "noise_sd": process.noise_sd,
        }
        if state.trajectories != digest(trajectories):
            self.find(Code.OTHER_TRAJECTORIES)
        if trajectories.states is None and not isinstance(self.simulator, CallableSimulator):
            self.find(Code.STARTS_NOT_RECORDED)
        if mixing["rhat"] > THRESHOLDS.mixed or mixing["ess"] < THRESHOLDS.mixed_draws:
            rhat, ess = mixing["rhat"], mixing["ess"]
            self.find(Code.NOT_MIXED, what="draws", rhat=rhat, ess=ess, unit="", remedy="evaluate more")
        margin = THRESHOLDS.best_at_bound
        at = [name for name, x in zip(self.space.names, best, strict=True) if min(x, 1 - x) < margin]
        if at:
            self.find(Code.BEST_AT_BOUND, parameters=at)
        if diverged:
            self.find(Code.DIVERGED_COUNT_AS_WORST, count=diverged, total=count, failure=self.simulator.failure)
        if likely < THRESHOLDS.epsilon_probability:
            self.find(Code.EPSILON_IMPROBABLE, probability=likely)
        if posterior.normaliser_error > THRESHOLDS.rough_density:
            self.find(Code.DENSITY_ROUGH, error=posterior.normaliser_error)


def independent_residuals(residual: FloatArray, observed: BoolArray) -> float:
    """How many independent numbers residuals are worth: sum_c n_c (1 - rho_c) / (1 + rho_c).

    Args:
        residual: (W, L, C).
        observed: (W, L, C), which of them there are.

    Returns:
        The number, by each channel's lag-one autocorrelation rho within windows and about zero.
    """
    residual = np.where(observed, residual, 0.0)
    pairs = observed[:, 1:] & observed[:, :-1]
    product = (np.where(pairs, residual[:, 1:] * residual[:, :-1], 0.0)).sum((0, 1))
    square = (np.where(pairs, residual[:, 1:] ** 2 + residual[:, :-1] ** 2, 0.0)).sum((0, 1)) / 2
    rho = np.clip(np.divide(product, square, out=np.zeros_like(square), where=square > 0), 0.0, 0.999)
    return float((observed.sum((0, 1)) * (1 - rho) / (1 + rho)).sum())
