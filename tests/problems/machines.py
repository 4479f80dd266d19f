"""Three driven machines that laws and extensions are placed at: a pendulum, a double one and a slide."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.envs.mjcf import Edit, MjcfEnvironment

_PENDULUM = """<mujoco><option timestep="0.004"><flag contact="disable"/></option><worldbody><body name="rod">
  <joint name="hinge" axis="0 1 0" damping="0.05" frictionloss="0.02" armature="0.01"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.5" size=".02" mass="1"/></body></worldbody>
  <actuator><motor name="motor" joint="hinge" gear="1.5"/></actuator></mujoco>"""
_DOUBLE = """<mujoco><option timestep="0.004" integrator="implicitfast"><flag contact="disable"/></option><worldbody>
  <body name="upper"><joint name="shoulder" axis="0 1 0" damping="0.1" armature="0.02"/>
    <geom type="capsule" fromto="0 0 0 0 0 -.4" size=".02" mass="1"/>
    <body name="lower" pos="0 0 -.4"><joint name="elbow" axis="0 1 0" damping="0.05" armature="0.005"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass=".5"/></body></body></worldbody>
  <tendon><fixed name="cable"><joint joint="shoulder" coef=".05"/><joint joint="elbow" coef=".03"/></fixed></tendon>
  <actuator><motor name="m1" joint="shoulder" gear="2"/><position name="m2" joint="elbow" kp="4" kv=".3"/></actuator>
  </mujoco>"""
_SLIDE = """<mujoco><option timestep="0.004"><flag contact="disable"/></option><worldbody>
  <body name="carriage"><joint name="slider" type="slide" axis="1 0 1" damping="0.5" frictionloss="0.1" armature="0.3"/>
  <geom type="box" size=".1 .1 .05" mass="2"/></body></worldbody>
  <actuator><motor name="drive" joint="slider" gear="3"/></actuator></mujoco>"""


@dataclass(frozen=True)
class Drive:
    """A machine, the body whose mass is unknown, its joints and the actuator of each."""

    xml: str
    body: str
    mass: float
    joints: tuple[str, ...]
    actuators: tuple[str, ...]


MACHINES = {
    "pendulum": Drive(_PENDULUM, "rod", 1.0, ("hinge",), ("motor",)),
    "double": Drive(_DOUBLE, "lower", 0.5, ("shoulder", "elbow"), ("m1", "m2")),
    "slide": Drive(_SLIDE, "carriage", 2.0, ("slider",), ("drive",)),
}


def environment(drive: Drive, extra: Sequence[Parameter] = (), edits: Sequence[Edit] = ()) -> MjcfEnvironment:
    """A machine whose joints' positions and velocities are measured, one mass unknown from half to twice the model's.

    More parameters follow it.
    """
    mass = Parameter("mass", 0.5 * drive.mass, 1.5 * drive.mass, targets=(f"body:{drive.body}.mass",))
    channels = [f"joint:{joint}.{what}" for joint in drive.joints for what in ("position", "velocity")]
    return MjcfEnvironment.build(drive.xml, [mass, *extra], drive.actuators, channels, edits)
