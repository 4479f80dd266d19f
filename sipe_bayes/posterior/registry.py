"""The list of posterior families, and reading a saved posterior back.

A new family is its own file plus one line in FAMILIES: class name -> the module that defines it, imported
only when it is asked for.
"""

from __future__ import annotations

import importlib
import os

from sipe_bayes.core.parameters import ParameterSpace
from sipe_bayes.posterior.base import Posterior
from sipe_bayes.posterior.storage import read_pair

FAMILIES: dict[str, str] = {
    "Dirac": "sipe_bayes.posterior.dirac",
    "Particles": "sipe_bayes.posterior.particles",
    "GaussianMixture": "sipe_bayes.posterior.mixture",
    "IndependentPrior": "sipe_bayes.posterior.independent",
    "SurrogatePosterior": "sipe_bayes.posterior.surrogate",
    "Flow": "sipe_bayes.posterior.flow",
}


def get_family(name: str) -> type[Posterior]:
    """The posterior class called ``name``; raises ValueError listing the names there are."""
    if name not in FAMILIES:
        raise ValueError(f"posterior family: expected one of {sorted(FAMILIES)}, got {name!r}")
    family: type[Posterior] = getattr(importlib.import_module(FAMILIES[name]), name)
    return family


def load_posterior(path: str | os.PathLike[str]) -> Posterior:
    """The posterior that ``Posterior.save(path)`` wrote; ``path`` with or without a suffix.

    Raises FileNotFoundError when one of the two files is missing and ValueError when they cannot be read.
    """
    header, tensors = read_pair(path)
    try:
        space = ParameterSpace.from_dict(header["space"])
        return get_family(header["family"])._restore(space, tensors, header["settings"])
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ValueError(
            f"{path}: not a posterior this version reads ({error}); save it again with posterior.save(path)"
        ) from error
