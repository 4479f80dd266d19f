"""What sensors do to a rollout: bias, scale, delay and filter against what they are by definition."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.integrate

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.envs.sensing import Sensing
from sipe_bayes.envs.target import TargetError
from sipe_bayes.simulation.simulator import Simulator
from tests.problems.machines import MACHINES, environment

DT = 0.01
TIME = np.arange(200) * DT
CHANNEL = "joint:hinge.velocity"


def sensing(**numbers: float) -> Sensing:
    values = {"bias": 0.0, "scale": 1.0, "delay": 0.0, "filter": 0.0, **numbers}
    return Sensing(**{name: np.array([[value]]) for name, value in values.items()})


def wave(time: np.ndarray) -> np.ndarray:
    return np.asarray(np.sin(5 * time) + 0.3 * np.cos(11 * time))


def seen(y: np.ndarray, **numbers: float) -> np.ndarray:
    return sensing(**numbers).seen(y[None, :, None], np.array([DT]))[0, :, 0]


def test_neutral_sensors_give_the_very_bits() -> None:
    np.testing.assert_array_equal(seen(wave(TIME)), wave(TIME))
    np.testing.assert_array_equal(seen(wave(TIME), bias=0.3), wave(TIME) + 0.3)


@pytest.mark.parametrize("numbers", [{"delay": 0.034}, {"filter": 0.034}, {"delay": 0.02, "filter": 0.05}])
def test_a_ramp_is_seen_late_from_its_first_sample_on(numbers: dict[str, float]) -> None:
    late = sum(numbers.values())
    np.testing.assert_allclose(seen(2 + 3 * TIME, **numbers), 2 + 3 * (TIME - late), rtol=0, atol=1e-12)


def test_a_delay_of_whole_samples_is_a_shift() -> None:
    np.testing.assert_allclose(seen(wave(TIME), delay=3 * DT)[3:], wave(TIME)[:-3], rtol=0, atol=1e-12)
    between = 0.25 * wave(TIME)[:-3] + 0.75 * wave(TIME)[1:-2]
    np.testing.assert_allclose(seen(wave(TIME), delay=2.25 * DT)[3:], between, rtol=0, atol=1e-12)


def test_a_filter_solves_its_equation() -> None:
    tau, slope = 0.06, (wave(TIME)[1] - wave(TIME)[0]) / DT
    solved = scipy.integrate.solve_ivp(
        lambda t, z: (np.interp(t, TIME, wave(TIME)) - z) / tau,
        (0, TIME[-1]),
        [wave(TIME)[0] - tau * slope],
        t_eval=TIME,
        max_step=DT / 4,
        rtol=1e-10,
        atol=1e-12,
    )
    np.testing.assert_allclose(seen(wave(TIME), filter=tau), solved.y[0], rtol=0, atol=1e-7)


def test_small_delays_and_filters_come_close_to_none() -> None:
    for name in ("delay", "filter"):
        tiny, twice = (seen(wave(TIME), **{name: size}) - wave(TIME) for size in (1e-7, 2e-7))
        assert 0 < np.abs(tiny).max() < 1e-5
        np.testing.assert_allclose(twice, 2 * tiny, atol=1e-10)


def test_order_is_delay_filter_scale_bias_of_each_simulation() -> None:
    y = np.stack([wave(TIME), wave(TIME + 1)])[..., None]
    rows = Sensing(*(np.array([[a], [b]]) for a, b in ((0.1, 0.0), (2.0, 1.0), (0.013, 0.0), (0.04, 0.0))))
    out = rows.seen(y, np.array([DT, DT]))
    expected = 0.1 + 2.0 * seen(seen(wave(TIME), delay=0.013), filter=0.04)
    np.testing.assert_allclose(out[0, :, 0], expected, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(out[1], y[1])


def measured(*parameters: Parameter) -> MjcfEnvironment:
    return environment(MACHINES["pendulum"], parameters)


def p(attribute: str, low: float, high: float, log: str | None = None) -> Parameter:
    return Parameter(f"{attribute}{log or ''}", low, high, targets=(f"sensor:{CHANNEL}.{attribute}",), log=log)


def test_a_simulator_measures_with_them_and_its_states_stay() -> None:
    extra = [p("bias", -1, 1), p("scale", 0.5, 2), p("delay", 0, 0.1), p("filter", 0, 0.1)]
    noisy, plain = Simulator(measured(*extra), 2), Simulator(measured(), 1)
    assert [q.default for q in noisy.space] == [1.0, 0.0, 1.0, 0.0, 0.0]
    assert [q.unit for q in noisy.space][1:] == ["rad/s", "1", "s", "s"]
    rng = np.random.default_rng(0)
    theta, actions = rng.random((3, 5)), rng.standard_normal((3, 60, 1)).repeat(2, axis=1)
    run = noisy.rollout(theta, actions, noisy.default_state(), 0.008)
    expected = plain.rollout(theta[:, :1], actions, plain.default_state(), 0.008)
    np.testing.assert_array_equal(run.states, expected.states)
    np.testing.assert_array_equal(run.observations[..., 0], expected.observations[..., 0])
    for row in range(3):
        bias, scale, delay, tau = noisy.space.values(theta[row])[1:]
        sensors = Sensing(*(np.array([[x]]) for x in (bias, scale, delay, tau)))
        own = sensors.seen(expected.observations[row : row + 1, :, 1:], np.array([0.008]))
        np.testing.assert_allclose(run.observations[row, :, 1], own[0, :, 0], rtol=0, atol=1e-12)
    neutral = noisy.rollout(np.append(theta[0, :1], noisy.space.default_theta[1:]), actions, noisy.default_state())
    same = plain.rollout(theta[0, :1], actions, plain.default_state())
    np.testing.assert_array_equal(neutral.observations, same.observations)


def test_sensors_of_each_log() -> None:
    made = measured(p("scale", 0.5, 2, "a"), p("scale", 0.5, 2, "b"))
    values = np.array([1.0, 0.6, 1.6])
    assert [float(made.sensing(values, log).scale[1]) for log in ("a", "b", "c")] == pytest.approx([0.6, 1.6, 1.1])


def test_wrong_sensors_are_refused_in_a_line() -> None:
    for bad, words in (
        (p("delay", -0.1, 0.1), "cannot be below 0"),
        (Parameter("s", 0.5, 2, targets=("sensor:gone.scale",)), "names no measured sensor or channel"),
    ):
        with pytest.raises(TargetError, match=words) as caught:
            measured(bad)
        assert "\n" not in str(caught.value)
    with pytest.raises(TargetError, match="writes what parameter 'delaya' writes too"):
        measured(p("delay", 0, 0.1, "a"), p("delay", 0, 0.1))
