"""Sequential rounds of simulation for the estimators whose trained network has a density: NPE and BayesSim.

M. Deistler, P. Goncalves, J. Macke 2022, "Truncated proposals for scalable and hassle-free simulation-based inference"
(https://arxiv.org/abs/2210.04815). Later rounds simulate the prior restricted to where the posterior so far has all but 1e-4 of
its mass. On that region the theta of every round have the prior's density up to a constant, so the proposal correction
p(theta) / p~(theta) is one and the loss stays what it is; the network is then right there only, for the log in hand.

Deviations. From the second round on the network is trained from the beginning on all rounds, as its standardisation changes.
When fewer than one draw of the prior in a thousand falls into the truncated region, proposals come from the posterior's own
draws with weights prior / posterior (their section 4.3): accepted with probability weight / largest weight, which leaves
the prior's density; and where that leaves too few, drawn with replacement, so that theta of large weight come several times, as
a warning says. Draws without replacement would have a density between the prior's and the posterior's, and the network would
count the log twice.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from sipe_bayes.core.checkpoint import State
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.core.validation import share, whole
from sipe_bayes.inference.amortised.prior_sampling import PriorSampling
from sipe_bayes.inference.amortised.simulations import BLOCK, Simulations
from sipe_bayes.inference.base import digest
from sipe_bayes.likelihood.settings import BudgetExhausted
from sipe_bayes.posterior import Posterior

FloatArray = NDArray[np.float64]

_DENSITY_DRAWS = 10_000  # that the truncation's threshold is taken from
_PROPOSALS = 2**17  # draws of the prior tried before resampling the posterior's
_FIELDS = ("theta", "observations", "valid")


class Rounds(PriorSampling):
    """Base of NPE and BayesSim. rounds: more than one conditions on the log in hand and is not amortised. truncated: the share of
    the posterior's mass that lies outside the truncated prior of the next round."""

    def __init__(self, simulator: Any, *, rounds: int = 1, truncated: float = 1e-4, **settings: Any) -> None:
        super().__init__(simulator, **settings)
        self.rounds, self.truncated = whole("rounds", rounds), share("truncated", truncated)
        if self.rounds > 1:
            self.amortised = False  # type: ignore[misc]  # this instance conditions on one log

    def settings(self) -> dict[str, Any]:
        return {**super().settings(), "rounds": self.rounds, "truncated": self.truncated}

    def start(self, trajectories: Trajectories) -> State:
        return self._begun(trajectories, 0)

    def _begun(self, trajectories: Trajectories, before: int) -> State:
        """Nothing simulated for these trajectories yet, ``before`` rollouts spent on others."""
        left = self.budget - before
        if left // len(trajectories) < self.rounds:
            least = self.rounds * len(trajectories)
            raise BudgetExhausted(f"{self.rounds} rounds take {least} rollouts or more, the budget has {left}")
        return {**super().start(trajectories), "round": 1, "before": before}

    def step(self, state: State, trajectories: Trajectories) -> State:
        """A block of simulations, or a training at the end of a round; with other trajectories, the first block of all."""
        if self.rounds == 1:
            return super().step(state, trajectories)
        if state["logs"] != digest(trajectories):
            state = self._begun(trajectories, self.rollouts)
        most = self._affordable(trajectories, state["before"])
        until = most * state["round"] // self.rounds
        if state["simulated"] == until:
            state = {**self._trained(state, trajectories), "trained_on": digest(trajectories)}
            if state["round"] == self.rounds:
                return state
            wanted = most * (state["round"] + 1) // self.rounds - until
            proposed = self._propose(state, wanted, trajectories)
            return {**state, "round": state["round"] + 1, "done": False, "proposed": proposed}
        count = min(BLOCK, until - state["simulated"])
        if state["round"] > 1:
            rng = np.random.default_rng([self.seed, 2, state["simulated"]])
            state = _joined(state, self.simulate(state["proposed"][:count], trajectories, rng))
        else:
            self._simulations(trajectories).first(state["simulated"] + count)
        count += state["simulated"]
        self.rollouts = state["before"] + count * len(trajectories)
        return {**state, "simulated": count}

    def posterior(self, state: State, trajectories: Trajectories) -> Posterior:
        if state.get("trained_on", digest(trajectories)) != digest(trajectories):
            raise ValueError("trajectories: several rounds were trained for other ones; use rounds=1, or fit again")
        return super().posterior(state, trajectories)

    def simulations(self, state: State, trajectories: Trajectories) -> Simulations:
        """Valid simulations of all rounds, with noise."""
        if "round_theta" not in state:
            return super().simulations(state, trajectories)
        later = Simulations(*(state[f"round_{key}"] for key in _FIELDS))
        first = self._simulations(trajectories).first(state["simulated"] - len(later))
        self.judge(_both(first, later))
        return _both(self._usable(first, trajectories), later.usable())

    def _propose(self, state: State, count: int, trajectories: Trajectories) -> FloatArray:
        """``count`` theta of the prior where the posterior has all but 1e-4 of its mass."""
        found = self.infer(state, trajectories)
        seed = np.random.SeedSequence([self.seed, 3, state["round"]]).generate_state(1)[0]
        generator = torch.Generator().manual_seed(int(seed))
        own = found.sample((_DENSITY_DRAWS,), generator=generator)
        threshold = found.log_prob(own).quantile(self.truncated)
        tried = self.prior.sample((_PROPOSALS,), generator=generator)
        inside = tried[found.log_prob(tried) >= threshold]
        self.diagnostics[f"truncated_prior_{state['round'] + 1}"] = len(inside) / _PROPOSALS
        if len(inside) >= count and len(inside) > 1e-3 * _PROPOSALS:
            return inside[:count].numpy()
        own = found.sample((_PROPOSALS,), generator=generator)
        density = found.log_prob(own)
        log_weight = torch.where(density >= threshold, self.prior.log_prob(own) - density, -torch.inf)
        if not torch.isfinite(log_weight).any():
            raise BudgetExhausted(f"the truncated prior of round {state['round'] + 1} is too small to draw theta from")
        weight = (log_weight - log_weight.max()).exp()
        accepted = own[torch.rand(len(own), dtype=torch.float64, generator=generator) < weight]
        if len(accepted) >= count:
            return accepted[:count].numpy()
        chosen = own[torch.multinomial(weight, count, replacement=True, generator=generator)]
        share = len(chosen.unique(dim=0)) / count
        self.warn(
            f"round {state['round'] + 1} looks where the prior hardly goes: {share:.0%} of its theta are different ones; take fewer "
            "rounds, or a larger ``truncated``"
        )
        return chosen.numpy()


def _both(first: Simulations, later: Simulations) -> Simulations:
    return Simulations(*(np.concatenate([getattr(first, name), getattr(later, name)]) for name in _FIELDS))


def _joined(state: State, new: Simulations) -> State:
    """``state`` with simulations of the later rounds appended and their theta taken off what is proposed."""
    made = {f"round_{name}": getattr(new, name) for name in _FIELDS}
    kept = {k: np.concatenate([state[k], v]) if k in state else v for k, v in made.items()}
    return {**state, **kept, "proposed": state["proposed"][len(new) :]}
