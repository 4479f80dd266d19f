"""Bayesian optimisation of the discrepancy, and the posterior of its Gaussian process.

Each theta is simulated once and its cost C(theta) is the mean squared difference of states (``discrepancy.StateDifference``). A
Gaussian process (``models.gaussian_process``) over y = log(C + ``floor``) has mean mu and sd s. The next theta
minimises the lower confidence bound (as one minimises, what the field calls the upper confidence bound; N. Srinivas et al.
2010, "Gaussian Process Optimization in the Bandit Setting", https://arxiv.org/abs/0912.3995)

    mu(theta) - kappa s(theta),

or maximises the expected improvement E[max(y_best - xi - y(theta), 0)] (D. R. Jones, M. Schonlau, W. J. Welch 1998, "Efficient
Global Optimization of Expensive Black-Box Functions", https://doi.org/10.1023/A:1008306431147; computed as a logarithm).
``batch`` candidates are chosen one after the other, each as if the ones before it had given the mean predicted there, which leaves mu
and narrows s (T. Desautels, A. Krause, J. W. Burdick 2014, "Parallelizing Exploration-Exploitation Tradeoffs in Gaussian
Process Bandit Optimization", https://jmlr.org/papers/v15/desautels14a.html). A candidate starts as the best of random points of
the box and of the best evaluated points changed in a few coordinates, and climbs by L-BFGS.

The posterior is ``SurrogatePosterior`` with the threshold

    epsilon = min_i mu(theta_i) + log[(C_min exp((N + 2) / n) + floor) / (C_min + floor)].

For Gaussian noise of unknown sd and n independent residuals, log p(y | theta) = -(n / 2) log C(theta): the posterior's covariance S
is that of a quadratic log C, and {log C < min log C + r^2 / n} is the ellipsoid of radius r in S. A uniform distribution on it has
covariance r^2 S / (N + 2), which r^2 = N + 2 makes S. So epsilon needs no truth: it is the best cost and what the
residuals there leave open. n counts residuals less what their autocorrelation takes, sum_c n_c (1 - rho_c) / (1 + rho_c), at the
best theta; within windows, so that wrong starts and a wrong model widen the posterior. The autocorrelation between channels is not
counted.

Deviations from the SiPE paper (B. Mehta, A. Handa, D. Fox, F. Ramos 2020, "A User's Guide to Calibrating Robotics Simulators",
https://arxiv.org/abs/2011.08985), which runs the package ``bayesopt`` with kappa 2.5 and xi 0 and returns the best point: the logarithm of
the cost; channels in units of their spread and windows of half a second (``Segments(None)`` for whole trajectories);
batches; a posterior, for whose sake a share ``checks`` of the evaluations is drawn from it: optimisation alone never looks at the wide
regions of little, but together too much, probability. Trajectories without recorded states start each window at states estimated
from the measurements, whose errors the posterior does not know: a warning says so. A diverged simulation counts as the worst finite cost.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sipe_bayes.core.checkpoint import State
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.core.validation import at_least, positive, whole
from sipe_bayes.inference.base import Estimator, digest
from sipe_bayes.likelihood.discrepancy import StateDifference, channel_scale, simulate
from sipe_bayes.likelihood.settings import BudgetExhausted
from sipe_bayes.likelihood.windows import Windows
from sipe_bayes.models.gaussian_process import GaussianProcess, fit_gaussian_process
from sipe_bayes.posterior import IndependentPrior, SurrogatePosterior
from sipe_bayes.posterior.surrogate import EFFECTIVE, MOST_STEPS, log_acceptance
from sipe_bayes.simulation.callable_simulator import CallableSimulator

FloatArray = NDArray[np.float64]

ACQUISITIONS = ("upper_confidence_bound", "expected_improvement")
_FEWEST = 4  # evaluations below which there is nothing to fit
_PARENTS, _CHANGED = 5, 10  # best points that are changed, coordinates that change
_CLIMBS, _CLIMB_STEPS = 3, 20  # candidates that climb together, iterations of L-BFGS
_CHECKED = 2000  # draws of the prior from which one of the posterior is picked
_TAIL = 1e-4  # of the prior on each side is not searched
_CLEAR_ACCEPTANCE = 0.01  # probability of epsilon at the median draw below which the posterior is said to be room alone
_CLEAR_ERROR = 0.2  # nats, standard error of log Z above which the density is said to be rough
_AT_BOUND = 2e-3  # of the range
_MIXED_RHAT, _MIXED_ESS = 1.05, 400


class BayesOpt(Estimator):
    """``SurrogatePosterior`` of a Gaussian process over the log discrepancy; see the module's docstring.

    acquisition: "upper_confidence_bound" with ``kappa``, or "expected_improvement" with ``xi`` (in nats of the cost). initial:
    evaluations of the quasi-random design that comes first, default 2 (N + 1), never more than half of what the budget affords.
    batch: evaluations of one step. checks: share of them that are drawn from the posterior. floor: added to the cost before its
    logarithm, in squared spreads of the channels: without one the valley is so sharp that the process's lengthscales become
    short and the posterior's tails heavy. epsilon: the threshold as a cost, default by the residuals at the best theta. growth: of
    the data between two fits of the process's hyper-parameters. pool: random points, and as many changed ones, that a candidate
    starts from. effective_draws, most_steps: of the posterior's chains, which end at the first or the second.
    """

    name: ClassVar[str] = "bayesopt"

    def __init__(
        self,
        simulator: Any,
        *,
        acquisition: str = "upper_confidence_bound",
        kappa: float = 2.5,
        xi: float = 0.0,
        initial: int | None = None,
        batch: int = 4,
        checks: float = 0.25,
        floor: float = 1e-2,
        epsilon: float | None = None,
        growth: float = 1.2,
        pool: int = 256,
        effective_draws: float = EFFECTIVE,
        most_steps: int = MOST_STEPS,
        **settings: Any,
    ) -> None:
        super().__init__(simulator, **settings)
        if acquisition not in ACQUISITIONS:
            raise ValueError(f"acquisition: expected one of {', '.join(ACQUISITIONS)}, got {acquisition!r}")
        self.acquisition, self.kappa, self.xi = acquisition, at_least("kappa", kappa, 0), at_least("xi", xi, 0)
        if at_least("checks", checks, 0) >= 1:
            raise ValueError(f"checks: expected a share of the evaluations in [0, 1), got {checks}")
        self.initial = None if initial is None else whole("initial", initial, 2)
        self.batch, self.checks, self.floor = whole("batch", batch), float(checks), positive("floor", floor)
        self.epsilon = None if epsilon is None else positive("epsilon", epsilon)
        self.growth, self.pool = at_least("growth", growth, 1), whole("pool", pool, _CLIMBS)
        self.effective_draws = positive("effective_draws", effective_draws)
        self.most_steps = whole("most_steps", most_steps, 20)

    def settings(self) -> dict[str, Any]:
        own = ("acquisition", "kappa", "xi", "initial", "batch", "checks", "floor", "epsilon")
        effort = ("growth", "pool", "effective_draws", "most_steps")
        return {**super().settings(), **{name: getattr(self, name) for name in own + effort}}

    def start(self, trajectories: Trajectories) -> State:
        self.windows(trajectories)
        if self._affordable(trajectories) < _FEWEST:
            raise BudgetExhausted(
                f"{_FEWEST} evaluations take {_FEWEST * len(trajectories)} rollouts, the budget is {self.budget}"
            )
        n = len(self.space)
        return {
            "logs": digest(trajectories),
            "theta": np.empty((0, n)),
            "cost": np.empty(0),
            "units": np.full(len(self.windows(trajectories).channels), np.nan),
            "independent": 0.0,
            "fitted": 0,
            "lengthscale": np.ones(n),
            **{name: 0.0 for name in ("noise", "level", "location", "scale")},
            "done": False,
        }

    def step(self, state: State, trajectories: Trajectories) -> State:
        """The initial design, or a batch of candidates; costs of other trajectories are of another scale, and are left."""
        if state["logs"] != digest(trajectories):
            state = self.start(trajectories)
        affordable = self._affordable(trajectories)
        if not affordable:
            return {**state, "done": True}
        if not len(state["theta"]):
            design = self.initial or 2 * (len(self.space) + 1)
            theta = self._design(min(design, max(2, affordable // 2)))
        else:
            theta = self._candidates(state, min(self.batch, affordable))
        state = self._evaluated(state, theta, self.windows(trajectories))
        state = self._fitted(state)
        return {**state, "done": not self._affordable(trajectories)}

    def describe(self, state: State) -> str:
        cost = state["cost"]
        return f"bayesopt: {len(cost)} evaluations" + (f", lowest cost {cost.min():.3g}" if len(cost) else "")

    def posterior(self, state: State, trajectories: Trajectories) -> SurrogatePosterior:
        if not np.isfinite(state["cost"]).any():
            raise ValueError(
                f"bayesopt: all of {len(state['cost'])} simulations {self.simulator.failure}; narrow the bounds, or mend the "
                "simulation"
            )
        process = self._process(state)
        found = SurrogatePosterior.sampled(
            process, self._threshold(state, process), self.prior, self.seed, self.effective_draws, self.most_steps
        )
        known = trajectories.states is not None or isinstance(self.simulator, CallableSimulator)
        self._report(state, process, found, known, state["logs"] == digest(trajectories))
        return found

    def _affordable(self, trajectories: Trajectories) -> int:
        return (self.budget - self.windows(trajectories).rollouts) // len(trajectories)

    def _design(self, count: int) -> FloatArray:
        """Quasi-random theta (count, N), spread as the prior is; plain draws of a prior whose parameters depend on each other."""
        seed = int(np.random.SeedSequence([self.seed, 0]).generate_state(1)[0])
        if not isinstance(self.prior, IndependentPrior):
            return self.prior.sample((count,), generator=torch.Generator().manual_seed(seed)).numpy()
        sobol = torch.quasirandom.SobolEngine(len(self.space), scramble=True, seed=seed)
        return self.prior._inverse(sobol.draw(count, dtype=torch.float64)).numpy()

    def _evaluated(self, state: State, theta: FloatArray, windows: Windows) -> State:
        """``state`` with the costs of theta (q, N), and the number of independent residuals where a new one is the best."""
        predicted = simulate(windows, theta)
        units = state["units"] if np.isfinite(state["units"]).all() else channel_scale(windows, predicted)
        cost = StateDifference(windows, units)(predicted)
        best = int(cost.argmin())
        independent = state["independent"]
        if cost[best] < state["cost"].min(initial=np.inf):
            independent = independent_residuals(predicted[best] - windows.measured, windows.observed)
        return {
            **state,
            "theta": np.concatenate([state["theta"], theta]),
            "cost": np.concatenate([state["cost"], cost]),
            "units": units,
            "independent": independent,
        }

    def _values(self, state: State) -> Tensor:
        """y (n,): log costs, the worst finite one where a simulation diverged."""
        cost = state["cost"]
        finite = np.isfinite(cost)
        worst = cost[finite].max() if finite.any() else 1.0
        return torch.from_numpy(np.log(np.where(finite, cost, worst) + self.floor))

    def _process(self, state: State) -> GaussianProcess:
        numbers = {name: state[name] for name in ("noise", "level", "location", "scale")}
        x, lengthscale = torch.from_numpy(state["theta"]), torch.from_numpy(state["lengthscale"])
        return GaussianProcess(x, self._values(state), lengthscale, **numbers)

    def _fitted(self, state: State) -> State:
        """``state`` with new hyper-parameters where the data have grown enough."""
        count = len(state["theta"])
        if count < self.growth * state["fitted"]:
            return state
        previous = self._process(state) if state["fitted"] else None
        process = fit_gaussian_process(torch.from_numpy(state["theta"]), self._values(state), self.seed, previous)
        numbers = {name: getattr(process, name) for name in ("noise", "level", "location", "scale")}
        return {**state, **numbers, "lengthscale": process.lengthscale.numpy(), "fitted": count}

    def _candidates(self, state: State, count: int) -> FloatArray:
        """theta (count, N) chosen one after the other, the last of a whole batch drawn from the posterior."""
        process, done = self._process(state), len(state["theta"])
        rng = np.random.default_rng([self.seed, done])
        low, high = self.prior.quantile(torch.tensor([_TAIL, 1 - _TAIL])).numpy()
        chosen: list[Tensor] = []
        checks = int((done + count) * self.checks) - int(done * self.checks)
        if checks:
            chosen += self._drawn(process, self._threshold(state, process), checks, done)
        for theta in chosen:
            process = process.imagined(theta)
        while len(chosen) < count:
            pool = torch.from_numpy(np.clip(self._pool(process, low, high, rng), low, high))
            with torch.no_grad():
                top = pool[self._merit(process, pool).topk(_CLIMBS).indices]
            theta = self._climbed(process, top, low, high)
            chosen.append(theta)
            process = process.imagined(theta)
        return torch.stack(chosen).numpy()

    def _drawn(self, process: GaussianProcess, epsilon: float, count: int, seed: int) -> list[Tensor]:
        """Rough draws (N,) of the posterior: draws of the prior picked by how probably they are below epsilon."""
        generator = torch.Generator().manual_seed(
            int(np.random.SeedSequence([self.seed, seed, 1]).generate_state(1)[0])
        )
        theta = self.prior.sample((_CHECKED,), generator=generator)
        with torch.no_grad():
            log_weight = log_acceptance(process, epsilon, theta)
        weight = torch.softmax(log_weight, 0)
        return list(theta[torch.multinomial(weight, count, generator=generator)])

    def _pool(
        self, process: GaussianProcess, low: FloatArray, high: FloatArray, rng: np.random.Generator
    ) -> FloatArray:
        """Random points of the box, and the best evaluated points changed in a few coordinates (2 ``pool``, N)."""
        n = len(low)
        everywhere = rng.uniform(low, high, (self.pool, n))
        best = process.x[process.y.argsort(stable=True)[:_PARENTS]].numpy()
        parents = best[rng.integers(len(best), size=self.pool)]
        changed = rng.random((self.pool, n)) < min(1.0, _CHANGED / n)
        reach = (high - low) * 10 ** rng.uniform(-3, -0.5, (self.pool, 1))
        return np.concatenate([everywhere, parents + changed * reach * rng.standard_normal((self.pool, n))])

    def _merit(self, process: GaussianProcess, theta: Tensor) -> Tensor:
        """What a candidate maximises (B,) of theta (B, N)."""
        return self._acquired(process, *process.predict(theta))

    def _acquired(self, process: GaussianProcess, mean: Tensor, sd: Tensor) -> Tensor:
        if self.acquisition == "upper_confidence_bound":
            return self.kappa * sd - mean
        return log_improvement((process.y.min() - self.xi - mean) / sd) + sd.log()

    def _climbed(self, process: GaussianProcess, starts: Tensor, low: FloatArray, high: FloatArray) -> Tensor:
        """The best theta (N,) reached from starts (B, N) within the box."""
        from scipy.optimize import minimize

        def negative(flat: FloatArray) -> tuple[float, FloatArray]:
            with torch.no_grad():
                mean, sd, by_mean, by_sd = process.slopes(torch.from_numpy(flat.reshape(starts.shape)))
            mean, sd = mean.requires_grad_(True), sd.requires_grad_(True)
            total = -self._acquired(process, mean, sd).sum()
            along_mean, along_sd = torch.autograd.grad(total, (mean, sd))
            gradient = along_mean[:, None] * by_mean + along_sd[:, None] * by_sd
            return float(total.detach()), gradient.numpy().ravel()

        bounds = list(zip(np.tile(low, len(starts)), np.tile(high, len(starts)), strict=True))
        options = {"maxiter": _CLIMB_STEPS}
        found = minimize(negative, starts.numpy().ravel(), jac=True, method="L-BFGS-B", bounds=bounds, options=options)
        ends = torch.cat([starts, torch.from_numpy(np.clip(found.x.reshape(starts.shape), low, high))])
        with torch.no_grad():
            return ends[self._merit(process, ends).argmax()]

    def _threshold(self, state: State, process: GaussianProcess) -> float:
        if self.epsilon is not None:
            return math.log(self.epsilon + self.floor)
        with torch.no_grad():
            mean, _ = process.predict(process.x)
        lowest = state["cost"].min()
        if not np.isfinite(lowest):
            return float(mean.min())
        allowed = lowest * math.exp((len(self.space) + 2) / max(state["independent"], 1.0))
        return float(mean.min()) + math.log((allowed + self.floor) / (lowest + self.floor))

    def _report(
        self, state: State, process: GaussianProcess, found: SurrogatePosterior, starts_known: bool, same_logs: bool
    ) -> None:
        diverged, count = int((~np.isfinite(state["cost"])).sum()), len(state["cost"])
        mixing = found.mixing
        with torch.no_grad():
            likely = float(log_acceptance(process, found.epsilon, found.draws[::10]).median().exp())
        self.diagnostics = {
            "mixing": mixing,
            "median_acceptance": likely,
            "evaluations": count,
            "diverged": diverged,
            "lowest_cost": float(state["cost"].min()),
            "best": found.best.tolist(),
            "epsilon": found.epsilon,
            "independent_residuals": float(state["independent"]),
            "log_normaliser": found.log_normaliser,
            "normaliser_error": found.normaliser_error,
            "lengthscale": process.lengthscale.tolist(),
            "noise_sd": process.noise_sd,
        }
        remarks = []
        if not same_logs:
            self.doubt("the costs are those of other trajectories than these: the posterior is theirs")
        if not starts_known:
            self.doubt(
                "the trajectories have no recorded states: errors of the windows' estimated starts are not in the posterior; "
                "compare it with laplace or mcmc"
            )
        at = [n for n, x in zip(self.space.names, found.best.tolist(), strict=True) if min(x, 1 - x) < _AT_BOUND]
        if at:
            remarks.append(
                f"the best point has {', '.join(at)} at a bound: the truth may lie beyond it; widen the bounds"
            )
        if diverged:
            remarks.append(
                f"{diverged} of {count} simulations {self.simulator.failure} and count as the worst finite cost: narrow the bounds"
            )
        if mixing["rhat"] > _MIXED_RHAT or mixing["ess"] < _MIXED_ESS:
            self.doubt(
                f"the draws have not mixed (R-hat {mixing['rhat']:.3f}, {mixing['ess']:.0f} effective): evaluate more "
                "before you trust the intervals"
            )
        if likely < _CLEAR_ACCEPTANCE:
            remarks.append(
                f"most of the posterior lies where a cost as low as epsilon is improbable ({likely:.1g}), because there is "
                "so much room there: the intervals are about the prior's; take the mode, evaluate more, or free fewer parameters"
            )
        if found.normaliser_error > _CLEAR_ERROR:
            remarks.append(
                f"the density is known up to a factor only (log normaliser +- {found.normaliser_error:.2f}): "
                "do not compare log_prob between runs"
            )
        for remark in remarks:
            self.warn(remark)


def log_improvement(z: Tensor) -> Tensor:
    """log(phi(z) + z Phi(z)) without cancellation, differentiable (S. Ament et al. 2023, "Unexpected Improvements to Expected
    Improvement for Bayesian Optimization", https://arxiv.org/abs/2310.20708, equation 9)."""
    high = z.clamp_min(-1.0)
    density = torch.exp(-(high**2) / 2) / math.sqrt(2 * math.pi)
    above = torch.log(density + high * torch.special.ndtr(high))
    low = z.clamp(-1e3, -1.0)
    mills = math.sqrt(math.pi / 2) * torch.special.erfcx(-low / math.sqrt(2))
    below = -(low**2) / 2 - math.log(2 * math.pi) / 2 + torch.log1p(low * mills)
    # beyond: phi(z) / z^2 is what is left
    beyond = z.clamp_max(-1e3)
    far = -(beyond**2) / 2 - math.log(2 * math.pi) / 2 - 2 * torch.log(-beyond)
    return torch.where(z > -1.0, above, torch.where(z > -1e3, below, far))


def independent_residuals(residual: FloatArray, observed: NDArray[np.bool_]) -> float:
    """How many independent numbers residuals (W, L, C) are worth, by each channel's lag-one autocorrelation rho within windows
    and about zero: sum_c n_c (1 - rho_c) / (1 + rho_c)."""
    residual = np.where(observed, residual, 0.0)
    pairs = observed[:, 1:] & observed[:, :-1]
    product = (np.where(pairs, residual[:, 1:] * residual[:, :-1], 0.0)).sum((0, 1))
    square = (np.where(pairs, residual[:, 1:] ** 2 + residual[:, :-1] ** 2, 0.0)).sum((0, 1)) / 2
    rho = np.clip(np.divide(product, square, out=np.zeros_like(square), where=square > 0), 0.0, 0.999)
    return float((observed.sum((0, 1)) * (1 - rho) / (1 + rho)).sum())
