"""BayesSim: a mixture density network from statistics of the trajectory to a Gaussian mixture over theta.

F. Ramos, R. Possas, D. Fox 2019, "BayesSim: adaptive domain randomization via probabilistic inference for robotics
simulators" (https://arxiv.org/abs/1906.01728). Simulations of prior draws train q(theta | x) by maximum likelihood; x
are the trajectory's statistics (products of state differences with actions, mean and variance of the differences). With
draws from a proposal p~ instead of the prior p, the answer is q p / p~.

- ``features``: "mlp" (two layers of 24 tanh units) or "random_fourier" (quasi-Monte Carlo, Matern-5/2), then a linear
  layer.
- ``summary``: "statistics"; "learned": a network on each control step, averaged, trained with the mixture; or
  "regressed": what a regression on the simulations makes of the log (``models.regressed``); or "robust", the same, of
  which the log's is that of the nearest simulations (``models.minimum_distance``).
- ``rounds`` > 1 draws later rounds where the answer so far has its mass: truncated proposals, for which the correction
  p / p~ is one (``inference.amortised.rounds``), instead of dividing mixtures, which need not leave a density.

Deviations:

- The mixture is restricted to the cube, with its true normaliser.
- Statistics are averages over control steps, so that length does not matter.
- Early stopping on held-out simulations; standardised inputs.
- The mixture is of theta less a regression's summaries, which is most of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, from_numpy, nn

from sipe_bayes.core.arrays import Float32Array, FloatArray
from sipe_bayes.core.options import Options, option
from sipe_bayes.core.seeding import seed_integer
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.inference.amortised.rounds import Rounds, RoundsOptions, RoundsState
from sipe_bayes.inference.amortised.summaries import REGRESSED
from sipe_bayes.models.mixture_density import Features, MixtureDensity
from sipe_bayes.models.training import TrainedNetwork, Training, check_device, restore, train
from sipe_bayes.models.transitions import StepEmbedding, control_steps
from sipe_bayes.posterior import GaussianMixture


@dataclass(frozen=True)
class BayesSimOptions(RoundsOptions):
    """Options of ``BayesSim``."""

    components: int = option(5, "of the mixture", least=1)
    features: Features = option("mlp", "what a linear layer makes the mixture of", among=get_args(Features))
    summary: str = option(
        "statistics",
        'what the features are of; "regressed": theta as regressed on the simulations; '
        '"robust": the same, of which the log\'s is by minimum distance',
        among=("statistics", "learned", *REGRESSED),
    )
    hidden: int | None = option(
        None, "units of each of the network's two layers, default 24, or random features, default 500", least=2
    )
    summary_features: int = option(32, 'numbers that summary="learned" makes of a log', least=1)
    summary_hidden: int = option(64, "units of each of its layers", least=1)
    training: Training | None = option(None, "of the network, ``models.training.Training(...)``; default its own")
    device: str = option("cpu", "where the network is trained")

    def __post_init__(self) -> None:
        """Check, also what is no number."""
        super().__post_init__()
        check_device(self.device)
        if self.training is not None and not isinstance(self.training, Training):
            raise ValueError(f"training: expected models.training.Training(...), got a {type(self.training).__name__}")

    @property
    def units(self) -> int:
        """``hidden``, or its default."""
        return self.hidden or {"mlp": 24, "random_fourier": 500}[self.features]


class BayesSim(Rounds[TrainedNetwork]):
    """Mixture density network on statistics of the log; amortised, or in rounds. A GaussianMixture."""

    name: ClassVar[str] = "bayessim"
    options_type: ClassVar[type[Options]] = BayesSimOptions
    state_type: ClassVar = RoundsState[TrainedNetwork]
    options: BayesSimOptions

    @property
    def summary(self) -> str:
        """See the base's."""
        return self.options.summary

    def train_network(self, inputs: Float32Array, theta: FloatArray, member: tuple[int, ...]) -> TrainedNetwork:
        """The network, of greatest likelihood of held-out simulations."""
        device, seed = self.options.device, seed_integer([self.seed, 2, *member])
        rows, targets = from_numpy(inputs).to(device), torch.tensor(theta, dtype=torch.float32, device=device)
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            network = self._network().to(device)
        network.fit_inputs(rows, targets)
        trained = train(
            network,
            lambda chosen: -network.log_prob(rows[chosen], targets[chosen]),
            len(theta),
            self.options.training or Training(),
            torch.Generator().manual_seed(seed),
        )
        self.still_improving(trained.converged, trained.passes, "epochs", "training.epochs")
        return trained

    def infer_network(self, trained: TrainedNetwork, inputs: Float32Array) -> GaussianMixture:
        """The mixture that the network makes of the log; raises ValueError where it has no whole control step."""
        network = self._network()
        restore(network, trained.weights)
        if not np.isfinite(inputs).any():
            raise ValueError("trajectories: no control step has all channels measured at both ends; resample the log")
        self.diagnostics |= trained.summary("epochs")
        return GaussianMixture(*network.mixture(from_numpy(inputs)), self.space)

    def inputs(self, observations: NDArray[np.floating], trajectories: Trajectories) -> Float32Array:
        """What the network reads of n simulations: statistics (n, I) or control steps (n, M, F)."""
        if self.options.summary == "learned":
            seen = np.where(np.isfinite(trajectories.observations), observations, np.nan)
            return control_steps(seen, trajectories.actions, trajectories.length)
        return self.statistics(observations, trajectories).astype(np.float32)

    def _network(self) -> _Summarised:
        environment, options = self.simulator.environment, self.options
        o, a = len(environment.channels), environment.num_actions
        embedding, size = None, len(self.space) if self.summary in REGRESSED else o * a + 2 * o
        if options.summary == "learned":
            embedding = StepEmbedding(2 * o + a, options.summary_features, options.summary_hidden)
            size = options.summary_features
        n = len(self.space)
        density = MixtureDensity(size, n, options.components, options.features, options.units, self.seed)
        return _Summarised(embedding, density, self.summary in REGRESSED)


class _Summarised(nn.Module):
    """An embedding, or none, before a MixtureDensity, which may be of theta less the inputs."""

    def __init__(self, embedding: StepEmbedding | None, density: MixtureDensity, less: bool) -> None:
        super().__init__()
        self.embedding, self.density, self.less = embedding, density, less

    @torch.no_grad()
    def fit_inputs(self, inputs: Tensor, theta: Tensor) -> None:
        if self.embedding is not None:
            self.embedding.standardise.fit(inputs)
        self.density.fit_inputs(self._summary(inputs), self._left(inputs, theta))

    def _summary(self, inputs: Tensor) -> Tensor:
        return inputs if self.embedding is None else self.embedding(inputs)

    def _left(self, inputs: Tensor, theta: Tensor) -> Tensor:
        return theta - inputs if self.less else theta

    def log_prob(self, inputs: Tensor, theta: Tensor) -> Tensor:
        return self.density.log_prob(self._summary(inputs), self._left(inputs, theta))

    @torch.no_grad()
    def mixture(self, inputs: Tensor) -> tuple[FloatArray, FloatArray, FloatArray]:
        weights, means, covariances = self.density.mixture(self._summary(inputs)[0])
        return weights, means + inputs[0].double().numpy() if self.less else means, covariances
