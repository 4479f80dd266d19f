"""Training small networks: seeded, early stopping on held-out rows, weights as arrays that a checkpoint takes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.options import Options, option

Loss = Callable[[Tensor], Tensor]
"""Losses (b,) of the rows (b,) whose indices are given."""
Weights = dict[str, FloatArray]
"""A network's weights and buffers by name, each in its own type."""


@dataclass(frozen=True)
class Training(Options):
    """How a network is trained by ``train``."""

    batch: int = option(100, "rows in a step", least=1)
    epochs: int = option(500, "passes over the rows at most", least=1)
    patience: int = option(20, "passes without a better held-out loss that end it", least=1)
    held_out: float = option(0.1, "share of the rows that is not trained on", above=0, below=1)
    learning_rate: float = option(1e-3, "of Adam", above=0)
    weight_decay: float = option(0.0, "of Adam", least=0)


@dataclass(frozen=True)
class TrainedNetwork:
    """What a training leaves.

    Attributes:
        weights: of its best look at the held-out rows.
        held_out_loss: mean loss of these then.
        passes: epochs, or gradient steps, that were made.
        converged: whether it ended by itself, not at its limit on passes.
    """

    weights: Weights
    held_out_loss: float
    passes: int
    converged: bool

    def summary(self, passes: str) -> dict[str, float]:
        """How it went, for an estimator's diagnostics; what ``passes`` were."""
        return {"held_out_loss": self.held_out_loss, passes: self.passes, "converged": self.converged}


class EarlyStopping:
    """Keeps a network's weights where its held-out loss was least.

    Args:
        network: what is trained.
        patience: looks without a better loss, after which it is time to stop.
        absolute: a better loss is lower by this much,
        relative: and by this share.
    """

    def __init__(self, network: nn.Module, patience: int, absolute: float = 0.0, relative: float = 0.0) -> None:
        self.network, self.patience, self.absolute, self.relative = network, patience, absolute, relative
        self.best, self.waited = np.inf, 0
        self._weights = _copy(network)

    def stops(self, loss: float) -> bool:
        """Take note of a held-out loss; whether to stop."""
        if loss < self.best * (1 - self.relative) - self.absolute:
            self.best, self.waited, self._weights = loss, 0, _copy(self.network)
        else:
            self.waited += 1
        return self.waited >= self.patience

    def finish(self, passes: int) -> TrainedNetwork:
        """Put the best weights back into the network, and say how its training went."""
        self.network.load_state_dict(self._weights)
        return TrainedNetwork(weights(self.network), float(self.best), passes, self.waited >= self.patience)


def check_device(device: str) -> str:
    """``device`` if torch can compute on it here; raises ValueError otherwise."""
    try:
        torch.ones(1, device=device).sum().item()  # "meta" holds no numbers
    except (RuntimeError, AssertionError, TypeError):
        raise ValueError(f"device: {device!r} is not available here; use 'cpu'") from None
    return device


def split(rows: int, share: float, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Indices of training and held-out rows; at least one of each."""
    order = torch.randperm(rows, generator=generator)
    held = min(max(1, round(share * rows)), rows - 1)
    return order[held:], order[:held]


def descend(
    optimiser: torch.optim.Optimizer, parameters: list[nn.Parameter], loss: Tensor, longest: float = 5.0
) -> None:
    """One step of the optimiser down the gradient of ``loss``.

    Args:
        optimiser: of the parameters.
        parameters: what is changed.
        loss: a number.
        longest: norm to which a longer gradient is shortened, so that one odd batch undoes nothing.
    """
    optimiser.zero_grad(set_to_none=True)
    loss.backward()
    torch.nn.utils.clip_grad_norm_(parameters, longest)
    optimiser.step()


def train(network: nn.Module, loss: Loss, rows: int, settings: Training, generator: torch.Generator) -> TrainedNetwork:
    """Minimise a mean loss with Adam.

    Args:
        network: left with the weights of the best held-out pass.
        loss: of rows, given their indices.
        rows: how many there are.
        settings: how.
        generator: of what is held out and of the batches.

    Returns:
        How it went; ``passes`` are epochs.
    """
    parameters = [p for p in network.parameters() if p.requires_grad]
    optimiser = torch.optim.Adam(parameters, settings.learning_rate, weight_decay=settings.weight_decay, foreach=True)
    inside, outside = split(rows, settings.held_out, generator)
    stopping = EarlyStopping(network, settings.patience, absolute=1e-4)
    for epoch in range(1, settings.epochs + 1):  # noqa: B007 (returned)
        shuffled = inside[torch.randperm(len(inside), generator=generator)]
        for chosen in shuffled.split(settings.batch):
            descend(optimiser, parameters, loss(chosen).mean())
        with torch.no_grad():
            now = float(torch.cat([loss(part) for part in outside.split(2000)]).mean())  # parts save memory
        if stopping.stops(now):
            break
    return stopping.finish(epoch)


def _copy(network: nn.Module) -> dict[str, Tensor]:
    return {name: tensor.detach().clone() for name, tensor in network.state_dict().items()}


def weights(network: nn.Module) -> Weights:
    """The network's weights and buffers as arrays on the CPU."""
    return {name: tensor.detach().cpu().numpy().copy() for name, tensor in network.state_dict().items()}


def restore(network: nn.Module, stored: Weights) -> None:
    """Put ``weights`` back."""
    network.load_state_dict({name: torch.from_numpy(array) for name, array in stored.items()})
