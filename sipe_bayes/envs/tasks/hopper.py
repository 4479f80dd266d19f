"""The hopper: mass, lengths and friction of a one-legged robot.

Model, observation, reward, starting states and ends are those of Gymnasium's Hopper-v5 (Erez, Tassa and Todorov,
Infinite-Horizon Model Predictive Control for Periodic Tasks with Contacts, 2011,
https://doi.org/10.15607/RSS.2011.VII.010): three motors, at most 1000 steps of 0.008 s, and an episode ends where the
torso sinks below 0.7 m or leans by more than 0.2 rad. Velocities are observed up to 10 m/s or rad/s.

How a link grows is described in ``sipe_bayes.envs.tasks.links``. Lengths stay within a quarter of the published ones:
on shorter legs the torso could not stand above 0.7 m. It starts at the same height whatever the leg: a long one begins
pressed into the ground and pushes it up.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from sipe_bayes.core.arrays import BoolArray, FloatArray
from sipe_bayes.core.parameters import ParameterSpace
from sipe_bayes.envs.assets import compiled_without_visuals, gymnasium_asset
from sipe_bayes.envs.task import Solved, Transition, scaled
from sipe_bayes.envs.tasks.links import LinkTask


@dataclass(frozen=True)
class _Published:
    """Hopper-v5's numbers."""

    step: float = 0.008  # s, four physics steps
    control_cost: float = 1e-3  # a step and squared action
    alive: float = 1.0  # a step
    noise: float = 5e-3  # half-width of the starting states
    fastest: float = 10.0  # of an observed velocity, m/s or rad/s
    lowest: float = 0.7  # m, of the torso
    steepest: float = 0.2  # rad, of the torso
    largest: float = 100.0  # of everything that follows in the state
    torso_mass: float = 3.665191429188092  # kg, of its geom at MuJoCo's density


_PUBLISHED = _Published()
_JOINTS = ("rootx", "rootz", "rooty", "thigh", "leg", "foot")
_X, _Z, _PITCH, _VELOCITIES = 1, 2, 3, slice(7, 13)  # columns of the state, whose first is the time


@dataclass(frozen=True, eq=False)
class Hopper(LinkTask):
    """Actions in [-1, 1], times 200 N m."""

    frame_skip = 4
    num_actions = 3
    start_noise = _PUBLISHED.noise
    channels = ("torso_z", *(f"{j}_angle" for j in _JOINTS[2:]), *(f"{j}_velocity" for j in _JOINTS))

    def compile(self) -> mujoco.MjModel:
        """The published model."""
        return compiled_without_visuals(gymnasium_asset("hopper.xml"))

    def observe(
        self, model: mujoco.MjModel, states: FloatArray, derived: FloatArray | None, goals: FloatArray | None = None
    ) -> FloatArray:
        """All of the state but the time and the way along the ground, velocities clipped."""
        observations = states[..., _Z : _VELOCITIES.stop].copy()
        velocities = observations[..., _VELOCITIES.start - _Z :]
        np.clip(velocities, -_PUBLISHED.fastest, _PUBLISHED.fastest, out=velocities)
        return observations

    def state_columns(self, model: mujoco.MjModel) -> tuple[int | None, ...]:
        """Angles and the height; a velocity is not measured beyond 10."""
        return (*range(_Z, _VELOCITIES.start), *[None] * (_VELOCITIES.stop - _VELOCITIES.start))

    def reward(self, step: Transition) -> FloatArray:
        """Speed forward in m/s, 1 for staying upright, less the cost of control."""
        forward = (step.next_states[..., _X] - step.states[..., _X]) / _PUBLISHED.step
        effort = np.einsum("...a,...a->...", step.actions, step.actions)
        return np.asarray(forward + _PUBLISHED.alive * ~self.terminated(step) - _PUBLISHED.control_cost * effort)

    def terminated(self, step: Transition) -> BoolArray:
        """Too low, leaning too far, or out of all bounds."""
        states = step.next_states
        upright = (states[..., _Z] > _PUBLISHED.lowest) & (np.abs(states[..., _PITCH]) < _PUBLISHED.steepest)
        return np.asarray(~(upright & (np.abs(states[..., _PITCH : _VELOCITIES.stop]) < _PUBLISHED.largest).all(-1)))


def hopper() -> Hopper:
    """Hopper: mass of the torso, three lengths, friction of the foot, damping of the joints."""
    return Hopper(
        name="Hopper",
        parameters=ParameterSpace(
            [
                scaled(
                    *("torso_mass", _PUBLISHED.torso_mass, ["body:torso.mass"], "kg"),
                    "What the leg must lift: a heavier torso jumps less far and turns less with the leg. It trades off "
                    "against the lengths, which change the mass of the leg.",
                ),
                scaled(
                    *("thigh_length", 0.45, ["link:thigh_geom.length"], "m"),
                    "Distance of the knee from the hip, with the thigh's mass; in the height of the torso it trades "
                    "off against the leg.",
                    *(0.75, 1.25),
                ),
                scaled(
                    *("leg_length", 0.5, ["link:leg_geom.length"], "m"),
                    "Distance of the ankle from the knee, with the shank's mass; in the height of the torso it trades "
                    "off against the thigh.",
                    *(0.75, 1.25),
                ),
                scaled(
                    *("foot_length", 0.39, ["link:foot_geom.length"], "m"),
                    "Reach of heel and toe about the ankle, which decides when the hopper tips over and how it pushes "
                    "off; its mass trades off against the leg's.",
                    *(0.75, 1.25),
                ),
                scaled(
                    *("foot_friction", 2.0, ["geom:foot_geom.friction"], "1"),
                    "How hard the foot may push along the ground before it slips; without slipping it changes nothing.",
                ),
                scaled(
                    *(
                        "joint_damping",
                        1.0,
                        [f"joint:{j}_joint.damping" for j in ("thigh", "leg", "foot")],
                        "N m s/rad",
                    ),
                    "Torque against the speed of hip, knee and ankle, which slows the leg; it trades off against the "
                    "torso's mass.",
                ),
            ]
        ),
        summary="A planar robot hops on its only leg; mass, lengths, friction and damping are unknown.",
        episode_steps=1000,
        solved=Solved("return", 3800.0),
        reference="gymnasium Hopper-v5",
        outside_sign=(1, -1, 1, -1, 1, -1),
    )
