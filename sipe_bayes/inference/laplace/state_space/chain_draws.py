"""Draws in the place of a chain's normal, where it does not stand or the posterior reaches further than it.

The normal of the only optimum is looked beyond (``inference.stretches``). Where a stretch is found, or draws from the
normal say that it is none (``importance.judged``), importance draws come from the normal widened, from a normal along
each stretch, and from normals with the moments of what was drawn; the noise is held at its estimate, and each draw
takes one simulation of the logs, or two. All in one step, so that the linearisation is taken once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.budget import BudgetExhausted
from sipe_bayes.inference import importance
from sipe_bayes.inference.importance import Draws
from sipe_bayes.inference.laplace.state_space.target import ChainTarget
from sipe_bayes.inference.laplace.strategy import SearchProblem
from sipe_bayes.inference.stretches import look_size, proposals, stretches
from sipe_bayes.posterior import GaussianMixture


@dataclass(frozen=True)
class Look:
    """What lies beyond an optimum's normal.

    Args:
        draws: None where the normal stands.
        judged: whether the budget sufficed to know that, and for draws along every stretch.
    """

    draws: Draws | None
    judged: bool


def draws_size(size: int, problem: SearchProblem) -> int:
    """Rollouts of a log that a search of ``size`` parameters leaves to the look and to half of the draws, at most."""
    tuning = problem.options.tuning.importance
    return look_size(size) + tuning.most_batches // 2 * importance.batch_size(size, tuning)


def looked_beyond(problem: SearchProblem, target: ChainTarget, stands: bool) -> Look:
    """The posterior around an optimum, whose normal ``stands`` by draws from it, or does not."""
    tuning, optimum, chain = problem.options.tuning.importance, target.optimum, target.chain
    values = importance.in_chunks(target, len(chain.log), tuning)
    mean, covariance = optimum.mean, optimum.covariance
    draws, given = Draws.none(len(mean)), 1
    try:
        beyond = stretches(values, optimum.theta, mean, covariance, problem.options.tuning.stretches)
        if stands and not beyond:
            return Look(None, judged=True)
        normal = GaussianMixture([0.0], mean[None], covariance[None], problem.space)
        first = [(mean, tuning.first_wider**2 * covariance), *proposals(beyond, covariance)]
        given = len(first)
        for middle, spread in first:
            draws = importance.drawn_from(
                draws, values, middle, spread, tuning.share, problem.prior, problem.seed, tuning
            )
        while not importance.ended(draws, problem.prior, tuning, given):
            draws = importance.draw(draws, values, normal, problem.prior, problem.seed, tuning)
    except BudgetExhausted:
        chain.short = True  # a larger budget goes on from here
        return Look(draws if draws.batches or not stands else None, judged=draws.batches >= given)
    return Look(draws, judged=True)


def blur(held: FloatArray, averaged: FloatArray) -> FloatArray:
    """Covariance (N, N) that the noise's uncertainty adds to that at a held noise, in directions where it adds any."""
    sd = np.sqrt(np.diag(held))
    eigenvalues, axes = np.linalg.eigh((averaged - held) / np.outer(sd, sd))
    return np.asarray((axes * np.maximum(eigenvalues, 0.0)) @ axes.T * np.outer(sd, sd))
