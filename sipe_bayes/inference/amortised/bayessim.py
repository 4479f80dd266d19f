"""BayesSim: a mixture density network from statistics of the trajectory to a Gaussian mixture over theta.

F. Ramos, R. Possas, D. Fox 2019, "BayesSim: adaptive domain randomization via probabilistic inference for robotics simulators"
(https://arxiv.org/abs/1906.01728). Simulations of prior draws train q(theta | x) by maximum likelihood; x are the trajectory's
statistics (products of state differences with actions, mean and variance of the differences). With draws from a proposal
p~ instead of the prior p, the answer is q p / p~.

- ``features``: "mlp" (two layers of 24 tanh units) or "random_fourier" (quasi-Monte Carlo, Matern-5/2), then a linear layer.
- ``summary``: "statistics", or "learned": a network on each control step, averaged, trained with the mixture.
- ``rounds`` > 1 draws later rounds where the answer so far has its mass: truncated proposals, for which the correction
  p / p~ is one (``inference.rounds``), instead of dividing mixtures, which need not leave a density.

Deviations: the mixture is restricted to the cube, with its true normaliser; statistics are averages over control steps, so that
length does not matter; early stopping on held-out simulations; standardised inputs.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Any, ClassVar, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from sipe_bayes.core.checkpoint import State
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.core.validation import whole
from sipe_bayes.inference.amortised.rounds import Rounds
from sipe_bayes.inference.amortised.simulations import Simulations
from sipe_bayes.models.mixture_density import Features, MixtureDensity
from sipe_bayes.models.training import Training, check_device, restore, train, weights
from sipe_bayes.models.transitions import StepEmbedding, control_steps
from sipe_bayes.posterior import GaussianMixture

_HIDDEN: dict[str, int] = {"mlp": 24, "random_fourier": 500}  # where none is given


class BayesSim(Rounds):
    """A GaussianMixture; see the module's docstring.

    components: of the mixture. hidden: units of each of the network's two layers, default 24, or of its random features, default
    500. summary_features, summary_hidden: of ``summary="learned"``: numbers it makes of a log, units of its layers. training: of
    the network, ``models.training.Training``. device: where it is trained.
    """

    name: ClassVar[str] = "bayessim"

    def __init__(
        self,
        simulator: Any,
        *,
        components: int = 5,
        features: Features = "mlp",
        summary: str = "statistics",
        hidden: int | None = None,
        summary_features: int = 32,
        summary_hidden: int = 64,
        training: Training | None = None,
        device: str = "cpu",
        **settings: Any,
    ) -> None:
        super().__init__(simulator, **settings)
        for name, value, known in (
            ("features", features, get_args(Features)),
            ("summary", summary, ("statistics", "learned")),
        ):
            if value not in known:
                raise ValueError(f"{name}: expected one of {', '.join(known)}, got {value!r}")
        if training is not None and not isinstance(training, Training):
            raise ValueError(f"training: expected models.training.Training(...), got a {type(training).__name__}")
        self.components, self.features, self.summary = whole("components", components), features, summary
        self.hidden = whole("hidden", _HIDDEN[features] if hidden is None else hidden, 2)
        self.summary_features = whole("summary_features", summary_features)
        self.summary_hidden = whole("summary_hidden", summary_hidden)
        self.training, self.device = training or Training(), check_device(device)

    def settings(self) -> dict[str, Any]:
        own = ("components", "features", "summary", "hidden", "summary_features", "summary_hidden", "device")
        return {**super().settings(), **{name: getattr(self, name) for name in own}, "training": asdict(self.training)}

    def train(self, simulations: Simulations, trajectories: Trajectories) -> State:
        torch_seed = int(np.random.SeedSequence([self.seed, 2]).generate_state(1)[0])
        inputs = torch.from_numpy(self._inputs(simulations.observations, trajectories)).to(self.device)
        theta = torch.tensor(simulations.theta, dtype=torch.float32, device=self.device)
        with torch.random.fork_rng():
            torch.manual_seed(torch_seed)
            network = self._network(trajectories).to(self.device)
        network.fit_inputs(inputs, theta)
        trained = train(
            network,
            lambda rows: -network.log_prob(inputs[rows], theta[rows]),
            len(theta),
            self.training,
            torch.Generator().manual_seed(torch_seed),
        )
        self.still_improving(trained.converged, trained.epochs, "epochs", "training.epochs")
        return {
            **weights(network),
            "held_out_loss": trained.held_out_loss,
            "epochs": trained.epochs,
            "converged": trained.converged,
        }

    def infer(self, state: State, trajectories: Trajectories) -> GaussianMixture:
        network = self._network(trajectories)
        restore(network, state)
        inputs = torch.from_numpy(self._inputs(trajectories.observations[None], trajectories))
        if not inputs.isfinite().any():
            raise ValueError("trajectories: no control step has all channels measured at both ends; resample the log")
        self.diagnostics.update({name: state[name] for name in ("held_out_loss", "epochs", "converged")})
        log_weights, means, covariances = network.mixture(inputs)
        return GaussianMixture(log_weights, means, covariances, self.space)

    def _inputs(self, observations: NDArray[np.floating], trajectories: Trajectories) -> NDArray[np.float32]:
        """What the network reads of n simulations: statistics (n, I) or control steps (n, M, F)."""
        if self.summary == "learned":
            seen = np.where(np.isfinite(trajectories.observations), observations, np.nan)
            return control_steps(seen, trajectories.actions, trajectories.length)
        return self.statistics(observations, trajectories).astype(np.float32)

    def _network(self, trajectories: Trajectories) -> _Summarised:
        environment = self.simulator.environment
        o, a = len(environment.channels), environment.num_actions
        embedding, size = None, o * a + 2 * o
        if self.summary == "learned":
            embedding, size = (
                StepEmbedding(2 * o + a, self.summary_features, self.summary_hidden),
                self.summary_features,
            )
        density = MixtureDensity(size, len(self.space), self.components, self.features, self.hidden, self.seed)
        return _Summarised(embedding, density)


class _Summarised(nn.Module):
    """An embedding, or none, before a MixtureDensity."""

    def __init__(self, embedding: StepEmbedding | None, density: MixtureDensity) -> None:
        super().__init__()
        self.embedding, self.density = embedding, density

    @torch.no_grad()
    def fit_inputs(self, inputs: Tensor, theta: Tensor) -> None:
        if self.embedding is not None:
            self.embedding.standardise.fit(inputs)
            inputs = self.embedding(inputs)
        self.density.fit_inputs(inputs, theta)

    def summary(self, inputs: Tensor) -> Tensor:
        return inputs if self.embedding is None else self.embedding(inputs)

    def log_prob(self, inputs: Tensor, theta: Tensor) -> Tensor:
        return self.density.log_prob(self.summary(inputs), theta)

    def mixture(self, inputs: Tensor) -> tuple[NDArray[np.float64], ...]:
        with torch.no_grad():
            return self.density.mixture(self.summary(inputs)[0])
