"""Any estimator's posterior, calibrated by simulation: what its point estimate would be at known parameters says what it is worth.

Posteriors are often too narrow (a likelihood that is wrong in its noise), too wide (summaries that lose information) or points.
Whatever an estimator's own claim, its estimate m is a statistic of the log, and simulation shows how it is distributed given
theta. P. Fearnhead, D. Prangle 2012, "Constructing summary statistics for approximate Bayesian computation" (JRSS B 74,
https://arxiv.org/abs/1004.1112) take point estimates as summary statistics; S. Wood 2010, "Statistical inference for noisy
nonlinear ecological dynamic systems" (Nature 466, https://doi.org/10.1038/nature09319) takes a normal likelihood of statistics
fitted to simulations. With both: logs are simulated at theta_1..R from a neighbourhood of the estimate, the estimator is fitted to
each, and the estimates are regressed on the truths,

    m_r = a + B theta_r + e_r,  e ~ N(0, V);   p(theta | m_0) is proportional to p(theta) N(m_0; a + B theta, V).

Bias of the estimate is in (a, B), its scatter in V: neither asks what the estimator believes. An estimate that does not move with a
parameter has B = 0 there, and the prior comes back. (a, B, V) are uncertain, as R is finite; how that widens the tails stands in
``inference.inverse_regression``.

Cost: ``refits`` times that of a fit, or, of an amortised estimator, which only conditions anew, one rollout for each refit and log;
``cost`` states it before anything is done.

The neighbourhood is found in up to three rounds: twice the estimator's own sd and at least 0.02 of the range (a point: 0.1), of an amortised
estimator, whose refits cost next to nothing and whose estimate may be far off, twice the prior's about its mean; half the range at most; then 1.5
times the sd of what was learned, about its mean. The last regression leaves out truths outside the last neighbourhood's
99.9 % ellipsoid, since the line is only local.

Deviations. Issue and textbook name regression of truth on estimate; here estimate on truth, turned round by Bayes' rule, so that the
width of the neighbourhood is not a second prior. One mode: estimates that jump between several make V wide. Uniform priors are
normals of sd 10 about the cube's centre, flat within it to half a percent. Replicas have first-order autoregressive noise as
``laplace`` finds it in a measured log, whatever noise the estimator believes in, and start as far
from the log's estimated start as noise leaves that: a linear regression on single steps follows the start more than it does theta. Where states are recorded, the noise that the estimator
infers, and for those that infer none, or where a function makes its own, as ``noise_level`` says. With a ``StateSpace`` their states are
shaken by the process noise that the fit of the log inferred, but for jumps that it let go; that is never inferred to be zero, so that
where there is none the result is somewhat too wide. A model that is wrong is not mended by
simulating it.
"""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import scipy.stats
import torch
from numpy.typing import NDArray

from sipe_bayes.core.checkpoint import State
from sipe_bayes.core.findings import Code, Finding, Severity
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.core.validation import whole
from sipe_bayes.inference.base import Estimator, Progress
from sipe_bayes.inference.inverse_regression import Line
from sipe_bayes.inference.laplace.estimator import Laplace
from sipe_bayes.inference.laplace.least_squares import QuadraticPrior
from sipe_bayes.likelihood.noise import Noise
from sipe_bayes.likelihood.replicas import Replicas, observation_noise
from sipe_bayes.likelihood.settings import BudgetExhausted, Segments, StateSpace
from sipe_bayes.posterior import GaussianMixture, Posterior
from sipe_bayes.simulation.simulator import Simulator

FloatArray = NDArray[np.float64]

_FEWEST, _PER_PARAMETER = 100, 8  # refits by default
_FLAT_PRECISION = 0.01  # sd 10 in units of the cube
_FIRST, _AGAIN = 2.0, 1.5  # sd of the neighbourhood, of the estimator's own and of what was learned
_LEAST_SD, _POINT_SD, _MOST_SD = 0.02, 0.1, 0.5  # of the first neighbourhood, in the cube
NOISE_BUDGET = 2000
_LOCAL = 0.999  # of the last neighbourhood
_ODD = 0.01  # p-value below which a warning says that estimates do not scatter normally about a line
_LOST = 0.1  # of the refits: more failures are a warning


class Recalibrated(Estimator):
    """A GaussianMixture around what ``estimator`` finds; see the module's docstring.

    estimator: any; one that is amortised and has been trained is not trained again. refits: logs simulated and fitted, default 100 or 8 for each
    parameter and two, twice that of an amortised one. budget: rollouts in all, default ``cost``. seed: of the simulations. checkpoint, progress: as every estimator's;
    a refit that is done is never done again.
    """

    name: ClassVar[str] = "recalibrated"

    def __init__(
        self,
        estimator: Estimator,
        *,
        refits: int | None = None,
        budget: int | None = None,
        seed: int = 0,
        checkpoint: str | Path | None = None,
        progress: Progress | None = None,
    ) -> None:
        if not isinstance(estimator, Estimator) or isinstance(estimator, Recalibrated):
            raise ValueError(
                f"estimator: expected another estimator, got {estimator!r}; sipe.Recalibrated(sipe.get_estimator(...))"
            )
        super().__init__(
            estimator.simulator,
            prior=estimator.prior,
            budget=budget,
            seed=seed,
            checkpoint=checkpoint,
            progress=progress,
        )
        self.likelihood = estimator.likelihood  # checked there, a StateSpace too
        n = len(self.space)
        default = max(_FEWEST, _PER_PARAMETER * (n + 2)) * (1 + estimator.amortised)
        self.refits = whole("refits", default if refits is None else refits, 3 * n + 10)
        self.estimator, self._asked = estimator, budget
        self._fitted: tuple[Trajectories, Estimator, Posterior] | None = None
        self._replicas: tuple[Trajectories, Replicas] | None = None
        self._proposals: tuple[tuple[bytes, bytes], FloatArray] | None = None
        self._found: list[Finding] = []  # of its fit
        self._seconds: float | None = None

    def settings(self) -> dict[str, Any]:
        own = {"budget": self._asked, "refits": self.refits, "of": self.estimator.settings()}
        return {**super().settings(), **own}

    def cost(self, trajectories: Any) -> int:
        """Rollouts that ``fit`` takes at most."""
        logs = len(self._given.stack(self._recorded(trajectories)))
        each = logs if self.estimator.amortised else logs + self.estimator.budget
        return self.estimator.budget + self.refits * each + self._looks_for_noise(trajectories) * NOISE_BUDGET

    def start(self, trajectories: Trajectories) -> State:
        self._bound_budget(trajectories)
        base, posterior = self._base(trajectories)
        mean, covariance = posterior.mean.numpy(), posterior.covariance.numpy()
        self.rollouts = base.rollouts
        noise = self._noise(base, mean, trajectories)
        n = len(mean)
        return {
            "estimate": mean,
            "own_sd": np.sqrt(np.maximum(np.diag(covariance), 0.0)),
            "noise_sd": noise.sd,
            "noise_tau": noise.tau,
            "process": process_noise(base.diagnostics),
            "theta": np.empty((0, n)),
            "estimates": np.empty((0, n)),
            "tried": 0,
            "round_tried": 0,  # and found before the present neighbourhood
            "round_found": 0,
            "centre": self.prior.mean.numpy() if base.amortised else mean,
            "neighbourhood": _first_neighbourhood(self.prior.covariance.numpy() if base.amortised else covariance),
            "done": False,
        }

    def step(self, state: State, trajectories: Trajectories) -> State:
        """One replica and its estimate; at the end of a round, the next neighbourhood."""
        self._bound_budget(trajectories)
        base, _ = self._base(trajectories)
        began, tried = time.monotonic(), state["tried"]
        rng = np.random.default_rng([self.seed, 1, tried])
        theta = self._proposal(state, tried)
        self._spend(len(trajectories))
        replica = self._simulated(state, trajectories).many(theta[None], rng, estimated=True)[0]
        estimate = None if replica is None else self._estimate(base, replica)
        if estimate is not None:
            rows = {"theta": theta[None], "estimates": estimate[None]}
            state = {**state, **{k: np.concatenate([state[k], v]) for k, v in rows.items()}}
        state = {**state, "tried": tried + 1, "done": tried + 1 >= self.refits}
        if tried + 1 in self._rounds() and len(state["theta"]) > 2 * len(theta) + 3:
            centre, covariance = self._learned(state)
            begun = {"round_tried": tried + 1, "round_found": len(state["theta"])}
            state = {**state, **begun, "centre": centre, "neighbourhood": _AGAIN**2 * covariance}
        self._seconds = time.monotonic() - began
        return state

    def posterior(self, state: State, trajectories: Trajectories) -> Posterior:
        n = len(self.space)
        theta, estimates = _local(state)
        if len(theta) < 2 * n + 4:
            raise ValueError(
                f"refits: {len(theta)} of {state['tried']} gave an estimate, {2 * n + 4} are the least for {n} parameters; raise "
                "refits or budget, or narrow the bounds"
            )
        tried = state["tried"] - state["round_tried"]
        lost = 1 - (len(state["theta"]) - state["round_found"]) / max(1, tried)
        if lost > _LOST:
            self.warn(
                f"{lost:.0%} of the replicas diverged or could not be fitted: the recalibrated intervals speak of the others only"
            )
        line = Line.fit(theta, estimates)
        rng = np.random.default_rng([self.seed, 2])
        found = GaussianMixture(*line.mixture(state["estimate"], self._before, rng), self.space)
        p = line.normality()
        if p < _ODD:
            self.warn(
                f"the estimates of simulated logs do not scatter normally about a line in theta (p = {p:.1g}): the recalibrated "
                "intervals are approximate; verify them with `sipe check`"
            )
        sd = found.stddev.numpy()
        self.diagnostics.update(
            refits=len(theta),
            scatter_p=p,
            own_sd=state["own_sd"].tolist(),
            widened=(sd / np.maximum(state["own_sd"], 1e-12)).tolist(),
            noise_sd=state["noise_sd"].tolist(),
            noise_tau=state["noise_tau"].tolist(),
        )
        return found

    def describe(self, state: State) -> str:
        said = f"recalibrating {self.estimator.name}: refit {state['tried']} of {self.refits}"
        left = self.refits - state["tried"]
        if self._seconds is None or not left:
            return said
        seconds = left * self._seconds
        return f"{said}, about {seconds:.0f} s left" if seconds < 100 else f"{said}, about {seconds / 60:.0f} min left"

    def _looks_for_noise(self, trajectories: Any) -> bool:
        """Whether the log's noise has to be looked for with a fit of its own."""
        batch = self._given.stack(self._recorded(trajectories))
        same = isinstance(self.estimator, Laplace) and self.likelihood.noise == "ar1"
        return not same and noise_is_unknown(self.simulator, self.likelihood, batch)

    def _noise(self, base: Estimator, theta: FloatArray, trajectories: Trajectories) -> Noise:
        """Of all O channels."""
        if self._looks_for_noise(trajectories):
            noise, _, rollouts = fitted_noise(self.simulator, self.likelihood, trajectories, self.prior, theta)
            self.rollouts += rollouts
            return noise
        return observation_noise(base.diagnostics, trajectories, self.likelihood)

    def _bound_budget(self, trajectories: Trajectories) -> None:
        if self._asked is None:
            self.budget = self.cost(trajectories)

    def _spend(self, rollouts: int) -> None:
        if self.rollouts + rollouts > self.budget:
            raise BudgetExhausted(f"{self.rollouts} of {self.budget} rollouts used, the next refit takes {rollouts}")
        self.rollouts += rollouts

    def _base(self, trajectories: Trajectories) -> tuple[Estimator, Posterior]:
        """The estimator fitted to the log itself, and what it found; after an interruption from its own checkpoint."""
        if self._fitted is None or self._fitted[0] is not trajectories:
            base = self.estimator.fresh()
            if base.amortised and base.ended:
                found = base.get_parameter_estimate(trajectories)
            else:
                base.progress = self.progress
                own = self.estimator.checkpoint
                if own is None and self.checkpoint is not None:
                    own = self.checkpoint.with_name(f"{self.checkpoint.stem}-{base.name}{self.checkpoint.suffix}")
                base.checkpoint = own
                found = base.fit(trajectories)
            self._fitted = (trajectories, base, found)
            # before it sees replicas; one that is not amortised doubts its widths, which are mended here
            self._found = [
                item
                if base.amortised or item.severity is not Severity.BLOCKING
                else replace(item, severity=Severity.CAUTION)
                for item in base.findings
            ]
        self.findings.extend(self._found)
        return self._fitted[1:]

    def _estimate(self, base: Estimator, replica: Trajectories) -> FloatArray | None:
        """Mean (N,) of the estimator's posterior of a replica; None where it finds none."""
        again = base if base.amortised else base.fresh()
        try:
            if base.amortised and base.snapshot is not None:
                found = base.posterior(base.snapshot.state, replica)
            else:
                again.budget = min(base.budget, max(1, self.budget - self.rollouts))
                found = again.fit(replica)
        except ValueError:  # LinAlgError is one
            found = None
        if not base.amortised:
            self.rollouts += again.rollouts
            if again.budget < base.budget and (found is None or Code.BUDGET_SPENT in again.findings):
                raise BudgetExhausted(f"{self.rollouts} of {self.budget} rollouts used, too few were left for a refit")
        return None if found is None else found.mean.numpy()

    def _simulated(self, state: State, trajectories: Trajectories) -> Replicas:
        if self._replicas is None or self._replicas[0] is not trajectories:
            noise = Noise(state["noise_sd"], state["noise_tau"])
            self._replicas = (trajectories, Replicas(self.simulator, trajectories, noise, state["process"]))
        return self._replicas[1]

    def _rounds(self) -> tuple[int, ...]:
        """Refits after which the neighbourhood is looked for anew."""
        first = max(self.refits // 4, 2 * len(self.space) + 5)
        return tuple(k for k in (first, 2 * first) if 2 * k <= self.refits)

    def _proposal(self, state: State, number: int) -> FloatArray:
        """A truth (N,) from the present neighbourhood, all of whose truths are drawn at once."""
        key = (state["centre"].tobytes(), state["neighbourhood"].tobytes())
        if self._proposals is None or self._proposals[0] != key:
            around = GaussianMixture([0.0], state["centre"][None], state["neighbourhood"][None], self.space)
            generator = torch.Generator().manual_seed(int(np.random.SeedSequence([self.seed, 0]).generate_state(1)[0]))
            self._proposals = (key, around.sample((self.refits,), generator=generator).numpy())
        return self._proposals[1][number]

    @property
    def _before(self) -> QuadraticPrior:
        own = QuadraticPrior.of(self.prior)
        flat = _FLAT_PRECISION * np.eye(len(self.space))
        precision = own.precision + flat
        pull = own.precision @ own.mean + flat @ np.full(len(self.space), 0.5)
        return QuadraticPrior(np.linalg.solve(precision, pull), precision)

    def _learned(self, state: State) -> tuple[FloatArray, FloatArray]:
        """Mean (N,), within the cube, and covariance (N, N), no wider than the prior, of the best line's normal alone."""
        line = Line.fit(*_local(state))
        _, mean, covariance = line.inverted(line.coefficients, line.scatter, state["estimate"], self._before)
        sd = np.sqrt(np.diag(covariance))
        shrink = np.minimum(sd, self.prior.stddev.numpy()) / sd
        return np.clip(mean, 0.0, 1.0), covariance * np.outer(shrink, shrink)


def process_noise(diagnostics: dict[str, Any]) -> FloatArray:
    """sd (D,) of a fit with a ``StateSpace``, none of any other."""
    return np.array(diagnostics.get("process_noise", ()), float)


def noise_is_unknown(simulator: Any, likelihood: Any, trajectories: Trajectories) -> bool:
    """Whether these are logs of a machine, whose noise only a fit tells."""
    return isinstance(simulator, Simulator) and isinstance(likelihood, Segments) and trajectories.states is None


def fitted_noise(
    simulator: Any,
    likelihood: Segments | StateSpace,
    trajectories: Trajectories,
    prior: Posterior,
    theta: FloatArray | None = None,
    budget: int = NOISE_BUDGET,
) -> tuple[Noise, FloatArray, int]:
    """Noise of all O channels by a fit of ``laplace``, from theta (N,) where given: autoregressive, or that of the measurement with a
    ``StateSpace``; its process noise (D,), else none; and the fit's rollouts."""
    coloured = replace(likelihood, noise="ar1") if isinstance(likelihood, Segments) else likelihood
    fit = Laplace(simulator, likelihood=coloured, prior=prior, initial=theta, budget=budget)
    fit.fit(trajectories)
    return observation_noise(fit.diagnostics, trajectories, likelihood), process_noise(fit.diagnostics), fit.rollouts


def _first_neighbourhood(covariance: FloatArray) -> FloatArray:
    """Covariance (N, N), in the cube, of the first truths."""
    sd = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    least = np.where(sd > 0, _LEAST_SD, _POINT_SD)
    return np.diag(np.clip(_FIRST * sd, least, _MOST_SD) ** 2)


def _local(state: State) -> tuple[FloatArray, FloatArray]:
    """The truths of the last neighbourhood's ellipsoid and their estimates; all of them where these are too few."""
    theta, n = state["theta"], state["theta"].shape[1]
    gap = theta - state["centre"]
    distance = np.einsum("ri,ri->r", gap @ np.linalg.pinv(state["neighbourhood"], hermitian=True), gap)
    near = distance <= scipy.stats.chi2.ppf(_LOCAL, n)
    if near.sum() < 2 * n + 4:
        near[:] = True
    return theta[near], state["estimates"][near]
