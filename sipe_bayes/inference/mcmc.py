"""Markov chain Monte Carlo over theta, noise and starts integrated out: emcee on the likelihood.

D. Foreman-Mackey et al. 2013, "emcee: The MCMC Hammer", PASP 125 (https://arxiv.org/abs/1202.3665). Moves: an
independent Metropolis-Hastings proposal from the widened ``laplace`` posterior (all walkers in one batch, nearly
independent draws where Laplace is good) mixed with differential evolution (ter Braak & Vrugt 2008), which finds its way
where it is not.

The target is that of ``laplace.target``, whose starts and their Jacobian are those of the ``laplace`` fit that comes
first and also places the walkers; that saves D of D + 1 simulations. How far a fresh Jacobian would move the target is
measured on some of the first walkers and reported as ``linearisation_error`` (sd in nats; NaN where it would cost more
than a tenth of the budget). With ``StateSpace`` the target is that of ``laplace.state_space.target``, with the noise
of the ``laplace`` fit.

Deviations:

- R-hat and effective draws treat the walkers of one ensemble as chains; walkers share information, so both are
  optimistic.
- No tempering: that the chains hold every optimum is owed to the independent proposals, which hold those that
  ``laplace`` came to.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import torch

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.budget import BudgetExhausted, BudgetTooSmall
from sipe_bayes.core.findings import Code
from sipe_bayes.core.options import Options, option
from sipe_bayes.core.parameters import ParameterSpace
from sipe_bayes.core.seeding import torch_generator_from
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.core.validation import whole
from sipe_bayes.inference.base import Estimator
from sipe_bayes.inference.laplace import Laplace, Target, TargetFit, noise_diagnostics, target_fit, target_of
from sipe_bayes.likelihood import BoundLikelihood, BoundStates, Segments, StateSpace
from sipe_bayes.posterior import GaussianMixture, Particles
from sipe_bayes.posterior.ensemble import mixing_of

if TYPE_CHECKING:
    import emcee


@dataclass(frozen=True)
class MCMCTuning(Options):
    """How the ensemble is placed, moved and judged."""

    block: int = option(20, "steps of the ensemble between checkpoints", least=1)
    warm_up: float = option(1 / 3, "share of the chain that is dropped", least=0, below=1)
    wider: float = option(
        1.2, "width of the independent proposal over laplace's: heavier tails than the target", above=0
    )
    most_draws: int = option(4000, "draws kept at most", least=1)
    placings: int = option(20, "rounds in which walkers look for a valid place", least=1)
    moves: tuple[float, ...] = option(
        (0.6, 0.3, 0.1), "shares of independent Metropolis-Hastings, differential evolution, and its snooker"
    )
    fewest_checked: int = option(4, "walkers that make an sd", least=2)
    checked: int = option(16, "walkers on which the linearisation is checked", least=1)
    check_share: float = option(0.1, "share of the budget that this may cost", above=0, below=1)
    search_share: float = option(0.8, "share of the budget that the laplace fit may cost", above=0, below=1)
    least_walkers: int = option(24, "walkers by default, or twice the dimensions plus two", least=2)
    nonlinear: float = option(0.5, "error of the linearisation that is worth a finding", "nats", above=0)


@dataclass(frozen=True)
class MCMCOptions(Options):
    """What ``MCMC`` takes beside what every estimator takes."""

    walkers: int | None = option(None, "chains of the ensemble; default twice the dimensions plus two, at least 24")
    effective: int = option(400, "effective draws, of bulk and tails, at which it stops, once R-hat is small", least=1)
    mixed: float = option(1.01, "R-hat at which it stops, once there are effective draws enough", above=1)
    restarts: int = option(2, "starting points of the laplace fit that comes first", least=1)
    candidates: int = option(8, "points among which they are chosen", least=0)
    tuning: MCMCTuning = option(MCMCTuning(), "numbers of the chains themselves")


@dataclass(frozen=True)
class RandomState:
    """A ``numpy.random.RandomState``, as emcee wants it, as plain data."""

    kind: str
    keys: np.ndarray
    position: int
    has_gauss: int
    cached: float

    @classmethod
    def of(cls, random: np.random.RandomState) -> RandomState:
        """Its present state."""
        kind, keys, position, has_gauss, cached = random.get_state(legacy=True)
        return cls(str(kind), np.asarray(keys), int(position), int(has_gauss), float(cached))

    def plain(self) -> tuple[str, np.ndarray, int, int, float]:
        """As ``set_state`` takes it."""
        return self.kind, self.keys, self.position, self.has_gauss, self.cached


@dataclass(frozen=True)
class Proposal:
    """The widened normals of ``laplace``: log weights (K,), means (K, N), covariances (K, N, N)."""

    weights: FloatArray
    means: FloatArray
    covariances: FloatArray


@dataclass(frozen=True)
class MCMCState:
    """An ensemble of W walkers after S steps.

    Args:
        fit: the laplace optimum that the target is made of.
        proposal: of the independent move.
        walkers: (W, N), where they stand.
        log_prob: (W,), the target there.
        best: (N,), the best draw.
        best_log_prob: the target there.
        linearisation_error: sd of what fresh Jacobians change, in nats; NaN where that was too dear.
        chain: (S, W, N).
        chain_log_prob: (S, W).
        accepted: (W,), moves that were.
        random: of the moves to come.
        done: whether there are enough effective draws.
    """

    fit: TargetFit
    proposal: Proposal
    walkers: FloatArray
    log_prob: FloatArray
    best: FloatArray
    best_log_prob: float
    linearisation_error: float
    chain: FloatArray
    chain_log_prob: FloatArray
    accepted: FloatArray
    random: RandomState
    done: bool = False


class MCMC(Estimator[MCMCState]):
    """emcee over the likelihood of `laplace`, all walkers in one batch; in minutes. Particles.

    Args:
        walkers: chains of the ensemble; default twice the dimensions plus two, at least 24.
        effective: effective draws, of bulk and tails, at which it stops early, once R-hat is small too.
        mixed: the R-hat that is small.
        restarts, candidates: of the ``laplace`` fit that comes first.
        tuning: numbers of the chains themselves.
    """

    name: ClassVar[str] = "mcmc"
    searches: ClassVar[bool] = True
    default_budget: ClassVar[int] = 50_000
    options_type = MCMCOptions
    state_type = MCMCState
    options: MCMCOptions

    def check_options(self) -> None:
        """Refuse a likelihood that is none, and too few walkers."""
        if self.likelihood.noise == "sandwich":
            raise ValueError("noise: 'sandwich' is a width without a likelihood, for laplace only; use 'ar1' with mcmc")
        if self.options.walkers is not None:
            whole("walkers", self.options.walkers, 2 * len(self.space) + 2)

    def start(self, trajectories: Trajectories) -> MCMCState:
        """Fit ``laplace``, which places the walkers and supplies the starts' Jacobian."""
        tuning, windows = self.options.tuning, self.bound(trajectories)
        search = Laplace(
            self.simulator,
            prior=self.prior,
            budget=max(1, int(tuning.search_share * self.budget)),
            seed=self.seed,
            likelihood=self.likelihood,
            restarts=self.options.restarts,
            candidates=self.options.candidates,
        )
        try:
            normals = search.fit(trajectories)
        except BudgetTooSmall:
            raise BudgetExhausted(
                f"{self.budget} rollouts did not suffice for the laplace fit that comes first"
            ) from None
        windows.rollouts += search.rollouts
        assert search.snapshot is not None
        assert isinstance(normals, GaussianMixture)
        # what was noticed on the way holds; what its posterior says of itself does not hold of the chains
        self.findings.extend(search.snapshot.findings)
        assert search.best is not None
        for one in search.findings.of(Code.SEARCH_UNSETTLED) if isinstance(self.likelihood, StateSpace) else ():
            self.findings.add(one)  # the chains hold that noise
        fit = target_fit(windows, search.best)
        if search.snapshot.state.draws is not None:  # kernels, which are slow to draw from
            mean, covariance = normals.gaussian_moments()
            normals = GaussianMixture([0.0], mean[None], covariance[None], self.space)
        spread = tuning.wider**2 * normals.covariances.numpy()
        proposal = Proposal(normals.log_weights.numpy(), normals.means.numpy(), spread)
        random = np.random.RandomState(self.seed)
        count = self.options.walkers or max(tuning.least_walkers, 2 * len(self.space) + 2)
        target = target_of(self.prior, windows, fit)
        walkers, log_prob = self._place(target, proposal, count, random)
        best = fit.optimum.theta
        return MCMCState(
            fit,
            proposal,
            walkers,
            log_prob,
            best,
            best_log_prob=float(target(best[None])[0]),
            linearisation_error=self._linearisation_error(windows, target, walkers),
            chain=np.empty((0, *walkers.shape)),
            chain_log_prob=np.empty((0, count)),
            accepted=np.zeros(count),
            random=RandomState.of(random),
        )

    def _place(
        self, target: Target, proposal: Proposal, count: int, random: np.random.RandomState
    ) -> tuple[FloatArray, FloatArray]:
        """Walkers (count, N) drawn from the proposal, each where the target is finite, and its values there."""
        draws = IndependentMove(proposal, self.space)
        walkers = draws.sample(count, random)
        log_prob = target(walkers)
        for _ in range(self.options.tuning.placings):
            lost = np.flatnonzero(~np.isfinite(log_prob))
            if not len(lost):
                return walkers, log_prob
            walkers[lost] = draws.sample(len(lost), random)
            log_prob[lost] = target(walkers[lost])
        raise ValueError(
            f"mcmc: {len(lost)} of {count} walkers found no valid place around the laplace fit; "
            "the simulation diverges there: narrow the bounds or shorten the model's timestep"
        )

    def describe(self, state: MCMCState) -> str:
        """Steps until now."""
        return f"mcmc: step {len(state.chain)}"

    def step(self, state: MCMCState, trajectories: Trajectories) -> MCMCState:
        """A block of steps of the whole ensemble."""
        import emcee

        windows = self.bound(trajectories)
        walkers, dimensions = state.walkers.shape
        target = target_of(self.prior, windows, state.fit)
        room = (self.budget - windows.rollouts) // (target.value_cost * walkers * len(trajectories))
        steps = min(self.options.tuning.block, room)
        if steps < 1:
            raise BudgetExhausted("the next step of the chain does not fit")
        moves = self.moves(state)
        sampler = emcee.EnsembleSampler(walkers, dimensions, target, vectorize=True, moves=moves)
        sampler.log_prob_fn = target  # bare: emcee's wrapper prints the walkers when it is interrupted
        begin = emcee.State(state.walkers, log_prob=state.log_prob, random_state=state.random.plain())
        end = sampler.run_mcmc(begin, steps, skip_initial_state_check=True, progress=False)
        random = np.random.RandomState()
        random.set_state(end.random_state)
        chain, log_prob = sampler.get_chain(), sampler.get_log_prob()
        top = np.unravel_index(log_prob.argmax(), log_prob.shape)
        state = replace(
            state,
            walkers=end.coords,
            log_prob=end.log_prob,
            best=chain[top] if log_prob[top] > state.best_log_prob else state.best,
            best_log_prob=float(max(log_prob[top], state.best_log_prob)),
            chain=np.concatenate([state.chain, chain]),
            chain_log_prob=np.concatenate([state.chain_log_prob, log_prob]),
            accepted=state.accepted + sampler.backend.accepted,
            random=RandomState.of(random),
        )
        mixing = self._mixing(state)
        enough = mixing["ess"] >= self.options.effective and mixing["rhat"] <= self.options.mixed
        return replace(state, done=bool(enough))

    def moves(self, state: MCMCState) -> list[tuple[emcee.moves.Move, float]]:
        """What emcee proposes, and the shares of these moves."""
        import emcee

        from sipe_bayes.posterior.snooker import SnookerMove

        independent = emcee.moves.MHMove(IndependentMove(state.proposal, self.space))
        kinds = (independent, emcee.moves.DEMove(), SnookerMove())
        return list(zip(kinds, self.options.tuning.moves, strict=True))

    def _mixing(self, state: MCMCState) -> dict[str, float]:
        """Worst R-hat over the parameters, effective draws and acceptance of the chain after warm-up."""
        kept = self._kept(state)
        if len(kept) < 2 * self.options.tuning.block:
            return {"rhat": np.inf, "ess": 0.0, "acceptance": 0.0, "steps": len(state.chain)}
        acceptance = float(state.accepted.sum()) / (len(state.chain) * kept.shape[1])
        return {**mixing_of(kept), "acceptance": acceptance, "steps": len(state.chain)}

    def _kept(self, state: MCMCState) -> FloatArray:
        """The chain after warm-up (steps, W, N)."""
        return state.chain[int(self.options.tuning.warm_up * len(state.chain)) :]

    def posterior(self, state: MCMCState, trajectories: Trajectories) -> Particles:
        """The chain after warm-up, thinned.

        Raises:
            BudgetTooSmall: where there is no step yet.
        """
        if not len(state.chain):
            raise BudgetTooSmall(f"budget: {self.budget} rollouts were not enough for one block of steps; raise it")
        chain, tuning = self._kept(state), self.options.tuning
        thin = max(1, int(np.ceil(chain.shape[0] * chain.shape[1] / tuning.most_draws)))
        theta = np.swapaxes(chain[::-thin][::-1], 0, 1)
        log_prob = state.chain_log_prob[-len(chain) :][::-thin][::-1].T
        rates = np.repeat(state.accepted / len(state.chain), theta.shape[1])
        stats = {"lp": log_prob.ravel(), "acceptance_rate": rates}
        mixing, error = self._mixing(state), state.linearisation_error
        self.diagnostics = {"mixing": {**mixing, "linearisation_error": error}, **noise_diagnostics(state.fit.optimum)}
        if not (mixing["rhat"] <= THRESHOLDS.mixed and mixing["ess"] >= self.options.effective / 2):
            rhat, ess, remedy = mixing["rhat"], mixing["ess"], "raise the budget"
            self.find(Code.NOT_MIXED, what="chains", rhat=rhat, ess=ess, unit=" draws", remedy=remedy)
        if error > tuning.nonlinear:
            segments = isinstance(self.likelihood, Segments)
            self.find(Code.NONLINEAR_STARTS if segments else Code.NONLINEAR_STATES, error=error)
        flat = np.clip(theta.reshape(-1, len(self.space)), 0, 1)
        return Particles(flat, self.space, chains=len(theta), best=np.clip(state.best, 0, 1), sample_stats=stats)

    def _linearisation_error(
        self, windows: BoundLikelihood | BoundStates, target: Target, walkers: FloatArray
    ) -> float:
        """Sd, over walkers, of the difference that a fresh Jacobian of the starts makes to the target (nats)."""
        tuning = self.options.tuning
        if not windows.num_start:
            return 0.0
        cost = len(windows.trajectories) * target.check_cost
        count = min(tuning.checked, int(tuning.check_share * self.budget) // cost)
        if count < tuning.fewest_checked or windows.rollouts + count * cost > self.budget:
            return float("nan")
        points = walkers[np.linspace(0, len(walkers) - 1, count).astype(int)]
        return float(np.std([float(target(p[None])[0]) - target.refreshed(p) for p in points]))


class IndependentMove:
    """Independent draws of theta, and the log density ratio that Metropolis-Hastings needs, as emcee asks for it."""

    def __init__(self, proposal: Proposal, space: ParameterSpace) -> None:
        self.theta = GaussianMixture(proposal.weights, proposal.means, proposal.covariances, space)

    def sample(self, count: int, random: np.random.RandomState) -> FloatArray:
        """Draws (count, N)."""
        return self.theta.sample((count,), generator=torch_generator_from(random)).numpy()

    def log_density(self, points: FloatArray) -> FloatArray:
        """Of points (B, N) the log density (B,), up to a constant."""
        return self.theta.log_prob(torch.from_numpy(np.clip(points, 0, 1))).numpy()

    def __call__(self, coords: FloatArray, random: np.random.RandomState) -> tuple[FloatArray, FloatArray]:
        """Proposals (W, N) for walkers (W, N), and the log ratio of densities (W,)."""
        proposed = self.sample(len(coords), random)
        return proposed, self.log_density(coords) - self.log_density(proposed)
