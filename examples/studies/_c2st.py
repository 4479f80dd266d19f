"""Accuracy of a classifier that tells draws of a posterior from others: 0.5 when it cannot, 1 when it always can.

D. Lopez-Paz, M. Oquab 2017, "Revisiting Classifier Two-Sample Tests" (https://arxiv.org/abs/1610.06545), by
``sbi.utils.metrics.c2st`` with its random forest.
"""

from __future__ import annotations

import torch
from numpy.typing import ArrayLike

from sipe_bayes.models.sbi_tools import import_sbi
from sipe_bayes.posterior import Particles, Posterior, SurrogatePosterior


def c2st(posterior: Posterior, reference: ArrayLike | torch.Tensor, seed: int = 0) -> float:
    """The accuracy against draws (M, N) in theta; of a posterior that stores its draws none is taken twice."""
    given = posterior.space.check_shape(reference)
    generator, stored = torch.Generator().manual_seed(seed), None
    if isinstance(posterior, SurrogatePosterior):
        stored = posterior.draws
    elif isinstance(posterior, Particles) and float(posterior.weights.max() - posterior.weights.min()) < 1e-12:
        stored = posterior.theta
    if stored is None:
        own = posterior.sample((len(given),), generator=generator)
    else:  # a repeated draw gives itself away
        own = stored[torch.randperm(len(stored), generator=generator)[: len(given)]]
    other = torch.from_numpy(given)[: len(own)].float()
    return float(import_sbi("utils.metrics").c2st(other, own.float(), seed=seed + 1))
