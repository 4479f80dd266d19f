"""A small torque-driven pendulum with simulated logs, shared by the tests of inference."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.core.trajectory import Trajectory
from sipe_bayes.envs.mjcf import Edit, MjcfEnvironment
from sipe_bayes.simulation.simulator import Simulator

XML = """
<mujoco>
  <option timestep="0.01" integrator="implicitfast"/>
  <worldbody>
    <body name="rod">
      <joint name="hinge" axis="0 1 0" damping="0.05"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.01" mass="0.6" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge"/></actuator>
</mujoco>
"""
DT = 0.01


def pendulum(*extra: Parameter, num_threads: int = 1, edits: Sequence[Edit] = ()) -> Simulator:
    """Rod mass and damping unknown, and whatever else is given."""
    parameters = [
        Parameter("rod_mass", 0.3, 1.0, targets=("body:rod.mass",)),
        Parameter("damping", 0.0, 0.2, targets=("joint:hinge.damping",)),
        *extra,
    ]
    environment = MjcfEnvironment.build(XML, parameters, ["motor"], ["joint:hinge.position"], edits)
    return Simulator(environment, num_threads=num_threads)


def stepped(spec: mujoco.MjSpec, seconds: float) -> None:
    """An edit: physics steps of so many seconds."""
    spec.option.timestep = seconds


def coloured(rng: np.random.Generator, n: int, sd: float, rho: float) -> np.ndarray:
    """First-order autoregressive noise (n,) of stationary sd."""
    z, noise = rng.standard_normal(n), np.empty(n)
    noise[0] = z[0]
    for i in range(1, n):
        noise[i] = rho * noise[i - 1] + np.sqrt(1 - rho**2) * z[i]
    return sd * noise


def log(
    simulator: Simulator,
    values: list[float],
    seed: int,
    name: str = "log",
    steps: int = 400,
    sd: float = 0.01,
    rho: float = 0.0,
) -> Trajectory:
    """A simulated log at physical ``values``: sums of sines drive the motor, the angle is measured with noise."""
    rng = np.random.default_rng(seed)
    time = np.arange(steps) * DT
    frequency, phase = rng.uniform(0.3, 1.5, 4), rng.uniform(0, 2 * np.pi, 4)
    actions = 0.6 * np.sin(2 * np.pi * frequency * time[:, None] + phase).sum(1, keepdims=True)
    theta = simulator.space.normalise(np.array(values))
    motion = simulator.rollout(theta, actions, simulator.default_state(), dt=DT)
    noise = coloured(rng, steps + 1, sd, rho)[:, None]
    return Trajectory(motion.observations[0] + noise, actions, DT, name=name, channels=simulator.environment.channels)


def repeated(
    simulator: Simulator,
    actions: np.ndarray,
    angle: float = 0.0,
    states: bool = False,
    seed: int = 5,
    sd: float = 0.01,
) -> Trajectory:
    """A log of another theta under given actions from a given angle."""
    start = simulator.default_state()
    start[1] = angle
    motion = simulator.rollout(np.array([0.8, 0.3]), actions, start, dt=DT)
    seen = motion.observations[0] + sd * np.random.default_rng(seed).standard_normal(motion.observations[0].shape)
    assert motion.states is not None
    return Trajectory(
        seen, actions, DT, motion.states[0] if states else None, "repeated", simulator.environment.channels
    )
