"""StateSpace where the first states are known, through contact: a pushed mass that bounces off the floor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import sipe_bayes as sipe
from sipe_bayes.inference.laplace.estimator import Laplace
from sipe_bayes.inference.laplace.state_space.state import ChainOptimum
from sipe_bayes.inference.laplace.strategy import distinct, mixture
from sipe_bayes.likelihood.settings import StateSpace
from tests.problems.bouncing import bouncing, bouncing_log

KNOWN = StateSpace(starts="recorded")


def test_intervals_through_a_bouncing_contact_hold_the_truth() -> None:
    """Of 12 intervals of 90 % for what bounces at least 8 hold the truth; what nothing moves keeps its prior.

    Right ones fail with probability 0.4 %, were they independent. Their squared z-scores average 2.65 at most (0.15 %;
    short differences have 4).
    """
    rng, covered, errors, scores = np.random.default_rng(4), 0, [], []
    for seed in range(6):
        theta = rng.uniform(0.1, 0.9, 3)
        estimator = Laplace(bouncing(), likelihood=KNOWN, restarts=1, seed=seed)
        posterior = estimator.fit(bouncing_log(theta, seed))
        low, high = posterior.quantile([0.05, 0.95]).numpy()
        covered += int(((low <= theta) & (theta <= high))[:2].sum())
        errors.append(np.abs(posterior.mean.numpy() - theta)[:2])
        scores.append(errors[-1] / posterior.stddev.numpy()[:2])
        print(
            seed, theta.round(3), posterior.mean.numpy().round(3), posterior.stddev.numpy().round(4), estimator.warnings
        )
        # of some 100 effective draws a uniform sd is known to 4.5 %
        assert float(posterior.stddev[2]) == pytest.approx(
            1 / np.sqrt(12), rel=0.02 if estimator.state.draws is None else 0.14
        )
    square = float(np.mean(np.square(scores)))
    print("covered", covered, "of 12, median error", np.median(errors), "mean squared z", square)
    assert covered >= 8
    assert np.median(errors) < 0.02
    assert square < 2.65


def test_mcmc_agrees_with_laplace() -> None:
    """Means to one sd and central 68 % to a factor of 1.5, of what bounces, by Jacobians over wide differences.

    Both with the noise held; the chains have a longer tail, which a normal has not.
    """
    theta = np.array([0.4, 0.6, 0.5])
    log = bouncing_log(theta, 5)
    estimator = Laplace(bouncing(), likelihood=KNOWN, seed=1)
    estimator.fit(log)
    assert estimator.state is not None
    best = distinct(estimator.state.search.optima)[0]
    assert isinstance(best, ChainOptimum)
    laplace = mixture([replace(best, averaged=None)], estimator.space)
    chains = sipe.get_estimator(bouncing(), "mcmc", likelihood=KNOWN, seed=1, mixed=1.05).fit(log)
    levels = torch.tensor([0.16, 0.84], dtype=torch.float64)
    width, other = (np.ptp(posterior.quantile(levels).numpy(), axis=0)[:2] / 2 for posterior in (laplace, chains))
    gap = (laplace.mean - chains.mean).abs().numpy()[:2]
    assert (gap < width).all()
    assert (np.abs(np.log(other / width)) < np.log(1.5)).all()
