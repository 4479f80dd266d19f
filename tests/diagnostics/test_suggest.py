"""Suggested experiments tell more than random ones, in fits of their logs; candidates stay within limits and band."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from sipe_bayes.calibration.problem import prepare
from sipe_bayes.cli.app import app
from sipe_bayes.core.parameters import Parameter, ParameterSpace
from sipe_bayes.core.trajectory import Trajectory
from sipe_bayes.diagnostics.suggest import KINDS, Plan, generate, information, limits, rank
from sipe_bayes.diagnostics.suggest import contraction as expected
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.inference import get_estimator
from sipe_bayes.likelihood import Noise, Segments
from sipe_bayes.posterior import prior
from sipe_bayes.simulation.simulator import Simulator
from tests.problems.carts import GEARED
from tests.problems.pendulums import DT, log, pendulum

BOUNDS = np.array([[-1.0, 1.0]])
NOISE = Noise(np.array([0.01]), np.zeros(1))
SEGMENTS = Segments(0.5, noise="white")
TRUTH, ANGLE = np.array([0.6, 0.08]), "joint:hinge.position"


def contraction(simulator: Simulator, plan: Plan, seed: int) -> float:
    """Of a fit of a noisy log of the plan, mean over the parameters."""
    rng = np.random.default_rng(seed)
    motion = simulator.rollout(simulator.space.normalise(TRUTH), plan.actions, simulator.default_state(), dt=plan.dt)
    seen = motion.observations[0] + 0.01 * rng.standard_normal(motion.observations[0].shape)
    log = Trajectory(seen, plan.actions, plan.dt, name="log", channels=simulator.environment.channels)
    found = get_estimator(simulator, "laplace", likelihood=SEGMENTS, restarts=1, candidates=0).fit(log)
    return float((1 - found.stddev / prior(simulator.space).stddev).mean())


def test_the_suggested_experiment_beats_random_ones() -> None:
    """Contraction of actual fits, 8 plans.

    What is left of the sd after the first is less than 0.6 of the mean over all, less than after any but at most one,
    and the order is much that of the scores.
    """
    simulator = pendulum()
    plans = generate(8, 2.0, DT, BOUNDS, (0.5, 5.0), seed=1)
    ranked = rank(simulator, SEGMENTS, plans, NOISE, prior(simulator.space), draws=3)
    left = np.array([1 - contraction(simulator, one.plan, seed=5) for one in ranked])
    scores = np.array([one.score for one in ranked])
    order = np.corrcoef(np.argsort(np.argsort(-left)), np.argsort(np.argsort(scores)))[0, 1]
    print(left.round(4), scores.round(4), order)
    assert left[0] < 0.6 * left.mean()
    assert (left < left[0]).sum() <= 1
    assert order > 0.7


def test_what_is_expected_is_what_a_fit_finds() -> None:
    """The same experiment again takes sds to 1 / sqrt 2 of what the first left."""
    simulator = pendulum()
    recorded = log(simulator, TRUTH.tolist(), 3)
    posterior = get_estimator(simulator, "laplace", likelihood=SEGMENTS).fit(recorded)
    (found,) = rank(simulator, SEGMENTS, [Plan(recorded.actions, DT)], NOISE, posterior, draws=2)
    print(found.contraction)
    np.testing.assert_allclose(list(found.contraction.values()), 1 - np.sqrt(0.5), atol=0.03)


def test_a_plan_that_diverges_tells_nothing() -> None:
    simulator = pendulum()
    wild, still = Plan(np.full((100, 1), 1e9), DT, "wild"), Plan(np.zeros((100, 1)), DT, "still")
    found = {
        one.plan.name: one for one in rank(simulator, SEGMENTS, [wild, still], NOISE, prior(simulator.space), draws=2)
    }
    assert (found["wild"].diverged, found["wild"].score) == (2, 0.0)
    assert found["still"].diverged == 0


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
        at = np.full(len(simulator.space), 0.5)
        told = information(simulator, SEGMENTS, plan, NOISE, at)
        assert told is not None
        gains.append(expected(12 * np.eye(len(told)), [told]))
    without, own, logs = gains
    print(without, own, logs)
    np.testing.assert_allclose(logs[:2], own[:2], rtol=1e-4)
    np.testing.assert_allclose(logs[2:], 0, atol=1e-9)
    assert (without > own[:2] + 1e-6).any()


def test_what_takes_the_machine_far_beyond_its_logs_comes_last() -> None:
    """Whatever it tells: the small ones stay within what a small one reached, the large ones do not."""
    simulator = pendulum()
    plans = generate(12, 2.0, DT, BOUNDS, (0.5, 5.0), seed=1)
    known = simulator, SEGMENTS, plans, NOISE, prior(simulator.space)
    plain = rank(*known, draws=2)
    assert not any(one.strays for one in plain)
    near = np.array([min((one.reach[ANGLE] for one in plain), key=np.ptp)])
    ranked = rank(*known, reached=near, draws=2)
    strays = [bool(one.strays) for one in ranked]
    assert 0 < sum(strays) < len(strays)
    last = [one.strays or one.score < 0.5 * max(other.score for other in ranked) for one in ranked]
    assert [bool(x) for x in last] == sorted(bool(x) for x in last)
    assert not ranked[0].strays
    for one in ranked:
        beyond = max(near[0, 0] - one.reach[ANGLE][0], one.reach[ANGLE][1] - near[0, 1])
        assert (one.strays == (ANGLE,)) == (beyond > 0.5 * float(np.ptp(near, axis=1)[0]))


def test_a_narrow_band_holds_every_kind() -> None:
    """No multiple of 1 / duration lies in it."""
    for plan in generate(8, 5.0, 0.01, BOUNDS, (0.3, 0.35)):
        assert np.isfinite(plan.actions).all()
        assert np.ptp(plan.actions) > 0


def test_the_parameters_asked_for_decide() -> None:
    """The score is theirs alone."""
    simulator = pendulum()
    plans = generate(4, 2.0, DT, BOUNDS, (0.5, 5.0))
    found = rank(simulator, SEGMENTS, plans, NOISE, prior(simulator.space), ["damping"], draws=2)
    for one in found:
        assert one.score == pytest.approx(one.contraction["damping"])
    assert [one.score for one in found] == sorted((one.score for one in found), reverse=True)
    with pytest.raises(ValueError, match="no parameter 'mass'; there are rod_mass, damping"):
        rank(simulator, SEGMENTS, plans, NOISE, prior(simulator.space), ["mass"])


def test_candidates_keep_limits_band_and_rest() -> None:
    bounds = np.array([[-2.0, 1.0], [0.5, 3.0]])
    plans = generate(12, 4.0, 0.01, bounds, (0.5, 4.0), seed=3)
    assert {plan.name.split(",")[0] for plan in plans} == set(KINDS)
    for plan in plans:
        assert plan.actions.shape == (400, 2)
        assert (plan.actions >= bounds[:, 0] - 1e-12).all()
        assert (plan.actions <= bounds[:, 1] + 1e-12).all()
        np.testing.assert_allclose(plan.actions[[0, -1]], [[0.0, 0.5]] * 2, atol=1e-12)
        wave = plan.actions[20:-20, 0] - plan.actions[20:-20, 0].mean()
        power = np.abs(np.fft.rfft(wave)) ** 2
        inside = (np.fft.rfftfreq(len(wave), 0.01) > 0.2) & (np.fft.rfftfreq(len(wave), 0.01) < 6.0)
        assert power[inside].sum() > 0.9 * power.sum(), plan.name
    again = generate(12, 4.0, 0.01, bounds, (0.5, 4.0), seed=3)
    assert all(np.array_equal(a.actions, b.actions) for a, b in zip(plans, again, strict=True))


def test_limits_come_from_the_model_or_the_logs() -> None:
    simulator = pendulum()
    for nothing in (None, np.full((5, 1), 0.3)):
        with pytest.raises(ValueError, match="limits: the model states no control range"):
            limits(simulator, nothing)
    np.testing.assert_allclose(limits(simulator, np.array([[0.3], [-0.7]])), [[-0.7, 0.3]])
    np.testing.assert_allclose(limits(simulator, np.array([[0.0], [3.0]])), [[0.0, 3.0]])  # never the other way
    ranged = GEARED.replace('gear="3"', 'gear="3" ctrllimited="true" ctrlrange="-2 1"')
    parameters = [Parameter("gear", 1.0, 6.0, targets=("actuator:motor.gear",))]
    model = Simulator(MjcfEnvironment.build(ranged, parameters, ["motor"], ["joint:slide.position"]), num_threads=1)
    np.testing.assert_allclose(limits(model, np.array([[0.0], [3.0]])), [[-2, 1]])


def test_a_parameter_of_one_log_is_not_asked_for() -> None:
    zero = Parameter("zero[a]", -0.3, 0.3, targets=("sensor:joint:hinge.position.bias",), log="a")
    simulator = pendulum(zero)
    plans = generate(1, 2.0, DT, BOUNDS, (0.5, 5.0))
    with pytest.raises(ValueError, match=r"names: 'zero\[a\]' is of a log that is there already"):
        rank(simulator, SEGMENTS, plans, NOISE, prior(simulator.space), ["zero[a]"])
    (found,) = rank(simulator, SEGMENTS, plans, NOISE, prior(simulator.space), draws=2)
    *own, zero = found.contraction.values()
    assert found.score == pytest.approx(np.mean(own))
    assert zero == pytest.approx(0, abs=1e-9)


def test_a_posterior_with_other_bounds_is_refused(config: Path, tmp_path: Path) -> None:
    """It would be taken for other values."""
    space = prepare(config, 1).simulator.space
    other = ParameterSpace([replace(space[0], high=2 * space[0].high), *list(space)[1:]])
    prior(other).save(tmp_path / "posterior")
    result = call(config, "--posterior", tmp_path / "posterior")
    assert result.exit_code == 2
    assert "has mass from" in result.stderr
    assert "in the configuration; give that of a run of it" in result.stderr
    with pytest.raises(ValueError, match=r"prior: has mass from .* in the simulator; use the same bounds"):
        get_estimator(prepare(config, 1).simulator, "laplace", prior=prior(other))


def call(*arguments: object) -> Any:
    return CliRunner().invoke(app, ["suggest", *map(str, arguments)])


def test_the_command_writes_the_best_and_ranks_given_ones(config: Path, tmp_path: Path) -> None:
    still = pd.DataFrame({"time": np.arange(0, 2, 0.02), "force": 0.0})
    still.to_csv(tmp_path / "still.csv", index=False)
    arguments = ("--candidates", 4, "--duration", 2, "--given", tmp_path / "still.csv", "--threads", 1)
    result = call(config, *arguments, "--for", "mass", "--json", "--out", tmp_path / "best.csv")
    found = json.loads(result.stdout)
    assert len(found["candidates"]) == 5
    assert found["candidates"][-1]["name"].endswith("still.csv")  # a cart that is left alone tells nothing of its mass
    assert found["candidates"][-1]["score"] < 0.01 < found["candidates"][0]["score"]
    best = pd.read_csv(tmp_path / "best.csv")
    assert list(best) == ["time", "force"]
    assert len(best) == 100
    assert best["force"].abs().max() <= 3.0
    text = call(config, *arguments, "--out", tmp_path / "best.csv").stdout
    assert "expected contraction mass" in text
    assert "reaches place" in text


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--for", "weight"), "no parameter 'weight'; there are mass, damping"),
        (("--low", 9), "band: expected"),
        (("--candidates", 0), "--candidates: expected at least 1, or --given"),
        (("--duration", -1), "--duration: expected a positive number"),
    ],
)
def test_wrong_input_is_one_line(config: Path, arguments: tuple[object, ...], words: str) -> None:
    result = call(config, *arguments, "--json")
    assert result.exit_code == 2, result.output
    assert words in result.stderr
    assert result.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "given.csv: "),
        ("time,torque\n0,0\n1,0\n", "no column 'force'; it has ['time', 'torque']"),
        ("time,force\n0,0\n1,\n", "'force' holds what is no number"),
        ("time,force\n1,0\n0,0\n", "times that increase; sort the rows"),
        ("time,force\n0,0\n1,50\n", "makes motor go from 0 to 50, beyond its control range, -3 to 3"),
    ],
)
def test_given_commands_are_checked(config: Path, tmp_path: Path, text: str, words: str) -> None:
    model = config.parent / "cart.xml"
    model.write_text(model.read_text().replace('name="motor"', 'name="motor" ctrllimited="true" ctrlrange="-3 3"'))
    (tmp_path / "given.csv").write_text(text)
    result = call(config, "--given", tmp_path / "given.csv", "--out", tmp_path / "best.csv")
    assert result.exit_code == 2, result.output
    assert words in result.stderr
    assert result.stderr.count("\n") == 1
    assert not (tmp_path / "best.csv").exists()


def test_what_the_configuration_reads_is_not_written_over(config: Path) -> None:
    """Its own logs, its model, itself."""
    problem = prepare(config, 1)
    for path in (problem.config.logs[0].file, problem.config.model, config):
        before = Path(path).read_bytes()
        result = call(config, "--out", path)
        assert result.exit_code == 2
        assert f"--out {path}: is what {config} reads, and would be lost" in result.stderr
        assert Path(path).read_bytes() == before
