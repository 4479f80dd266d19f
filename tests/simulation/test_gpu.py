"""The engine of a GPU as MuJoCo in float64, or finding where it is not.

On a card where there is one, else on Warp's own processor device.
Warp compiles what the arm needs once, for 20 s on one core, and 1 to 5 s more for each task, and keeps it. Longer
rollouts of every task are in ``examples/studies/gpu_agreement.py``.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import sipe_bayes as sipe
from sipe_bayes.benchmark import bank
from sipe_bayes.benchmark.cells import Cell
from sipe_bayes.benchmark.executors.pool import Inline
from sipe_bayes.benchmark.records import Record
from sipe_bayes.benchmark.run import Order, run
from sipe_bayes.core.files import OutputError
from sipe_bayes.core.findings import Code
from sipe_bayes.envs.registry import TASKS
from sipe_bayes.inference.registry import get_estimator
from sipe_bayes.likelihood import Segments
from sipe_bayes.models.policy import load_policy
from sipe_bayes.rl.settings import Settings as Learning
from sipe_bayes.rl.train import train
from sipe_bayes.rl.trainer import Trainer
from sipe_bayes.simulation.audit import spread
from sipe_bayes.simulation.simulator import Simulator
from tests.problems.small_models import CASES, HINGE, PENDULUM, Case, draw, p

BOUND = 1e-4  # of what a channel varies by, over 8 steps of 4 ms; the largest of these is 1e-5
DEVICE = "cuda" if torch.cuda.is_available() else "warp:cpu"


@pytest.fixture(scope="module", autouse=True)
def _compiled_fast() -> Iterator[None]:
    warp = pytest.importorskip("warp")
    pytest.importorskip("mujoco_warp")
    before, warp.config.optimization_level = warp.config.optimization_level, 0
    yield
    warp.config.optimization_level = before


@pytest.fixture(scope="module")
def arm(_compiled_fast: None) -> Simulator:
    return Simulator(CASES["arm"].environment(), 1, DEVICE)


def drawn(batch: int) -> tuple[Simulator, Any, Any, Any]:
    """As ``draw``, of 8 control steps: launching kernels one by one takes 10 ms a step."""
    exact, theta, actions, starts = draw(CASES["arm"], batch)
    return exact, theta, actions[:, :8], starts


def error(single: Any, double: Any) -> Any:
    """(B, T+1, O), in what a channel varies by."""
    return np.abs(single.observations - double.observations) / spread(double.observations, double.valid)


def assert_same(one: Any, other: Any) -> None:
    """The same observations: bits on the processor; on a card, whose threads add in any order, all but rounding."""
    if DEVICE == "warp:cpu":
        np.testing.assert_array_equal(one, other)
    np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-5)


def test_it_is_mujoco_in_float32_and_the_same_twice(arm: Simulator) -> None:
    exact, theta, actions, starts = drawn(4)
    again = arm.rollout(theta, actions, starts)
    double, single = exact.rollout(theta, actions, starts), arm.rollout(theta, actions, starts)
    assert_same(single.observations, again.observations)
    assert single.valid.all()
    assert single.observations.dtype == single.states.dtype == np.float64
    np.testing.assert_allclose(single.states[..., 0], double.states[..., 0], rtol=1e-12)
    assert 0 < error(single, double).max() < BOUND


@pytest.mark.parametrize("name", [q.name for q in CASES["arm"].parameters])
def test_every_parameter_does_what_it_does_on_the_processor(arm: Simulator, name: str) -> None:
    exact, _, actions, starts = drawn(1)
    theta = np.full((2, len(arm.space)), 0.5)
    theta[:, arm.space.index(name)] = 0.1, 0.9
    if name == "slip":  # a box that slides
        starts[:, 1 + exact.model.nq + 2] = 2.0
    single, double = arm.rollout(theta, actions, starts), exact.rollout(theta, actions, starts)
    moved = [np.abs(np.diff(run.observations, axis=0)).max() for run in (single, double)]
    assert moved[1] > 1e-4
    assert moved[0] == pytest.approx(moved[1], rel=1e-2)


def test_batches_of_any_size_and_of_several_timesteps_are_as_alone(arm: Simulator) -> None:
    exact, theta, actions, starts = drawn(3)
    dt = np.array([0.004, 0.008, 0.005])
    whole = arm.rollout(theta, actions, starts, dt)
    assert error(whole, exact.rollout(theta, actions, starts, dt)).max() < BOUND
    alone = arm.rollout(theta[1], actions[1], starts[1], dt[1])
    assert_same(alone.observations[0], whole.observations[1])


def test_what_diverges_or_is_unphysical_is_flagged_and_touches_no_other(arm: Simulator) -> None:
    exact, theta, actions, starts = drawn(4)
    starts[1, 1 + exact.model.nq] = 3e9
    theta[2, 0] = -2.0  # a mass below zero
    single, double = (s.rollout(theta, actions, starts, allow_outside=True) for s in (arm, exact))
    np.testing.assert_array_equal(single.valid[[0, 2, 3]], double.valid[[0, 2, 3]])
    assert not single.valid[1, -1]
    assert not single.valid[2].any()
    assert np.isnan(single.observations[2]).all()
    alone = arm.rollout(theta[[0, 3]], actions[[0, 3]], starts[[0, 3]])
    assert_same(single.observations[[0, 3]], alone.observations)


def test_more_contacts_than_there_is_room_for(arm: Simulator, monkeypatch: pytest.MonkeyPatch) -> None:
    _, theta, actions, starts = drawn(2)
    whole = arm.rollout(theta, actions, starts)
    small = Simulator(arm.environment, 1, DEVICE)
    small.runs.capacity = small.runs.capacity._replace(contacts=1)  # type: ignore[attr-defined]
    monkeypatch.setattr("sipe_bayes.simulation.gpu.engine._LARGEST", 1)
    assert not small.rollout(theta, actions, starts).valid[:, -1].any()
    assert small.diverged == 2
    monkeypatch.undo()
    assert_same(small.rollout(theta, actions, starts).observations, whole.observations)
    assert small.runs.capacity.contacts > 1  # type: ignore[attr-defined]


def test_bodies_that_a_constraint_joins() -> None:
    """For such constraints mujoco-warp takes the velocities of the step before, unless it gets those of the state."""
    simulator = Simulator(Case(JOINED, LIGHT, ("motor",), HINGE).environment(), 1, DEVICE)
    start = simulator.default_state()
    start[3:] = 4.0, 4.0
    theta, actions = np.array([[0.2], [0.8]]), np.full((1, 4, 1), 0.3)
    single, again, double = (s.rollout(theta, actions, start) for s in (simulator, simulator, simulator.on_processor))
    assert_same(single.states, again.states)
    assert error(single, double).max() < BOUND


def test_an_estimator_takes_either_engine_and_says_how_far_they_agree(arm: Simulator) -> None:
    exact, _, actions, starts = drawn(1)
    log = exact.rollout(np.full((1, 4), 0.4), actions, starts)
    means = []
    for simulator in (exact, arm):
        estimator = get_estimator(simulator, "cem", budget=64, seed=1, likelihood=Segments(None, starts="recorded"))
        means.append(estimator.fit(log).mean.numpy())
    np.testing.assert_allclose(means[1], means[0], atol=1e-2)
    (finding,) = estimator.findings.of(Code.FLOAT32_AGREES, Code.FLOAT32_DIFFERS)
    assert finding.code is Code.FLOAT32_AGREES


def test_the_benchmark_simulates_on_the_device_and_tells_its_records_apart(tmp_path: Path) -> None:
    order = Order(tmp_path, Inline, report=lambda _: None)
    cell = Cell("Pendulum", "regression", budget=60, steps=5, device=DEVICE)
    assert (
        run(
            [cell],
            order,
        )
        == 0
    )
    which = bank.Bank("Pendulum", "in_distribution", 0, 5, DEVICE)
    assert bank.verify(which, 60, tmp_path) == []
    assert bank.shards(which, 60, bank.known_place(which, tmp_path)) == []
    assert bank.known_place(replace(which, device="cpu"), tmp_path) is None
    (record,) = Record.every(tmp_path)
    assert (record.status, record.device) == ("done", DEVICE)
    with pytest.raises(OutputError, match=f"with device {DEVICE} and not cpu"):
        run([replace(cell, device="cpu")], order)


def test_what_differentiates_stays_in_float64(arm: Simulator) -> None:
    exact, _, actions, starts = drawn(1)
    log = exact.rollout(np.full((1, 4), 0.4), actions, starts)
    fits = [get_estimator(s, "laplace", budget=300, likelihood=Segments(None, starts="recorded")) for s in (exact, arm)]
    alone, on_gpu = (fit.fit(log).mean.numpy() for fit in fits)
    np.testing.assert_array_equal(alone, on_gpu)
    assert Code.ON_PROCESSOR in fits[1].findings
    assert Code.ON_PROCESSOR not in fits[0].findings


JOINED = """<mujoco><option timestep="0.004"/><worldbody>
  <body name="left"><joint name="hinge" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -.5" size=".02" mass="1"/>
  </body><body name="right" pos=".2 0 0"><joint name="other" axis="0 1 0"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.5" size=".02" mass="1"/></body></worldbody>
  <equality><connect body1="left" body2="right" anchor="0 0 -.4"/></equality>
  <actuator><motor name="motor" joint="hinge"/></actuator></mujoco>"""
LIGHT = (p("mass", 0.5, 2, "body:left.mass"),)
PID = PENDULUM.replace("<motor", "<pid input='pos' kp='3' kv='1'")
SOLVER = PENDULUM.replace("<option", '<option solver="PGS"')
LAW = Case(PENDULUM, (p("stribeck", 0, 1, "joint:hinge.stribeck"),), ("motor",), HINGE)


@pytest.mark.parametrize(
    ("case", "what"),
    [
        (Case(PID, (p("m", 0.5, 2, "body:rod.mass"),), ("motor",), HINGE), "pid actuators, and 'motor' is one"),
        (Case(SOLVER, (p("m", 0.5, 2, "body:rod.mass"),), ("motor",), HINGE), "PGS"),
        (Case(JOINED.replace("<option", '<option integrator="RK4"'), LIGHT, ("motor",), HINGE), "Runge-Kutta"),
    ],
)
def test_what_it_can_not_simulate_is_refused_by_name(case: Case, what: str) -> None:
    with pytest.raises(ValueError, match=f"^device: .*{what}.*leave device out"):
        Simulator(case.environment(), 1, DEVICE)


@pytest.mark.parametrize("device", ["tpu", "cuda:x", "warp:cuda", 3])
def test_no_such_device(device: Any) -> None:
    with pytest.raises(ValueError, match="device: expected 'cpu', 'cuda'"):
        Simulator(CASES["pendulum"].environment(), 1, device)


COMPILED_FOR_LONG = ("Door", "Relocate", "HumanoidLinks", "HumanoidJoints")  # in examples/studies/gpu_agreement.py


@pytest.mark.parametrize("name", [task for task in TASKS if task not in COMPILED_FOR_LONG])
def test_every_task_agrees_or_is_refused_by_name(name: str) -> None:
    """The middle of the unit cube, and every parameter by itself at 0.9; three control steps."""
    task = sipe.make_task(name)
    if name.startswith("Fetch"):
        with pytest.raises(ValueError, match=f"control of {name} has a memory"):
            Simulator(task, 1, DEVICE)
        return
    simulator, rng, size = Simulator(task, 1, DEVICE), np.random.default_rng(0), len(task.space)
    theta = np.full((1 + size, size), 0.5)
    theta[1 + np.arange(size), np.arange(size)] = 0.9
    actions = rng.uniform(task.action_low, task.action_high, (1, 3, task.num_actions))
    starts, goals = task.initial_states(rng, 1)
    single, again, double = (
        s.rollout(theta, actions, starts, goals=goals) for s in (simulator, simulator, simulator.on_processor)
    )
    assert_same(single.observations, again.observations)
    assert single.valid.all()
    assert error(single, double).max() < 1e-3
    moves = [run.observations[1:] - run.observations[:1] for run in (single, double)]
    assert np.abs(moves[0] - moves[1]).max() < 1e-2 * np.abs(moves[1]).max()


def test_closed_loop_is_the_processors_and_its_own_open_loop() -> None:
    """With theta that change on the way, and rollouts in between."""
    task = sipe.make_task("Pendulum")
    simulator, rng = Simulator(task, 1, DEVICE), np.random.default_rng(0)
    theta, actions = rng.random((3, len(task.space))), rng.uniform(-2, 2, (6, 3, 1))
    ends = []
    for engine in (simulator, simulator.on_processor, simulator):
        seen = [engine.reset(theta, seed=4).observations]
        episodes = engine.episodes
        assert episodes is not None
        start = episodes.states.copy()
        for t in range(6):
            step = engine.step(actions[t])
            seen.append(step.observations)
            if t == 2:
                whole = engine.rollout(theta, actions[:3].swapaxes(0, 1), start)
                np.testing.assert_array_equal(whole.observations[:, -1], step.observations)
                episodes.set_theta(np.array([1]), 1 - theta[1])
        assert step.valid.all()
        ends.append((np.stack(seen), step.rewards))
    np.testing.assert_array_equal(ends[0][0], ends[2][0])
    np.testing.assert_allclose(ends[0][0], ends[1][0], atol=1e-5)
    np.testing.assert_allclose(ends[0][1], ends[1][1], atol=1e-4)
    with pytest.raises(ValueError, match="theta: "):
        episodes.set_theta(np.array([0]), np.full(len(task.space), -5.0))


def test_an_agent_learns_from_worlds_of_the_device(tmp_path: Path) -> None:
    settings = Learning(hidden=(8, 8), batch=16, start_steps=32, lanes=16, updates_per_step=0.25, normalise=True)
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    pace = {"evaluate_every": 96, "evaluation_episodes": 1, "checkpoint_every": 96, "device": DEVICE}
    train("Pendulum", 192, 0, whole, settings, **pace)
    train("Pendulum", 96, 0, parts, settings, **pace)
    train("Pendulum", 192, 0, parts, settings, resume=True, **pace)
    weights = [load_policy(folder / "policies" / "192.safetensors", "Pendulum").layers for folder in (whole, parts)]
    for one, other in zip(*weights, strict=True):
        np.testing.assert_array_equal(one[0], other[0])
    with pytest.raises(ValueError, match="another run"):
        train("Pendulum", 192, 0, parts, settings, resume=True, **{**pace, "device": "cpu"})
    with pytest.raises(ValueError, match="FetchPush has a memory"):
        Trainer(sipe.make_task("FetchPush"), settings, device=DEVICE)


def test_nothing_of_warp_is_imported_on_the_processor() -> None:
    code = "import sys, sipe_bayes as s; s.Simulator(s.make_task('Pendulum')); assert 'warp' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
