"""The engine against a plain mj_step loop, bit for bit, whatever the threads, batch, order or what ran before."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import mujoco
import mujoco.rollout
import numpy as np
import pytest
from numpy.typing import NDArray

from sipe_bayes.envs.channels import Channel
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.simulation.device import Memory
from sipe_bayes.simulation.simulator import Simulator
from tests.problems.small_models import ARM, CASES, FULL, HINGE, HORIZON, PENDULUM, draw, p, plain


@pytest.fixture(autouse=True)
def _folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The plain loops let MuJoCo write its log where they run."""
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("skip", [1, 3])
def test_bits_are_those_of_a_plain_loop(name: str, skip: int) -> None:
    simulator, theta, actions, starts = draw(CASES[name])
    dt = skip * simulator.model.opt.timestep
    result = simulator.rollout(theta, actions, starts, dt)
    assert result.valid.all()
    expected = [plain(simulator.environment, *lane, dt, skip)[0] for lane in zip(theta, actions, starts, strict=True)]
    np.testing.assert_array_equal(result.states, expected)


@pytest.mark.parametrize("name", CASES)
def test_bits_do_not_depend_on_threads_batch_order_or_earlier_use(name: str) -> None:
    simulator, theta, actions, starts = draw(CASES[name])
    dt = 2.5 * simulator.model.opt.timestep
    whole = simulator.rollout(theta, actions, starts, dt)
    assert whole.valid.all()
    wild = starts + np.where(np.arange(starts.shape[1]) > simulator.model.nq, 1e9, 0)
    threaded = Simulator(simulator.environment, 2)
    for lanes in (np.arange(7), np.array([3]), np.array([6, 0, 5, 2]), np.array([1, 1, 1, 4])):
        for engine in (threaded, simulator):
            engine.rollout(1 - theta[::2], actions[::2], wild[::2], dt)
            again = engine.rollout(theta[lanes], actions[lanes], starts[lanes], dt)
            np.testing.assert_array_equal(again.states, whole.states[lanes])
            np.testing.assert_array_equal(again.observations, whole.observations[lanes])


@pytest.mark.parametrize("name", CASES)
def test_one_step_windows_make_the_whole_horizon(name: str) -> None:
    simulator, theta, actions, starts = draw(CASES[name], batch=2)
    whole = simulator.rollout(theta, actions, starts)
    for lane in range(2):
        cut = simulator.rollout(theta[lane], actions[lane][:, None], whole.states[lane, :-1])
        np.testing.assert_array_equal(cut.states[:, 1], whole.states[lane, 1:])
        np.testing.assert_array_equal(cut.observations[:, 0], whole.observations[lane, :-1])
        assert cut.valid.all()


def test_many_chunks_are_one_batch(monkeypatch: pytest.MonkeyPatch) -> None:
    simulator, theta, actions, starts = draw(CASES["arm"])
    whole = simulator.rollout(theta, actions, starts)
    room = Memory(model_bytes=3 * mujoco.mj_sizeModel(simulator.model))
    monkeypatch.setattr("sipe_bayes.simulation.device.MEMORY", room)
    small = Simulator(simulator.environment, 1)
    cut = small.rollout(theta, actions, starts)
    np.testing.assert_array_equal(cut.observations, whole.observations)
    assert len(small.pool.slots) == 3


def test_single_rows_stand_for_all_lanes() -> None:
    simulator, theta, actions, starts = draw(CASES["pendulum"])
    result = simulator.rollout(theta[0], actions, starts[0])
    for lane in range(len(actions)):
        alone = simulator.rollout(theta[0], actions[lane], starts[0])
        np.testing.assert_array_equal(result.states[lane], alone.states[0])


def test_environment_survives_pickling() -> None:
    simulator, theta, actions, starts = draw(CASES["arm"])
    other = Simulator(pickle.loads(pickle.dumps(simulator.environment)), 1)  # noqa: S301
    expected = simulator.rollout(theta, actions, starts)
    np.testing.assert_array_equal(other.rollout(theta, actions, starts).observations, expected.observations)


# delays


def delayed(delay: float, dt: float, skip: int) -> tuple[Simulator, Any, Any]:
    xml = PENDULUM.replace('timestep="0.004"', f'timestep="{dt / skip}"')
    environment = MjcfEnvironment.build(xml, [p("delay", 0, 0.05, "actuator:motor.delay")], ["motor"], HINGE)
    actions = np.random.default_rng(1).normal(size=(1, 60, 1))
    return Simulator(environment, 1), environment.space.normalise([[delay]]), actions


@pytest.mark.parametrize("samples", [0, 0.1, 0.3, 1, 2.5])
@pytest.mark.parametrize("skip", [1, 3])
def test_history_of_earlier_commands_continues_a_simulation(samples: float, skip: int) -> None:
    dt = 0.012
    simulator, theta, actions = delayed(samples * dt, dt, skip)
    model, cut = simulator.model, 23
    full = simulator.rollout(theta, actions, simulator.default_state(), dt)
    start = full.states[:, cut].copy()
    start[:, 0] = 0.0  # windows start their clock anew
    start[:, 1 + model.nq + model.nv + model.na :] = 1e3  # history does not leak through
    before = np.repeat(actions[0, :cut], skip, axis=0)
    start = simulator.environment.history(model, start, [before], np.array([dt / skip]))
    tail = simulator.rollout(theta, actions[:, cut:], start, dt)
    np.testing.assert_allclose(tail.observations, full.observations[:, cut:], rtol=1e-12, atol=1e-12)
    assert np.ptp(full.observations[:, cut:]) > 0.01


def test_short_histories_hold_the_first_command() -> None:
    simulator, theta, _ = delayed(0.03, 0.012, 3)
    model, timestep = simulator.model, np.array([0.004])
    starts = np.tile(simulator.default_state(), (2, 1))
    few = [np.full((2, 1), 0.7), np.full((40, 1), 0.7)]
    filled = simulator.environment.history(model, starts, few, np.repeat(timestep, 2))
    np.testing.assert_array_equal(filled[0], filled[1])
    assert (starts == simulator.default_state()).all(), "the caller's states stay as they are"
    held = simulator.rollout(theta, np.full((1, 9, 1), 0.7), filled[:1], 0.012)
    none = simulator.rollout([[0.0]], np.full((1, 9, 1), 0.7), filled[:1], 0.012)
    np.testing.assert_allclose(held.observations, none.observations, atol=1e-12)


@pytest.mark.parametrize("part", [1e-6, 0.3, 0.999, 1.0, 1.25])
def test_a_delay_between_physics_steps_is_interpolated(part: float) -> None:
    dt = 0.012
    simulator, theta, actions = delayed(part * dt, dt, 1)
    late = simulator.rollout(theta, actions, simulator.default_state(), dt)
    whole, share = int(part), part % 1.0
    padded = np.concatenate([np.zeros((1, 2, 1)), actions], axis=1)
    newer, older = padded[:, 2 - whole : 62 - whole], padded[:, 1 - whole : 61 - whole]
    plain_motor = simulator.rollout([[0.0]], newer + share * (older - newer), simulator.default_state(), dt)
    np.testing.assert_allclose(late.observations, plain_motor.observations, atol=1e-12)


# sensors, logs, biases


def test_sensors_belong_to_the_state_they_are_returned_with() -> None:
    case = CASES["arm"]
    simulator, theta, actions, starts = draw(case, batch=2)
    environment, dt = simulator.environment, 3 * simulator.model.opt.timestep
    result = simulator.rollout(theta, actions, starts, dt)
    for lane in range(2):
        model = environment.compile()
        environment.write(model, environment.space.values(theta[lane]))
        mujoco.mj_setConst(model, mujoco.MjData(model))
        data = mujoco.MjData(model)
        for t in range(HORIZON + 1):
            mujoco.mj_setState(model, data, result.states[lane, t], FULL)
            data.ctrl[:] = actions[lane, min(t, HORIZON - 1)]
            mujoco.mj_forward(model, data)
            sensors = data.sensordata
            expected = [data.joint("shoulder").qpos[0], data.joint("elbow").qvel[0], *sensors]
            np.testing.assert_allclose(result.observations[lane, t], expected, rtol=1e-9, atol=1e-9)


def test_logs_with_different_rates_share_a_batch() -> None:
    simulator, theta, actions, starts = draw(CASES["arm"])
    dt = simulator.model.opt.timestep * np.array([1.0, 2.0, 2.5, 0.3, 2.0, 1.0, 7.2])
    result = simulator.rollout(theta, actions, starts, dt)
    np.testing.assert_array_equal(result.dt, dt)
    for lane in range(len(dt)):
        alone = simulator.rollout(theta[lane], actions[lane], starts[lane], dt[lane])
        np.testing.assert_array_equal(alone.observations[0], result.observations[lane])
        np.testing.assert_allclose(result.states[lane, :, 0], np.arange(HORIZON + 1) * dt[lane], atol=1e-12)
    assert result.valid.all()


def test_parameters_and_biases_of_each_log() -> None:
    parameters = [
        p("mass", 0.5, 2, "body:rod.mass"),
        p("offset a", -1, 1, "actuator:motor.offset", "sensor:joint:hinge.position.bias", log="a"),
        p("offset b", -1, 1, "actuator:motor.offset", "sensor:joint:hinge.position.bias", log="b"),
    ]
    channels = [
        Channel("joint:hinge.position", "joint:hinge.position"),
        Channel("joint:hinge.velocity", "speed"),
    ]
    simulator = Simulator(MjcfEnvironment.build(PENDULUM, parameters, ["motor"], channels), 1)
    theta, actions = np.array([0.3, 0.2, 0.9]), np.random.default_rng(0).normal(size=(1, 20, 1))
    values = simulator.space.values(theta)
    result = simulator.rollout(
        theta, np.tile(actions, (4, 1, 1)), simulator.default_state(), logs=["a", "b", "c", None]
    )
    common = [p("mass", 0.5, 2, "body:rod.mass"), p("offset", -1, 1, "actuator:motor.offset")]
    plain_one = Simulator(MjcfEnvironment.build(PENDULUM, common, ["motor"], HINGE), 1)
    offsets = [values[1], values[2], values[1:].mean(), values[1:].mean()]
    for lane, offset in enumerate(offsets):
        expected = plain_one.rollout([0.3, (offset + 1) / 2], actions, plain_one.default_state()).observations[0]
        np.testing.assert_allclose(result.observations[lane], expected + np.array([offset, 0]), atol=1e-12)


def test_a_sensor_bias_shifts_its_channels_alone() -> None:
    parameters = [p("b", -1, 1, "sensor:acc.bias"), p("e", -1, 1, "sensor:elbow angle.bias")]
    channels: list[str | Channel] = [
        "sensor:acc[2]",
        "sensor:gyro[1]",
        Channel("joint:elbow.position", "elbow angle"),
    ]
    simulator = Simulator(MjcfEnvironment.build(ARM, parameters, ["m1", "m2"], channels), 1)
    actions = np.random.default_rng(0).normal(size=(1, 5, 2))
    result = simulator.rollout([[0.5, 0.5], [0.7, 0.0]], actions, simulator.default_state())
    shift = result.observations[1] - result.observations[0]
    np.testing.assert_allclose(shift, np.tile([0.4, 0.0, -1.0], (6, 1)), atol=1e-12)
    assert simulator.space.units == ("m/s^2", "rad")


def test_counts() -> None:
    simulator, theta, actions, starts = draw(CASES["pendulum"])
    simulator.rollout(theta, actions, starts)
    simulator.rollout(theta[:2], actions[:2, :3], starts[:2])
    assert simulator.control_steps == 7 * HORIZON + 6
    assert simulator.diverged == 0


@pytest.mark.parametrize(
    ("dt", "steps"), [(0.004, 1), (0.0040001, 1), (0.0041, 2), (0.012, 3), (0.001, 1), (0.0121, 4)]
)
def test_physics_steps_are_never_longer_than_the_models(dt: float, steps: int) -> None:
    simulator = Simulator(CASES["pendulum"].environment(), 1)
    count, timestep = simulator.physics_steps(dt)
    assert count == steps
    assert count * timestep == pytest.approx(dt, rel=1e-14)
    assert timestep <= 0.004 * 1.002


def call(**changes: Any) -> Any:
    simulator, theta, actions, starts = draw(CASES["pendulum"])
    arguments = {"theta": theta, "actions": actions, "initial_state": starts, **changes}
    return simulator.rollout(**arguments)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"theta": np.zeros((7, 2))}, r"theta: expected 3 parameters, shape \(3,\), got \(7, 2\)"),
        ({"theta": 0.5}, "expected 3 parameters"),
        (
            {"theta": np.full((7, 3), 1.2)},
            r"values in \[0, 1\], got 1.2 to 1.2; clip them, or pass allow_outside=True",
        ),
        ({"theta": np.full((7, 3), np.nan), "allow_outside": True}, "theta: expected finite numbers"),
        ({"actions": np.zeros((7, 4, 2))}, r"actions: expected \(B, T, 1\), got \(7, 4, 2\)"),
        ({"actions": np.zeros(7)}, r"actions: expected \(B, T, 1\)"),
        ({"actions": np.zeros((7, 0, 1))}, "actions: expected at least one control step"),
        ({"actions": np.full((7, 4, 1), np.nan)}, "actions: expected finite numbers"),
        ({"actions": np.full((7, 4, 1), 1e11)}, "actions: expected finite numbers up to 1e10"),
        ({"initial_state": np.zeros((7, 4))}, r"initial_state: expected \(B, 3\), got \(7, 4\)"),
        ({"initial_state": np.zeros((3, 3))}, "batch sizes differ: theta 7, actions 7, initial_state 3"),
        ({"dt": 0.0}, "dt: expected seconds above zero, got 0"),
        ({"dt": np.nan}, "dt: expected seconds above zero, got nan"),
        ({"dt": np.full(3, 0.01)}, r"dt: expected one number or \(7,\), one for each simulation, got shape \(3,\)"),
        ({"logs": ["a"]}, "logs: expected 7 names, one for each simulation, got 1"),
    ],
)
def test_wrong_input_is_named(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        call(**changes)


def test_wrong_number_of_threads() -> None:
    with pytest.raises(ValueError, match="num_threads: expected at least 1, got 0"):
        Simulator(CASES["pendulum"].environment(), 0)


def test_theta_outside_the_cube_on_request() -> None:
    assert call(theta=np.full((7, 3), 1.2), allow_outside=True).valid.all()


def test_results_are_not_views_of_the_input() -> None:
    simulator, theta, actions, starts = draw(CASES["pendulum"])
    kept: NDArray[np.float64] = starts.copy()
    simulator.rollout(theta, actions, starts).states[:] = 0
    np.testing.assert_array_equal(starts, kept)
