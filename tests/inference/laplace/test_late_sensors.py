"""Windows of logs with a sensor that comes late, or filtered, by an unknown time."""

from __future__ import annotations

import numpy as np
import pytest

from sipe_bayes.core import rotations
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.envs.channels import Channel
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.envs.sensing import Sensing
from sipe_bayes.inference.laplace import Laplace
from sipe_bayes.likelihood import Segments, StateSpace
from sipe_bayes.likelihood.state_space.chain import Chain
from sipe_bayes.likelihood.windows import Windows
from sipe_bayes.simulation.simulator import Simulator

CART = """<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody><body name="cart">
  <joint name="x" type="slide" axis="1 0 0" damping="2"/><geom type="box" size=".1 .05 .05" mass="1" contype="0"/>
  <body name="pole"><joint name="swing" axis="0 1 0" damping=".005"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.4" size=".01" mass=".2" contype="0"/></body></body></worldbody>
  <actuator><motor name="push" joint="x" gear="10"/></actuator></mujoco>"""
UNKNOWNS = (
    Parameter("damping", 0.5, 5.0, targets=("joint:x.damping",)),
    Parameter("pole_mass", 0.1, 0.4, targets=("body:pole.mass",)),
    Parameter("gear", 5.0, 20.0, targets=("actuator:push.gear",)),
)
CHANNELS = (Channel("joint:x.position", "x"), Channel("joint:swing.position", "swing"))
DT, FINE, BEFORE, STEPS = 0.02, 10, 50, 200


def cart(kind: str = "delay", longest: float = 0.12) -> Simulator:
    late = Parameter(kind, 0.0, longest, targets=(f"sensor:swing.{kind}",))
    return Simulator(MjcfEnvironment.build(CART, [*UNKNOWNS, late], ["push"], CHANNELS), num_threads=1)


def driven(simulator: Simulator, theta: np.ndarray, seed: int, noise: float = 1.0) -> tuple[Trajectory, np.ndarray]:
    """A log that a finer simulation makes, which began a second earlier; and its true positions (T+1, 2)."""
    rng, steps = np.random.default_rng([seed, 3]), BEFORE + STEPS
    pace, phase = rng.uniform(0.3, 2.0, 4), rng.uniform(0, 6.28, 4)
    force = np.sin(2 * np.pi * pace * DT * np.arange(steps)[:, None] + phase).mean(1)[:, None]
    start, prompt = simulator.default_state(), np.append(theta[:-1], 0.0)
    fine = simulator.rollout(prompt, np.repeat(force, FINE, 0), start, dt=DT / FINE).observations[0]
    at, seconds = FINE * np.arange(BEFORE, steps + 1), float(simulator.space[-1].value(theta[-1]))
    sensed = fine[at].copy()
    sensed[:, 1] = np.interp(at - seconds * FINE / DT, np.arange(len(fine)), fine[:, 1])
    sensed += noise * rng.standard_normal(sensed.shape) * [5e-4, 3e-3]
    return Trajectory(sensed, force[BEFORE:], DT), fine[at]


def test_intervals_hold_the_truth_where_a_camera_is_late() -> None:
    """Six fits of half-second windows: within five sds, and z has a root mean square below 1.6 (each 1 in 1000).

    With the time before a window as a ramp it was 8, the worst value 29 sds off, without a finding.
    """
    simulator, sizes = cart(), []
    for seed in range(6):
        theta = np.random.default_rng([seed, 7]).uniform(0.2, 0.8, 4)
        posterior = Laplace(simulator, seed=0).fit(driven(simulator, theta, seed)[0])
        sizes.append((posterior.mean.numpy() - theta) / posterior.stddev.numpy())
        assert posterior.stddev.numpy()[-1] < 0.02  # of 0.12 s
    print(np.round(sizes, 1))
    assert np.abs(sizes).max() < 5
    assert np.sqrt(np.mean(np.square(sizes))) < 1.6


@pytest.mark.parametrize("starts", ["estimated", "recorded"])
def test_every_sample_is_predicted_once(starts: str) -> None:
    """Of a late channel without those that tell of the time before the log, an eighth of it at most."""
    simulator, theta = cart(), np.array([0.5, 0.5, 0.5, 0.5])
    log = driven(simulator, theta, 0)[0]
    force = np.zeros((STEPS, 1))
    whole = simulator.rollout(theta, force, simulator.default_state(), dt=DT)[0]
    log = log if starts == "estimated" else whole
    for window, longest, left_out in ((0.5, 0.12, 6), (0.1, 0.12, 6), (None, 0.12, 6), (1.1, 2.0, STEPS // 8)):
        simulator = cart(longest=longest)
        windows = Windows(Segments(window, starts=starts), simulator, Trajectories.stack([log]))
        count = np.zeros((STEPS + 1, 2), int)
        for w, place, channel in zip(*np.nonzero(windows.observed), strict=True):
            count[windows.start[w] + place, channel] += 1
        known = int(starts == "recorded")
        np.testing.assert_array_equal(count[:, 0], [0] * known + [1] * (STEPS + 1 - known))
        np.testing.assert_array_equal(count[:, 1], [0] * (left_out + known) + [1] * (STEPS + 1 - left_out - known))
        index = windows.sequences[1].index
        window_of, place = np.divmod(index, windows.observed.shape[1])
        assert (np.diff(windows.start[window_of] + place) == 1).all()


def samples_of(windows: Windows) -> set[tuple[int, int, int]]:
    """Log, sample and channel of all that is compared."""
    rows = zip(*np.nonzero(windows.observed), strict=True)
    return {(int(windows.log[w]), int(windows.start[w] + place), int(channel)) for w, place, channel in rows}


@pytest.mark.parametrize("seconds", [None, 4.0])
def test_models_that_are_compared_predict_the_same_samples(seconds: float | None) -> None:
    """Also of logs that are kept in blocks, and where a delay and a filter add up."""
    prompt = Simulator(MjcfEnvironment.build(CART, UNKNOWNS, ["push"], CHANNELS), num_threads=1)
    both = [Parameter(kind, 0.0, 0.06, targets=(f"sensor:swing.{kind}",)) for kind in ("delay", "filter")]
    slow = Simulator(MjcfEnvironment.build(CART, [*UNKNOWNS, *both], ["push"], CHANNELS), num_threads=1)
    logs = Trajectories.stack([driven(cart(), np.full(4, 0.5), seed)[0] for seed in (0, 1)])
    for window in (0.06, 0.5):
        settings = Segments(window, late=(("swing", 0.24),), seconds=seconds)
        one, *others = (samples_of(Windows(settings, simulator, logs)) for simulator in (prompt, cart(), slow))
        assert all(other == one for other in others)
        assert len(one) > 150
    with pytest.raises(ValueError, match=r"late: expected names of channels with seconds not below zero"):
        Segments(late=(("swing", -0.1),))


def test_what_begins_early_has_samples() -> None:
    """Of whole logs of which the first eighth is left out: beginnings of windows go beyond it."""
    prompt = Simulator(MjcfEnvironment.build(CART, UNKNOWNS, ["push"], CHANNELS), num_threads=1)
    log = Trajectories.stack([driven(cart(), np.full(4, 0.5), 0)[0]])
    windows = Windows(Segments(None, late=(("x", 0.3), ("swing", 0.3))), prompt, log)
    assert windows.beginnings(4).observed.any(axis=(0, 1)).all()


def test_windows_begin_where_a_late_sensor_will_say() -> None:
    simulator, theta = cart(), np.array([0.5, 0.5, 0.5, 0.8])
    log, truth = driven(simulator, theta, 1, noise=0.0)
    other = driven(simulator, theta, 2, noise=0.0)[0]
    half = Trajectory(other.observations[:101], other.actions[:100], DT)  # neither has a name
    both = Windows(Segments(), simulator, Trajectories.stack([half, log]))
    windows, off = both.part(np.flatnonzero(both.log == 1)), []
    for one in (theta, np.append(theta[:-1], 0.0)):
        begin = windows.states(one[None], windows.no_starts(1))[0, :-1]
        off.append(np.abs(begin[:, 1:3] - truth[windows.start[:-1]]).max(0))
    print(off)
    assert off[0][1] < 0.05 * off[1][1]
    assert (off[0] < [2e-3, 2e-2]).all()


def test_an_orientation_is_seen_as_it_was() -> None:
    """Of a turn at a steady rate, through half a turn, where its rotation vector jumps; also what is to come."""
    time, rate = 0.02 * np.arange(120), np.array([0.3, 1.5, -0.4])
    turns = rotations.added(np.zeros((120, 3)), time[:, None] * rate)
    assert np.abs(np.diff(turns, axis=0)).max() > 3
    shifted = Sensing(np.zeros((1, 3)), np.ones((1, 3)), np.full((1, 3), 0.05), np.zeros((1, 3)))
    seen = shifted.seen(turns[None], np.array([0.02]), ((0, 1, 2),))[0]
    due = rotations.added(np.zeros((120, 3)), (time - 0.05)[:, None] * rate)
    np.testing.assert_allclose(rotations.between(seen, due), 0, atol=1e-9)


def test_state_space_refuses_what_a_step_can_not_hold() -> None:
    log = Trajectories.stack([driven(cart(), np.full(4, 0.5), 0)[0]])
    with pytest.raises(
        ValueError, match=r"StateSpace can not follow 'swing', whose delay or filter may reach back 0.12"
    ):
        Chain(StateSpace(), cart(), log)
    Chain(StateSpace(), cart(longest=DT), log)
