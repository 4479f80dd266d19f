"""A ball on a spring that bounces off a stiff floor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import sipe_bayes as sipe
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.core.trajectory import Trajectory
from sipe_bayes.simulation.simulator import Simulator


def bouncing(num_threads: int = 1) -> Simulator:
    """A ball of unknown mass on a spring of unknown stiffness above a stiff floor, which it hits again and again.

    Its height measured, and a second joint that nothing moves or measures, whose damping is unknown, too.
    """
    xml = (
        '<mujoco><option timestep="0.005"/><worldbody><geom type="plane" size="1 1 .1" solref="-8000 -2"/>'
        '<body name="ball" pos="0 0 .25"><joint name="z" type="slide" axis="0 0 1" stiffness="20" damping="0.2"/>'
        '<geom name="ball" size=".1" mass="1" solref="-8000 -2"/></body>'
        '<body pos="5 0 1"><joint name="idle" type="hinge" axis="0 0 1" damping="1"/><geom size=".1"/></body>'
        '</worldbody><actuator><motor name="m" joint="z"/></actuator></mujoco>'
    )
    parameters = [
        Parameter("mass", 0.5, 2.0, targets=("body:ball.mass",)),
        Parameter("stiffness", 5.0, 40.0, targets=("joint:z.stiffness",)),
        Parameter("idle_damping", 0.5, 1.5, targets=("joint:idle.damping",)),
    ]
    environment = sipe.MjcfEnvironment.build(xml, parameters, ["m"], ["joint:z.position"])
    return Simulator(environment, num_threads=num_threads)


def bouncing_log(theta: np.ndarray, seed: int, steps: int = 100) -> Trajectory:
    """2 s from rest in the air, with 5 mm of noise and the states."""
    simulator, actions = bouncing(), 6 * np.sin(np.arange(steps) * 0.2 + seed)[:, None]
    (motion,) = simulator.rollout(theta, actions, simulator.default_state(), dt=0.02)
    noise = 0.005 * np.random.default_rng(seed).standard_normal(motion.observations.shape)
    return replace(motion, observations=motion.observations + noise)
