"""The engine against a plain mj_step loop, bit for bit, whatever the threads, the batch, the order or what
ran before."""

from __future__ import annotations

import math
import pickle
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import mujoco.rollout
import numpy as np
import pytest
from numpy.typing import NDArray

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.envs.channels import Channel
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.simulation.engine import Engine
from sipe_bayes.simulation.simulator import Memory, Simulator

FULL = mujoco.mjtState.mjSTATE_FULLPHYSICS
HORIZON = 24

PENDULUM = """<mujoco><option timestep="0.004"/><worldbody><body name="rod">
  <joint name="hinge" axis="0 1 0" damping="0.05" frictionloss="0.02"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.5" size=".02" mass="1"/></body></worldbody>
  <actuator><motor name="motor" joint="hinge"/></actuator></mujoco>"""
CART_POLE = """<mujoco><option timestep="0.004" integrator="implicitfast"/><worldbody><body name="cart">
  <joint name="slider" type="slide" axis="1 0 0" damping="0.1"/><geom type="box" size=".1 .1 .05" mass="1"/>
  <body name="pole" pos="0 0 .05"><joint name="hinge" axis="0 1 0"/>
  <inertial pos="0 0 .3" mass=".2" diaginertia=".006 .006 .003"/></body></body></worldbody>
  <actuator><motor name="motor" joint="slider" gear="3"/></actuator></mujoco>"""
ARM = """<mujoco><option timestep="0.004"/><worldbody><geom name="floor" type="plane" size="3 3 .1"/>
  <body name="upper" pos="0 0 .6"><joint name="shoulder" axis="0 1 0" damping="0.1"/>
    <geom type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass=".5"/>
    <body name="lower" pos=".3 0 0"><joint name="elbow" axis="0 1 0" damping="0.1"/>
      <geom type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass=".3"/>
      <site name="tip" pos=".3 0 0"/></body></body>
  <body name="box" pos=".3 0 .1"><freejoint/><geom name="box" type="box" size=".1 .1 .1" mass=".4"/></body>
  </worldbody>
  <actuator><motor name="m1" joint="shoulder"/><motor name="m2" joint="elbow"/></actuator>
  <sensor><accelerometer name="acc" site="tip"/><gyro name="gyro" site="tip"/>
    <framepos name="pos" objtype="body" objname="box"/><jointpos name="enc" joint="elbow"/></sensor>
  </mujoco>"""
SERVO = """<mujoco><option timestep="0.004"/><worldbody><body name="rod">
  <joint name="hinge" axis="0 1 0" armature=".01"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.5" size=".02" mass="1"/></body></worldbody>
  <actuator><general name="servo" joint="hinge" dyntype="filter" dynprm=".03" gainprm="20"
    biastype="affine" biasprm="0 -20 -1"/></actuator></mujoco>"""


@pytest.fixture(autouse=True)
def _folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The plain loops let MuJoCo write its log where they run."""
    monkeypatch.chdir(tmp_path)


@dataclass(frozen=True)
class Case:
    xml: str
    parameters: tuple[Parameter, ...]
    actuators: tuple[str, ...]
    measurements: tuple[str | Channel, ...]

    def environment(self) -> MjcfEnvironment:
        return MjcfEnvironment.build(self.xml, self.parameters, self.actuators, self.measurements)


def p(name: str, low: float, high: float, *targets: str, **more: Any) -> Parameter:
    return Parameter(name, low, high, targets=targets, **more)


HINGE = ("joint:hinge.position", "joint:hinge.velocity")
ARM_SENSORS = tuple(f"sensor:{s}[{i}]" for s in ("acc", "gyro", "pos") for i in range(3))
CASES = {
    "pendulum": Case(
        PENDULUM,
        (
            p("mass", 0.5, 2, "body:rod.mass", scale="log"),
            p("friction", 0, 0.1, "joint:hinge.frictionloss"),
            p("com", -0.4, -0.1, "body:rod.com_z"),
        ),
        ("motor",),
        HINGE,
    ),
    "cart-pole": Case(
        CART_POLE,
        (
            p("cart", 0.5, 2, "body:cart.mass"),
            p("inertia", 0.004, 0.008, "body:pole.inertia_yy"),
            p("tilt", -0.001, 0.001, "body:pole.inertia_xz"),
            p("gear", 1, 5, "actuator:motor.gear"),
        ),
        ("motor",),
        ("joint:slider.position", *HINGE),
    ),
    "arm": Case(
        ARM,
        (
            p("lower", 0.5, 2, "body:lower.mass", relative=True),
            p("slip", 0.2, 1.5, "geom:box.friction", "geom:floor.friction"),
            p("box", -0.05, 0.05, "body:box.com_x"),
            p("gravity", -12, -8, "option.gravity_z"),
        ),
        ("m1", "m2"),
        ("joint:shoulder.position", "joint:elbow.velocity", *ARM_SENSORS, "sensor:enc"),
    ),
    "servo": Case(
        SERVO,
        (
            p("kp", 5, 40, "actuator:servo.kp"),
            p("kv", 0, 2, "actuator:servo.kv"),
            p("d", 0, 1, "joint:hinge.damping"),
        ),
        ("servo",),
        HINGE,
    ),
    "delay": Case(
        PENDULUM,
        (p("delay", 0, 0.03, "actuator:motor.delay"), p("offset", -0.5, 0.5, "actuator:motor.offset")),
        ("motor",),
        HINGE,
    ),
}


def draw(case: Case, batch: int = 7, seed: int = 0) -> tuple[Simulator, Any, Any, Any]:
    """A simulator with one thread and random theta (B, N), actions (B, T, A) and starts (B, S)."""
    simulator, rng = Simulator(case.environment(), 1), np.random.default_rng(seed)
    model = simulator.model
    starts = np.tile(simulator.default_state(), (batch, 1))
    starts[:, 1 + model.nq : 1 + model.nq + model.nv] = rng.normal(0, 0.5, (batch, model.nv))
    actions = rng.normal(0, 1, (batch, HORIZON, len(case.actuators)))
    return simulator, rng.random((batch, len(case.parameters))), actions, starts


def plain(environment: MjcfEnvironment, theta: Any, actions: Any, start: Any, dt: float, skip: int) -> tuple[Any, int]:
    """States (T+1, S) of one lane by mj_step, and the first physics step that warned, from 1."""
    model = environment.compile()
    environment.write(model, environment.space.values(theta))
    mujoco.mj_setConst(model, mujoco.MjData(model))
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_WARMSTART
    model.opt.timestep, data = dt / skip, mujoco.MjData(model)
    mujoco.mj_setState(model, data, start, FULL)
    states, bad = [start], len(actions) * skip + 1
    for t, action in enumerate(np.repeat(actions, skip, axis=0)):
        data.ctrl[environment._controls] = action
        mujoco.mj_step(model, data)
        mujoco.mj_getState(model, data, state := np.empty_like(start), FULL)
        states.append(state)
        if data.warning.number.any():
            bad = t + 1
            break
    states += states[-1:] * (len(actions) * skip + 1 - len(states))
    return np.array(states)[::skip], bad


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
    monkeypatch.setattr("sipe_bayes.simulation.simulator.MEMORY", room)
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


# divergence


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


# delays


def delayed(delay: float, dt: float, skip: int) -> tuple[Simulator, Any, Any]:
    xml = PENDULUM.replace('timestep="0.004"', f'timestep="{dt / skip}"')
    environment = MjcfEnvironment.build(xml, [p("delay", 0, 0.05, "actuator:motor.delay")], ["motor"], HINGE)
    actions = np.random.default_rng(1).normal(size=(1, 60, 1))
    return Simulator(environment, 1), environment.space.normalise([[delay]]), actions


@pytest.mark.parametrize("samples", [0, 1, 2.5])
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


@pytest.mark.parametrize("part", [1e-6, 0.3, 1.0])
def test_a_delay_up_to_one_physics_step_is_one_physics_step(part: float) -> None:
    dt = 0.012
    simulator, theta, actions = delayed(part * dt, dt, 1)
    late = simulator.rollout(theta, actions, simulator.default_state(), dt)
    shifted = np.concatenate([np.zeros((1, 1, 1)), actions[:, :-1]], axis=1)
    plain_motor = simulator.rollout([[0.0]], shifted, simulator.default_state(), dt)
    np.testing.assert_allclose(late.observations, plain_motor.observations, atol=1e-12)


def test_a_delay_between_samples_is_interpolated() -> None:
    dt = 0.012
    simulator, theta, actions = delayed(1.25 * dt, dt, 1)
    late = simulator.rollout(theta, actions, simulator.default_state(), dt)
    padded = np.concatenate([np.zeros((1, 2, 1)), actions], axis=1)
    mixed = 0.75 * padded[:, 1:-1] + 0.25 * padded[:, :-2]
    plain_motor = simulator.rollout([[0.0]], mixed, simulator.default_state(), dt)
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
        ({"dt": np.full(3, 0.01)}, r"dt: expected one number or \(7,\), one for each lane, got shape \(3,\)"),
        ({"logs": ["a"]}, "logs: expected 7 names, one for each lane, got 1"),
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
