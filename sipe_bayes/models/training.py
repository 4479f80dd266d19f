"""Training small networks: seeded, early stopping on held-out rows, weights as flat arrays for an estimator's state."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from sipe_bayes.core.validation import at_least, positive, share, whole

Loss = Callable[[Tensor], Tensor]
"""Losses (b,) of the rows (b,) whose indices are given."""


@dataclass(frozen=True)
class Training:
    """batch rows a step, at most ``epochs`` passes; stops ``patience`` passes after the held-out loss was last better;
    ``held_out`` share of the rows; learning rate of Adam, with weight decay."""

    batch: int = 100
    epochs: int = 500
    patience: int = 20
    held_out: float = 0.1
    learning_rate: float = 1e-3
    weight_decay: float = 0.0

    def __post_init__(self) -> None:
        for name in ("batch", "epochs", "patience"):
            object.__setattr__(self, name, whole(name, getattr(self, name)))
        object.__setattr__(self, "held_out", share("held_out", self.held_out))
        object.__setattr__(self, "learning_rate", positive("learning_rate", self.learning_rate))
        object.__setattr__(self, "weight_decay", at_least("weight_decay", self.weight_decay, 0))


@dataclass(frozen=True)
class Trained:
    """Mean loss of the held-out rows, passes made, optimiser's steps, and whether it stopped by itself."""

    held_out_loss: float
    epochs: int
    steps: int
    converged: bool


class EarlyStopping:
    """Keeps a network's weights where its held-out loss was least. A look counts as better when it is lower by ``absolute`` and by
    a share ``relative``; after ``patience`` looks that are not, it is time to stop."""

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

    def restore(self) -> None:
        """Put the best weights back into the network."""
        self.network.load_state_dict(self._weights)


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


def train(network: nn.Module, loss: Loss, rows: int, settings: Training, generator: torch.Generator) -> Trained:
    """Minimise the mean ``loss`` with Adam and leave the weights of the best held-out pass in ``network``."""
    parameters = [p for p in network.parameters() if p.requires_grad]
    optimiser = torch.optim.Adam(parameters, settings.learning_rate, weight_decay=settings.weight_decay, foreach=True)
    inside, outside = split(rows, settings.held_out, generator)
    stopping, steps = EarlyStopping(network, settings.patience, absolute=1e-4), 0
    for epoch in range(1, settings.epochs + 1):  # noqa: B007 (returned)
        shuffled = inside[torch.randperm(len(inside), generator=generator)]
        for chosen in shuffled.split(settings.batch):
            optimiser.zero_grad(set_to_none=True)
            loss(chosen).mean().backward()
            torch.nn.utils.clip_grad_norm_(parameters, 5.0)
            optimiser.step()
            steps += 1
        with torch.no_grad():
            now = float(torch.cat([loss(part) for part in outside.split(2000)]).mean())
        if stopping.stops(now):
            break
    stopping.restore()
    return Trained(stopping.best, epoch, steps, stopping.waited >= settings.patience)


def _copy(network: nn.Module) -> dict[str, Tensor]:
    return {name: tensor.detach().clone() for name, tensor in network.state_dict().items()}


def weights(network: nn.Module) -> dict[str, NDArray[np.generic]]:
    """The network's weights and buffers as arrays, names prefixed ``weight.``."""
    return {f"weight.{name}": tensor.detach().cpu().numpy().copy() for name, tensor in network.state_dict().items()}


def restore(network: nn.Module, state: dict[str, object]) -> None:
    """Put ``weights`` back."""
    found = {
        k.removeprefix("weight."): torch.from_numpy(v)
        for k, v in state.items()
        if isinstance(v, np.ndarray) and k.startswith("weight.")
    }
    network.load_state_dict(found)
