"""Windows of a log that tells an angle by its cosine and sine alone, and fits that do not follow a channel."""

from __future__ import annotations

import numpy as np
import pytest

import sipe_bayes as sipe
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.datasets import acting
from sipe_bayes.envs.channels import Channel
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.inference.laplace import Laplace
from sipe_bayes.inference.laplace.optimum import not_followed
from sipe_bayes.likelihood import Segments, estimate_states, unmeasured_joints
from sipe_bayes.likelihood.windows import Windows
from sipe_bayes.simulation.simulator import Simulator

LEVEL = 0.05
ROD = """<mujoco><option timestep="0.005"/><worldbody><body name="rod"><joint name="hinge" axis="0 1 0" {limit}/>
  <geom type="capsule" fromto="0 0 0 0 0 -.4" size=".02" mass=".5" contype="0" conaffinity="0"/><site name="tip"/>
</body></worldbody><actuator><motor name="motor" joint="hinge"/></actuator>
<sensor><framexaxis name="axis" objtype="site" objname="tip"/></sensor></mujoco>"""
CHANNELS = (Channel("sensor:axis[0]", "cosine"), Channel("sensor:axis[2]", "sine"))
DAMPING = Parameter("damping", 0.0, 0.1, targets=("joint:hinge.damping",))
DELAY = Parameter("delay", 0.0, 0.1, targets=("sensor:cosine.delay", "sensor:sine.delay"))


@pytest.fixture(scope="module")
def simulator() -> Simulator:
    return sipe.Simulator(sipe.make_task("Pendulum"), num_threads=1)


def swung(simulator: Simulator, seed: int, level: float = LEVEL) -> tuple[Trajectory, Trajectory, np.ndarray]:
    """A log with noise and without states, the one that it is made of, and its theta."""
    theta = np.random.default_rng([seed, 7]).uniform(0.1, 0.9, 3)
    behaviour = acting.excitation(simulator.environment, simulator.dt)
    motion = acting.simulate(simulator, theta, behaviour, acting.Recording("reference", 1, seed, 100))[0][0]
    noise = np.random.default_rng([seed, 1]).standard_normal(motion.observations.shape)
    noisy = motion.observations + level * motion.observations.std(axis=0) * noise
    return Trajectory(noisy, motion.actions, motion.dt), motion, theta


def test_the_angle_is_where_cosine_and_sine_have_it(simulator: Simulator) -> None:
    """To twice what noise makes of it, round and round; with one of them alone nothing tells it."""
    log, motion, _ = swung(simulator, 6)
    assert motion.states is not None
    assert np.ptp(motion.states[:, 1]) > 2 * np.pi
    off = estimate_states(simulator, log, raw=True)[:, 1] - motion.states[:, 1]
    off -= 2 * np.pi * np.round(off[0] / (2 * np.pi))
    print(np.abs(off).max())
    assert np.abs(off).max() < 0.2
    assert not unmeasured_joints(simulator, Trajectories.stack([log]))
    blind = log.observations.copy()
    blind[:, 1] = np.nan
    assert unmeasured_joints(simulator, Trajectories.stack([Trajectory(blind, log.actions, log.dt)])) == [0]


def test_windows_begin_where_cosine_and_sine_say(simulator: Simulator) -> None:
    """Ten fits of half-second windows: within five sds, and z has a root mean square below 1.6 (each 1 in 1000).

    From an angle of zero it was 2.6, one value 8 sds off, without a finding.
    """
    sizes = []
    for seed in range(10):
        log, _, theta = swung(simulator, seed)
        posterior = Laplace(simulator, seed=0).fit(log)
        sizes.append((posterior.mean.numpy() - theta) / posterior.stddev.numpy())
    print(np.round(sizes, 1))
    assert np.abs(sizes).max() < 5
    assert np.sqrt(np.mean(np.square(sizes))) < 1.6


@pytest.mark.parametrize("limit", ["", 'limited="true" range="-200 200"', 'limited="true" range="-360 360"'])
@pytest.mark.parametrize("every", [1, 2])
def test_angles_of_more_than_a_turn_and_channels_of_two_rates(limit: str, every: int) -> None:
    """Up to 195 degrees to either side, in ranges that hold one direction twice; sine on every other sample."""
    rod = Simulator(MjcfEnvironment.build(ROD.format(limit=limit), [DAMPING], ["motor"], CHANNELS), num_threads=1)
    angle = 3.4 * np.sin(0.04 * np.arange(300))
    seen = np.stack([np.cos(angle), -np.sin(angle)], axis=1)
    seen += 0.02 * np.random.default_rng(0).standard_normal(seen.shape)
    seen[np.arange(300) % every > 0, 1] = np.nan
    log = Trajectory(seen, np.zeros((299, 1)), 0.01)
    off = estimate_states(rod, log)[:, 1] - angle
    print(np.abs(off).max())
    assert np.abs(off[:-4]).max() < 0.1
    assert np.abs(off).max() < 0.15  # the last sample may have no sine: it stays where the one before was, .13 rad away
    assert not unmeasured_joints(rod, Trajectories.stack([log]))


def test_a_late_resolver_tells_nothing_of_a_windows_beginning() -> None:
    """Two fits with an unknown delay, 25 rad/s fast: within five sds, which are below .06 (false alarm 1 in 10,000).

    A signal that goes on straight before a window is wrong by three times the noise there: up to 18 sds off.
    """
    parameters = [DAMPING, Parameter("mass", 0.2, 1.0, targets=("body:rod.mass",)), DELAY]
    rod = Simulator(MjcfEnvironment.build(ROD.format(limit=""), parameters, ["motor"], CHANNELS), num_threads=1)
    times = 0.02 * np.arange(200)
    for seed in (2, 3):
        rng, state = np.random.default_rng(seed), rod.default_state()
        truth = rod.space.normalise(np.array([rng.uniform(0.01, 0.09), rng.uniform(0.3, 0.9), 0.02]))
        size, pace = rng.uniform(0.5, 1.2), 2 * np.pi * rng.uniform(0.3, 1.0)
        torque = size * (np.sin(pace * times) + 0.6 * np.sin(2.3 * pace * times))
        state[1] = rng.uniform(-3, 3)
        made = rod.rollout(truth, torque[:, None], state, 0.02).observations[0][20:]
        seen, torque = made + 0.02 * rng.standard_normal(made.shape), torque[20:]
        posterior = Laplace(rod, seed=0).fit(Trajectory(seen, torque[:, None], 0.02))
        mean, sd = posterior.mean.numpy(), posterior.stddev.numpy()
        print(np.round((mean - truth) / sd, 1), sd)
        assert (np.abs(mean - truth) < 5 * sd).all()
        assert (sd < 0.06).all()


def test_a_channel_that_a_fit_does_not_follow(simulator: Simulator) -> None:
    """Noise that is a good part of a channel and not in its samples; samples that do scatter by it are followed."""
    for level in (LEVEL, 0.5):
        log, motion, _ = swung(simulator, 4, level)
        windows = Windows(Segments(None), simulator, Trajectories.stack([log]))
        scatter = level * motion.observations.std(axis=0)
        assert not_followed(windows, scatter) is None
    windows = Windows(Segments(None), simulator, Trajectories.stack([swung(simulator, 4)[0]]))
    assert not_followed(windows, 0.2 * windows.spread) is None  # a model that lacks something, not one that is lost
    channel, ratio = not_followed(windows, np.array([0.05, 0.4, 0.2]) * windows.spread) or ("", 0.0)
    assert channel == "sin_angle"
    assert 5 < ratio < 12
