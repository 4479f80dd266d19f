"""The list of posterior families, and reading a saved posterior back.

A new family is its own file plus its class in FAMILIES.
"""

from __future__ import annotations

import os
from typing import Any

import torch
from torch import Generator, Tensor

from sipe_bayes.core.files import reading
from sipe_bayes.core.parameters import ParameterSpace
from sipe_bayes.posterior.averaged import Averaged
from sipe_bayes.posterior.base import Posterior
from sipe_bayes.posterior.dirac import Dirac
from sipe_bayes.posterior.flow import Flow
from sipe_bayes.posterior.independent import IndependentPrior
from sipe_bayes.posterior.mixture import GaussianMixture
from sipe_bayes.posterior.particles import Particles
from sipe_bayes.posterior.quantile_mapped import QuantileMapped
from sipe_bayes.posterior.storage import SAVE_AGAIN, read_pair
from sipe_bayes.posterior.surrogate import SurrogatePosterior

FAMILIES: dict[str, type[Posterior]] = {
    family.__name__: family
    for family in (
        *(Dirac, Particles, GaussianMixture, IndependentPrior, SurrogatePosterior),
        *(Flow, Averaged, QuantileMapped),
    )
}


def load_posterior(path: str | os.PathLike[str]) -> Posterior:
    """The posterior that ``Posterior.save(path)`` wrote; ``path`` with or without a suffix.

    Raises FileNotFoundError when one of the two files is missing and ValueError when they cannot be read.
    """
    header, tensors = read_pair(path)
    with reading(path, "a posterior", SAVE_AGAIN):
        space = ParameterSpace.from_dict(header["space"])
        posterior = _restored(header["family"], space, tensors, header["settings"])
        _try(posterior)
        return posterior


def _try(posterior: Posterior) -> None:
    """A draw, and its density: numbers of a file that no method can use are told here, and not where they are used."""
    with torch.no_grad():
        draws = posterior.sample((1,), generator=Generator().manual_seed(0))
        if posterior.has_density:
            posterior.log_prob(draws)


def _restored(family: str, space: ParameterSpace, tensors: dict[str, Tensor], settings: dict[str, Any]) -> Posterior:
    """The posterior of a family's name, after the posteriors that its settings hold."""
    if family not in FAMILIES:
        raise ValueError(f"posterior family: expected one of {sorted(FAMILIES)}, got {family!r}")
    inner = {
        name: _restored(
            part["family"],
            space,
            {key.removeprefix(f"{name}."): tensor for key, tensor in tensors.items() if key.startswith(f"{name}.")},
            part["settings"],
        )
        for name, part in settings.items()
        if isinstance(part, dict) and "family" in part
    }
    return FAMILIES[family]._restore(space, tensors, settings | inner)
