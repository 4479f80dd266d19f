"""Differences as long as the posterior is wide.

Exact where the model is linear, between the slopes of a kink, with an error there.
"""

from __future__ import annotations

import numpy as np
import pytest

import sipe_bayes as sipe
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.likelihood.binding import bind
from sipe_bayes.likelihood.settings import StateSpace
from sipe_bayes.likelihood.state_space.chain import Chain
from sipe_bayes.likelihood.state_space.differences import linearise, linearise_widely
from sipe_bayes.simulation.simulator import Simulator

STEP = 0.01


def sliding(spring: float = 10.0, limited: str = "false") -> Chain:
    """A mass on a slide joint, one control step of 10 ms long, that may end at a stop at zero.

    Pushed, its position measured.
    """
    xml = (
        f'<mujoco><option timestep="{STEP}" gravity="0 0 0" integrator="Euler"/><worldbody><body>'
        f'<joint name="x" type="slide" stiffness="{spring}" range="0 1" limited="{limited}"/>'
        '<geom size="0.1" mass="2" contype="0" conaffinity="0"/></body></worldbody>'
        '<actuator><motor name="m" joint="x"/></actuator></mujoco>'
    )
    parameters = [Parameter("stiffness", 0, 40, targets=("joint:x.stiffness",))]
    simulator = Simulator(sipe.MjcfEnvironment.build(xml, parameters, ["m"], ["joint:x.position"]), num_threads=1)
    log = Trajectory(np.array([[0.0], [0.1], [0.1]]), np.zeros((2, 1)), STEP)
    return bind(StateSpace(), simulator, Trajectories.stack([log]))


def states(positions: list[float]) -> np.ndarray:
    out = np.zeros((len(positions), 3))
    out[:, 1] = positions
    return out


def test_a_linear_model_has_the_same_slopes_at_any_length_and_no_error() -> None:
    chain = sliding()
    theta, at = np.array([0.25]), states([0.0, 0.3, 0.2])
    short = linearise(chain, theta, at)
    wide = linearise_widely(chain, theta, at, np.array([0.2]), np.full((3, 2), 0.3))
    assert short is not None
    assert wide is not None
    np.testing.assert_allclose(wide.transition, short.transition, atol=1e-6)
    np.testing.assert_allclose(wide.transition_theta, short.transition_theta, atol=1e-6)
    np.testing.assert_allclose(wide.measurement, short.measurement, atol=1e-6)
    np.testing.assert_allclose(wide.jump, short.jump)
    share = STEP / 2
    np.testing.assert_allclose(wide.transition[0], [[1 - STEP * share * 10, STEP], [-share * 10, 1]], atol=1e-9)
    assert wide.error.max() < 1e-20
    assert (short.error == 0).all()


def test_at_a_stop_the_slope_is_between_both_sides_and_the_jump_has_an_error() -> None:
    """Just at the stop, pushed on by nothing.

    In front of it the velocity does not depend on the position, behind it the stop pushes back. Half of that is the
    slope, and half the squared deviation of one side, once more halved, the variance.
    """
    chain, step = sliding(spring=1e-9, limited="true"), 0.01
    theta, at = np.array([0.0]), states([0.0, 0.5, 0.5])
    wide = linearise_widely(chain, theta, at, np.array([1e-4]), np.full((3, 2), step))
    assert wide is not None
    behind = chain.simulate(theta[None], states([-step, 0.5, 0.5])[None])[1][0, 0, 2]
    print("velocity after a control step behind the stop", behind)
    assert behind > 0.01
    assert wide.transition[0, 1, 0] == pytest.approx(-behind / (2 * step), rel=1e-6)
    moving = chain.simulate(theta[None], np.array([[0.0, 0, -step], [0, 0.5, 0], [0, 0.5, 0]])[None])[1][0, 0, 2]
    expected = 0.5 * ((behind / 2) ** 2 + ((moving + step) / 2) ** 2)
    assert wide.error[0, 1] == pytest.approx(expected, rel=1e-6)
    assert wide.error[1].max() < 1e-20  # far from the stop


def test_a_side_that_diverges_counts_as_no_slope(monkeypatch: pytest.MonkeyPatch) -> None:
    chain = sliding()
    simulate = chain.simulate

    def broken(theta, states, at=None):  # type: ignore[no-untyped-def]
        predicted, ends, valid = simulate(theta, states, at)
        valid[-1, 0] = False  # a lower velocity of the first state
        return predicted, ends, valid

    monkeypatch.setattr(chain, "simulate", broken)
    wide = linearise_widely(chain, np.array([0.25]), states([0.0, 0.3, 0.2]), np.array([0.2]), np.full((3, 2), 0.3))
    assert wide is not None
    assert (wide.transition[0, :, 1] == 0).all()
    assert wide.transition[1, 0, 1] == pytest.approx(STEP)
    assert (wide.error[0] < 1e-20).all()
