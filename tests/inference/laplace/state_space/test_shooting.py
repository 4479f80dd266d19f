"""Windows that grow through impacts, from measured states and the model as given."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.inference.laplace.estimator import Laplace
from sipe_bayes.inference.laplace.state_space.shooting import shot
from sipe_bayes.likelihood.settings import StateSpace
from tests.problems.bouncing import bouncing, bouncing_log


@pytest.mark.parametrize(("seed", "mass", "stiffness"), [(0, 0.2, 0.8), (1, 0.8, 0.2), (3, 0.3, 0.6)])
def test_windows_lead_through_impacts(seed: int, mass: float, stiffness: float) -> None:
    """From .3 away to within .12 of the truth, and nowhere the ball's height off by more than the noise of 5 mm.

    What nothing moves stays open. With a budget for nothing there is nothing. Without draws a window stays on the wrong
    side of an impact, and the height is off by four times as much and more.
    """
    theta = np.array([mass, stiffness, 0.5])
    motion = bouncing_log(theta, seed)
    estimator = Laplace(bouncing(), likelihood=StateSpace())
    logs = Trajectories.stack([replace(motion, states=None)])
    chain = estimator.bound(logs)
    end = shot(estimator.problem, chain, np.full(3, 0.5), [chain.reference], 2000)
    assert end is not None
    assert motion.states is not None
    apart = np.abs(end.states[:, 1] - motion.states[:, 1])
    print(end.theta - theta, apart.max(), chain.rollouts)
    assert np.abs(end.theta - theta)[:2].max() < 0.12
    assert apart.max() < 5e-3
    before = chain.rollouts
    assert shot(estimator.problem, chain, np.full(3, 0.5), [chain.reference], 5) is None
    assert chain.rollouts <= before + 5
    end = shot(_tuned(estimator, draw_rounds=0).problem, chain, np.full(3, 0.5), [chain.reference], 2000)
    assert end is not None
    assert np.abs(end.states[:, 1] - motion.states[:, 1]).max() > 4 * 5e-3


@pytest.mark.parametrize(("seed", "mass", "stiffness"), [(0, 0.2, 0.8), (1, 0.8, 0.2)])
def test_what_no_simulation_follows_has_no_say_in_theta(seed: int, mass: float, stiffness: float) -> None:
    """Six samples that are wrong by 40 noise sds leave theta within .12 of the truth."""
    theta = np.array([mass, stiffness, 0.5])
    motion = bouncing_log(theta, seed)
    wrong = motion.observations.copy()
    wrong[34:40] += 0.2 * np.array([1, -1, 1, -1, 1, -1])[:, None]
    estimator = _tuned(Laplace(bouncing(), likelihood=StateSpace()), window=16)
    chain = estimator.bound(Trajectories.stack([replace(motion, observations=wrong, states=None)]))
    end = shot(estimator.problem, chain, np.full(3, 0.5), [chain.reference], 2000)
    assert end is not None
    print(end.theta - theta)
    assert np.abs(end.theta - theta)[:2].max() < 0.12


def _tuned(estimator: Laplace, **shooting: int) -> Laplace:
    """The estimator with other numbers of its shooting."""
    tuning = estimator.options.tuning
    chain = replace(tuning.state_space, shooting=replace(tuning.state_space.shooting, **shooting))
    estimator.options = replace(estimator.options, tuning=replace(tuning, state_space=chain))
    return estimator


def test_each_window_begins_at_the_states_that_it_follows_best_from() -> None:
    """Beside states that are a metre off, before or after them, the measured ones lead where they lead alone."""
    motion = bouncing_log(np.array([0.2, 0.8, 0.5]), 0)
    estimator = Laplace(bouncing(), likelihood=StateSpace())
    ends = []
    for order in ([1], [0, 1], [1, 0]):
        chain = estimator.bound(Trajectories.stack([replace(motion, states=None)]))
        lifted = chain.reference.copy()
        lifted[:, 1] += 1.0
        end = shot(estimator.problem, chain, np.full(3, 0.5), [(lifted, chain.reference)[k] for k in order], 2000)
        assert end is not None
        ends.append(end.theta)
    assert np.array_equal(ends[0], ends[1])
    assert np.array_equal(ends[0], ends[2])
