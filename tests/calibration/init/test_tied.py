"""Joints that a closed chain ties: inverse dynamics knows no forces of these, but those of what carries them."""

from __future__ import annotations

import numpy as np

from sipe_bayes.calibration.init.regression import Regression
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.core.trajectory import Trajectory
from sipe_bayes.envs.mjcf import MjcfEnvironment

ROD = '<geom type="capsule" fromto="0 0 0 .1 0 0" size=".01" mass=".1" contype="0" conaffinity="0"/>'
GRIPPER = f"""<mujoco><worldbody><body name="arm"><joint name="lift" axis="0 1 0"/>{ROD}
  <body name="left" pos=".1 .03 0"><joint name="left" axis="0 0 1"/>{ROD}</body>
  <body name="right" pos=".1 -.03 0"><joint name="right" axis="0 0 1"/>{ROD}</body></body></worldbody>
  <equality><connect body1="left" body2="right" anchor=".1 -.03 0"/></equality>
  <actuator><motor name="lift" joint="lift"/></actuator></mujoco>"""


def test_an_arm_is_known_though_its_gripper_is_a_closed_chain() -> None:
    damping = Parameter("damping", 0.0, 1.0, targets=("joint:lift.damping",))
    measured = [f"joint:{name}.position" for name in ("lift", "left", "right")]
    time = 0.01 * np.arange(301)
    angles = np.stack([np.sin(3 * time), 0.1 * np.sin(5 * time), -0.1 * np.sin(5 * time)], axis=1)
    environment = MjcfEnvironment.build(GRIPPER, [damping], ["lift"], measured)
    regression = Regression(environment, [Trajectory(angles, np.zeros((300, 1)), 0.01)])
    assert regression.known.tolist() == [True, False, False]
