"""The package sbi without its side effects, for ``npe`` and ``abc``.

Importing sbi switches off torch.distributions' argument validation for the whole process, and some of its functions
seed every global random generator.
"""

from __future__ import annotations

import importlib
import random
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType

import numpy as np
import torch
from torch.distributions import Distribution


def import_sbi(module: str) -> ModuleType:
    """The module ``sbi.<module>``; argument validation stays as it was before."""
    before = Distribution._validate_args
    try:
        return importlib.import_module(f"sbi.{module}")
    finally:
        Distribution.set_default_validate_args(before)


@contextmanager
def seeded(seed: int) -> Iterator[None]:
    """torch's, numpy's and Python's global generators seeded within, and as they were afterwards."""
    legacy, plain = np.random.get_state(), random.getstate()  # noqa: NPY002
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        np.random.seed(seed % 2**32)  # noqa: NPY002
        random.seed(seed)
        try:
            yield
        finally:
            np.random.set_state(legacy)  # noqa: NPY002
            random.setstate(plain)


class NoTracker:
    """Keeps sbi from writing TensorBoard logs into the working directory."""

    log_dir = None

    def _nothing(self, *args: object, **kwargs: object) -> None:
        """Whatever it is told."""

    log_metric = log_metrics = log_params = add_figure = flush = _nothing
