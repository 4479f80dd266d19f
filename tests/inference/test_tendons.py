"""Tendons from logs: a finger that a cable pulls against springs, and two hinges that a belt couples."""

from __future__ import annotations

import numpy as np
import pytest

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.inference.registry import get_estimator
from sipe_bayes.simulation.simulator import Simulator
from tests.problems.tendons import FINGER

BELT = """<mujoco><compiler angle="radian"/><option timestep="0.005" integrator="implicitfast"/><worldbody>
  <body><joint name="one" axis="0 1 0" damping=".02"/><geom type="capsule" fromto="0 0 0 0 0 -.2" size=".02" mass=".3"/>
  </body><body pos=".5 0 0"><joint name="two" axis="0 1 0" damping=".02"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.2" size=".02" mass=".3"/></body></worldbody>
  <tendon><fixed name="belt" stiffness="1" damping=".02" springlength="0"><joint joint="one" coef="1"/>
  <joint joint="two" coef="-1"/></fixed></tendon><actuator><motor name="drive" joint="one"/></actuator>
  <sensor><tendonpos name="length" tendon="belt"/></sensor></mujoco>"""
MACHINES = {
    "finger": (
        FINGER,
        ["joint:mcp.position", "joint:pip.position"],
        {"stiffness": (5, 100, 45), "damping": (0, 20, 8), "frictionloss": (0, 3, 0.6)},
        "flexor",
    ),
    "finger by its winch": (
        FINGER,
        ["joint:mcp.position", "sensor:length"],
        {"stiffness": (5, 100, 45), "damping": (0, 20, 8), "frictionloss": (0, 3, 0.6)},
        "flexor",
    ),
    "belt": (
        BELT,
        ["joint:one.position", "joint:two.position"],
        {"stiffness": (0.2, 5, 2.4), "/two.coef": (-2, -0.5, -0.7), "springlength": (-0.5, 0.5, 0.2)},
        "belt",
    ),
}


def machine(name: str) -> tuple[Simulator, np.ndarray]:
    """A machine whose tendon's numbers are unknown, and what they are."""
    xml, channels, unknowns, tendon = MACHINES[name]
    parameters = [
        Parameter(what.strip("/"), low, high, targets=(f"tendon:{tendon}{what if '/' in what else f'.{what}'}",))
        for what, (low, high, _) in unknowns.items()
    ]
    environment = MjcfEnvironment.build(xml, parameters, ["drive"], channels)
    return Simulator(environment, 1), np.array([truth for _, _, truth in unknowns.values()])


@pytest.mark.parametrize("name", MACHINES)
def test_what_a_tendon_does_is_recovered_from_a_log(name: str) -> None:
    """Each number within four of its standard deviations, which are a fiftieth of its range or less."""
    simulator, truth = machine(name)
    space = simulator.space
    theta = np.array([float(p.normalise(value)) for p, value in zip(space, truth, strict=True)])
    time = 0.01 * np.arange(400)[:, None]
    actions = 0.8 + 0.5 * np.sin(4 * time) + 0.3 * np.sin(11 * time + 1) * (np.floor(time) % 3 > 0)
    run = simulator.rollout(theta[None], actions, simulator.default_state(), 0.01)
    noise = [2e-5 if channel.startswith("sensor") else 1e-3 for channel in simulator.environment.channels]
    measured = run.observations[0] + noise * np.random.default_rng(0).standard_normal(run.observations[0].shape)
    log = Trajectory(measured, actions, 0.01, name="a", channels=simulator.environment.channels)
    method = get_estimator(simulator, "laplace", restarts=1, candidates=0)
    posterior = method.fit(Trajectories.stack([log]))
    sd = posterior.stddev.numpy()
    print(dict(zip(space.names, zip(truth, space.values(posterior.mode.numpy()), sd, strict=True), strict=True)))
    assert (np.abs(posterior.mean.numpy() - theta) < 4 * sd).all()
    assert (sd < 0.02).all()
