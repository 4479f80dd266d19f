"""A mass that nothing measures, hung on another one by a spring."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import sipe_bayes as sipe
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.core.trajectory import Trajectory
from sipe_bayes.simulation.simulator import Simulator
from tests.problems.springs import HIGH, LOW


def hung(num_threads: int = 1) -> Simulator:
    """A mass hung on another one by a spring of unknown stiffness, the upper one's position measured."""
    body = (
        '<body><joint name="{0}" type="slide" axis="1 0 0" damping="0.5" stiffness="{1}"/><geom size="0.1" mass="1"/>'
    )
    xml = (
        '<mujoco><option timestep="0.01" gravity="0 0 0"><flag contact="disable"/></option><worldbody>'
        f"{body.format('upper', 20)}{body.format('lower', 10)}</body></body></worldbody>"
        '<actuator><motor name="m" joint="upper"/></actuator></mujoco>'
    )
    parameters = [Parameter("stiffness", LOW, HIGH, targets=("joint:lower.stiffness",))]
    environment = sipe.MjcfEnvironment.build(xml, parameters, ["m"], ["joint:upper.position"])
    return Simulator(environment, num_threads=num_threads)


def hung_log(theta: np.ndarray, seed: int, steps: int = 80) -> Trajectory:
    """From rest, with 1 cm of noise and the states."""
    simulator, actions = hung(), 4 * np.sin(np.arange(steps) * 0.12 + seed)[:, None]
    (motion,) = simulator.rollout(theta, actions, simulator.default_state(), dt=0.02)
    noise = 0.01 * np.random.default_rng(seed).standard_normal(motion.observations.shape)
    return replace(motion, observations=motion.observations + noise, name=f"log{seed}")
