"""The humanoid: 17 link sizes, or damping, stiffness and gear of the 17 actuated joints (51 parameters).

Model, observation and reward are those of Gymnasium's Humanoid-v4 without termination (Tassa, Erez and Todorov,
Synthesis and Stabilization of Complex Behaviors through Online Trajectory Optimization, 2012,
https://doi.org/10.1109/IROS.2012.6386025). An episode always lasts 1000 steps of 0.015 s: one that terminates at a fall
would end after 20 to 60 steps of most policies, too few to infer from. The reward for being upright, 5 a step, is paid
while the torso is between 1 and 2 m high.

The observation's 376 numbers are 45 of position and velocity and 331 that MuJoCo derives: inertia and velocity of every
body about the centre of mass of the whole robot, actuator and contact forces. The model is integrated with Runge-Kutta,
and what MjData holds after a step belongs to the last stage of the last physics step, close to the new state but not
at it. That is what Gymnasium reads, and what is read here. A sensor would give the state before that step instead. In an
episode's first observation they belong to the starting state.
"""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import mujoco
import numpy as np
from numpy.typing import NDArray

from sipe_bayes.envs.targets import Target, bind
from sipe_bayes.envs.task import Solved, Task, Transition, scaled
from sipe_bayes.parameters import Parameter, ParameterSpace

FloatArray = NDArray[np.float64]

_XYZ = ("x", "y", "z")
_STEP = 0.015  # s, five physics steps
_NOISE = 0.01  # half-width of the starting state's uniform distribution
_HEALTHY = (1.0, 2.0)  # heights of the torso in m that are paid for
_HEALTHY_REWARD, _FORWARD_REWARD, _CONTROL_COST = 5.0, 1.25, 0.1  # a step, per m/s, per squared action
_NO_SPRING = 0.001  # N m/rad, what stands for "none" in the table of joints without a spring


@dataclass(frozen=True, eq=False)
class Humanoid(Task):
    """Actions in [-0.4, 0.4], times the gear in N m."""

    frame_skip: ClassVar[int] = 5
    num_actions: ClassVar[int] = 17
    needs_derived: ClassVar[bool] = True
    derived_late: ClassVar[bool] = True
    data_fields: ClassVar[tuple[str, ...]] = ("cinert", "cvel", "qfrc_actuator", "cfrc_ext", "subtree_com")
