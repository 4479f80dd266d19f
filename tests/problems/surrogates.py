"""Surrogate posteriors over a known discrepancy, shared by tests."""

from __future__ import annotations

import numpy as np
import torch

from sipe_bayes.core.parameters import ParameterSpace
from sipe_bayes.models.gaussian_process import GaussianProcess
from sipe_bayes.posterior import IndependentPrior, SurrogatePosterior
from sipe_bayes.posterior.ensemble import EnsembleOptions


def bowl(n: int, count: int = 30) -> GaussianProcess:
    """A process with given hyper-parameters through a log-quadratic bowl around 0.6 in n dimensions."""
    x = torch.from_numpy(np.random.default_rng(n).random((count, n)))
    y = (((x - 0.6) ** 2).sum(1) + 0.05).log()
    return GaussianProcess(x, y, torch.full((n,), 0.7 * n**0.5), 1e-3, 0.5, float(y.mean()), float(y.std()))


def example_surrogate(space: ParameterSpace, exact_draws: int = 40_000) -> SurrogatePosterior:
    """With independent draws: draws of the prior, accepted with probability Phi, which is exact."""
    n = len(space)
    process, epsilon = bowl(n), float(np.log(0.15 + 0.05 * n))
    prior = IndependentPrior(np.linspace(0.3, 0.7, n), np.full(n, 0.4), space)
    sampled = SurrogatePosterior.sampled(
        process, epsilon, prior, options=EnsembleOptions(effective=300, most_steps=600)
    )
    generator, kept = torch.Generator().manual_seed(n), []
    while sum(len(part) for part in kept) < exact_draws:
        theta = prior.sample((20_000,), generator=generator)
        accepted = sampled.log_prob(theta) + sampled.log_normaliser - prior.log_prob(theta)
        kept.append(theta[torch.rand(len(theta), dtype=torch.float64, generator=generator).log() < accepted])
    draws = torch.cat(kept)[:exact_draws]
    return SurrogatePosterior(
        process, epsilon, prior, draws, 1, sampled.log_normaliser, sampled.normaliser_error, sampled.mixing
    )
