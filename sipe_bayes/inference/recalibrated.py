"""Any estimator's posterior, calibrated by simulation: what its estimate would be at known parameters says its worth.

Posteriors are often too narrow (a likelihood that is wrong in its noise), too wide (summaries that lose information) or
points. Whatever an estimator's own claim, its estimate m is a statistic of the log, and simulation shows how it is
distributed given theta. P. Fearnhead, D. Prangle 2012, "Constructing summary statistics for approximate Bayesian
computation" (JRSS B 74, https://arxiv.org/abs/1004.1112) take point estimates as summary statistics; S. Wood 2010,
"Statistical inference for noisy nonlinear ecological dynamic systems" (Nature 466, https://doi.org/10.1038/nature09319)
takes a normal likelihood of statistics fitted to simulations. With both: logs are simulated at theta_1..R from a
neighbourhood of the estimate, the estimator is fitted to each, and the estimates are regressed on the truths,

    m_r = a + B theta_r + e_r,  e ~ N(0, V);   p(theta | m_0) is proportional to p(theta) N(m_0; a + B theta, V).

Bias of the estimate is in (a, B), its scatter in V: neither asks what the estimator believes. An estimate that does not
move with a parameter has B = 0 there, and the prior comes back. (a, B, V) are uncertain, as R is finite; how that
widens the tails stands in ``inference.inverse_regression``.

Cost: ``refits`` times that of a fit, or, of an amortised estimator, which only conditions anew, one rollout for each
refit and log; ``cost`` states it before anything is done.

The neighbourhood is found in up to three rounds: twice the estimator's own sd and at least 0.02 of the range (a point:
0.1), of an amortised estimator, whose refits cost next to nothing and whose estimate may be far off, twice the prior's
about its mean; half the range at most; then 1.5 times the sd of what was learned, about its mean. The last regression
leaves out truths outside the last neighbourhood's 99.9 % ellipsoid, since the line is only local.

Deviations:

- Issue and textbook name regression of truth on estimate; here estimate on truth, turned round by Bayes' rule, so that
  the width of the neighbourhood is not a second prior.
- One mode: estimates that jump between several make V wide.
- Uniform priors are normals of sd 10 about the cube's centre, flat within it to half a percent.
- Replicas have first-order autoregressive noise as ``laplace`` finds it in a measured log, whatever noise the estimator
  believes in, and start as far from the log's estimated start as noise leaves that: a linear regression on single steps
  follows the start more than it does theta. Where states are recorded, the noise that the estimator infers, and for
  those that infer none, or where a function makes its own, as ``noise_level`` says.
- With a ``StateSpace`` their states are shaken by the process noise that the fit of the log inferred, but for
  outlying jumps; that is never inferred to be zero, so that where there is none the result is somewhat too wide.
- A model that is wrong is not mended by simulating it.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import scipy.stats

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.budget import BudgetExhausted
from sipe_bayes.core.findings import Code, Finding, Severity
from sipe_bayes.core.options import Options, option
from sipe_bayes.core.seeding import torch_generator
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.core.validation import whole
from sipe_bayes.inference.base import Estimator
from sipe_bayes.inference.inverse_regression import Line
from sipe_bayes.inference.log_noise import NOISE_BUDGET, fitted_noise, noise_is_unknown, process_noise
from sipe_bayes.inference.recorded import Progress, Recorded
from sipe_bayes.likelihood import FLAT_PRECISION, Noise, QuadraticPrior, Replicas, observation_noise
from sipe_bayes.posterior import GaussianMixture, Posterior


@dataclass(frozen=True)
class RecalibratedOptions(Options):
    """How many logs are simulated, and where."""

    refits: int | None = option(
        None, "logs simulated and fitted, by default the larger of the next two, twice that of an amortised estimator"
    )
    fewest: int = option(100, "refits, however few parameters there are", least=1)
    per_parameter: int = option(8, "refits for each parameter and two, so that V is known", least=1)
    first_width: float = option(2.0, "of the first neighbourhood", "the estimator's own sds", above=0)
    next_width: float = option(1.5, "of the next ones", "sds of what was learned", above=0)
    least_sd: float = option(0.02, "of the first neighbourhood", "of the range", above=0)
    point_sd: float = option(0.1, "of the first neighbourhood of a point estimate", "of the range", above=0)
    most_sd: float = option(0.5, "of the first neighbourhood", "of the range", above=0)
    local: float = option(0.999, "of the last neighbourhood, whose truths the line goes through", above=0, below=1)


@dataclass(frozen=True)
class RecalibratedState:
    """The log's own estimate, and the refits.

    Args:
        estimate: the log's own (N,).
        own_sd: what the estimator claims (N,).
        noise: of all O channels.
        process: sd (D,) of process noise, none without a ``StateSpace``.
        theta: truths (R, N) that gave an estimate.
        estimates: of them (R, N).
        centre: of the present neighbourhood (N,).
        neighbourhood: its covariance (N, N).
        tried: refits so far, R and those that gave no estimate.
        round_tried: of them before the present neighbourhood.
        round_valid: R before the present neighbourhood.
        done: whether all refits were tried.
    """

    estimate: FloatArray
    own_sd: FloatArray
    noise: Noise
    process: FloatArray
    theta: FloatArray
    estimates: FloatArray
    centre: FloatArray
    neighbourhood: FloatArray
    tried: int = 0
    round_tried: int = 0
    round_valid: int = 0
    done: bool = False


@dataclass(frozen=True)
class _Fit:
    """The estimator fitted to the log itself, with what it noticed there before it sees replicas."""

    trajectories: Trajectories
    estimator: Estimator
    posterior: Posterior
    findings: list[Finding]


class Recalibrated(Estimator[RecalibratedState]):
    """A GaussianMixture around what an estimator finds; see the module's docstring.

    Args:
        estimator: any; one that is amortised and has been trained is not trained again.
        refits: logs simulated and fitted, see ``RecalibratedOptions``.
        budget: rollouts in all, default ``cost``.
        seed: of the simulations.
        checkpoint: as every estimator's; a refit that is done is never done again.
        progress: as every estimator's.
        **options: the others of ``RecalibratedOptions``.
    """

    name: ClassVar[str] = "recalibrated"
    options_type = RecalibratedOptions
    state_type = RecalibratedState
    options: RecalibratedOptions

    def __init__(
        self,
        estimator: Estimator,
        *,
        refits: int | None = None,
        budget: int | None = None,
        seed: int = 0,
        checkpoint: str | Path | None = None,
        progress: Progress | None = None,
        **options: object,
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
            **{**options, "refits": refits},  # type: ignore[arg-type]  # fields of the options only
        )
        self.likelihood = estimator.likelihood  # checked there, a StateSpace too
        n = len(self.space)
        default = max(self.options.fewest, self.options.per_parameter * (n + 2)) * (1 + estimator.amortised)
        self.refits = whole("refits", default if refits is None else refits, 3 * n + 10)
        self.estimator, self._asked = estimator, budget
        self._own_fit: _Fit | None = None
        self._replicas: tuple[Trajectories, Replicas] | None = None
        self._proposals: tuple[tuple[bytes, bytes], FloatArray] | None = None
        self._seconds: float | None = None

    def choose_likelihood(self, batch: Trajectories) -> None:
        """That of the estimator."""
        self.estimator.choose_likelihood(batch)
        self.likelihood = self.estimator.likelihood

    def settings(self) -> dict[str, object]:
        """As every estimator's, and the other one's."""
        return {**super().settings(), "budget": self._asked, "refits": self.refits, "of": self.estimator.settings()}

    def cost(self, trajectories: Recorded) -> int:
        """Rollouts that ``fit`` takes at most."""
        batch = self._given.stack(self._recorded(trajectories))
        self.choose_likelihood(batch)
        logs = len(batch)
        each = logs if self.estimator.amortised else logs + self.estimator.budget
        return self.estimator.budget + self.refits * each + self._looks_for_noise(trajectories) * NOISE_BUDGET

    def start(self, trajectories: Trajectories) -> RecalibratedState:
        """The estimator fitted to the log itself."""
        self._bound_budget(trajectories)
        base, posterior = self._base(trajectories)
        mean, covariance = posterior.mean.numpy(), posterior.covariance.numpy()
        self.rollouts = base.rollouts
        none = np.empty((0, len(mean)))
        around = self.prior if base.amortised else posterior
        return RecalibratedState(
            estimate=mean,
            own_sd=np.sqrt(np.maximum(np.diag(covariance), 0.0)),
            noise=self._noise(base, mean, trajectories),
            process=process_noise(base.diagnostics),
            theta=none,
            estimates=none,
            centre=around.mean.numpy(),
            neighbourhood=self._first_neighbourhood(around.covariance.numpy()),
        )

    def step(self, state: RecalibratedState, trajectories: Trajectories) -> RecalibratedState:
        """One replica and its estimate; at the end of a round, the next neighbourhood."""
        self._bound_budget(trajectories)
        base, _ = self._base(trajectories)
        began, tried = time.monotonic(), state.tried
        # simulate a log at a truth, and fit it
        rng = np.random.default_rng([self.seed, 1, tried])
        theta = self._proposal(state, tried)
        self._spend(len(trajectories))
        replica = self._simulated(state, trajectories).many(theta[None], rng, estimated=True)[0]
        estimate = None if replica is None else self._estimate(base, replica)
        if estimate is not None:
            both = np.concatenate([state.theta, theta[None]]), np.concatenate([state.estimates, estimate[None]])
            state = replace(state, theta=both[0], estimates=both[1])
        tried += 1
        state = replace(state, tried=tried, done=tried >= self.refits)
        # look elsewhere in the next round
        if tried in self._rounds() and len(state.theta) > 2 * len(theta) + 3:
            centre, covariance = self._learned(state)
            wider = self.options.next_width**2 * covariance
            count = len(state.theta)
            state = replace(state, round_tried=tried, round_valid=count, centre=centre, neighbourhood=wider)
        self._seconds = time.monotonic() - began
        return state

    def posterior(self, state: RecalibratedState, trajectories: Trajectories) -> Posterior:
        """The regression of the refits, turned round."""
        n = len(self.space)
        theta, estimates = self._local(state)
        if len(theta) < 2 * n + 4:
            raise ValueError(
                f"refits: {len(theta)} of {state.tried} gave an estimate, {2 * n + 4} are the least for {n} "
                "parameters; raise refits or budget, or narrow the bounds"
            )
        tried = state.tried - state.round_tried
        lost = 1 - (len(state.theta) - state.round_valid) / max(1, tried)
        if lost > THRESHOLDS.refits_lost:
            self.find(Code.REFITS_LOST, share=lost)
        line = Line.fit(theta, estimates)
        rng = np.random.default_rng([self.seed, 2])
        posterior = GaussianMixture(*line.mixture(state.estimate, self._before, rng), self.space)
        p = line.normality()
        if p < THRESHOLDS.refits_odd:
            self.find(Code.REFITS_NOT_NORMAL, p=p)
        self.diagnostics.update(
            refits=len(theta),
            scatter_p=p,
            own_sd=state.own_sd.tolist(),
            widened=(posterior.stddev.numpy() / np.maximum(state.own_sd, 1e-12)).tolist(),
            noise_sd=state.noise.sd.tolist(),
            noise_tau=state.noise.tau.tolist(),
        )
        return posterior

    def describe(self, state: RecalibratedState) -> str:
        """For the progress bar, with the time that is left."""
        progress = f"recalibrating {self.estimator.name}: refit {state.tried} of {self.refits}"
        left = self.refits - state.tried
        if self._seconds is None or not left:
            return progress
        seconds = left * self._seconds
        about = f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} min"
        return f"{progress}, about {about} left"

    def _looks_for_noise(self, trajectories: Recorded) -> bool:
        """Whether the log's noise has to be looked for with a fit of its own."""
        batch = self._given.stack(self._recorded(trajectories))
        same = self.estimator.name == "laplace" and self.likelihood.noise == "ar1"
        return not same and noise_is_unknown(self.simulator, self.likelihood, batch)

    def _noise(self, base: Estimator, theta: FloatArray, trajectories: Trajectories) -> Noise:
        """Of all O channels."""
        if self._looks_for_noise(trajectories):
            fitted = fitted_noise(self.simulator, self.likelihood, trajectories, self.prior, theta)
            self.rollouts += fitted.rollouts
            return fitted.noise
        return observation_noise(base.diagnostics, trajectories, self.likelihood, self.simulator)

    def _bound_budget(self, trajectories: Trajectories) -> None:
        if self._asked is None:
            self.budget = self.cost(trajectories)

    def _spend(self, rollouts: int) -> None:
        if self.rollouts + rollouts > self.budget:
            raise BudgetExhausted(f"{self.rollouts} of {self.budget} rollouts used, the next refit takes {rollouts}")
        self.rollouts += rollouts

    def _base(self, trajectories: Trajectories) -> tuple[Estimator, Posterior]:
        """The estimator fitted to the log itself, and its posterior; after an interruption from its own checkpoint."""
        fit = self._own_fit
        if fit is None or fit.trajectories is not trajectories:
            fit = self._own_fit = self._fitted_base(trajectories)
        self.findings.extend(fit.findings)
        return fit.estimator, fit.posterior

    def _fitted_base(self, trajectories: Trajectories) -> _Fit:
        base = self.estimator.fresh()
        if base.amortised and base.ended:
            posterior = base.get_parameter_estimate(trajectories)
        else:
            base.progress = self.progress
            own = self.estimator.checkpoint
            if own is None and self.checkpoint is not None:
                own = self.checkpoint.with_name(f"{self.checkpoint.stem}-{base.name}{self.checkpoint.suffix}")
            base.checkpoint = own
            posterior = base.fit(trajectories)
        findings = list(base.findings)
        if not base.amortised:  # it doubts its widths, which are mended here
            blocking = {Severity.BLOCKING: Severity.CAUTION}
            findings = [replace(item, severity=blocking.get(item.severity, item.severity)) for item in findings]
        return _Fit(trajectories, base, posterior, findings)

    def _estimate(self, base: Estimator, replica: Trajectories) -> FloatArray | None:
        """Mean (N,) of the estimator's posterior of a replica; None where it has none."""
        again = base if base.amortised else base.fresh()
        posterior: Posterior | None
        try:
            if base.amortised and base.snapshot is not None:
                posterior = base.posterior(base.snapshot.state, replica)
            else:
                again.budget = min(base.budget, max(1, self.budget - self.rollouts))
                posterior = again.fit(replica)
        except ValueError:  # LinAlgError is one
            posterior = None
        if not base.amortised:
            self.rollouts += again.rollouts
            if again.budget < base.budget and (posterior is None or Code.BUDGET_SPENT in again.findings):
                raise BudgetExhausted(f"{self.rollouts} of {self.budget} rollouts used, too few were left for a refit")
        return None if posterior is None else posterior.mean.numpy()

    def _simulated(self, state: RecalibratedState, trajectories: Trajectories) -> Replicas:
        if self._replicas is None or self._replicas[0] is not trajectories:
            replicas = Replicas(self.simulator, trajectories, state.noise, state.process)
            self._replicas = (trajectories, replicas)
        return self._replicas[1]

    def _rounds(self) -> tuple[int, ...]:
        """Refits after which the neighbourhood is looked for anew."""
        first = max(self.refits // 4, 2 * len(self.space) + 5)
        return tuple(k for k in (first, 2 * first) if 2 * k <= self.refits)

    def _proposal(self, state: RecalibratedState, number: int) -> FloatArray:
        """A truth (N,) from the present neighbourhood, all of whose truths are drawn at once."""
        key = (state.centre.tobytes(), state.neighbourhood.tobytes())
        if self._proposals is None or self._proposals[0] != key:
            around = GaussianMixture([0.0], state.centre[None], state.neighbourhood[None], self.space)
            draws = around.sample((self.refits,), generator=torch_generator([self.seed, 0]))
            self._proposals = (key, draws.numpy())
        return self._proposals[1][number]

    @property
    def _before(self) -> QuadraticPrior:
        """The prior's normal, or a flat one."""
        own = QuadraticPrior.of(self.prior)
        flat = FLAT_PRECISION * np.eye(len(self.space))
        precision = own.precision + flat
        pull = own.precision @ own.mean + flat @ np.full(len(self.space), 0.5)
        return QuadraticPrior(np.linalg.solve(precision, pull), precision)

    def _first_neighbourhood(self, covariance: FloatArray) -> FloatArray:
        """Covariance (N, N), in the cube, of the first truths."""
        sd = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        least = np.where(sd > 0, self.options.least_sd, self.options.point_sd)
        return np.diag(np.clip(self.options.first_width * sd, least, self.options.most_sd) ** 2)

    def _learned(self, state: RecalibratedState) -> tuple[FloatArray, FloatArray]:
        """Mean (N,), within the cube, and covariance (N, N), no wider than the prior, of the best line's normal."""
        line = Line.fit(*self._local(state))
        _, mean, covariance = line.inverted(line.coefficients, line.scatter, state.estimate, self._before)
        sd = np.sqrt(np.diag(covariance))
        shrink = np.minimum(sd, self.prior.stddev.numpy()) / sd
        return np.clip(mean, 0.0, 1.0), covariance * np.outer(shrink, shrink)

    def _local(self, state: RecalibratedState) -> tuple[FloatArray, FloatArray]:
        """Truths in the last neighbourhood's ellipsoid and their estimates; all of them where these are too few."""
        theta, n = state.theta, state.theta.shape[1]
        gap = theta - state.centre
        distance = np.einsum("ri,ri->r", gap @ np.linalg.pinv(state.neighbourhood, hermitian=True), gap)
        near = distance <= scipy.stats.chi2.ppf(self.options.local, n)
        if near.sum() < 2 * n + 4:
            near[:] = True
        return theta[near], state.estimates[near]
