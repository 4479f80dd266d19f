"""A motor pushes a free body: contact that chatters gives differences over short steps any slope."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.inference.laplace.levenberg_marquardt import DampingRule
from sipe_bayes.inference.laplace.options import GrowingTuning
from sipe_bayes.inference.laplace.windows.growing_windows import grown
from sipe_bayes.inference.laplace.windows.state import Phase, Position
from sipe_bayes.likelihood.quadratic_prior import QuadraticPrior
from sipe_bayes.likelihood.settings import Segments
from sipe_bayes.likelihood.windows import Windows
from sipe_bayes.simulation.simulator import Simulator
from tests.problems.bodies import cube, tosses

PUSHED = """<mujoco><option timestep="0.004" integrator="implicitfast" cone="elliptic" impratio="5"/><worldbody>
  <geom name="table" type="plane" size="3 3 .1" friction=".3 .005 .0001"/>
  <body name="puck" pos=".12 0 .02"><freejoint name="free"/>
  <geom name="puck" type="cylinder" size=".04 .02" mass=".2" friction=".3 .005 .0001"/></body>
  <body name="slider" pos="0 0 .03"><joint name="stroke" type="slide" axis="1 0 0" damping="3" armature=".1"/>
  <geom type="box" size=".02 .06 .02" mass=".3"/></body></worldbody>
  <actuator><motor name="push" joint="stroke"/></actuator></mujoco>"""
UNKNOWNS = [
    Parameter("damping", 0.0, 12.0, targets=("joint:stroke.damping",)),
    Parameter("friction", 0.02, 1.5, targets=("geom:puck.friction", "geom:table.friction")),
    Parameter("mass", 0.1, 0.4, targets=("body:puck.mass",)),
]
CHANNELS = ["joint:stroke.position", "body:puck.position", "body:puck.orientation"]
TRUTH, DT, STEPS = np.array([0.433, 0.196, 0.567]), 0.02, 40
GIVEN, TUNING = np.array([0.25, 0.324, 0.333]), GrowingTuning()


def pushed() -> Windows:
    """Six logs of .8 s."""
    simulator = Simulator(MjcfEnvironment.build(PUSHED, UNKNOWNS, ["push"], CHANNELS), num_threads=1)
    rng, time = np.random.default_rng(0), DT * np.arange(STEPS)
    logs = []
    for k in range(6):
        force, span = rng.uniform(4, 9), rng.uniform(0.25, 0.4)
        command = np.where(time < span, force * np.sin(np.pi * time / span), -2 * np.exp(-(time - span) / 0.2))[:, None]
        done = simulator.rollout(TRUTH[None], command[None], simulator.default_state()[None], DT)
        noisy = done.observations[0] + 4e-4 * rng.standard_normal(done.observations[0].shape)
        logs.append(Trajectory(noisy, command, DT, name=f"push {k}", channels=done.channels))
    return Windows(Segments(None, "white"), simulator, Trajectories.stack(logs))


def searched(windows: Windows, given: FloatArray, horizon: int) -> list[Position]:
    """Every step of the search on the first beginnings."""
    n = windows.num_theta
    prior = QuadraticPrior(np.full(n, 0.5), np.zeros((n, n)))
    here = Position.at(windows, given, DampingRule())
    here = replace(here, phase=Phase.GROW, horizon=horizon, theta_step=TUNING.widest, alone=True)
    steps = [here]
    while steps[-1].horizon == horizon and steps[-1].phase is Phase.GROW:
        steps.append(grown(windows, windows, prior, steps[-1], TUNING, DampingRule()))
    return steps


def test_contact_that_chatters_is_seen_over_wide_differences() -> None:
    """Theta moves first, by the measured starts, more than half of the way; short differences would measure jumps."""
    windows = pushed()
    steps = searched(windows, GIVEN, 20)
    alone = [here for here in steps if here.alone]
    print(alone[-1].theta, steps[-1].theta, steps[-1].theta_step, windows.rollouts)
    assert all((here.starts == 0).all() for here in alone)
    assert abs(alone[-1].theta[0] - TRUTH[0]) < 0.09 < 0.5 * abs(GIVEN[0] - TRUTH[0])
    assert steps[-1].jumps
    assert steps[-1].theta_step == TUNING.widest


def test_tosses_that_are_smooth_are_seen_over_short_differences() -> None:
    """A cube in flight, with one impact: differences shrink to the shortest."""
    simulator = cube()
    logs, _ = tosses(simulator, 4, 70, seed=5, noise=0.004)
    windows = Windows(Segments(None, "white"), simulator, logs)
    steps = searched(windows, np.array([0.3]), 60)
    print(steps[-1].theta, steps[-1].theta_step, windows.beginnings(60).theta_step)
    assert not steps[-1].jumps
    assert steps[-1].theta_step == windows.beginnings(60).theta_step
