"""The half-cheetah: five lengths of its links, or damping, stiffness and gear of its leg joints.

Model, observation, reward and starting states are those of Gymnasium's HalfCheetah-v5 (Wawrzynski, A Cat-Like Robot
Real-Time Learning to Run, 2009, https://doi.org/10.1007/978-3-642-04921-7_39): two legs with three motors each run in a
vertical plane, 1000 steps of 0.05 s, and nothing ends an episode early.

How a link grows is described in ``sipe_bayes.envs.tasks.links``. Front and back links are one parameter and keep their
proportions; its value is the length of the back one. A density does not change, so a longer cheetah is a heavier one.
The torso starts at the same height whatever its legs: long ones begin pressed into the ground and push it up.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import Parameter, ParameterSpace
from sipe_bayes.envs.assets import compiled_without_visuals, gymnasium_asset
from sipe_bayes.envs.task import Solved, Transition, scaled
from sipe_bayes.envs.tasks.links import LinkTask


@dataclass(frozen=True)
class _Published:
    """HalfCheetah-v5's numbers."""

    step: float = 0.05  # s, five physics steps
    control_cost: float = 0.1  # a step and squared action
    noise: float = 0.1  # of the starting states: half-width of the positions, sd of the velocities


@dataclass(frozen=True)
class _Link:
    """A length of the back or only link, in m, and of the front one with it."""

    parameter: str
    back: str
    front: str
    length: float
    description: str


@dataclass(frozen=True)
class _Leg:
    """A joint: damping in N m s/rad, stiffness in N m/rad, gear in N m."""

    name: str
    words: str
    damping: float
    stiffness: float
    gear: float


_PUBLISHED = _Published()
_JOINTS = ("rootx", "rootz", "rooty", "bthigh", "bshin", "bfoot", "fthigh", "fshin", "ffoot")
_X, _OBSERVED = 1, slice(2, 19)  # columns of the state, whose first is the time

_LINKS = (
    _Link(
        *("torso_length", "torso", "", 1.0),
        "Distance of the hips and most of the mass; it slows the pitching. In the mass it trades off against the head.",
    ),
    _Link(
        *("head_length", "head", "", 0.3),
        "Mass in front of the front hip, which tips the torso forward; it trades off against the torso's length.",
    ),
    _Link(
        *("thigh_length", "bthigh", "fthigh", 0.29),
        "Distance of the knees from the hips, with the thighs' mass; in the legs' reach it trades off against the "
        "shins.",
    ),
    _Link(
        *("shin_length", "bshin", "fshin", 0.3),
        "Distance of the ankles from the knees, with the shins' mass; in the legs' reach it trades off against the "
        "thighs and the feet.",
    ),
    _Link(
        *("foot_length", "bfoot", "ffoot", 0.188),
        "Reach of the feet below the ankles, which sets the stride; in the legs' reach it trades off against the "
        "shins.",
    ),
)
_LEGS = (
    _Leg("bthigh", "back hip", 6.0, 240.0, 120.0),
    _Leg("bshin", "back knee", 4.5, 180.0, 90.0),
    _Leg("bfoot", "back ankle", 3.0, 120.0, 60.0),
    _Leg("fthigh", "front hip", 4.5, 180.0, 120.0),
    _Leg("fshin", "front knee", 3.0, 120.0, 60.0),
    _Leg("ffoot", "front ankle", 1.5, 60.0, 30.0),
)


@dataclass(frozen=True, eq=False)
class HalfCheetah(LinkTask):
    """Actions in [-1, 1]; times the gear they are torques in N m."""

    frame_skip = 5
    num_actions = 6
    start_noise = _PUBLISHED.noise
    channels = ("torso_z", *(f"{j}_angle" for j in _JOINTS[2:]), *(f"{j}_velocity" for j in _JOINTS))

    def compile(self) -> mujoco.MjModel:
        """The published model."""
        return compiled_without_visuals(gymnasium_asset("half_cheetah.xml"))

    def observe(
        self, model: mujoco.MjModel, states: FloatArray, derived: FloatArray | None, goals: FloatArray | None = None
    ) -> FloatArray:
        """All of the state but the time and the way along the ground."""
        return states[..., _OBSERVED]

    def state_columns(self, model: mujoco.MjModel) -> tuple[int | None, ...]:
        """All of them."""
        return tuple(range(_OBSERVED.start, _OBSERVED.stop))

    def reward(self, step: Transition) -> FloatArray:
        """Speed forward in m/s less the cost of control."""
        forward = (step.next_states[..., _X] - step.states[..., _X]) / _PUBLISHED.step
        return np.asarray(forward - _PUBLISHED.control_cost * np.einsum("...a,...a->...", step.actions, step.actions))

    def initial_velocities(self, rng: np.random.Generator, shape: tuple[int, int]) -> FloatArray:
        """Normal (count, nv), as published."""
        return _PUBLISHED.noise * rng.standard_normal(shape)


def links() -> HalfCheetah:
    """HalfCheetahLinks: five lengths."""
    parameters = [
        scaled(
            one.parameter, one.length, [f"link:{g}.length" for g in (one.back, one.front) if g], "m", one.description
        )
        for one in _LINKS
    ]
    return _task("HalfCheetahLinks", "A planar cheetah runs; the lengths of its links are unknown.", parameters)


def joints() -> HalfCheetah:
    """HalfCheetahJoints: damping, stiffness and gear of five leg joints, the front ankle as published (15)."""
    summary = "A planar cheetah runs; springs, dampers and motors of five of its leg joints are unknown."
    return _task("HalfCheetahJoints", summary, _joint_parameters(_LEGS[:-1]))


def all_joints() -> HalfCheetah:
    """HalfCheetahAllJoints: damping, stiffness and gear of all six leg joints (18)."""
    summary = "A planar cheetah runs; springs, dampers and motors of all its leg joints are unknown."
    return _task("HalfCheetahAllJoints", summary, _joint_parameters(_LEGS))


def _joint_parameters(legs: tuple[_Leg, ...]) -> list[Parameter]:
    kinds = (
        (
            *("damping", "joint", "N m s/rad"),
            "Torque against the speed of the {joint}, which slows and shortens its strokes; it trades off against the "
            "gear in fast motion.",
        ),
        (
            *("stiffness", "joint", "N m/rad"),
            "Spring that returns the {joint} to its middle, which also carries weight; it trades off against the gear "
            "in slow motion.",
        ),
        (
            *("gear", "actuator", "N m"),
            "Torque of the motor at the {joint} at full action; stiffness and damping scaled with it keep most of the "
            "motion.",
        ),
    )
    return [
        scaled(f"{leg.name}_{kind}", value, [f"{owner}:{leg.name}.{kind}"], unit, text.format(joint=leg.words))
        for leg in legs
        for (kind, owner, unit, text), value in zip(kinds, (leg.damping, leg.stiffness, leg.gear), strict=True)
    ]


def _task(name: str, summary: str, parameters: list[Parameter]) -> HalfCheetah:
    return HalfCheetah(
        name=name,
        parameters=ParameterSpace(parameters),
        summary=summary,
        episode_steps=1000,
        solved=Solved("return", 4800.0),
        reference="gymnasium HalfCheetah-v5",
    )
