"""What strikes is seen in the states along a log, and fitted with states unknown at every sample."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from sipe_bayes.benchmark.leaderboard.task import known_start
from sipe_bayes.core.findings import Code
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.diagnostics.evaluate import measured_starts
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.inference.laplace import Laplace
from sipe_bayes.likelihood import Segments, StateSpace
from sipe_bayes.likelihood.windows import Windows
from sipe_bayes.simulation.contacts import Contacts, contacts_along, may_touch
from sipe_bayes.simulation.simulator import Simulator
from tests.problems.bodies import FRICTION, POSE, ROUND, cube, tosses, with_noise
from tests.problems.bouncing import bouncing, bouncing_log

BOUNCE = """<mujoco><option timestep="0.002" cone="elliptic"/><worldbody>
  <geom name="floor" type="plane" size="3 3 .1" solref=".012 1"/>
  <body name="ball"><joint name="z" type="slide" axis="0 0 1"/>
    <geom name="ball" type="sphere" size=".03" mass=".05" solref=".012 1"/></body></worldbody></mujoco>"""
DAMPRATIO = Parameter("dampratio", 0.05, 1.2, targets=("geom:ball.solref_dampratio", "geom:floor.solref_dampratio"))
NOISE = 0.002


@pytest.fixture(scope="module")
def simulator() -> Simulator:
    return Simulator(MjcfEnvironment.build(BOUNCE, [DAMPRATIO], [], ["joint:z.position"]), num_threads=1)


def drops(simulator: Simulator, theta: float, count: int, steps: int = 60, above: float = 0.0) -> Trajectories:
    """A ball on a slide, dropped from differing heights, at 100 Hz."""
    rng, states = np.random.default_rng(1), np.tile(simulator.default_state(), (count, 1))
    states[:, 1], states[:, 2] = above + rng.uniform(0.15, 0.35, count), rng.uniform(-0.5, 0.5, count)
    made = simulator.rollout(np.array([[theta]]), np.zeros((count, steps, 0)), states, 0.01)
    seen = made.observations + rng.normal(0, NOISE, made.observations.shape)
    return Trajectories.stack([Trajectory(own, np.zeros((steps, 0)), 0.01, name=str(k)) for k, own in enumerate(seen)])


def test_a_contact_that_comes_and_goes_is_seen(simulator: Simulator) -> None:
    """Not one that always is, and none where nothing may touch."""
    high, low = (np.tile(simulator.default_state(), (50, 1)) for _ in range(2))
    high[:, 1], low[:, 1] = 0.2, 0.02
    assert contacts_along(simulator, [high, low]).change
    assert not contacts_along(simulator, [high]).touch
    assert contacts_along(simulator, [low]) == Contacts(touch=True, change=False)
    resting = low.copy()
    resting[:, 1] = 0.03 + 0.0005 * np.random.default_rng(2).standard_normal(50)  # noise of what lies on the floor
    assert not contacts_along(simulator, [resting]).change
    off = BOUNCE.replace('cone="elliptic"/>', 'cone="elliptic"><flag contact="disable"/></option>')
    assert not may_touch(mujoco.MjModel.from_xml_string(off))
    free = BOUNCE.replace('type="sphere"', 'type="sphere" contype="0" conaffinity="0"')
    apart = Simulator(MjcfEnvironment.build(free, [DAMPRATIO], [], ["joint:z.position"]), num_threads=1)
    assert not contacts_along(apart, [high, low]).change


def test_a_free_body_that_touches_nothing_has_no_impacts() -> None:
    """A cube's flight is as smooth as joints' motions are; the same cube's landing is not."""
    flying = cube()
    for steps, landed in ((20, False), (120, True)):
        logs, _ = tosses(flying, 2, steps, seed=1)
        windows = Windows(Segments(None), flying, logs)
        assert windows.contacts.touch == landed
        assert windows.impacts == landed


def test_a_bounce_between_two_samples_is_a_touch() -> None:
    """Smoothing over 60 ms lifts a bounce off the floor, and samples 10 ms apart step over it: none of 24 is missed."""
    stiff = ROUND.replace('friction=".3"/>', 'friction=".3" solref="-100000 -10"/>')
    body = Simulator(MjcfEnvironment.build(stiff, [FRICTION], [], POSE), num_threads=1)
    rng, missed = np.random.default_rng(3), 0
    for _ in range(24):
        state = body.default_state()
        state[3], state[8:11] = rng.uniform(0.4, 0.5), [*rng.normal(size=2), rng.uniform(-3, -1)]
        made = body.rollout(np.full((1, 1), 0.5), np.zeros((1, 30, 0)), state[None], 0.01)
        height = made.observations[0][:, 2]
        assert np.ptp(height[height.argmin() :]) > 0.1  # it went up again
        seen = with_noise(made.observations[0], body.environment.rotations, 1e-3, rng)
        logs = Trajectories.stack([Trajectory(seen, np.zeros((30, 0)), 0.01)])
        missed += not Windows(Segments(None), body, logs).impacts
    assert not missed


def test_a_ball_on_a_slide_that_bounces(simulator: Simulator) -> None:
    """By default every state is unknown, and the interval holds the truth; segments are told to be wrong."""
    logs, truth = drops(simulator, 0.2, 8), 0.2
    assert Windows(Segments(None, "white"), simulator, logs).impacts
    method = Laplace(simulator, seed=0)
    posterior = method.fit(logs)
    assert isinstance(method.likelihood, StateSpace)
    mean, sd = posterior.mean.item(), posterior.stddev.item()
    assert abs(mean - truth) < 3 * sd < 0.3, (mean, sd)
    assert not method.findings.blocking
    segments = Laplace(simulator, likelihood=Segments(None, "white"), seed=0, budget=500)
    segments.fit(logs)
    assert Code.IMPACTS in [item.code for item in segments.findings.blocking]


def test_logs_without_a_strike_are_fitted_by_segments(simulator: Simulator) -> None:
    """The same ball from so high that it flies all along."""
    method = Laplace(simulator, seed=0, budget=500)
    method.fit(drops(simulator, 0.2, 2, above=3.0))
    assert isinstance(method.likelihood, Segments)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_known_states_lead_through_impacts(seed: int) -> None:
    """A ball that bounces on a spring: right from states known at every eighth step, blocked from the first alone."""
    theta = np.random.default_rng([seed, 1]).uniform(0.2, 0.8, 3)
    logs = Trajectories.stack([bouncing_log(theta, seed, 120)])
    short = Laplace(bouncing(), likelihood=Segments(8 * 0.02, "white", starts="recorded"), seed=0)
    posterior = short.fit(known_start(logs, 8))
    off = np.abs(posterior.mean.numpy() - theta) / posterior.stddev.numpy()
    print(off, short.rollouts)
    assert (off < 4).all()
    assert not short.findings.blocking
    whole = Laplace(bouncing(), likelihood=Segments(None, "white", starts="recorded"), seed=0)
    whole.fit(known_start(logs))
    assert Code.IMPACTS in [item.code for item in whole.findings.blocking]


def test_the_first_tenth_of_a_second_tells_where_a_thrown_body_starts() -> None:
    """Velocities to the error of a straight line's slope, less than half of that of smoothed measurements."""
    body, noise, theta = cube(), 0.004, np.array([[0.5]])
    logs, states = tosses(body, 8, 70, seed=5, noise=noise)
    windows, velocity = Windows(Segments(None, "white"), body, logs), slice(8, 14)
    samples = int(0.1 / windows.dt[0]) + 2
    slope = np.sqrt(12) * noise / (samples**1.5 * windows.dt[0])
    error = {
        name: np.sqrt(((windows.states(theta, starts)[0] - states[:, 0])[:, velocity] ** 2).mean())
        for name, starts in (("told", measured_starts(windows, theta)), ("measured", windows.no_starts(1)))
    }
    print(error, slope)
    assert error["told"] < 1.3 * slope < 0.5 * error["measured"]
