"""A network that tells recorded control steps from simulated ones, with its training state as flat arrays.

I. Goodfellow et al. 2014, "Generative Adversarial Networks", https://arxiv.org/abs/1406.2661: with D the probability
that x is recorded, binary cross-entropy

    -E_recorded log D(x) - E_simulated log(1 - D(x))

is least at D = p_recorded / (p_recorded + p_simulated), which is 1/2 where the two cannot be told apart.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import logsigmoid
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from sipe_bayes.core.arrays import Float32Array
from sipe_bayes.models.transitions import Standardise


class Discriminator(nn.Module):
    """Logit of "recorded": two layers of tanh units on standardised features.

    Args:
        features: F.
        seed: of the first weights.
        hidden: units of each layer.
    """

    def __init__(self, features: int, seed: int = 0, hidden: int = 128) -> None:
        super().__init__()
        self.standardise = Standardise(features)
        self.layers = nn.Sequential(
            nn.Linear(features, hidden), nn.Tanh(), nn.Linear(hidden, hidden), nn.Tanh(), nn.Linear(hidden, 1)
        )
        generator = torch.Generator().manual_seed(seed)
        for layer in self.layers:
            if isinstance(layer, nn.Linear):
                nn.init.xavier_uniform_(layer.weight, generator=generator)
                nn.init.zeros_(layer.bias)

    def forward(self, x: Tensor) -> Tensor:
        """Logits (...,) of features (..., F)."""
        out: Tensor = self.layers(self.standardise(x))[..., 0]
        return out


@dataclass(frozen=True)
class TrainingState:
    """What training goes on from, exactly.

    Args:
        weights: of the network (P,).
        first_moment: Adam's running mean of the gradient (P,).
        second_moment: Adam's running mean of its square (P,).
        steps: steps taken.
        mean: of the features (F,), which standardises them.
        sd: of the features (F,).
    """

    weights: Float32Array
    first_moment: Float32Array
    second_moment: Float32Array
    steps: int
    mean: Float32Array
    sd: Float32Array


class Training:
    """A discriminator with Adam.

    Args:
        network: the discriminator.
        learning_rate: of Adam.
    """

    def __init__(self, network: Discriminator, learning_rate: float) -> None:
        self.network = network
        self.optimiser = torch.optim.Adam(network.layers.parameters(), lr=learning_rate)
        self.steps = 0

    def step(self, recorded: Tensor, simulated: Tensor) -> float:
        """One step on a batch of each (n, F); the loss before it."""
        loss = -logsigmoid(self.network(recorded)).mean() / 2 - logsigmoid(-self.network(simulated)).mean() / 2
        self.optimiser.zero_grad()
        loss.backward()
        self.optimiser.step()
        self.steps += 1
        return float(loss.detach())

    def state(self) -> TrainingState:
        """What ``load`` goes on from."""
        parameters = list(self.network.layers.parameters())
        moments = [self.optimiser.state.get(p, {}) for p in parameters]
        first, second = (
            torch.cat([m.get(name, torch.zeros_like(p)).flatten() for m, p in zip(moments, parameters, strict=True)])
            for name in ("exp_avg", "exp_avg_sq")
        )
        standardise = self.network.standardise
        flat = (parameters_to_vector(parameters).detach(), first, second)
        weights, first_moment, second_moment, mean, sd = (
            x.numpy().copy() for x in (*flat, standardise.mean, standardise.sd)
        )
        return TrainingState(weights, first_moment, second_moment, self.steps, mean, sd)

    def load(self, state: TrainingState) -> None:
        """Go on from what ``state`` returned; raises ValueError for that of a discriminator of another size."""
        parameters = list(self.network.layers.parameters())
        sizes, features = [p.numel() for p in parameters], self.network.standardise.mean.shape
        weights, *moments = (
            _of_shape(values, (sum(sizes),)) for values in (state.weights, state.first_moment, state.second_moment)
        )
        mean, sd = _of_shape(state.mean, tuple(features)), _of_shape(state.sd, tuple(features), still=True)
        if not 0 <= state.steps < 2**63:
            raise ValueError("the checkpoint's discriminator claims impossibly many steps; delete it to start again")
        vector_to_parameters(weights, parameters)
        first, second = (moment.split(sizes) for moment in moments)
        self.steps = state.steps
        for p, a, b in zip(parameters, first, second, strict=True):
            self.optimiser.state[p] = {
                "step": torch.tensor(float(self.steps)),
                "exp_avg": a.view_as(p).clone(),
                "exp_avg_sq": b.view_as(p).clone(),
            }
        self.network.standardise.mean.copy_(mean)
        self.network.standardise.sd.copy_(sd)


def _of_shape(values: Float32Array, shape: tuple[int, ...], still: bool = False) -> Tensor:
    """As a tensor; ``still`` allows the infinite sd of features that do not change."""
    sound = ~np.isnan(values) if still else np.isfinite(values)
    if values.shape != shape or values.dtype != np.float32 or not sound.all():
        raise ValueError(
            f"the checkpoint's discriminator has {values.dtype} {values.shape}, expected float32 {shape} of finite "
            "numbers; it is of other options or damaged: delete the checkpoint to start again"
        )
    return torch.tensor(values)
