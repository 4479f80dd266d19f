"""Scores over windows from measured starts: a bias is not counted twice, a divergence is said and stays where it is."""

from __future__ import annotations

import numpy as np
import pytest

import sipe_bayes as sipe
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.diagnostics.evaluate import _jackknifed, channel_scores, compare_errors, errors, fitted_residuals
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.likelihood import Noise, Segments
from sipe_bayes.likelihood.windows import Windows
from sipe_bayes.simulation.simulator import Simulator
from tests.problems.pendulums import XML, log, pendulum


def test_the_truth_with_a_sensor_bias_has_no_error() -> None:
    environment = sipe.MjcfEnvironment.build(
        XML,
        [
            Parameter("rod_mass", 0.3, 1.0, targets=("body:rod.mass",)),
            Parameter("bias", -0.5, 0.5, targets=("sensor:angle.bias",)),
        ],
        ["motor"],
        [sipe.Channel("joint:hinge.position", "angle"), sipe.Channel("joint:hinge.velocity", "rate")],
    )
    simulator = Simulator(environment, num_threads=1)
    theta = simulator.space.normalise(np.array([0.6, 0.3]))
    actions = 0.5 * np.sin(0.05 * np.arange(300))[:, None]
    motion = simulator.rollout(theta, actions, simulator.default_state(), dt=0.01)
    trajectory = Trajectory(motion.observations[0], actions, 0.01, name="biased", channels=environment.channels)
    windows = Windows(Segments(0.5), simulator, Trajectories.stack(trajectory))
    found = errors(windows, np.stack([theta, simulator.space.normalise(np.array([0.6, 0.0]))]))
    assert found[0].max() < 2e-3  # what is left is the smoothing of the starts
    assert found[1, 0, 0] > 0.02


def test_a_diverging_log_does_not_hide_the_others() -> None:
    simulator = pendulum()
    good = log(simulator, [0.6, 0.05], 1, "good")
    wild = Trajectory(good.observations.copy(), good.actions, 0.01, name="wild", channels=good.channels)
    wild.observations[200:] = 1e12 * np.sign(np.sin(np.arange(201)))[:, None]
    windows = Windows(Segments(1.0), simulator, Trajectories.stack([good, wild]))
    rows = {row.log: row for row in channel_scores(windows, simulator.space.normalise(np.array([0.6, 0.05])))}
    assert rows["good"].rmse < 0.05
    assert not rows["wild"].rmse < 1e3


def test_residuals_of_some_windows_stand_at_their_times() -> None:
    """As where a long log is searched on blocks spread over it."""
    simulator = pendulum()
    recorded = log(simulator, [0.6, 0.05], 1, steps=200)
    every = Windows(Segments(0.5), simulator, Trajectories.stack(recorded))
    theta, noise = simulator.space.normalise(np.array([0.6, 0.05])), Noise(np.array([0.01]), np.zeros(1))
    (whole,), (some,) = (
        fitted_residuals(w, theta, noise, w.no_starts()) for w in (every, every.part(np.array([0, 2])))
    )
    shown = np.isfinite(some.residual)
    assert len(some.residual) == len(some.time) == len(whole.residual)
    assert 0.4 < shown.mean() < 0.6
    np.testing.assert_array_equal(some.residual[shown], whole.residual[shown])


CART = """<mujoco><option timestep="0.002"/><worldbody><body name="cart"><joint name="rail" type="slide" axis="1 0 0"/>
  <geom type="box" size=".1 .05 .05" mass="1" contype="0" conaffinity="0"/></body></worldbody>
  <actuator><motor name="push" joint="rail" gear="8"/></actuator></mujoco>"""


def held_out(truth: list[float], *windows: float | None) -> Windows:
    """Logs of a pendulum at ``truth``, one for each length of windows.

    The model as given has 0.6 kg and a damping of 0.05.
    """
    simulator = pendulum()
    logs = Trajectories.stack([log(simulator, truth, seed, f"log {seed}") for seed in range(len(windows))])
    each = tuple((f"log {k}", window) for k, window in enumerate(windows))
    return Windows(Segments(0.5, windows=each), simulator, logs)


def test_a_model_that_helps_is_better_and_its_mirror_image_is_worse() -> None:
    """From either model's side the same numbers come out, turned round; whatever the windows."""
    windows = held_out([0.9, 0.15], 0.5, None)
    truth = windows.simulator.space.normalise(np.array([0.9, 0.15]))
    found = compare_errors(windows, truth)
    assert found is not None
    assert (found.verdict, found.pieces) == ("better", 20)
    assert 1 < found.low < found.ratio < found.high
    rows = channel_scores(windows, truth)
    assert found.ratio == pytest.approx(np.exp(np.mean([np.log(r.rmse_default / r.rmse) for r in rows])))
    far = windows.simulator.space.normalise(np.array([0.3, 0.0]))
    worse = compare_errors(held_out([0.6, 0.05], 0.5, None), far)
    assert worse is not None
    assert worse.verdict == "worse"
    assert worse.low < worse.ratio < worse.high < 1


def test_models_alike_are_not_better() -> None:
    windows = held_out([0.6, 0.05], 0.5)
    same = compare_errors(windows, windows.simulator.space.default_theta)
    assert same is not None
    assert (same.verdict, same.ratio, same.p) == ("not better", 1.0, 1.0)


def test_models_that_err_alike_are_called_different_as_rarely_as_it_says() -> None:
    """1000 comparisons of errors that are equally large and correlated along the log (rho 0.9, 100 samples a piece).

    A t-test at the 5 % level on two logs' tenths should call 50 of them different, with sd 7; up to 90 allows for what
    dependence is left.
    """
    rng = np.random.default_rng(0)
    noise = rng.standard_normal((1000, 2, 2, 1000))
    for i in range(1, 1000):
        noise[..., i] = 0.9 * noise[..., i - 1] + np.sqrt(0.19) * noise[..., i]
    sums = (noise**2).reshape(1000, 2, 2, 10, 100).sum(-1)
    called = [_jackknifed([one[0][:, :, None], one[1][:, :, None]]).verdict for one in sums]
    print({word: called.count(word) for word in set(called)})
    assert 15 < sum(word != "not better" for word in called) < 90


def test_nothing_finite_is_no_comparison() -> None:
    windows = held_out([0.6, 0.05], 0.5)
    windows.measured[:] = np.inf
    assert compare_errors(windows, windows.simulator.space.default_theta) is None


def test_noisy_starts_do_not_decide() -> None:
    """A cart on a rail, its place with noise of 2 mm and no velocity.

    A free run of 4 s from measured starts errs by its start, so each model fits its own. The right model is then better
    than one of the wrong mass, and a worse one worse; with little noise on a pendulum nothing is fitted.
    """
    parameters = [Parameter("mass", 0.3, 3.0, targets=("body:cart.mass",))]
    environment = MjcfEnvironment.build(CART, parameters, ["push"], ["joint:rail.position"])
    simulator, rng = Simulator(environment, num_threads=1), np.random.default_rng(0)
    push = rng.choice([-1.0, 1.0], (40, 1)).repeat(10, axis=0)
    made = simulator.rollout(
        simulator.space.normalise(np.array([1.3])), push, simulator.default_state(), dt=0.01
    ).observations[0]
    noisy = Trajectory(made + 0.002 * rng.standard_normal(made.shape), push, 0.01, name="log")
    windows = Windows(Segments(None), simulator, Trajectories.stack([noisy]))
    found = compare_errors(windows, simulator.space.normalise(np.array([1.3])))
    assert found is not None
    print(found)
    assert found.starts is not None
    assert found.starts > 0.95
    assert found.verdict == "better"
    far = compare_errors(windows, simulator.space.normalise(np.array([0.5])))
    assert far is not None
    assert far.verdict == "worse"
    quiet = compare_errors(held_out([0.9, 0.15], 0.5), pendulum().space.normalise(np.array([0.9, 0.15])))
    assert quiet is not None
    assert quiet.starts is None
