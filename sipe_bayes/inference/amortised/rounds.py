"""What the estimators whose trained network has a density share, NPE and BayesSim: sequential rounds, and ensembles.

**Rounds.** M. Deistler, P. Goncalves, J. Macke 2022, "Truncated proposals for scalable and hassle-free simulation-based
inference" (https://arxiv.org/abs/2210.04815). Later rounds simulate the prior restricted to where the posterior so far
has all but 1e-4 of its mass. On that region the theta of every round have the prior's density up to a constant, so the
proposal correction p(theta) / p~(theta) is one and the loss stays what it is; the network is then right there only, for
the log in hand: with more than one round every ``fit`` simulates and trains anew.

**Ensembles.** ``members`` > 1 networks differ in their first weights, their batches and what validates them, and answer
with the mixture of their posteriors in equal parts (``posterior.averaged``): where they disagree it is wider. J.
Hermans et al. 2022, "A Trust Crisis In Simulation-Based Inference? Your Posterior Approximations Can Be Unfaithful"
(https://arxiv.org/abs/2110.06581).

Deviations:

- From the second round on the network is trained from the beginning on all rounds, as its standardisation changes.
- When fewer than one draw of the prior in a thousand falls into the truncated region, proposals come from the
  posterior's own draws with weights prior / posterior (their section 4.3): accepted with probability weight / largest
  weight, which leaves the prior's density; and where that leaves too few, drawn with replacement, so that theta of
  large weight come several times, as a warning says. Draws without replacement would have a density between the
  prior's and the posterior's, and the network would count the log twice.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from sipe_bayes.core.arrays import Float32Array, FloatArray
from sipe_bayes.core.budget import BudgetExhausted
from sipe_bayes.core.findings import Code
from sipe_bayes.core.options import option
from sipe_bayes.core.seeding import torch_generator
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.inference.amortised.held_back import HeldBackOptions
from sipe_bayes.inference.amortised.prior_sampling import PriorSampling, PriorSamplingOptions, PriorSamplingState
from sipe_bayes.inference.amortised.simulations import BLOCK, Simulations
from sipe_bayes.inference.amortised.summaries import REGRESSED, Summaries
from sipe_bayes.inference.recorded import digest
from sipe_bayes.likelihood import noise_level
from sipe_bayes.posterior import Averaged, Posterior

_DENSITY_DRAWS = 10_000  # that the truncation's threshold is taken from: 1 / truncated, as it is by default
_PROPOSALS = 2**17  # draws of the prior tried before resampling the posterior's, for time alone

L = TypeVar("L")


@dataclass(frozen=True)
class Members(Generic[L]):
    """What a training leaves.

    Attributes:
        networks: of the ensemble, or the one.
        summaries: how they read a log; None where they read ``inputs``.
    """

    networks: tuple[L, ...]
    summaries: Summaries | None = None


@dataclass(frozen=True)
class RoundsState(PriorSamplingState[Members[L]], Generic[L]):
    """How far a fit in rounds is.

    Attributes:
        round: from 1.
        proposed: theta (n, N) of this round that are to be simulated, None in the first.
        later: simulations of the rounds after the first, None before there are any.
    """

    round: int = 1
    proposed: FloatArray | None = None
    later: Simulations | None = None


@dataclass(frozen=True)
class RoundsOptions(HeldBackOptions, PriorSamplingOptions):
    """Options of methods that work in rounds."""

    rounds: int = option(1, "more than one conditions on the log in hand and is not amortised", least=1)
    truncated: float = option(
        1e-4, "share of the posterior's mass outside the truncated prior of the next round", above=0, below=1
    )
    members: int = option(1, "of an ensemble, each trained on all simulations, whose posteriors are averaged", least=1)

    def held_back(self, count: int) -> float:
        """See ``HeldBackOptions``; none of several rounds unless asked for: the last is the one that matters."""
        return 0.0 if self.calibration is None and self.rounds > 1 else super().held_back(count)


class Rounds(PriorSampling[RoundsState[L], Members[L]], Generic[L]):
    """Base of NPE and BayesSim.

    A subclass writes ``summary``, ``inputs``, ``train_network`` and ``infer_network``; none of them simulates.
    """

    options: RoundsOptions

    @property
    @abstractmethod
    def summary(self) -> str:
        """What networks read: what a regression on the simulations makes (``summaries.REGRESSED``), else ``inputs``."""

    @abstractmethod
    def inputs(self, observations: NDArray[np.floating], trajectories: Trajectories) -> Float32Array:
        """What a network reads of observations (n, R, T+1, O): (n, ...), without the samples that the log lacks."""

    @abstractmethod
    def train_network(self, inputs: Float32Array, theta: FloatArray, member: tuple[int, ...]) -> L:
        """What ``infer_network`` needs of n simulations: a frozen dataclass; ``member`` goes into its seeds."""

    @abstractmethod
    def infer_network(self, trained: L, inputs: Float32Array) -> Posterior:
        """The posterior that one network makes of a log (1, ...)."""

    def train(self, simulations: Simulations, trajectories: Trajectories) -> Members[L]:
        """All members."""
        theta, observations, summaries = simulations.theta, simulations.observations, None
        if self.summary in REGRESSED:
            noise = noise_level(trajectories, self.likelihood, self.simulator)
            statistics = self.statistics(observations, trajectories)
            summaries, estimates = Summaries.of(theta, observations, statistics, trajectories, noise, self.summary)
            inputs = estimates.astype(np.float32)
        else:
            inputs = self.inputs(observations, trajectories)
        members = [(), *((k,) for k in range(1, self.options.members))]
        return Members(tuple(self.train_network(inputs, theta, member) for member in members), summaries)

    def infer(self, learned: Members[L], trajectories: Trajectories) -> Posterior:
        """The members' posteriors in equal parts; that of a single network as it is."""
        observations = trajectories.observations[None]
        if learned.summaries is None:
            inputs = self.inputs(observations, trajectories)
        else:
            statistics = self.statistics(observations, trajectories)
            inputs = learned.summaries(trajectories.observations, statistics).astype(np.float32)
        posteriors = [self.infer_network(network, inputs) for network in learned.networks]
        return posteriors[0] if len(posteriors) == 1 else Averaged(posteriors)

    def prepare(self) -> None:
        """As the base's; in rounds, this instance conditions on one log."""
        super().prepare()
        self.amortised = self.keeps  # type: ignore[misc]  # of the instance

    @property
    def keeps(self) -> bool:
        """Of several rounds nothing is of use for another log."""
        return self.options.rounds == 1

    def start(self, trajectories: Trajectories) -> RoundsState[L]:
        """As the base's; raises BudgetExhausted where the budget does not reach for every round."""
        return self._begun(trajectories, 0)

    def _begun(self, trajectories: Trajectories, before: int) -> RoundsState[L]:
        """Nothing simulated for these trajectories yet, ``before`` rollouts spent on others."""
        left, least = self.budget - before, self.options.rounds * len(trajectories)
        if left < least:
            raise BudgetExhausted(f"{self.options.rounds} rounds take {least} rollouts or more, the budget has {left}")
        return replace(super().start(trajectories), before=before)

    def step(self, state: RoundsState[L], trajectories: Trajectories) -> RoundsState[L]:
        """A block of simulations, or a training at the end of a round; other trajectories begin anew."""
        rounds = self.options.rounds
        if rounds == 1:
            return super().step(state, trajectories)
        if state.log != digest(trajectories):
            state = self._begun(trajectories, self.rollouts)
        most = self._affordable(trajectories, state.before)
        until = most * state.round // rounds
        # the end of a round: train, and propose for the next
        if state.simulated == until:
            state = replace(self._trained(state, trajectories), done=state.round == rounds)
            if state.done:
                return state
            wanted = most * (state.round + 1) // rounds - until
            posterior = self.infer(state.learned.content, trajectories)  # type: ignore[union-attr]  # just trained
            return replace(state, round=state.round + 1, proposed=self._propose(posterior, state.round, wanted))
        # within a round: a block of the prior's simulations, or of what was proposed
        cache = self.prior_simulations(trajectories)
        count = min(max(BLOCK, cache.wave), until - state.simulated)
        if state.proposed is None:
            cache.first(state.simulated + count)
        else:
            rng = np.random.default_rng([self.seed, 2, state.simulated])
            made = self.simulate(state.proposed[:count], trajectories, rng)
            later = made if state.later is None else Simulations.joined((state.later, made))
            state = replace(state, later=later, proposed=state.proposed[count:])
        simulated = state.simulated + count
        self.rollouts = state.before + simulated * len(trajectories)
        return replace(state, simulated=simulated)

    def posterior(self, state: RoundsState[L], trajectories: Trajectories) -> Posterior:
        """As the base's; raises ValueError for trajectories other than those that several rounds were for."""
        if not self.keeps and state.learned is not None and state.learned.log != digest(trajectories):
            raise ValueError("trajectories: several rounds were trained for other ones; use rounds=1, or fit again")
        return super().posterior(state, trajectories)

    def simulations(self, state: RoundsState[L], trajectories: Trajectories) -> Simulations:
        """Valid simulations of all rounds, with noise."""
        if state.later is None:
            return super().simulations(state, trajectories)
        first = self.prior_simulations(trajectories).first(state.simulated - len(state.later))
        self.judge(Simulations.joined((first, state.later)))
        return Simulations.joined((self._usable(first, trajectories), state.later.usable()))

    def _propose(self, posterior: Posterior, number: int, count: int) -> FloatArray:
        """Theta (count, N) of the prior where the posterior after round ``number`` has all but 1e-4 of its mass."""
        generator = torch_generator([self.seed, 3, number])
        own = posterior.sample((_DENSITY_DRAWS,), generator=generator)
        threshold = posterior.log_prob(own).quantile(self.options.truncated)
        # draws of the prior, where at least one in a thousand falls into the region
        tried = self.prior.sample((_PROPOSALS,), generator=generator)
        inside = tried[posterior.log_prob(tried) >= threshold]
        self.diagnostics[f"truncated_prior_{number + 1}"] = len(inside) / _PROPOSALS
        if len(inside) >= count and len(inside) > 1e-3 * _PROPOSALS:
            return inside[:count].numpy()
        # draws of the posterior, accepted with the prior's density
        own = posterior.sample((_PROPOSALS,), generator=generator)
        density = posterior.log_prob(own)
        log_weight = torch.where(density >= threshold, self.prior.log_prob(own) - density, -torch.inf)
        if not torch.isfinite(log_weight).any():
            raise BudgetExhausted(f"the truncated prior of round {number + 1} is too small to draw theta from")
        weight = (log_weight - log_weight.max()).exp()
        accepted = own[torch.rand(len(own), dtype=torch.float64, generator=generator) < weight]
        if len(accepted) >= count:
            return accepted[:count].numpy()
        # too few: with replacement, and a warning
        chosen = own[torch.multinomial(weight, count, replacement=True, generator=generator)]
        different = len(chosen.unique(dim=0)) / count
        self.find(Code.FEW_DIFFERENT_PROPOSALS, number=number + 1, different=different)
        return chosen.numpy()
