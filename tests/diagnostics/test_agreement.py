"""Logs that agree pass in silence; a planted disagreement is named."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.findings import Finding
from sipe_bayes.core.parameters import Parameter, ParameterSpace
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.diagnostics.agreement import disagreement, linear_estimates
from sipe_bayes.diagnostics.evaluate import white_noise
from sipe_bayes.inference import get_estimator
from sipe_bayes.likelihood import Segments, StateSpace, bind
from sipe_bayes.simulation.simulator import Simulator
from sipe_bayes.structure.augmented import AugmentedModel
from sipe_bayes.structure.discrepancy import LogEstimate
from tests.problems.pendulums import log, pendulum

SEEDS = range(8)


def estimates(
    simulator: Simulator, likelihood: Segments | StateSpace, logs: Trajectories, start: FloatArray | None = None
) -> list[LogEstimate]:
    """Of each log, in the linear model at a fit of all."""
    method = get_estimator(
        simulator, "laplace", likelihood=likelihood, initial=start, budget=5000, restarts=1, candidates=0
    )
    theta = method.fit(logs).mode.numpy()
    assert method.result is not None
    if isinstance(likelihood, Segments):
        windows, noise, starts = bind(likelihood, simulator, logs), method.result.noise, method.result.starts_at(theta)
        return linear_estimates(AugmentedModel(windows, theta, noise, starts, placed=()).seen)
    windows = bind(Segments(0.5), simulator, replace(logs, states=method.result.states))
    model = AugmentedModel(windows, theta, white_noise(windows, theta), windows.no_starts(), placed=())
    return linear_estimates(model.seen.discounted)


def name_of(found: Finding) -> str:
    """The parameter that explains it."""
    return found.parameters[0] if found.parameters else "no single one"


def says(found: Finding) -> list[tuple[str, float, float]]:
    """Log, value and sd of each that is told."""
    told = re.findall(r"(\S+) says (\S+) ± ([^ ,;]+)", found.text)
    return [(name, float(value), float(sd)) for name, value, sd in told]


def alarms(heavier: float, rho: float) -> list[str]:
    """What is named, seed by seed, when the second log's rod is ``heavier`` times the first's."""
    simulator = pendulum(Parameter("coulomb", 0.0, 0.1, targets=("joint:hinge.frictionloss",)))
    named = []
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        mass, damping, coulomb = rng.uniform(0.5, 0.8), rng.uniform(0.03, 0.1), rng.uniform(0.01, 0.05)
        logs = Trajectories.stack(
            [
                log(simulator, [mass, damping, coulomb], 100 + seed, "monday", rho=rho),
                log(simulator, [mass * heavier, damping, coulomb], 200 + seed, "tuesday", rho=rho),
            ]
        )
        start = simulator.space.normalise(np.array([mass, damping, coulomb]))
        found = disagreement(simulator.space, estimates(simulator, Segments(0.5), logs, start))
        named.append("" if found is None else name_of(found))
    return named


@pytest.mark.parametrize("rho", [0.0, 0.9])
def test_agreeing_logs_pass_in_silence(rho: float) -> None:
    """At the 1 % level, 2 or more alarms in 8 have a probability of 0.3 %."""
    named = alarms(1.0, rho)
    assert named.count("") >= 7, named


@pytest.mark.parametrize("rho", [0.0, 0.9])
def test_a_heavier_rod_is_named(rho: float) -> None:
    named = alarms(1.1, rho)
    assert named.count("rod_mass") >= 7, named


@pytest.mark.parametrize("likelihood", [Segments(0.5, noise="white"), StateSpace()])
@pytest.mark.parametrize(("heavier", "named"), [(1.0, ""), (1.1, "rod_mass")])
def test_the_linear_model_of_a_fit_says_what_each_log_says(
    likelihood: Segments | StateSpace, heavier: float, named: str
) -> None:
    """Each log asks for the mass that it was made with."""
    simulator, masses = pendulum(), np.array([0.6, 0.6 * heavier])
    logs = Trajectories.stack([log(simulator, [mass, 0.08], k, f"log {k}") for k, mass in enumerate(masses)])
    alone = estimates(simulator, likelihood, logs)
    found = disagreement(simulator.space, alone)
    assert ("" if found is None else name_of(found)) == named
    assert [one.name for one in alone] == ["log 0", "log 1"]
    np.testing.assert_allclose([simulator.space.values(one.mean)[0] for one in alone], masses, atol=0.01)


def test_cochrans_q_against_a_plain_reference() -> None:
    """Gaussian estimates of two logs: p uniform when they agree (false-alarm rate of this test 1 %)."""
    space = ParameterSpace([Parameter("a"), Parameter("b")])
    rng = np.random.default_rng(0)
    root = np.array([[30.0, 0.0], [12.0, 20.0]])
    information = root @ root.T
    alarmed = 0
    for _ in range(2000):
        means = [0.5 + np.linalg.solve(root.T, rng.standard_normal(2)) for _ in range(2)]
        estimates = [LogEstimate(str(i), m, information) for i, m in enumerate(means)]
        alarmed += disagreement(space, estimates) is not None
    assert 8 <= alarmed <= 33  # 20 expected at the 1 % level, sd 4.5


def agreeing(informations: list[np.ndarray], rng: np.random.Generator, shift: float = 0.0) -> list[LogEstimate]:
    """Exact estimates of logs that agree, but for the first one's a, which is ``shift`` off.

    What a log does not determine is anywhere.
    """
    found = []
    for k, information in enumerate(informations):
        eigenvalues, axes = np.linalg.eigh(information)
        away = np.where(eigenvalues > 0, rng.standard_normal(2) / np.sqrt(np.maximum(eigenvalues, 1e-300)), 3.0)
        found.append(LogEstimate(str(k), np.array([0.5 + shift * (k == 0), 0.5]) + axes @ away, information))
    return found


TURNED = np.array([[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]])


@pytest.mark.parametrize(
    "informations",
    [
        [np.diag([1e4, 5.0])] * 2,
        [np.diag([1e4, 11.0])] * 5,
        [np.diag([1e4, 1e3]), np.diag([1e4, 0.0]), np.diag([0.0, 1e3])],
        [TURNED @ np.diag([1e4, 11.0]) @ TURNED.T, np.diag([1e4, 11.0]), np.diag([1e4, 1e4])],
        [np.diag([1e4, 0.0]), TURNED @ np.diag([1e4, 0.0]) @ TURNED.T, np.diag([1e4, 0.0])],
    ],
)
def test_logs_of_different_ranks_that_agree_raise_no_more_alarms_than_stated(informations: list[np.ndarray]) -> None:
    """Of 2,000 at the 1 % level: more than 33 have a probability of 0.3 %."""
    space, rng = ParameterSpace([Parameter("a"), Parameter("b")]), np.random.default_rng(3)
    alarms = [disagreement(space, agreeing(informations, rng)) is not None for _ in range(2000)]
    print(sum(alarms))
    assert sum(alarms) <= 33


def test_a_parameter_that_few_logs_determine_is_named_alone() -> None:
    """Parameter a differs between the two logs that determine it; b, which three more determine too, is the same."""
    space, rng, single = ParameterSpace([Parameter("a"), Parameter("b")]), np.random.default_rng(4), 0
    informations = [np.diag([1e4, 1e4])] * 2 + [np.diag([0.0, 1e4])] * 3
    for _ in range(300):
        found = disagreement(space, agreeing(informations, rng, shift=0.2))
        assert found is not None
        if found.parameters:
            assert found.parameters == ("a",)
            assert [log for log, _, _ in says(found)] == ["0", "1"]
            single += 1
    assert single >= 290  # 297 expected at the 1 % level, sd 1.7


def test_what_a_log_asks_for_beyond_a_bound_is_shown_there() -> None:
    """Three logs at the same bound would not seem to disagree."""
    space = ParameterSpace([Parameter("friction", 0.0, 2.0)])
    logs = [LogEstimate(str(k), np.array([mean]), np.array([[1e4]])) for k, mean in enumerate((0.05, -0.2, 0.05))]
    found = disagreement(space, logs)
    assert found is not None
    assert [value for _, value, _ in says(found)] == pytest.approx([0.1, -0.4, 0.1])
    assert "1 says -0.4" in found.text
    mass = disagreement(ParameterSpace([Parameter("mass", 0.1, 10.0, scale="log")]), logs)
    assert mass is not None
    wanted = [0.1 * 100**0.05, 0.1 * 100**-0.2, 0.1 * 100**0.05]
    assert [value for _, value, _ in says(mass)] == pytest.approx(wanted, rel=1e-3)  # to the digits that are told


def test_the_odd_log_is_named() -> None:
    """One of four differs: without it the others agree, at the 1 % level. Where two pairs differ nobody is odd."""
    space, rng = ParameterSpace([Parameter("a"), Parameter("b")]), np.random.default_rng(5)
    informations = [np.diag([1e4, 1e3])] * 4
    named = [
        found.text.partition("without ")[2][:1]
        for _ in range(200)
        if (found := disagreement(space, agreeing(informations, rng, 0.2))) is not None
    ]
    assert len(named) == 200
    assert named.count("0") >= 192  # 198 expected, sd 1.4
    pairs = [LogEstimate(str(k), np.array([0.4 + 0.2 * (k % 2), 0.5]), np.diag([1e4, 1e3])) for k in range(4)]
    found = disagreement(space, pairs)
    assert found is not None
    assert "without" not in found.text
    odd = disagreement(space, agreeing(informations, rng, 0.2))
    assert odd is not None
    assert "; without 0 the others agree (p = " in odd.text


def test_the_most_economical_parameter_is_named() -> None:
    """Both marginals shift when a alone differs and b is free to follow; a is the one that explains it."""
    space = ParameterSpace([Parameter("a", unit="kg"), Parameter("b")])
    information = np.array([[4000.0, 3000.0], [3000.0, 4000.0]])
    first = LogEstimate("one", np.array([0.40, 0.50]), information)
    second = LogEstimate("two", np.array([0.60, 0.50]), information)
    found = disagreement(space, [first, second])
    assert found is not None
    assert name_of(found) == "a"
    assert found.parameters == ("a",)
    assert "one says 0.4" in found.text
    assert "per_log = true" in found.text


@pytest.mark.parametrize(("second", "marked"), [(1.2, True), (1.01, False), (0.8, False)])
def test_a_log_that_asks_for_a_value_beyond_the_bounds_is_marked(second: float, marked: bool) -> None:
    space = ParameterSpace([Parameter("a", 0.0, 2.0, unit="kg"), Parameter("b")])
    estimates = [LogEstimate(name, np.array([a, 0.5]), 4000 * np.eye(2)) for name, a in (("x", 0.4), ("y", second))]
    found = disagreement(space, estimates)
    assert found is not None
    assert ("(beyond its bounds)" in found.text) == marked
    assert "x says 0.8 ± 0.032," in found.text


def test_two_differences_are_not_put_down_to_one_parameter() -> None:
    space = ParameterSpace([Parameter("a", unit="kg"), Parameter("b")])
    first = LogEstimate("one", np.array([0.40, 0.50]), 4000 * np.eye(2))
    second = LogEstimate("two", np.array([0.60, 0.70]), 4000 * np.eye(2))
    found = disagreement(space, [first, second])
    assert found is not None
    assert "no single parameter explains it" in found.text
    assert found.parameters == ()
    assert "says" not in found.text


def test_a_log_that_says_nothing_disagrees_with_nobody() -> None:
    space = ParameterSpace([Parameter("a"), Parameter("b")])
    silent = LogEstimate("silent", np.array([5.0, -3.0]), np.zeros((2, 2)))
    loud = LogEstimate("loud", np.array([0.5, 0.5]), 1e4 * np.eye(2))
    assert disagreement(space, [silent, loud]) is None


@pytest.mark.parametrize("beyond", [0.4, 1.0, 1.6, -0.5, 3.0])
def test_how_uncertain_a_log_is_beyond_a_bound_of_a_logarithmic_scale(beyond: float) -> None:
    """Half of the 68 % interval of draws of theta as values; what lies very far off is told where it is cut off."""
    parameter = Parameter("stiffness", low=1.0, high=1000.0, unit="N m/rad", scale="log")
    precise, rough = 1 / 0.02**2, 1 / 0.05**2
    logs = [LogEstimate("a", np.array([0.4]), np.array([[precise]]))]
    logs.append(LogEstimate("b", np.array([beyond]), np.array([[rough]])))
    logs.append(LogEstimate("c", np.array([0.9]), np.array([[precise]])))
    noticed = disagreement(ParameterSpace([parameter]), logs)
    assert noticed is not None
    drawn = np.clip(beyond, -1, 2) + 0.05 * np.random.default_rng(0).standard_normal(200_000)
    low, high = parameter.value(np.quantile(drawn, [0.1587, 0.8413]))
    name, value, sd = says(noticed)[1]
    assert name == "b"
    assert value == pytest.approx(parameter.value(float(np.clip(beyond, -1, 2))), rel=0.03)
    assert sd == pytest.approx((high - low) / 2, rel=0.05)  # the information has the uniform prior's beside it


def test_the_numbers_of_a_disagreement_differ_by_more_than_their_sds() -> None:
    """Two logs that know a combination of a and b well, neither alone: named is a, its sds with b in common."""
    space, information = ParameterSpace([Parameter("a"), Parameter("b")]), TURNED @ np.diag([1e8, 60.0]) @ TURNED.T
    logs = [LogEstimate(str(k), np.array([0.5, 0.5]) + 3e-3 * k * TURNED[:, 0], information) for k in range(2)]
    noticed = disagreement(space, logs)
    assert noticed is not None
    (_, one, sd), (_, other, _) = says(noticed)
    assert abs(one - other) > 5 * sd
