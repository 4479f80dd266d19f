"""Ridges, dead parameters and dead ranges are named; what is determined is not."""

from __future__ import annotations

import numpy as np
import pytest

from sipe_bayes.core.parameters import Parameter, ParameterSpace
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.diagnostics.identifiability import dead_ranges, ridges
from sipe_bayes.inference import get_estimator
from sipe_bayes.likelihood import Segments, bind
from tests.problems.pendulums import log, pendulum

SPACE = ParameterSpace([Parameter("mass", 0.1, 2.0), Parameter("length", 0.1, 2.0), Parameter("other", -1.0, 1.0)])


def named(draws: np.ndarray) -> list[str]:
    contraction = 1 - draws.std(0) / np.array([1.9, 1.9, 2.0]) * np.sqrt(12)
    return [r.text for r in ridges(SPACE, draws, contraction.tolist())]


def test_a_product_a_quotient_and_a_sum_are_described() -> None:
    rng = np.random.default_rng(0)
    length, other = rng.uniform(0.3, 1.8, 4000), rng.uniform(-1, 1, 4000)
    noise = np.exp(0.01 * rng.standard_normal(4000))
    (product,) = named(np.stack([0.5 / length**2 * noise, length, 0.01 * other], 1))
    assert "length^2" in product or "mass^0.5" in product
    assert "is determined; mass and length alone are not" in product
    (quotient,) = named(np.stack([0.9 * length * noise, length, 0.01 * other], 1))
    assert "mass / length = 0.9" in quotient or "length / mass = 1.1" in quotient
    (total,) = named(np.stack([1.0 - 0.5 * other + 0.01 * rng.standard_normal(4000), 0.01 * length, other], 1))
    assert "other" in total
    assert "mass" in total
    assert "length" not in total


def test_what_is_determined_is_not_called_a_ridge() -> None:
    rng = np.random.default_rng(0)
    a = 0.5 + 0.01 * rng.standard_normal(4000)
    assert named(np.stack([a, a + 1e-4 * rng.standard_normal(4000), 0.01 * rng.standard_normal(4000)], 1)) == []
    assert named(rng.uniform(0.1, 1, (4000, 3))) == []


def test_a_member_that_is_determined_is_not_said_to_be_open() -> None:
    """Mass within 1 % of its range follows a gear that is open."""
    rng = np.random.default_rng(0)
    space = ParameterSpace([Parameter("mass", 0.0, 100.0, unit="kg"), Parameter("gear", 0.0, 10.0)])
    gear = rng.uniform(4, 8, 4000)
    draws = np.stack([50 + 0.5 * (gear - 6) + 0.002 * rng.standard_normal(4000), gear], 1)
    contraction = 1 - draws.std(0) / np.array([100, 10]) * np.sqrt(12)
    (ridge,) = ridges(space, draws, contraction.tolist())
    assert "is determined; gear alone is not" in ridge.text
    assert set(ridge.parameters) == {"mass", "gear"}


def test_three_that_go_together_are_all_named() -> None:
    """Mass, gear and damping of a cart whose forces have no scale.

    Two determined combinations, in which each of the three occurs.
    """
    rng = np.random.default_rng(0)
    space = ParameterSpace(
        [Parameter("mass", 0.5, 3.0, unit="kg"), Parameter("gear", 3.0, 18.0), Parameter("damping", 0.0, 3.0)]
    )
    scale, noise = rng.uniform(0.4, 2.2, 4000), rng.standard_normal((3, 4000))
    draws = np.stack([1.3 * scale * (1 + 0.002 * noise[0]), 8 * scale, 0.8 * scale * (1 + 0.02 * noise[1])], 1)
    contraction = 1 - draws.std(0) / np.array([2.5, 15.0, 3.0]) * np.sqrt(12)
    found = ridges(space, draws, contraction.tolist())
    print(found)
    assert len(found) == 2
    assert {name for r in found for name in r.parameters} == {"mass", "gear", "damping"}
    assert "damping" in found[1].parameters
    assert len(found[1].parameters) == 2


def test_a_sum_of_many_is_found() -> None:
    """Thirty masses whose sum is known, none of them by itself."""
    rng = np.random.default_rng(0)
    draws = rng.uniform(1, 2, (4000, 30))
    draws += (45 - draws.sum(1, keepdims=True)) / 30 + 0.003 * rng.standard_normal((4000, 30))
    space = ParameterSpace([Parameter(f"p{k}", 0.0, 3.0) for k in range(30)])
    contraction = 1 - draws.std(0) / 3 * np.sqrt(12)
    assert [len(r.parameters) for r in ridges(space, draws, contraction.tolist())] == [30]


@pytest.mark.parametrize("estimator", ["laplace", "mcmc"])
def test_the_mass_length_ridge_of_a_pendulum_is_named(estimator: str) -> None:
    """Mass, its distance and the remaining inertia free: only first moment and inertia about the axis show."""
    simulator = pendulum(
        Parameter("distance", -0.4, -0.15, targets=("body:rod.com_z",)),
        Parameter("armature", 0.0, 0.05, targets=("joint:hinge.armature",)),
    )
    trajectory = log(simulator, [0.6, 0.05, -0.25, 0.01], 1, steps=200)
    posterior = get_estimator(simulator, estimator, budget=3000).fit(trajectory)
    draws = posterior.values(4000)
    prior_sd = np.array([p.high - p.low for p in simulator.space]) / np.sqrt(12)
    contraction = 1 - draws.std(0) / prior_sd
    found = ridges(simulator.space, draws, contraction.tolist())
    assert any({"rod_mass", "distance"} <= set(r.parameters) for r in found), found
    moment = draws[:, 0] * draws[:, 2]
    assert abs(moment.mean() + 0.15) < 0.02  # a straight normal on a curved ridge: 0.009 to 0.013 over seeds
    assert contraction[0] < 0.8


def test_dead_parameters_and_ranges_are_found() -> None:
    """Wind without a medium changes nothing; mass, damping and delay do, over their whole range."""
    simulator = pendulum(
        Parameter("delay", 0.0, 0.04, targets=("actuator:motor.delay",)),
        Parameter("wind", 0.0, 5.0, targets=("option.wind_x",)),
    )
    trajectory = log(simulator, [0.6, 0.05, 0.0, 0.0], 1)
    windows = bind(Segments(0.5), simulator, Trajectories.stack(trajectory))
    dead = dead_ranges(windows, np.array([0.4, 0.3, 0.5, 0.5]))
    assert dead == {"wind": [(0.0, 1.0)]}


def test_ridges_carry_units() -> None:
    """A quotient has its parameters' units, a sum's factors what makes its terms alike."""
    space = ParameterSpace([Parameter("force", 0.5, 4.0, unit="N"), Parameter("mass", 0.5, 4.0, unit="kg")])
    rng = np.random.default_rng(0)
    mass = rng.uniform(1.0, 2.5, 4000)
    quotient = np.stack([1.5 * mass * np.exp(0.01 * rng.standard_normal(4000)), mass], 1)
    (found,) = ridges(space, quotient, [0.3, 0.3])
    assert " N/kg is determined" in found.text, found.text
    assert found.text.startswith("force / mass = 1."), found.text
    total = np.stack([3.0 - 0.8 * mass + 0.003 * rng.standard_normal(4000), mass], 1)
    (found,) = ridges(space, total, [0.3, 0.3])
    assert "N/kg" in found.text or "kg/N" in found.text, found.text
    assert found.text.split("±")[1].split(" is determined")[0].endswith((" N", " kg")), found.text
