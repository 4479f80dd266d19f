"""Tendons along sites and over joints: what their targets write, and how the same is done in a spec or its text."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

XML = """<tendon>
  <spatial name="cable" stiffness="3" damping=".1" springlength=".2"><site site="fixed"/><site site="s"/></spatial>
  <spatial name="bungee" stiffness="2" springlength="0 .1"><site site="fixed"/><site site="s"/></spatial>
  <fixed name="belt" stiffness="1" springlength="-.1">
  <joint joint="hinge" coef="1"/><joint joint="hinge2" coef="-1"/></fixed>
  <fixed name="a/drum" springlength="0"><joint joint="hinge" coef=".03"/><joint joint="hinge2" coef=".02"/></fixed>
  <fixed name="rack" springlength="0"><joint joint="slide" coef="1"/><joint joint="hinge2" coef=".02"/></fixed>
  <fixed name="lift" damping=".1" springlength="0"><joint joint="slide" coef="2"/></fixed></tendon>"""

FINGER = """<mujoco><compiler angle="radian"/><option timestep="0.005" integrator="implicitfast"/><worldbody>
  <site name="anchor" pos="-.03 0 -.012"/>
  <body name="proximal"><joint name="mcp" axis="0 1 0" stiffness=".04" damping=".002"/>
  <geom type="capsule" fromto="0 0 0 .05 0 0" size=".008" mass=".04"/><site name="a" pos=".01 0 -.01"/>
  <site name="b" pos=".04 0 -.01"/><body pos=".05 0 0"><joint name="pip" axis="0 1 0" stiffness=".03" damping=".001"/>
  <geom type="capsule" fromto="0 0 0 .04 0 0" size=".007" mass=".025"/><site name="c" pos=".012 0 -.01"/></body></body>
  </worldbody><tendon><spatial name="flexor" stiffness="20" damping="4" frictionloss=".3">
  <site site="anchor"/><site site="a"/><site site="b"/><site site="c"/></spatial></tendon>
  <actuator><motor name="drive" tendon="flexor" gear="-3"/></actuator>
  <sensor><tendonpos name="length" tendon="flexor"/><tendonvel name="speed" tendon="flexor"/></sensor></mujoco>"""


def number(field: str, *slots: int) -> Callable[[Any, float], None]:
    """Set a number of a spec's element, or these of a vector."""

    def edit(element: Any, value: float) -> None:
        numbers = np.array(getattr(element, field), float)
        numbers[list(slots) if slots else ...] = value
        setattr(element, field, numbers if slots else float(numbers))

    return edit


def coefficient(joint: str) -> Callable[[Any, float], str]:
    """The text with another number behind a joint: MuJoCo lets no coefficient of a spec be written."""

    def edit(tendon: Any, value: float) -> str:
        head, own, tail = XML.partition(f'<fixed name="{tendon.name}"')
        before, behind, after = tail.partition(f'joint="{joint}" coef="')
        return head + own + before + behind + f'{value}"' + after.partition('"')[2]

    return edit


# (target, value, unit, how it is edited)
CASES = [
    ("tendon:cable.stiffness", 20.0, "N/m", number("stiffness", 0)),
    ("tendon:belt.stiffness", 2.0, "N m/rad", number("stiffness", 0)),
    ("tendon:a/drum.stiffness", 2.0, "force/position", number("stiffness", 0)),
    ("tendon:cable.damping", 0.4, "N s/m", number("damping", 0)),
    ("tendon:belt.damping", 0.4, "N m s/rad", number("damping", 0)),
    ("tendon:lift.damping", 0.4, "N s/m", number("damping", 0)),
    ("tendon:cable.frictionloss", 0.4, "N", number("frictionloss")),
    ("tendon:belt.frictionloss", 0.4, "N m", number("frictionloss")),
    ("tendon:cable.armature", 0.2, "kg", number("armature")),
    ("tendon:belt.armature", 0.2, "kg m^2", number("armature")),
    ("tendon:rack.armature", 0.2, "inertia", number("armature")),
    ("tendon:cable.springlength", 0.15, "m", number("springlength", 0, 1)),
    ("tendon:belt.springlength", -0.2, "rad", number("springlength", 0, 1)),
    ("tendon:bungee.springlength_low", 0.05, "m", number("springlength", 0)),
    ("tendon:bungee.springlength_high", 0.25, "m", number("springlength", 1)),
    ("tendon:a/drum/hinge2.coef", 0.04, "position/rad", coefficient("hinge2")),
    ("tendon:belt/hinge2.coef", -0.7, "1", coefficient("hinge2")),
    ("tendon:rack/slide.coef", 1.2, "position/m", coefficient("slide")),
    ("tendon:lift/slide.coef", -1.0, "1", coefficient("slide")),
]

# (target, words of the error)
WRONG = [
    ("tendon:cabel.stiffness", "the model has no tendon 'cabel'; did you mean 'cable'"),
    ("tendon:cable.stifness", "a tendon has no attribute 'stifness'; did you mean 'stiffness'"),
    ("tendon:bungee.springlength", "rests from 0 to 0.1; give springlength_low and springlength_high instead"),
    ("tendon:belt/hinge.ceof", "a tendon has no attribute 'ceof'; did you mean 'coef'"),
    ("tendon:belt/hinge3.coef", "expected FIXED_TENDON/JOINT, got 'belt/hinge3'; did you mean 'belt/hinge'"),
    ("tendon:cable/hinge.coef", r"expected FIXED_TENDON/JOINT, got 'cable/hinge'; .*'belt/hinge'"),
]
