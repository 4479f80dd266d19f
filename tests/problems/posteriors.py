"""A posterior of each family in any number of dimensions."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache

import numpy as np
import torch

from sipe_bayes.core.parameters import Parameter, ParameterSpace
from sipe_bayes.posterior import (
    Averaged,
    Dirac,
    GaussianMixture,
    IndependentPrior,
    Particles,
    Posterior,
    QuantileMapped,
)
from sipe_bayes.posterior.flow import Flow, spline_flow
from tests.problems.surrogates import example_surrogate

SIGMAS = 5.0
RIDGE = np.array([[1.0, 0.9999e-4], [0.9999e-4, 1e-8]])


def space_of(n: int) -> ParameterSpace:
    return ParameterSpace(
        Parameter(f"p{j}", 1.0, 3.0 + j, unit="kg" if j % 2 else "N m", scale="log" if j % 2 else "linear")
        for j in range(n)
    )


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def random_mixture(n: int, components: int = 3, seed: int = 0) -> GaussianMixture:
    """Correlated components, some means outside the cube."""
    rng = np.random.default_rng(seed)
    factors = rng.standard_normal((components, n, n)) * 0.25
    covariances = factors @ factors.transpose(0, 2, 1) + 0.02 * np.eye(n)
    means = rng.uniform(-0.3, 1.3, (components, n))
    return GaussianMixture(rng.standard_normal(components), means, covariances, space_of(n))


def single(mean: object, covariance: object) -> GaussianMixture:
    mean = np.atleast_1d(np.asarray(mean, dtype=float))
    return GaussianMixture([0.0], mean[None], np.atleast_2d(covariance)[None], space_of(len(mean)))


def example_particles(n: int) -> Particles:
    rng = np.random.default_rng(n)
    return Particles(rng.beta(2, 3, (400, n)), space_of(n), rng.exponential(size=400), best=rng.random(n))


def example_flow(n: int) -> Flow:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        net = spline_flow(n, 4, 2, 8, 4)
    architecture = {"transforms": 2, "hidden": 8, "bins": 4}
    learned = dict(net.named_parameters())
    mild = {name: 0.5 * tensor if name in learned else tensor for name, tensor in net.state_dict().items()}
    return Flow(mild, torch.ones(4), torch.zeros(n), torch.ones(n), space_of(n), **architecture)


EXAMPLES: dict[str, Callable[[int], Posterior]] = {
    "Dirac": lambda n: Dirac(np.linspace(0.2, 0.9, n), space_of(n)),
    "Particles": example_particles,
    "GaussianMixture": random_mixture,
    "IndependentPrior": lambda n: IndependentPrior(
        np.linspace(-0.2, 0.7, n), [math.inf if j % 2 else 0.3 for j in range(n)], space_of(n)
    ),
    "SurrogatePosterior": lambda n: example_surrogate(space_of(n)),
    "Flow": example_flow,
    "Averaged": lambda n: Averaged([random_mixture(n, 1, seed) for seed in (1, 2)]),
    "QuantileMapped": lambda n: QuantileMapped(
        random_mixture(n), np.linspace(-1, 1, 5)[:, None].repeat(n, 1), np.linspace(-1.3, 1.2, 5)[:, None].repeat(n, 1)
    ),
}


@cache
def example(name: str, n: int) -> Posterior:
    """Made once: posteriors do not change."""
    return EXAMPLES[name](n)
