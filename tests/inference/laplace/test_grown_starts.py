"""A long log of a motion that is all but chaotic, from a known start: beginnings lead where a search stops."""

from __future__ import annotations

import numpy as np
import pytest

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.inference.laplace.estimator import Laplace
from sipe_bayes.inference.laplace.windows.contact_starts import grown_starts
from sipe_bayes.likelihood.settings import Segments
from sipe_bayes.simulation.simulator import Simulator

MODEL = """
<mujoco><option timestep="0.005" integrator="implicitfast"/><worldbody><body name="upper">
<inertial pos="0 0 -0.2" mass="1" diaginertia="0.02 0.02 0.002"/><joint name="shoulder" axis="0 1 0" armature=".02"/>
<body name="lower" pos="0 0 -0.4"><inertial pos="0 0 -0.2" mass="0.6" diaginertia="0.01 0.01 0.001"/>
<joint name="elbow" axis="0 1 0" damping="0.01"/></body></body></worldbody></mujoco>
"""
LIKELIHOOD = Segments(None, starts="recorded")


def released(seed: int, steps: int) -> tuple[Laplace, Trajectory, FloatArray]:
    """A double pendulum let go at 70 degrees, its angles with noise of .02 rad; and the truth (3,)."""
    parameters = [
        Parameter("mass", 0.2, 1.0, targets=("body:lower.mass",)),
        Parameter("com", -0.35, -0.05, targets=("body:lower.com_z",)),
        Parameter("inertia", 0.005, 0.05, targets=("joint:shoulder.armature",)),
    ]
    measured = ["joint:shoulder.position", "joint:elbow.position"]
    simulator = Simulator(MjcfEnvironment.build(MODEL, parameters, [], measured), num_threads=1)
    rng, start = np.random.default_rng(seed), simulator.default_state()
    start[1:3] = 1.2, 0.5
    truth, nothing = rng.uniform(0.1, 0.9, 3), np.zeros((steps, 0))
    motion = simulator.rollout(truth, nothing, start, dt=0.01)
    noise = 0.02 * rng.standard_normal(motion.observations[0].shape)
    log = Trajectory(motion.observations[0] + noise, nothing, 0.01, name="log", states=motion.states[0])
    return Laplace(simulator, likelihood=LIKELIHOOD, seed=seed), log, truth


@pytest.mark.parametrize("seed", range(4))
def test_beginnings_lead_to_the_truth(seed: int) -> None:
    """Within four sds, by chance one fit of five thousand not; where the logs are searched whole most are far off."""
    method, log, truth = released(seed, 600)
    posterior = method.fit(log)
    z = (posterior.mean.numpy() - truth) / posterior.stddev.numpy()
    print(seed, z, posterior.stddev.numpy(), method.rollouts, method.warnings)
    assert np.abs(z).max() < 4


def test_a_short_log_is_searched_as_it_is() -> None:
    method, log, _ = released(0, 100)
    windows = method.bound(Trajectories.stack([log]))
    assert grown_starts(method.problem, windows) is None
    assert not windows.rollouts
