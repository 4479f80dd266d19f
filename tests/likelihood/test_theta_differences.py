"""Long differences lie around theta, within the cube, and are as long there; short ones lie ahead."""

from __future__ import annotations

import numpy as np

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.likelihood.settings import Segments
from sipe_bayes.likelihood.theta_differences import ThetaDifferences
from sipe_bayes.likelihood.windows import Windows
from tests.problems.pendulums import log, pendulum


def test_points_ahead_and_behind() -> None:
    """In the middle, near the lower bound, at it and near the upper one; the last is short."""
    theta, size = np.array([0.5, 0.01, 0.0, 0.99, 0.3]), np.array([0.04, 0.04, 0.04, 0.04, 1e-3])
    steps = ThetaDifferences.of(theta, size, np.array([0.04, 0.04, 0.04, 0.04, 0.0]))
    np.testing.assert_allclose(steps.ahead, [0.02, 0.03, 0.04, -0.03, 1e-3])
    np.testing.assert_allclose(steps.back, [-0.02, -0.01, 0.0, 0.01, 0.0])
    assert steps.both.tolist() == [0, 1, 3]
    np.testing.assert_allclose(steps.length, [0.04, 0.04, 0.04, -0.04, 1e-3])
    points = steps.points
    assert points.shape == (8, 5)
    assert ((points >= 0) & (points <= 1)).all()
    np.testing.assert_allclose(points[:5] - theta, np.diag(steps.ahead), atol=1e-15)
    np.testing.assert_allclose((points[5:] - theta)[:, [0, 1, 3]], np.diag(steps.back[[0, 1, 3]]), atol=1e-15)


def test_the_other_way_is_one_sided_and_within_the_cube() -> None:
    steps = ThetaDifferences.of(np.array([0.5, 0.01]), np.array([0.04, 0.04]), np.array([0.04, 0.04]))
    turned = steps.other_way(np.array([0, 1]))
    np.testing.assert_allclose(turned.ahead, [-0.04, -0.01])
    assert not turned.back.any()


def test_the_slope_of_a_delay_is_that_at_theta() -> None:
    """Not of half a physics step later: a fifth as far off what shorter and shorter physics steps approach."""
    delay = Parameter("delay", 0.0, 0.1, targets=("actuator:motor.delay",))
    simulator = pendulum(delay)
    recorded = Trajectories.stack([log(simulator, [0.6, 0.08, 0.031], 3)])
    windows = Windows(Segments(0.5), simulator, recorded)
    theta, starts = simulator.space.normalise(np.array([0.6, 0.08, 0.031])), windows.no_starts()
    made = windows.linearise(theta, starts)
    before = windows.rollouts
    again = windows.linearise(theta, starts)
    assert windows.rollouts - before == 3 + windows.num_start + 1 + 1  # one more, behind the delay
    np.testing.assert_array_equal(again.jacobian, made.jacobian)
    ends = np.array([theta, theta, theta])
    ends[1:, 2] += [0.1, -0.1]  # over two physics steps
    middle, later, earlier = windows.predict(ends, np.tile(starts, (3, 1, 1)), True)[0]
    central, ahead = (later - earlier) / 0.2, (later - middle) / 0.1
    here = np.where(windows.observed, made.jacobian[..., 2] - central, 0.0)
    off = np.where(windows.observed, ahead - central, 0.0)
    print(np.abs(here).max(), np.abs(off).max(), np.nanmax(np.abs(central)))
    assert (here**2).sum() < 0.04 * (off**2).sum()
