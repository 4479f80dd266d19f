"""Seeds: one way from a sequence of whole numbers to a generator of NumPy or of torch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from torch import Generator


def seed_integer(entropy: Sequence[int]) -> int:
    """One whole number of 32 bits for a sequence of them; another sequence gives another."""
    return int(np.random.SeedSequence(list(entropy)).generate_state(1)[0])


def torch_generator_from(random: np.random.Generator | np.random.RandomState) -> Generator:
    """A generator of torch's own, seeded with the next number of one of NumPy's; of RandomState, which emcee wants."""
    import torch

    seed = random.randint(2**31) if isinstance(random, np.random.RandomState) else random.integers(2**62)
    return torch.Generator().manual_seed(int(seed))


def torch_generator(entropy: Sequence[int]) -> Generator:
    """A generator of torch's own, seeded with ``seed_integer``."""
    import torch

    return torch.Generator().manual_seed(seed_integer(entropy))
