"""Residuals of orientations: rotation vectors, against a plain calculation and finite differences."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from sipe_bayes.core.rotations import added, quaternions
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.likelihood import Noise, Segments
from sipe_bayes.likelihood.moments import Moments
from sipe_bayes.likelihood.restricted import Pulls, estimate_noise
from sipe_bayes.likelihood.starts.estimates import STATE_STEP
from sipe_bayes.likelihood.windows import Windows
from tests.problems.bodies import cube, tosses

TURN = [3, 4, 5]


def plain(measured: np.ndarray, predicted: np.ndarray) -> np.ndarray:
    """The rotation vector from one orientation to another, by MuJoCo's quaternions."""
    out = []
    for one, two in zip(quaternions(measured), quaternions(predicted), strict=True):
        back, way, vector = np.zeros(4), np.zeros(4), np.zeros(3)
        mujoco.mju_negQuat(back, two)
        mujoco.mju_mulQuat(way, one, back)
        mujoco.mju_quat2Vel(vector, way, 1.0)
        out.append(vector)
    return np.array(out)


@pytest.fixture(scope="module")
def windows() -> Windows:
    simulator = cube()
    logs, _ = tosses(simulator, 2, 25, seed=5, noise=0.02)
    return Windows(Segments(None, "white"), simulator, logs)


def test_residuals_are_rotations_from_predicted_to_measured(windows: Windows) -> None:
    """Also where the vectors themselves wrap, and plain differences elsewhere."""
    theta, starts = np.array([[0.3]]), windows.no_starts()[None]
    residual, valid = windows.residuals(theta, starts)
    assert valid.all()
    motion = windows.simulator.rollout(theta, windows.actions, windows.states(theta, starts)[0], windows.dt)
    for w in range(2):
        measured = windows.measured[w]
        np.testing.assert_allclose(residual[0, w, :, :3], measured[:, :3] - motion.observations[w, :, :3], atol=1e-12)
        expected = plain(measured[:, TURN], motion.observations[w][:, TURN])
        np.testing.assert_allclose(residual[0, w][:, TURN], expected, atol=1e-9)
    assert np.abs(np.diff(windows.measured[..., TURN], axis=1)).max() > 3, "some vector wraps"


def test_a_way_of_writing_an_orientation_changes_nothing(windows: Windows) -> None:
    """Whole rounds added to measured rotation vectors leave residuals and Jacobians as they are."""
    logs = []
    for k, log in enumerate(windows.trajectories):
        seen = log.observations.copy()
        axis = seen[:, TURN] / np.linalg.norm(seen[:, TURN], axis=1, keepdims=True)
        rounds = np.random.default_rng(k).integers(-2, 3, (len(seen), 1))
        seen[:, TURN] += 2 * np.pi * rounds * axis
        logs.append(Trajectory(seen, log.actions, log.dt, name=log.name))
    other = Windows(windows.settings, windows.simulator, Trajectories.stack(logs))
    other.reference = windows.reference
    theta, starts = np.array([0.3]), windows.no_starts()
    one, two = windows.linearise(theta, starts), other.linearise(theta, starts)
    np.testing.assert_allclose(one.residual, two.residual, atol=1e-9)
    np.testing.assert_allclose(one.jacobian, two.jacobian, atol=1e-3)


@pytest.mark.parametrize("offset", [0.0, 1.0, 3.1])
def test_the_jacobian_is_that_of_the_residual(windows: Windows, offset: float) -> None:
    """Against central differences of the plain residual, near the data, far from it, and nearly half a turn away."""
    logs = []
    for log in windows.trajectories:
        seen = log.observations.copy()
        seen[:, TURN] = added(seen[:, TURN], np.array([0.0, offset, 0.0]))
        logs.append(Trajectory(seen, log.actions, log.dt, name=log.name))
    turned = Windows(windows.settings, windows.simulator, Trajectories.stack(logs))
    turned.reference = windows.reference
    theta, starts = np.array([0.4]), windows.no_starts()
    lin = turned.linearise(theta, starts)
    assert np.abs(lin.jacobian[:, :12]).max() < 1e3, "no difference jumps"
    for d in (3, 4, 5, 9, 10, 11):  # turns and angular velocities of the start
        ends = []
        for step in (-STATE_STEP, STATE_STEP):
            moved = starts.copy()
            moved[:, d] += step
            state = turned.states(theta[None], moved[None])[0]
            ends.append(turned.simulator.rollout(theta[None], turned.actions, state, turned.dt).observations)
        for w in range(2):
            measured = turned.measured[w][:12][:, TURN]  # before anything touches the floor
            low, high = (plain(measured, end[w][:12][:, TURN]) for end in ends)
            smooth = np.abs(high - low).max(1) < 1e-3
            assert smooth.sum() > 6
            slope = -(high - low) / (2 * STATE_STEP)
            np.testing.assert_allclose(lin.jacobian[w, :12][:, TURN][..., 1 + d][smooth], slope[smooth], atol=2e-3)


def test_an_orientation_is_fitted_whole_or_not_at_all() -> None:
    simulator = cube()
    logs, _ = tosses(simulator, 1, 5, seed=0)
    names = simulator.environment.channels
    assert Windows(Segments(None, fit=names[:3]), simulator, logs).rotations == ()
    assert Windows(Segments(None, fit=names[3:]), simulator, logs).rotations == ((0, 1, 2),)
    with pytest.raises(ValueError, match="three numbers are fitted together"):
        Windows(Segments(None, fit=names[:4]), simulator, logs)


def test_an_orientation_has_one_noise_scale() -> None:
    """Estimated of residuals of three sizes it is their root mean square; other channels keep their own."""
    simulator = cube()
    logs, _ = tosses(simulator, 3, 25, seed=5, noise=0.02)
    windows = Windows(Segments(None), simulator, logs)
    assert windows.scales.tolist() == [0, 1, 2, 3, 3, 3]
    rng = np.random.default_rng(0)
    sizes = np.array([0.01, 0.02, 0.03, 0.1, 0.2, 0.3])
    residual = sizes * rng.normal(size=windows.measured.shape)
    moments = Moments(residual, np.zeros((*residual.shape, 1)), 1, windows.sequences)
    nothing = Pulls(np.eye(1), np.zeros(1), np.zeros(0), np.zeros((3, 0)), np.array([True]))
    start = Noise(np.ones(6), np.zeros(6))
    for coloured in (False, True):
        found = estimate_noise(
            moments, start, nothing, np.full(6, np.nan), coloured, windows.dt[0], 1.0, windows.scales
        )
        assert found.sd[3] == found.sd[4] == found.sd[5]
        assert found.tau[3] == found.tau[4] == found.tau[5]
        error = 4 / np.sqrt(2 * residual[..., 0].size)
        np.testing.assert_allclose(found.sd[:3], sizes[:3], rtol=error)
        np.testing.assert_allclose(found.sd[3], np.sqrt((sizes[3:] ** 2).mean()), rtol=error)
