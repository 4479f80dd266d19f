"""StateSpace where the first states are known, through contact: a pushed mass that bounces off the floor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import sipe_bayes as sipe
from sipe_bayes.core.findings import Code
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.inference.laplace.estimator import Laplace
from sipe_bayes.inference.laplace.state_space.growing_horizon import grown
from sipe_bayes.inference.laplace.state_space.known_starts import KnownStartSearch
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


def grown_from(logs: list[Trajectory], **settings: object) -> tuple[np.ndarray | None, Laplace]:
    estimator = Laplace(bouncing(), likelihood=KNOWN, **settings)  # type: ignore[arg-type]
    return grown(estimator.problem, estimator.bound(Trajectories.stack(logs))), estimator


def test_many_logs_and_late_samples_grow_as_well() -> None:
    """A dozen logs, and one whose first samples are missing.

    Each comes near the truth (the prior's mean is .37 off).
    """
    theta = np.array([0.87, 0.38, 0.5])
    logs = [bouncing_log(theta, seed, 60) for seed in range(12)]
    late = logs[0].observations.copy()
    late[:13] = np.nan
    for name, given in (("many", logs), ("late", [replace(logs[0], observations=late)])):
        points, estimator = grown_from(given, restarts=1)
        assert points is not None
        print(name, points, estimator.warnings)
        assert np.abs(points[0] - theta)[:2].max() < 0.15


def test_a_model_that_diverges_as_given_is_said_to(monkeypatch: pytest.MonkeyPatch) -> None:
    theta = np.array([0.87, 0.38, 0.5])
    estimator = Laplace(bouncing(), likelihood=KNOWN, restarts=1)
    windows = estimator.bound(Trajectories.stack([bouncing_log(theta, 0, 30)]))
    simulator, rollout = windows.simulator, windows.simulator.rollout

    def broken(thetas, *rest, **more):  # type: ignore[no-untyped-def]
        result = rollout(thetas, *rest, **more)
        default = np.abs(np.atleast_2d(thetas) - simulator.space.default_theta).max(1) == 0
        result.valid[default, 1:] = False
        return result

    simulator.rollout = broken
    monkeypatch.setattr("sipe_bayes.likelihood.windows.prompt", lambda given, contacts: given)
    points = grown(estimator.problem, windows)
    assert points is not None
    assert [item.code for item in estimator.findings] == [Code.DIVERGES_AS_GIVEN]


def test_an_estimate_that_was_made_is_not_lost_when_the_budget_ends() -> None:
    """With every budget around the one at which the first estimate of the noise is done.

    Nothing likelier is known than what is kept.
    """
    log, start, seen = bouncing_log(np.array([0.4, 0.6, 0.5]), 5, 60), np.array([[0.5, 0.5, 0.5]]), []

    def noted(self, state, linear):  # type: ignore[no-untyped-def]
        after = estimated(self, state, linear)
        seen.append((self.chain.rollouts, max(one.evidence for one in after[0].optima)))
        return after

    estimated = KnownStartSearch.estimated
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(KnownStartSearch, "estimated", noted)
        Laplace(bouncing(), likelihood=KNOWN, initial=start).fit(log)
        (first, evidence), *_ = seen
        for budget in range(first, first + 4):
            estimator = Laplace(bouncing(), likelihood=KNOWN, initial=start, budget=budget)
            estimator.fit(log)
            assert estimator.state is not None
            assert max(one.evidence for one in estimator.state.search.optima) >= evidence - 1e-9


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
