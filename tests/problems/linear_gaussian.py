"""Systems with exact posteriors for estimators of every kind: five parameters, two of them correlated.

And a bimodal one.
"""

from __future__ import annotations

import numpy as np
import torch

import sipe_bayes as sipe
from sipe_bayes.core.parameters import Parameter, ParameterSpace
from sipe_bayes.core.trajectory import Trajectory
from sipe_bayes.likelihood import Segments
from sipe_bayes.posterior import GaussianMixture
from sipe_bayes.simulation.callable_simulator import CallableSimulator
from sipe_bayes.simulation.simulator import Simulator

CENTRE = np.array([0.45, 0.6, 0.5, 0.4, 0.55])
SD = 0.08  # of the function's noise


def function_problem() -> tuple[CallableSimulator, Trajectory, GaussianMixture, Segments]:
    """``x = M theta + noise``: simulator, log, exact posterior, likelihood. M mixes the first two parameters."""
    mixing = np.eye(5)
    mixing[0, 1] = mixing[1, 0] = 0.7

    def function(values: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        return values @ mixing.T + SD * rng.standard_normal(values.shape)

    space = ParameterSpace([Parameter(f"p{j}", 0.0, 1.0) for j in range(5)])
    simulator = CallableSimulator(function, space, name="linear_gaussian")
    x = mixing @ CENTRE + SD * np.random.default_rng(7).standard_normal(5)
    log = Trajectory(np.stack([np.zeros(5), x]), np.zeros((1, 0)), 1.0, name="log")
    covariance = np.linalg.inv(mixing.T @ mixing) * SD**2
    exact = GaussianMixture(torch.zeros(1), np.linalg.solve(mixing, x)[None], covariance[None], space)
    return simulator, log, exact, Segments(noise_sd=(0.0,) * 5)


def carts_problem() -> tuple[Simulator, Trajectory, GaussianMixture, Segments]:
    """Four carts, positions measured from known starts.

    Each has an unknown constant force, the first an encoder with an unknown bias as well, which does nearly the same as
    the force.
    """
    bodies = "".join(
        f'<body name="c{k}"><joint name="j{k}" type="slide" axis="1 0 0"/><geom size="0.1" mass="2" contype="0" '
        'conaffinity="0"/></body>'
        for k in range(4)
    )
    motors = "".join(f'<motor name="m{k}" joint="j{k}"/>' for k in range(4))
    xml = (
        '<mujoco><option timestep="0.02" gravity="0 0 0" integrator="Euler"/>'
        f"<worldbody>{bodies}</worldbody><actuator>{motors}</actuator></mujoco>"
    )
    parameters = [
        Parameter("bias", -0.1, 0.1, targets=("sensor:x.bias",)),
        *(Parameter(f"offset{k}", -1.0, 1.0, targets=(f"actuator:m{k}.offset",)) for k in range(4)),
    ]
    channels = [sipe.Channel("joint:j0.position", "x"), *(f"joint:j{k}.position" for k in range(1, 4))]
    environment = sipe.MjcfEnvironment.build(xml, parameters, [f"m{k}" for k in range(4)], channels)
    simulator, rng = Simulator(environment, num_threads=1), np.random.default_rng(3)
    actions = np.zeros((50, 4))
    start = simulator.default_state()
    thetas = np.concatenate([CENTRE[None], CENTRE + 0.1 * np.eye(5)])
    motion = simulator.rollout(thetas, actions, start, dt=0.02)
    noise = 0.02
    seen = motion.observations[0] + noise * rng.standard_normal((51, 4))
    log = Trajectory(seen, actions, 0.02, motion.states[0], "log", environment.channels)
    design = np.stack(
        [(motion.observations[k + 1] - motion.observations[0])[1:].ravel() / 0.1 for k in range(5)], axis=1
    )
    covariance = np.linalg.inv(design.T @ design) * noise**2
    mean = CENTRE + covariance @ design.T @ (seen - motion.observations[0])[1:].ravel() / noise**2
    exact = GaussianMixture(torch.zeros(1), mean[None], covariance[None], simulator.space)
    return simulator, log, exact, Segments(None, noise="white", noise_sd=(noise,) * 4, starts="recorded")


def squared_function() -> tuple[CallableSimulator, Trajectory, Segments]:
    """``x = (2 theta - 1)^2`` plus noise of sd 0.03: modes at 0.5 +- 0.3 for x = 0.36."""

    def function(values: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        return (2 * values - 1) ** 2 + 0.03 * rng.standard_normal(values.shape)

    simulator = CallableSimulator(function, ParameterSpace([Parameter("p", 0.0, 1.0)]), name="squared")
    return (
        simulator,
        Trajectory(np.array([[0.0], [0.36]]), np.zeros((1, 0)), 1.0, name="log"),
        Segments(noise_sd=(0.0,)),
    )


def squared_rod() -> tuple[Simulator, Trajectory, Segments]:
    """A mass at an unknown place p along a balanced rod of inertia 0.05 + p^2: theta = 0.5 +- 0.3 move alike."""
    xml = """
    <mujoco><option timestep="0.02" gravity="0 0 0"/>
      <worldbody><body name="rod"><joint name="hinge" axis="0 0 1" damping="0.05"/>
        <inertial pos="0 0 0" mass="0.1" diaginertia="0.05 0.05 0.05"/>
        <body name="weight"><inertial pos="0.1 0 0" mass="1" diaginertia="1e-4 1e-4 1e-4"/></body>
      </body></worldbody>
      <actuator><motor name="motor" joint="hinge"/></actuator></mujoco>"""
    place = Parameter("place", -1.0, 1.0, targets=("body:weight.com_x",))
    simulator = Simulator(sipe.MjcfEnvironment.build(xml, [place], ["motor"], ["joint:hinge.position"]), num_threads=1)
    actions = 0.3 * np.sin(0.2 * np.arange(100))[:, None]
    motion = simulator.rollout(np.array([[0.8]]), actions, simulator.default_state(), dt=0.02)
    seen = motion.observations[0] + 0.01 * np.random.default_rng(1).standard_normal((101, 1))
    log = Trajectory(seen, actions, 0.02, motion.states[0], "log", simulator.environment.channels)
    return simulator, log, Segments(None, noise="white", noise_sd=(0.01,), starts="recorded")
