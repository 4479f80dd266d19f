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


@pytest.mark.parametrize(("seed", "mass", "stiffness"), [(0, 0.2, 0.8), (1, 0.8, 0.2)])
def test_windows_lead_through_impacts(seed: int, mass: float, stiffness: float) -> None:
    """From .3 away to within .12 of the truth, and nowhere the ball's height off by more than the noise of 5 mm.

    What nothing moves stays open. With a budget for nothing there is nothing.
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
