"""The user's own MJCF: what it measures and drives, which parameters write what, and what may be wrong."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.envs.channels import Channel
from sipe_bayes.envs.foreign.load import ModelError
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.envs.target import TargetError
from sipe_bayes.simulation.simulator import Simulator

XML = """<mujoco><worldbody>
  <body name="rod"><joint name="hinge" axis="0 1 0" damping="0.1"/>
    <geom name="rod" type="capsule" fromto="0 0 0 0 0 -.5" size=".02" mass="1"/>
    <site name="tip" pos="0 0 -.5"/>
    <body name="bob" pos="0 0 -.5"><joint name="slide" type="slide" axis="0 0 1"/>
      <geom size=".05" mass=".5"/></body>
  </body>
  <body name="ball" pos="1 0 0"><freejoint name="free"/><geom size=".1" mass="2"/></body></worldbody>
  <actuator><motor name="motor" joint="hinge"/><position name="servo" joint="slide" kp="10"/></actuator>
  <sensor><jointpos name="encoder" joint="hinge"/><accelerometer name="acc" site="tip"/>
    <jointvel name="tacho" joint="slide"/><gyro name="gyro" site="tip"/><framepos name="place" objtype="site"
    objname="tip"/><jointpos name="slow" joint="hinge" nsample="3" delay=".004"/></sensor></mujoco>"""


def p(name: str, low: float, high: float, *targets: str, **more: Any) -> Parameter:
    return Parameter(name, low, high, targets=targets, **more)


MASS = p("mass", 0.5, 2, "body:rod.mass")


def build(
    *parameters: Parameter,
    source: str = XML,
    actuators: tuple[str, ...] = ("motor",),
    measurements: tuple[str | Channel, ...] = ("joint:hinge.position",),
) -> MjcfEnvironment:
    return MjcfEnvironment.build(source, parameters or (MASS,), actuators, measurements)


def test_units_defaults_and_columns_come_from_the_model() -> None:
    environment = build(
        MASS,
        p("damping", 0, 1, "joint:hinge.damping", unit="mN m s/rad"),
        p("kp", 5, 20, "actuator:servo.kp"),
        measurements=(
            "joint:hinge.position",
            Channel("joint:slide.velocity", "bob speed"),
            "sensor:encoder",
            "sensor:acc[2]",
            "sensor:tacho[0]",
        ),
    )
    assert environment.space.units == ("kg", "mN m s/rad", "N/m")
    assert [q.default for q in environment.space] == [1.0, 0.1, 10.0]
    assert environment.channels[:2] == ("joint:hinge.position", "bob speed")
    assert environment.channel_units == ("rad", "m/s", "rad", "m/s^2", "m/s")
    assert environment.num_actions == 1
    model = environment.compile()
    # states are [time | qpos (9) | qvel (8)]
    assert environment.state_columns(model) == (1, 1 + model.nq + 1, 1, None, 1 + model.nq + 1)


def test_a_path_and_its_text_are_the_same(tmp_path: Path) -> None:
    path = tmp_path / "model.xml"
    path.write_text(XML)
    from_path, from_text = MjcfEnvironment.build(path, [MASS], ["motor"], ["sensor:encoder"]), build()
    assert from_path.space == from_text.space
    np.testing.assert_array_equal(from_path.compile().body_mass, from_text.compile().body_mass)


def test_only_named_actuators_are_driven() -> None:
    environment = build(actuators=("servo",))
    controls = environment.control(environment.compile(), np.zeros((2, 1)), np.ones((2, 3, 1)))
    np.testing.assert_array_equal(controls, np.broadcast_to([0.0, 1.0], (2, 3, 2)))


def test_one_parameter_may_drive_several_targets() -> None:
    both = ("body:rod.mass", "body:bob.mass")
    for parameter, values in (
        (p("both", 0.2, 3, *both), (1.5, 1.5)),
        (p("both", 0.2, 3, *both, relative=True), (1.5, 0.75)),
    ):
        environment = build(parameter)
        model = environment.compile()
        assert environment.write(model, np.array([1.5]))
        assert (model.body("rod").mass[0], model.body("bob").mass[0]) == pytest.approx(values, rel=1e-15)


def test_relative_bounds_are_factors_of_the_models_value() -> None:
    gravity = p("g", 0.9, 1.1, "option.gravity_z", relative=True, prior_mean=1.0, prior_sd=0.01)
    parameter = build(gravity).space[0]
    assert (parameter.low, parameter.high, parameter.default) == pytest.approx((-10.791, -8.829, -9.81))
    assert (parameter.prior_mean, parameter.prior_sd) == pytest.approx((-9.81, 0.0981))
    assert build(parameter).space[0] == parameter, "building twice scales once"


def test_values_of_each_log_and_of_unknown_logs() -> None:
    parameters = [
        MASS,
        *(p(f"g {k}", 0.5, 3, "actuator:motor.gear", log=k) for k in "ab"),
        *(p(f"d {k}", 0, 1, "joint:hinge.damping", log=k) for k in "ac"),
    ]
    environment, values = build(*parameters), np.array([1.0, 2.0, 3.0, 0.2, 0.6])
    expected = {"a": (2.0, 0.2), "b": (3.0, 0.4), "c": (2.5, 0.6), "z": (2.5, 0.4), None: (2.5, 0.4)}
    model = environment.compile()
    for log, pair in [*expected.items(), *list(expected.items())[::-1]]:
        environment.write(model, values, log)
        assert (model.actuator("motor").gear[0], model.joint("hinge").damping[0]) == pytest.approx(pair)


def test_biases_add_up_and_leave_the_model_alone() -> None:
    environment = build(
        p("a", -1, 1, "sensor:acc.bias"),
        p("b", -1, 1, "sensor:acc.bias", "sensor:angle.bias"),
        measurements=(
            "sensor:acc[0]",
            Channel("joint:hinge.position", "angle"),
            "sensor:encoder",
            "sensor:acc[1]",
        ),
    )
    np.testing.assert_allclose(environment.bias(np.array([0.1, 0.2])), [0.3, 0.2, 0.0, 0.3])
    assert not environment.needs_constants
    assert [q.default for q in environment.space] == [0.0, 0.0]


def test_unphysical_values_are_reported() -> None:
    environment = build(MASS, p("i", 0.001, 0.1, "body:rod.inertia_yy"))
    model = environment.compile()
    assert environment.write(model, np.array([1.0, 0.0232]))
    assert not environment.write(model, np.array([1.0, 0.09]))
    assert not environment.write(model, np.array([-1.0, 0.0232]))
    assert not environment.write(model, np.array([np.nan, 0.0232]))
    assert environment.write(model, np.array([2.0, 0.0464]))


def test_inertia_is_the_same_after_any_earlier_values() -> None:
    names = ("inertia_xx", "inertia_xy", "inertia_yz")
    bounds = ((0.02, 0.03), (-0.01, 0.01), (-0.01, 0.01))
    environment = build(*(p(n, *b, f"body:rod.{n}") for n, b in zip(names, bounds, strict=True)))
    values = np.array([0.0233, 0.0001, -0.0001])
    fresh, used = environment.compile(), environment.compile()
    for other in np.random.default_rng(0).normal(0.01, 0.01, (20, 3)):
        environment.write(used, other)
    environment.write(fresh, values)
    environment.write(used, values)
    np.testing.assert_array_equal(used.body_inertia, fresh.body_inertia)
    np.testing.assert_array_equal(used.body_iquat, fresh.body_iquat)


def test_the_centre_of_mass_of_a_free_ball_may_move() -> None:
    """MuJoCo compiles such a body with a short cut that holds only while its centre of mass is its origin."""
    environment = build(p("com", -0.05, 0.05, "body:ball.com_x"), p("i", 0.005, 0.012, "body:ball.inertia_xx"))
    simulator = Simulator(environment, 1)
    start = simulator.default_state()
    start[1 + simulator.model.nq + 6] = 3.0  # spins about y
    result = simulator.rollout([[0.5, 0.5], [1.0, 0.5]], np.zeros((1, 50, 1)), start)
    assert result.valid.all()
    assert np.abs(result.states[1] - result.states[0]).max() > 1e-3


def test_history_has_room_for_the_longest_delay() -> None:
    environment = build(p("delay", 0, 0.05, "actuator:motor.delay"))
    model = environment.compile()
    assert (
        model.actuator_history[model.actuator("motor").id, 0] == 52
    )  # 25 steps of 2 ms, which may be refined to 1 ms, and 2
    state = Simulator(environment, 1).default_state()[None]
    past = [np.ones((5, 1))]
    environment.history(model, state, past, np.array([0.001]))
    with pytest.raises(ValueError, match=r"actuator:motor.delay: 0.05 s do not fit the history of 52 physics steps"):
        environment.history(model, state, past, np.array([0.0005]))


def test_differences_of_a_delay_are_one_physics_step() -> None:
    """Of .002 s, whatever the delay; on a log scale as well, and never more than a quarter of the range."""
    environment = build(
        p("delay", 0, 0.05, "actuator:motor.delay"),
        p("log", 0.001, 0.1, "actuator:servo.delay", scale="log"),
        MASS,
        measurements=("joint:hinge.position",),
        source=XML.replace(' nsample="3" delay=".004"', "").replace('kp="10"', 'kp="10" delay=".02" nsample="60"'),
    )
    for motor, servo in ((0.003, 0.0039), (0.0041, 0.05)):
        here = environment.space.normalise(np.array([motor, servo, 1.0]))
        steps = [0.04, np.log((servo + 0.002) / servo) / np.log(100), 0.0]
        np.testing.assert_allclose(environment.least_steps(here), steps)
    plain = build(p("delay", 0, 0.005, "actuator:motor.delay"), source=XML.replace(' nsample="3" delay=".004"', ""))
    assert plain.least_steps(np.zeros(1))[0] == 0.25


def test_differences_of_a_short_lag_are_two_physics_steps() -> None:
    """Of .002 s each, from lags below two; beyond, any difference will do."""
    source = XML.replace('kp="10"', 'kp="10" timeconst="0.02"')
    environment = build(p("lag", 0, 0.05, "actuator:servo.lag"), source=source, measurements=("joint:hinge.position",))
    for lag, step in ((0.0, 0.08), (0.0039, 0.08), (0.0041, 0.0)):
        np.testing.assert_allclose(environment.least_steps(environment.space.normalise(np.array([lag]))), [step])


def test_history_leaves_models_without_delay_alone() -> None:
    environment = build()
    state = np.zeros((1, 3))
    assert environment.history(environment.compile(), state, [np.ones((5, 1))], np.array([0.002])) is not None
    plain = environment_without_history()
    assert plain.history(plain.compile(), state, [np.ones((5, 1))], np.array([0.002])) is state


def environment_without_history() -> MjcfEnvironment:
    return build(source=XML.replace(' nsample="3" delay=".004"', ""))


def test_pickles_to_the_same_environment() -> None:
    environment = build(p("kp", 5, 20, "actuator:servo.kp"), measurements=("sensor:acc[1]",))
    assert environment.needs_derived
    other = pickle.loads(pickle.dumps(environment))  # noqa: S301
    assert other.space == environment.space
    assert other.channels == environment.channels
    assert other.needs_derived


def test_observing_sensors_needs_them() -> None:
    environment = build(measurements=("sensor:encoder",))
    with pytest.raises(ValueError, match="channel 'sensor:encoder': needs sensordata, got none"):
        environment.observe(environment.compile(), np.zeros((1, 18)), None)


def test_all_sensor_units_are_known_or_empty() -> None:
    environment = build(measurements=("sensor:acc[0]", "sensor:tacho", "sensor:gyro[2]", "sensor:place[0]"))
    assert environment.channel_units == ("m/s^2", "m/s", "rad/s", "m")


@pytest.mark.parametrize(
    ("arguments", "error", "words"),
    [
        (
            {"source": "no/such.xml"},
            ModelError,
            "model: no file 'no/such.xml'; give the path of an MJCF file",
        ),
        ({"source": "<mujoco><worldbody>"}, ModelError, "model: the MJCF text is not valid MJCF"),
        (
            {"source": XML.replace('joint="slide"', 'joint="sldie"')},
            ModelError,
            "model: the MJCF text (does not compile|is not valid MJCF)",
        ),
        ({"source": XML.replace("mass=", "mss=")}, ModelError, "model: the MJCF text is not valid MJCF"),
        ({"actuators": ("moter",)}, TargetError, "no actuator 'moter'; did you mean 'motor'"),
        ({"measurements": ("hinge",)}, TargetError, "target 'hinge' is not one of joint:NAME.position"),
        ({"measurements": ("joint:hinge.angle",)}, TargetError, "is not one of joint:NAME.position"),
        ({"measurements": ("joint:hige.position",)}, TargetError, "no joint 'hige'; did you mean 'hinge'"),
        (
            {"measurements": ("joint:free.position",)},
            TargetError,
            "neither hinge nor slide; measure its body",
        ),
        ({"measurements": ("sensor:gps",)}, TargetError, r"no sensor 'gps'; the model has \['encoder'"),
        ({"measurements": ("sensor:acc",)}, TargetError, r"has 3 components; write sensor:NAME\[i\], i < 3"),
        ({"measurements": ("sensor:acc[3]",)}, TargetError, "has 3 components"),
        (
            {"measurements": ("sensor:slow",)},
            TargetError,
            "sensor 'slow' has a delay or an interval; remove it",
        ),
        (
            {"measurements": ("sensor:acc[0]",) * 2},
            ValueError,
            r"names must differ, but \['sensor:acc\[0\]'\]",
        ),
    ],
)
def test_wrong_models_and_measurements_are_named(arguments: dict[str, Any], error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        build(**arguments)


@pytest.mark.parametrize(
    ("parameters", "error", "words"),
    [
        (
            [p("m", 0, 1)],
            TargetError,
            "parameter 'm': names no target; give what it changes, such as body:rod.mass",
        ),
        (
            [p("m", 0, 1, "body:rodd.mass")],
            TargetError,
            "parameter 'm': target 'body:rodd.mass'.*did you mean 'rod'",
        ),
        ([p("m", 2, 3, "body:rod.mass")], ValueError, "the default 1 kg lies outside the bounds"),
        ([p("b", 0, 1, "sensor:acc.bias")], TargetError, "names no measured sensor or channel; measured are"),
        ([p("b", 0, 1, "sensor:hing.bias")], TargetError, "names no measured sensor or channel"),
        (
            [p("f", 0.5, 2, "joint:hinge.frictionloss", relative=True)],
            TargetError,
            "is 0 in the model, so a factor of it says nothing; give absolute bounds",
        ),
        (
            [MASS, p("n", 0, 2, "body:rod.mass")],
            TargetError,
            "'n'.*writes what parameter 'mass' writes too; keep one",
        ),
        (
            [MASS, p("n", 0, 2, "body:rod.mass", log="a")],
            TargetError,
            "writes what parameter 'mass' writes too",
        ),
        (
            [p("k", 5, 20, "actuator:servo.kp"), p("g", 5, 20, "actuator:servo.gain")],
            TargetError,
            "'actuator:servo.gain' writes what parameter 'k' writes too",
        ),
        (
            [p("o", -1, 1, "actuator:motor.offset"), p("f", -1, 1, "actuator:motor.bias_force")],
            TargetError,
            "writes what parameter 'o' writes too",
        ),
        (
            [p("m", -1, 3, "body:rod.mass")],
            TargetError,
            "parameter 'm': bounds from -1 kg, but body:rod.mass cannot be below 0; raise the lower one",
        ),
        (
            [p("m", -1, 2, "body:rod.mass", relative=True)],
            TargetError,
            "parameter 'm': bounds from -1 kg",
        ),
        (
            [p("d", 0, 1, "joint:hinge.damping"), p("d", -1, 1, "option.wind_x")],
            ValueError,
            "the names must differ",
        ),
    ],
)
def test_wrong_parameters_are_named(parameters: list[Parameter], error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        build(*parameters)


def test_commands_need_actuators_with_one_control() -> None:
    environment = build(actuators=("motor", "servo"))
    model = environment.compile()
    assert environment._controls == [0, 1]
    assert isinstance(model, mujoco.MjModel)


def test_the_force_at_a_joint_is_what_its_actuators_apply() -> None:
    """Of a servo on a hinge of gear 2 and a motor on a slide: kp (u - 2 q) times 2 in N m, and the command in N."""
    xml = """<mujoco><worldbody><body name="b"><joint name="turn" axis="0 1 0"/><geom size=".1" mass="1"/></body>
    <body name="c"><joint name="push" type="slide" axis="1 0 0"/><geom size=".1" mass="2"/></body></worldbody>
    <actuator><position name="servo" joint="turn" kp="5" gear="2"/><motor name="motor" joint="push"/></actuator>
    </mujoco>"""
    measured = ("joint:turn.force", "joint:turn.position", "joint:push.force")
    unknown = p("kp", 5, 20, "actuator:servo.kp")
    environment = MjcfEnvironment.build(xml, [unknown], ["servo", "motor"], measured)
    assert [c.unit for c in environment.measurements] == ["N m", "rad", "N"]
    simulator, actions = Simulator(environment, 1), np.array([[0.3, 1.5], [0.3, 1.5], [-0.4, 2.0]])
    run = simulator.rollout(np.array([1.0]), actions, simulator.default_state(), dt=0.02).observations[0]
    np.testing.assert_allclose(run[:3, 0], 2 * 20 * (actions[:, 0] - 2 * run[:3, 1]), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(run[:3, 2], actions[:, 1])
    with pytest.raises(TargetError, match="joint 'nothing'"):
        MjcfEnvironment.build(xml, [unknown], ["servo", "motor"], ["joint:nothing.force"])
