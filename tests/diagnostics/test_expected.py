"""What a plan is expected to tell is what a fit of its log then tells: contraction, ridge, idle parameters."""

from __future__ import annotations

import numpy as np
import pytest

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.diagnostics.expected import Plan, contraction, expect, informations
from sipe_bayes.inference import get_estimator
from sipe_bayes.likelihood import Noise, Segments
from sipe_bayes.posterior import GaussianMixture, prior
from tests.problems.carts import cart
from tests.problems.pendulums import DT, log, pendulum

NOISE = Noise(np.array([0.01]), np.zeros(1))
SEGMENTS = Segments(0.5, noise="white")


@pytest.mark.parametrize("scale", ["linear", "log"])
def test_the_carts_ridge_is_foreseen_in_words_and_units(scale: str) -> None:
    """Only gear / mass will show, and wind, without a medium, nothing."""
    simulator = cart(scale)
    plan = Plan(2 * np.sin(0.07 * np.arange(300))[:, None], 0.01)
    found = expect(simulator, SEGMENTS, plan, NOISE, prior(simulator.space))
    print(found.sentences(), found.contraction)
    assert found.idle == ("wind",)
    (ridge,) = found.ridges
    assert set(ridge.parameters) == {"gear", "mass"}
    said = " ".join(found.sentences())
    assert "would be determined; gear and mass alone are not" in said
    assert "wind is never excited" in said
    assert "kg" in said
    assert scale == "linear" or "gear / mass" in said or "mass / gear" in said
    assert (found.contraction < 0.6).all()


def test_what_is_expected_is_what_a_fit_finds() -> None:
    """The same experiment again takes sds to 1 / sqrt 2 of what the first left.

    By the information at draws of its posterior.
    """
    simulator = pendulum()
    recorded = log(simulator, [0.6, 0.08], 3)
    posterior = get_estimator(simulator, "laplace", likelihood=SEGMENTS).fit(recorded)
    found = expect(simulator, SEGMENTS, Plan(recorded.actions, DT), NOISE, posterior, draws=2)
    print(found.contraction)
    np.testing.assert_allclose(found.contraction, 1 - np.sqrt(0.5), atol=0.03)
    assert found.idle == ()
    assert (found.remaining > 0.9).all()
    assert found.sentences() == []  # what is known now stays determined


def test_what_is_known_now_is_not_called_open() -> None:
    """Gear and mass are known to half a percent of their ranges; only their quotient would show."""
    simulator = cart("log")
    known = GaussianMixture([0.0], [[0.6, 0.5, 0.5]], [np.diag([0.005**2, 0.005**2, 0.1])], simulator.space)
    found = expect(simulator, SEGMENTS, Plan(2 * np.sin(0.07 * np.arange(300))[:, None], 0.01), NOISE, known, draws=2)
    assert found.sentences() == ["wind is never excited: its posterior will be what is known now"]


def test_a_new_log_has_nuisances_of_its_own() -> None:
    """Zero errors of two old logs.

    The plan says nothing of them, and of the rest what it says where its own zero error is unknown. A mass at one place
    and a zero of 0.3 rad do much the same to a pendulum that hardly moves, so that this is not what it says with a
    known zero.
    """
    bias = ("sensor:joint:hinge.position.bias",)
    old = [Parameter(f"zero[{log}]", -0.3, 0.3, targets=bias, log=log) for log in ("a", "b")]
    plan = Plan(0.5 * np.sin(0.05 * np.arange(300))[:, None], DT)
    gains = []
    for more in ((), (Parameter("zero", -0.3, 0.3, targets=bias),), old):
        simulator = pendulum(*more)
        at = np.full((1, len(simulator.space)), 0.5)
        (told,) = informations(simulator, SEGMENTS, plan, NOISE, at)
        gains.append(contraction(12 * np.eye(len(told)), [told]))
    without, own, logs = gains
    print(without, own, logs)
    np.testing.assert_allclose(logs[:2], own[:2], rtol=1e-4)
    np.testing.assert_allclose(logs[2:], 0, atol=1e-9)
    assert (without > own[:2] + 1e-6).any()


def test_a_good_plan_has_nothing_to_be_said_of() -> None:
    simulator = pendulum()
    plan = Plan(log(simulator, [0.6, 0.08], 3).actions, DT)
    found = expect(simulator, SEGMENTS, plan, NOISE, prior(simulator.space), draws=2)
    assert (found.contraction > 0.9).all()
    assert found.sentences() == []


def test_a_plan_that_diverges_is_refused() -> None:
    simulator = pendulum()
    with pytest.raises(ValueError, match="plan: 'planned' diverges at all 2 draws"):
        expect(simulator, SEGMENTS, Plan(np.full((100, 1), 1e9), DT), NOISE, prior(simulator.space), draws=2)
