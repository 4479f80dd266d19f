"""What a servo applies tells masses and gains that its motion tells only together."""

from __future__ import annotations

import numpy as np
import torch

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.inference.laplace import Laplace
from sipe_bayes.likelihood import Segments
from sipe_bayes.simulation.simulator import Simulator

XML = """<mujoco><option timestep="0.005" integrator="implicitfast"/><worldbody>
  <body name="rod"><joint name="hinge" axis="0 1 0"/>
  <geom type="capsule" fromto="0 0 0 .4 0 0" size=".01" mass=".5" contype="0" conaffinity="0"/></body></worldbody>
  <actuator><position name="servo" joint="hinge" kp="20" kv="1"/></actuator></mujoco>"""
UNKNOWNS = [
    Parameter("mass", 0.2, 1.2, targets=("body:rod.mass",)),
    Parameter("kp", 8.0, 60.0, targets=("actuator:servo.kp",)),
    Parameter("kv", 0.2, 5.0, targets=("actuator:servo.kv",)),
]
TRUTH = np.array([0.7, 30.0, 1.5])


def fitted(*measured: str) -> tuple[np.ndarray, np.ndarray]:
    """Mean and sd, in values, of a fit to a log whose noise has .001 rad and .05 N m."""
    simulator = Simulator(MjcfEnvironment.build(XML, UNKNOWNS, ["servo"], measured), 1)
    time = 0.01 * np.arange(300)
    actions = (0.4 * np.sin(3 * time) + 0.3 * np.sin(8.3 * time))[:, None]
    run = simulator.rollout(simulator.space.normalise(TRUTH), actions, simulator.default_state(), dt=0.01)
    sd = np.array([0.001, 0.05])[: len(measured)]
    seen = run.observations[0] + sd * np.random.default_rng(4).standard_normal(run.observations[0].shape)
    log = Trajectory(seen, actions, 0.01, channels=simulator.environment.channels)
    laplace = Laplace(simulator, likelihood=Segments(0.5), seed=0)
    values = laplace.fit(Trajectories.stack([log])).values(2000, generator=torch.Generator().manual_seed(0))
    return np.asarray(values).mean(0), np.asarray(values).std(0)


def test_a_measured_force_makes_masses_and_gains_known() -> None:
    """Without it all three may be as many times larger; with it they are known to 1 %."""
    mean, sd = fitted("joint:hinge.position", "joint:hinge.force")
    print(mean, sd)
    assert (np.abs(mean - TRUTH) < 3.5 * sd).all()  # false alarm: .14 % of three numbers
    assert (sd < 0.01 * TRUTH).all()
    _, alone = fitted("joint:hinge.position")
    print(alone)
    assert (alone > 0.1 * TRUTH).all()
