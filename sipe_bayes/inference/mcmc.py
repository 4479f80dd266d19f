"""Markov chain Monte Carlo over theta, noise and starts integrated out: emcee on the windowed likelihood.

D. Foreman-Mackey et al. 2013, "emcee: The MCMC Hammer", PASP 125 (https://arxiv.org/abs/1202.3665). Moves: an independent
Metropolis-Hastings proposal from the widened ``laplace`` posterior (all walkers in one batch, nearly independent draws
where Laplace is good) mixed with differential evolution (ter Braak & Vrugt 2008), which finds its way where it is not.

The target is that of ``window_target``, whose starts and their Jacobian are those of the ``laplace`` fit that comes first and also places the
walkers; that saves D of D + 1 simulations. How far a fresh Jacobian would move the target is measured on some of the first walkers and reported as
``linearisation_error`` (sd in nats; NaN where it would cost more than a tenth of the budget). With ``StateSpace`` the target is that of
``state_space_target``, with the noise of the ``laplace`` fit.

Deviations: R-hat and the autocorrelation time treat the walkers of one ensemble as chains, as emcee's authors do;
walkers share information, so R-hat is an optimistic diagnostic.
"""

from __future__ import annotations

import warnings
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray

from sipe_bayes.core.checkpoint import State
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.core.validation import whole
from sipe_bayes.inference.base import Estimator
from sipe_bayes.inference.laplace import state_space_target, window_target
from sipe_bayes.inference.laplace.chain_state import process_diagnostics
from sipe_bayes.inference.laplace.estimator import UNSETTLED, Laplace
from sipe_bayes.inference.laplace.optima import distinct_modes
from sipe_bayes.likelihood.settings import BudgetExhausted, BudgetTooSmall
from sipe_bayes.likelihood.state_space.chain import Chain
from sipe_bayes.likelihood.windows import Windows
from sipe_bayes.posterior import GaussianMixture, Particles

FloatArray = NDArray[np.float64]

_BLOCK = 20  # steps of the ensemble between checkpoints
_WARM_UP = 1 / 3  # of the chain is dropped
_MIXED_RHAT = 1.05
_WIDER = 1.2  # of the sds of the independent proposal against laplace's
_DRAWS = 4000  # at most kept
_PLACINGS = 20  # rounds in which walkers look for a valid place
_CHECKED, _CHECKS_SHARE = 16, 0.1  # walkers on which the linearisation is checked; of the budget, at most


class MCMC(Estimator):
    """Particles of an emcee ensemble; see the module's docstring.

    restarts, candidates: of the ``laplace`` fit that comes first. walkers: default twice the dimensions plus two, at least
    24. effective: effective draws at which it stops early,
    once R-hat is small too.
    """

    name: ClassVar[str] = "mcmc"
    searches: ClassVar[bool] = True
    default_budget: ClassVar[int] = 50_000

    def __init__(
        self,
        simulator: Any,
        *,
        walkers: int | None = None,
        effective: int = 400,
        restarts: int = 2,
        candidates: int = 8,
        **settings: Any,
    ) -> None:
        super().__init__(simulator, **settings)
        if self.likelihood.noise == "sandwich":
            raise ValueError("noise: 'sandwich' is a width without a likelihood, for laplace only; use 'ar1' with mcmc")
        self.walkers = None if walkers is None else whole("walkers", walkers, 2 * len(self.space) + 2)
        self.effective = whole("effective", effective)
        self.restarts, self.candidates = whole("restarts", restarts), whole("candidates", candidates, 0)

    def settings(self) -> dict[str, Any]:
        own = ("walkers", "effective", "restarts", "candidates")
        return {**super().settings(), **{name: getattr(self, name) for name in own}}

    def start(self, trajectories: Trajectories) -> State:
        """Fit ``laplace``, with at most four fifths of the budget, which places the walkers and supplies the starts' Jacobian."""
        first = Laplace(
            self.simulator,
            prior=self.prior,
            budget=max(1, 4 * self.budget // 5),
            seed=self.seed,
            likelihood=self.likelihood,
            restarts=self.restarts,
            candidates=self.candidates,
        )
        windows = self.windows(trajectories)
        try:
            found = first.fit(trajectories)
        except BudgetTooSmall:
            raise BudgetExhausted(
                f"{self.budget} rollouts did not suffice for the laplace fit that comes first"
            ) from None
        windows.rollouts += first.rollouts
        assert first.snapshot is not None
        searched = first.snapshot.state
        for sentence in (
            f.text for f in first.snapshot.findings
        ):  # of the search; its posterior's do not hold of the chains
            self.warn(sentence)
        best = distinct_modes(searched)[0]
        mode = {k[5:]: v[best] for k, v in searched.items() if k.startswith("mode_")}
        if not mode.get("settled", True):
            self.doubt(UNSETTLED)  # the chains hold that noise
        at_optimum = (state_space_target if isinstance(windows, Chain) else window_target).at_optimum
        picked, proposal = at_optimum(windows, mode), found
        if "draws_share" in searched:  # kernels, which are slow to draw from
            mean, covariance = found.gaussian_moments()
            proposal = GaussianMixture([0.0], mean[None], covariance[None], self.space)
        random = np.random.RandomState(self.seed)
        state = {
            "done": False,
            **picked,
            "proposal_weights": proposal.log_weights.numpy(),
            "proposal_means": proposal.means.numpy(),
            "proposal_covariances": _WIDER**2 * proposal.covariances.numpy(),
        }
        count = self.walkers or max(24, 2 * len(self.space) + 2)
        walkers, log_prob = self._place(windows, state, count, random)
        return {
            **state,
            "walkers": walkers,
            "log_prob": log_prob,
            "best": state["fit_theta"],
            "best_log_prob": float(self._target(windows, state)(state["fit_theta"][None])[0]),
            "linearisation_error": self._linearisation_error(windows, state, walkers),
            "chain": np.empty((0, *walkers.shape)),
            "chain_log_prob": np.empty((0, count)),
            "accepted": np.zeros(count),
            **_random_state(random),
        }

    def _target(self, windows: Windows | Chain, state: State) -> Any:
        """log p(theta | y) of walkers, of either likelihood."""
        if isinstance(windows, Chain):
            return state_space_target.ChainTarget(self.prior, windows, state)
        return window_target.WindowTarget(self.prior, windows, state)

    def _place(
        self, windows: Windows, state: State, count: int, random: np.random.RandomState
    ) -> tuple[FloatArray, FloatArray]:
        """Walkers (count, N) drawn from the proposal, each where the target is finite, and its values there."""
        proposal, target = _Proposal(self, state), self._target(windows, state)
        walkers = proposal.draw(count, random)
        log_prob = target(walkers)
        for _ in range(_PLACINGS):
            lost = np.flatnonzero(~np.isfinite(log_prob))
            if not len(lost):
                return walkers, log_prob
            walkers[lost] = proposal.draw(len(lost), random)
            log_prob[lost] = target(walkers[lost])
        raise ValueError(
            f"mcmc: {len(lost)} of {count} walkers found no valid place around the laplace fit; "
            "the simulation diverges there: narrow the bounds or shorten the model's timestep"
        )

    def describe(self, state: State) -> str:
        return f"mcmc: step {len(state['chain'])}"

    def step(self, state: State, trajectories: Trajectories) -> State:
        """A block of steps of the whole ensemble."""
        import emcee

        windows = self.windows(trajectories)
        walkers, dimensions = state["walkers"].shape
        steps = min(_BLOCK, (self.budget - windows.rollouts) // (walkers * len(trajectories)))
        if steps < 1:
            raise BudgetExhausted("the next step of the chain does not fit")
        proposal, target = _Proposal(self, state), self._target(windows, state)
        sampler = emcee.EnsembleSampler(
            walkers,
            dimensions,
            target,
            vectorize=True,
            moves=[
                (emcee.moves.MHMove(proposal), 0.6),
                (emcee.moves.DEMove(), 0.3),
                (emcee.moves.DESnookerMove(), 0.1),
            ],
        )
        sampler.log_prob_fn = target  # bare: emcee's wrapper prints the walkers when it is interrupted
        begin = emcee.State(state["walkers"], log_prob=state["log_prob"], random_state=_restore_random(state))
        end = sampler.run_mcmc(begin, steps, skip_initial_state_check=True, progress=False)
        random = np.random.RandomState()
        random.set_state(end.random_state)
        chain, log_prob = sampler.get_chain(), sampler.get_log_prob()
        top = np.unravel_index(log_prob.argmax(), log_prob.shape)
        better = log_prob[top] > state["best_log_prob"]
        state = {
            **state,
            "walkers": end.coords,
            "log_prob": end.log_prob,
            "best": chain[top] if better else state["best"],
            "best_log_prob": float(max(log_prob[top], state["best_log_prob"])),
            "chain": np.concatenate([state["chain"], chain]),
            "chain_log_prob": np.concatenate([state["chain_log_prob"], log_prob]),
            "accepted": state["accepted"] + sampler.backend.accepted,
            **_random_state(random),
        }
        mixing = self._mixing(state)
        enough = mixing["ess"] >= self.effective and mixing["rhat"] <= _MIXED_RHAT
        return {**state, "done": bool(enough)}

    def _mixing(self, state: State) -> dict[str, float]:
        """Worst R-hat over the parameters, effective draws and acceptance of the chain after warm-up."""
        kept = self._kept(state)
        if len(kept) < 2 * _BLOCK:
            return {"rhat": np.inf, "ess": 0.0, "acceptance": 0.0, "steps": len(state["chain"])}
        import arviz
        import emcee

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            rhat = max(float(arviz.rhat(kept[:, :, j].T)) for j in range(kept.shape[2]))
            time = emcee.autocorr.integrated_time(kept, quiet=True, tol=0, has_walkers=True)
        steps, walkers = kept.shape[:2]
        tau = max(1.0, float(np.nanmax(time))) if np.isfinite(time).any() else float(steps)
        return {
            "rhat": rhat,
            "ess": steps * walkers / tau if steps >= 10 * tau else min(steps * walkers / tau, 10.0 * walkers),
            "autocorrelation_steps": tau,
            "acceptance": float(state["accepted"].sum()) / (len(state["chain"]) * walkers),
            "steps": len(state["chain"]),
        }

    def _kept(self, state: State) -> FloatArray:
        """The chain after warm-up (steps, walkers, N)."""
        return state["chain"][int(_WARM_UP * len(state["chain"])) :]

    def posterior(self, state: State, trajectories: Trajectories) -> Particles:
        if not len(state["chain"]):
            raise BudgetTooSmall(f"budget: {self.budget} rollouts were not enough for one block of steps; raise it")
        n = len(self.space)
        chain = self._kept(state)
        thin = max(1, int(np.ceil(chain.shape[0] * chain.shape[1] / _DRAWS)))
        theta = np.swapaxes(chain[::-thin][::-1], 0, 1)
        log_prob = state["chain_log_prob"][-len(chain) :][::-thin][::-1].T
        rates = np.repeat(state["accepted"] / len(state["chain"]), theta.shape[1])
        stats = {"lp": log_prob.ravel(), "acceptance_rate": rates}
        mixing = self._mixing(state)
        mixing["linearisation_error"] = state["linearisation_error"]
        self.diagnostics = {"mixing": mixing, **_noise_of(state)}
        if not (mixing["rhat"] <= _MIXED_RHAT and mixing["ess"] >= self.effective / 2):
            self.doubt(
                f"the chains have not mixed (R-hat {mixing['rhat']:.3f}, {mixing['ess']:.0f} effective draws): "
                "raise the budget before you trust the intervals"
            )
        if mixing["linearisation_error"] > 0.5:
            what, remedy = "windows' starts", "use shorter windows"
            if isinstance(self.windows(trajectories), Chain):
                what, remedy = "states", "hold the intervals against those of laplace"
            self.warn(f"the {what} are strongly nonlinear (error {mixing['linearisation_error']:.2f} nats): {remedy}")
        flat = np.clip(theta.reshape(-1, n), 0, 1)
        return Particles(flat, self.space, chains=len(theta), best=np.clip(state["best"], 0, 1), sample_stats=stats)

    def _linearisation_error(self, windows: Windows, state: State, walkers: FloatArray) -> float:
        """Sd, over walkers, of the difference that a fresh Jacobian of the starts makes to the target (nats)."""
        if not windows.num_start:
            return 0.0
        target = self._target(windows, state)
        cost = len(windows.trajectories) * target.check_cost
        count = min(_CHECKED, int(_CHECKS_SHARE * self.budget) // cost)
        if count < 4 or windows.rollouts + count * cost > self.budget:
            return float("nan")
        points = walkers[np.linspace(0, len(walkers) - 1, count).astype(int)]
        return float(np.std([float(target(p[None])[0]) - target.refreshed(p) for p in points]))


def _noise_of(state: State) -> dict[str, Any]:
    """The noise of the laplace fit."""
    found = {"noise_sd": state["fit_sd"].tolist(), "noise_tau": state["fit_tau"].tolist()}
    if "fit_process" not in state:
        return found
    return found | process_diagnostics(*(state[f"fit_{name}"] for name in ("process", "movement", "loose")))


class _Proposal:
    """Independent draws of theta, and the log density ratio that Metropolis-Hastings needs."""

    def __init__(self, owner: MCMC, state: State) -> None:
        self.theta = GaussianMixture(
            state["proposal_weights"], state["proposal_means"], state["proposal_covariances"], owner.space
        )

    def draw(self, count: int, random: np.random.RandomState) -> FloatArray:
        """(count, N)."""
        generator = torch.Generator().manual_seed(int(random.randint(2**31)))
        return self.theta.sample((count,), generator=generator).numpy()

    def log_density(self, points: FloatArray) -> FloatArray:
        """(count,), up to a constant."""
        return self.theta.log_prob(torch.from_numpy(np.clip(points, 0, 1))).numpy()

    def __call__(self, coords: FloatArray, random: np.random.RandomState) -> tuple[FloatArray, FloatArray]:
        proposed = self.draw(len(coords), random)
        return proposed, self.log_density(coords) - self.log_density(proposed)


def _random_state(random: np.random.RandomState) -> State:
    kind, keys, position, has_gauss, cached = random.get_state(legacy=True)
    return {
        "random_kind": str(kind),
        "random_keys": np.asarray(keys),
        "random_position": int(position),
        "random_has_gauss": int(has_gauss),
        "random_cached": float(cached),
    }


def _restore_random(state: State) -> tuple[Any, ...]:
    names = ("kind", "keys", "position", "has_gauss", "cached")
    return tuple(state[f"random_{n}"] for n in names)
