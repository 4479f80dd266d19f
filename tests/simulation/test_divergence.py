"""Simulations that diverge are flagged, touch no other, and are counted; unphysical ones are never simulated."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.simulation.engine import Engine
from sipe_bayes.simulation.simulator import Simulator
from tests.problems.small_models import CASES, HINGE, HORIZON, PENDULUM, draw, p, plain


@pytest.fixture(autouse=True)
def _folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The plain loops let MuJoCo write its log where they run."""
    monkeypatch.chdir(tmp_path)


def divergent(case: str) -> tuple[Simulator, Any, Any, Any]:
    """Seven lanes; 2 and 5 diverge, at different times and for different reasons."""
    simulator, theta, actions, starts = draw(CASES[case])
    velocity = 1 + simulator.model.nq
    starts[2, velocity] = 1e11  # refused by the first step
    starts[5, velocity] = 3e9 if case != "servo" else 0.0
    if case == "servo":
        theta[5] = 1e9, 0, 0  # unstable: grows until the acceleration is refused
    return simulator, theta, actions, starts


@pytest.mark.parametrize("case", ["pendulum", "cart-pole", "arm", "servo", "delay"])
@pytest.mark.parametrize("skip", [1, 3])
def test_divergence_is_flagged_and_touches_no_other_lane(
    case: str, skip: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    simulator, theta, actions, starts = divergent(case)
    dt = skip * simulator.model.opt.timestep
    sound = np.array([0, 1, 3, 4, 6])
    alone = simulator.rollout(theta[sound], actions[sound], starts[sound], dt)
    for threads in (1, 2):
        engine = Simulator(simulator.environment, threads)
        result = engine.rollout(theta, actions, starts, dt, allow_outside=True)
        np.testing.assert_array_equal(result.states[sound], alone.states)
        np.testing.assert_array_equal(result.observations[sound], alone.observations)
        assert result.valid[sound].all()
        assert engine.diverged == (~result.valid[:, -1]).sum()
    assert not list(tmp_path.iterdir()), "MuJoCo wrote its log"
    assert capfd.readouterr() == ("", ""), "MuJoCo wrote to the terminal"
    for lane in (2, 5):
        states, bad = plain(simulator.environment, theta[lane], actions[lane], starts[lane], dt, skip)
        first = math.ceil(bad / skip)
        if simulator.environment.needs_derived and bad % skip == 1 % skip:
            first -= 1  # the sensors of the sample before come from the step that failed
        if lane == 2:
            first = 0  # the start itself is what MuJoCo takes for diverged
        assert result.valid[lane].tolist() == [t < first for t in range(HORIZON + 1)]
        np.testing.assert_array_equal(result.states[lane, :first], states[:first])


@pytest.mark.parametrize("horizon", [1, 2, 5])
@pytest.mark.parametrize("time", [0.0, 1.0])
def test_a_first_step_that_fails_is_flagged(horizon: int, time: float) -> None:
    """From time 0 MuJoCo's reset ends on the expected time: the state alone does not tell."""
    simulator, theta, actions, starts = draw(CASES["servo"], batch=3)
    starts[:, 0] = time
    starts[1, 1] = 9e9  # a spring of 1e9 N m/rad: the acceleration is refused
    theta[1] = 1e9, 0, 0
    result = simulator.rollout(theta, actions[:, :horizon], starts, allow_outside=True)
    assert result.valid[1].tolist() == [True] + [False] * horizon
    assert result.valid[[0, 2]].all()


@pytest.mark.parametrize("horizon", [1, 2, 5])
def test_a_warning_without_a_reset_is_flagged(horizon: int) -> None:
    """A body without mass: MuJoCo warns of a singular inertia, steps once and repeats that state."""
    environment = MjcfEnvironment.build(PENDULUM, [p("m", 0, 2, "body:rod.mass")], ["motor"], HINGE)
    simulator, actions = Simulator(environment, 1), np.ones((1, horizon, 1))
    start = simulator.default_state()
    result = simulator.rollout([[0.0], [0.5]], actions, start)
    assert plain(environment, np.zeros(1), actions[0], start, 0.004, 1)[1] == 1
    assert result.valid.tolist() == [[True] + [False] * horizon, [True] * (horizon + 1)]


@pytest.mark.parametrize(
    ("parameter", "theta"),
    [
        (p("m", 0.5, 2, "body:rod.mass"), -1.0),
        (p("d", 0.0, 2, "joint:hinge.damping"), -0.1),
        (p("i", 0.001, 0.05, "body:rod.inertia_yy"), 1.0),
        (p("i", 0.0001, 0.05, "body:rod.inertia_zz"), -1.0),
        (p("i", 0.0, 1.0, "body:rod.inertia_xz"), 0.9),
    ],
)
def test_unphysical_parameters_are_never_simulated(
    parameter: Parameter, theta: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    lanes = []
    real: Callable[..., Any] = Engine._native

    def counted(engine: Engine, models: Any, *args: Any) -> Any:
        lanes.append(len(models))
        return real(engine, models, *args)

    monkeypatch.setattr(Engine, "_native", counted)
    environment = MjcfEnvironment.build(PENDULUM, [parameter], ["motor"], HINGE)
    simulator, actions = Simulator(environment, 1), np.zeros((1, 3, 1))
    default = float(environment.space.default_theta[0])
    thetas = [[default], [theta], [default]]
    result = simulator.rollout(thetas, actions, simulator.default_state(), allow_outside=True)
    assert result.valid.all(1).tolist() == [True, False, True]
    assert not result.valid[1].any()
    assert np.isnan(result.states[1]).all()
    assert lanes == [2]
    assert simulator.diverged == 1
    assert not simulator.rollout([[theta]], actions, simulator.default_state(), allow_outside=True).valid.any()
    assert lanes == [2]


def test_a_start_that_is_not_finite_is_never_simulated() -> None:
    simulator, theta, actions, starts = draw(CASES["pendulum"])
    starts[3, 1] = np.nan
    result = simulator.rollout(theta, actions, starts)
    assert not result.valid[3].any()
    assert result.valid[[0, 1, 2, 4, 5, 6]].all()
    assert np.isnan(result.observations[3]).all()
