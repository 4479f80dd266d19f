"""The Adroit hand's tasks: Relocate carries a ball to a target, Door turns a latch and pulls a door open.

Models, rewards and success are those of gymnasium-robotics' AdroitHandRelocate-v1 and AdroitHandDoor-v1 with dense
reward (Rajeswaran et al., Learning Complex Dexterous Manipulation with Deep Reinforcement Learning and Demonstrations,
2018, https://arxiv.org/abs/1709.10087). Positions of the palm, the handle and the ball are read one physics step old,
as those classes read them. What differs, on purpose:

- Every episode starts from one fixed state, the hand at rest. The published classes draw where the ball and its target,
  or the door, stand. Relocate keeps the places that its XML gives. The door's place in the XML is one that its class
  never draws, so the door stands in the middle of the box it is drawn from.
- The latch's damping is 1.5 N m s/rad at theta = 0.5, as the benchmark's table has it. The XML has 0.05:
  ``door(latch_damping=0.05)`` is the published class.
- What is only there to be seen (meshes, textures, materials) and the touch and joint sensors, which no observation
  uses, are left out of the simulated model: the motion is the same to the last bit and a model takes 0.1 MB, not 7 MB.
  ``scene`` compiles everything, to draw.

Two oddities of the published rewards are kept: 0.1 per metre between the palm and the handle or the ball is paid, not
charged as their documentation says; and a ball counts as lifted when its centre is above 4 cm, which that of a ball
with a radius above 4 cm is on the table.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import mujoco
import numpy as np

from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray
from sipe_bayes.core.parameters import ParameterSpace
from sipe_bayes.envs.assets import robotics_asset
from sipe_bayes.envs.target import Target, named
from sipe_bayes.envs.task import Solved, Task, Transition, scaled

_FINGERS = ("FFJ3", "FFJ2", "FFJ1", "FFJ0", "MFJ3", "MFJ2", "MFJ1", "MFJ0", "RFJ3", "RFJ2", "RFJ1", "RFJ0")
_HAND = ("WRJ1", "WRJ0", *_FINGERS, "LFJ4", "LFJ3", "LFJ2", "LFJ1", "LFJ0", "THJ4", "THJ3", "THJ2", "THJ1", "THJ0")
_PALM = "S_grasp"


@dataclass(frozen=True)
class _Door:
    """AdroitHandDoor-v1's numbers; angles of the hinge in rad, each with what is paid beyond it."""

    position: tuple[float, float, float] = (-0.25, 0.3, 0.301)  # of the frame in m, the middle of the published box
    ajar: float = 0.2
    wide: float = 1.0
    open: float = 1.35
    stop: float = 1.57
    ajar_reward: float = 2.0
    wide_reward: float = 8.0
    open_reward: float = 10.0
    distance_reward: float = 0.1  # per m
    closed_cost: float = 0.1  # per rad^2
    speed_cost: float = 1e-5


@dataclass(frozen=True)
class _Relocate:
    """AdroitHandRelocate-v1's numbers, lengths in m."""

    lifted: float = 0.04  # height of the ball's centre
    near: float = 0.1  # of ball and target
    at_target: float = 0.05  # likewise
    near_reward: float = 10.0
    at_target_reward: float = 20.0
    distance_reward: float = 0.1  # per m


_DOOR, _RELOCATE = _Door(), _Relocate()


def _xyz(name: str) -> tuple[str, ...]:
    return tuple(f"{name}_{axis}" for axis in "xyz")


def _distance(a: FloatArray, b: FloatArray) -> FloatArray:
    difference = a - b
    return np.sqrt(np.einsum("...i,...i->...", difference, difference))


@dataclass(frozen=True, eq=False)
class Adroit(Task):
    """The hand with absolute joint positions as commands: actions in [-1, 1] span each actuator's range."""

    frame_skip = 5
    needs_derived = True
    derived_late = True
    scene_file: ClassVar[str]
    observed: ClassVar[tuple[str, ...]]  # joints whose position comes first in an observation
    places: ClassVar[tuple[tuple[str, mujoco.mjtObj], ...]]  # what the sensordata holds the positions of

    def compile(self) -> mujoco.MjModel:
        """The simulated model: what is measured, without what is only seen."""
        return self._simulated(self._spec()).compile()

    def scene(self) -> mujoco.MjModel:
        """The same model with its meshes and textures, to draw; its state is that of the simulated one."""
        return self._spec().compile()

    def _simulated(self, spec: mujoco.MjSpec) -> mujoco.MjSpec:
        """The spec without what is only seen, measuring what is observed."""
        spec.compiler.discardvisual = True
        for sensor in list(spec.sensors):
            spec.delete(sensor)
        for name, kind in self.places:
            spec.add_sensor(name=name, type=mujoco.mjtSensor.mjSENS_FRAMEPOS, objtype=kind, objname=name)
        return spec

    def _spec(self) -> mujoco.MjSpec:
        return mujoco.MjSpec.from_file(str(robotics_asset(f"adroit_hand/{self.scene_file}")))

    def control(self, model: mujoco.MjModel, states: FloatArray, actions: FloatArray) -> FloatArray:
        """Joint positions: the actions, clipped, over the actuators' ranges."""
        middle, reach = self._command_range
        return middle + np.clip(actions, -1.0, 1.0) * reach

    def initial_states(self, rng: np.random.Generator, count: int) -> tuple[FloatArray, None]:
        """The one fixed start: every joint at zero and at rest."""
        return self.states(np.zeros((count, self.published.nq)), np.zeros((count, self.published.nv))), None

    def state_columns(self, model: mujoco.MjModel) -> tuple[int | None, ...]:
        """Joint angles."""
        joints: list[int | None] = [self._position(name) for name in self.observed]
        return (*joints, *[None] * (len(self.channels) - len(joints)))

    @cached_property
    def _command_range(self) -> tuple[FloatArray, FloatArray]:
        """Middle and half width (A,) of the actuators' ranges."""
        low, high = self.published.actuator_ctrlrange.T.copy()
        return (low + high) / 2, (high - low) / 2

    @cached_property
    def _observed_columns(self) -> IntArray:
        return np.array([self._position(name) for name in self.observed])

    def _position(self, joint: str) -> int:
        """Column of the state that holds a joint's position; the time comes before the positions."""
        return 1 + int(self.published.joint(joint).qposadr[0])


@dataclass(frozen=True, eq=False)
class Door(Adroit):
    """Sensordata: palm (3), handle (3). latch_damping: N m s/rad at theta = 0.5."""

    latch_damping: float = 1.5

    num_actions = 28
    scene_file = "adroit_door.xml"
    observed = ("ARRx", "ARRy", "ARRz", *_HAND, "latch", "door_hinge")
    places = ((_PALM, mujoco.mjtObj.mjOBJ_SITE), ("S_handle", mujoco.mjtObj.mjOBJ_SITE))
    channels = (*observed, *_xyz("palm"), *_xyz("handle"), *_xyz("palm_minus_handle"), "door_open")

    def _spec(self) -> mujoco.MjSpec:
        spec = super()._spec()
        spec.body("frame").pos[:] = _DOOR.position
        spec.joint("latch").damping[0] = self.latch_damping
        return spec

    def observe(
        self, model: mujoco.MjModel, states: FloatArray, derived: FloatArray | None, goals: FloatArray | None = None
    ) -> FloatArray:
        """Joint angles, palm, handle, what is between them, and whether the door is open."""
        assert derived is not None
        observations = np.empty((*states.shape[:-1], len(self.channels)))
        observations[..., :29] = states[..., self._observed_columns]
        observations[..., 29:35] = derived
        np.subtract(derived[..., :3], derived[..., 3:], out=observations[..., 35:38])
        observations[..., 38] = np.where(observations[..., 28] > _DOOR.wide, 1.0, -1.0)
        return observations

    def reward(self, step: Transition) -> FloatArray:
        """0.1 per metre from palm to handle, less for a closed door and for speed, and bonuses as the door opens."""
        assert step.next_derived is not None
        hinge, palm, handle = self._hinge(step), step.next_derived[..., :3], step.next_derived[..., 3:]
        speed = step.next_states[..., 1 + self.published.nq :]
        reward = _DOOR.distance_reward * _distance(palm, handle) - _DOOR.closed_cost * (hinge - _DOOR.stop) ** 2
        reward -= _DOOR.speed_cost * np.einsum("...i,...i->...", speed, speed)
        reward = reward + _DOOR.ajar_reward * (hinge > _DOOR.ajar) + _DOOR.wide_reward * (hinge > _DOOR.wide)
        return reward + _DOOR.open_reward * (hinge > _DOOR.open)

    def success(self, step: Transition) -> BoolArray:
        """Open."""
        return self._hinge(step) >= _DOOR.open

    def _hinge(self, step: Transition) -> FloatArray:
        return step.next_states[..., self._observed_columns[28]]


@dataclass(frozen=True, eq=False)
class Relocate(Adroit):
    """Sensordata: palm (3), ball (3), target (3)."""

    num_actions = 30
    scene_file = "adroit_relocate.xml"
    observed = ("ARTx", "ARTy", "ARTz", "ARRx", "ARRy", "ARRz", *_HAND)
    places = (
        (_PALM, mujoco.mjtObj.mjOBJ_SITE),
        ("Object", mujoco.mjtObj.mjOBJ_XBODY),
        ("target", mujoco.mjtObj.mjOBJ_SITE),
    )
    channels = (*observed, *_xyz("palm_minus_ball"), *_xyz("palm_minus_target"), *_xyz("ball_minus_target"))

    def observe(
        self, model: mujoco.MjModel, states: FloatArray, derived: FloatArray | None, goals: FloatArray | None = None
    ) -> FloatArray:
        """Joint angles, and what is between palm, ball and target."""
        assert derived is not None
        observations = np.empty((*states.shape[:-1], len(self.channels)))
        observations[..., :30] = states[..., self._observed_columns]
        palm, ball, target = derived[..., :3], derived[..., 3:6], derived[..., 6:]
        np.subtract(palm, ball, out=observations[..., 30:33])
        np.subtract(palm, target, out=observations[..., 33:36])
        np.subtract(ball, target, out=observations[..., 36:])
        return observations

    def reward(self, step: Transition) -> FloatArray:
        """0.1 per metre from palm to ball; above the table closeness to the target counts, with two bonuses."""
        assert step.next_derived is not None
        palm, ball, target = (step.next_derived[..., i : i + 3] for i in (0, 3, 6))
        gap = _distance(ball, target)
        lifted = 1.0 - 0.5 * _distance(palm, target) - 0.5 * gap
        reward = _RELOCATE.distance_reward * _distance(palm, ball)
        reward = reward + np.where(ball[..., 2] > _RELOCATE.lifted, lifted, 0.0)
        reward = reward + _RELOCATE.near_reward * (gap < _RELOCATE.near)
        return reward + _RELOCATE.at_target_reward * (gap < _RELOCATE.at_target)

    def success(self, step: Transition) -> BoolArray:
        """The ball near its target."""
        assert step.next_derived is not None
        return _distance(step.next_derived[..., 3:6], step.next_derived[..., 6:]) < _RELOCATE.near

    def bind(self, target: str) -> Target:
        """As every task's, and ``ball:radius``."""
        return _ball_radius(self.published, target) if target == "ball:radius" else super().bind(target)


def _ball_radius(model: mujoco.MjModel, spec: str) -> Target:
    """The radius at an unchanged mass: a solid sphere's inertia 2/5 m r^2 goes with its square.

    Written after the mass, whose scale of the inertia is kept.
    """
    geom, body = named(model, "geom", "sphere", spec), named(model, "body", "Object", spec)
    radius, mass = float(model.geom_size[geom, 0]), float(model.body_mass[body])
    inertia = model.body_inertia[body].copy()

    def write(other: mujoco.MjModel, value: float) -> None:
        other.geom_size[geom, 0] = value
        other.body_inertia[body] = inertia * (other.body_mass[body] / mass * (value / radius) ** 2)

    return Target(spec, "m", radius, write, order=1, constants=True, minimum=0.0)


_FRAME_MASS = """Mass of the fixed frame. The frame cannot move, so this changes nothing but rounding, which contact \
may amplify: expect the prior back."""
_DOOR_MASS = """Mass and, with it, inertia of the door leaf: how slowly it gains and loses speed. Trades off against \
the latch mass, since the latch hangs on the leaf and turns with it."""
_LATCH_MASS = """Mass and, with it, inertia of the latch and its handle: it turns with the door, and pulls on the \
latch because it hangs off its axis. Trades off against the door mass and, once the latch turns, its friction loss."""
_DOOR_FRICTION = """Dry friction of the door hinge: the torque below which the door stands still. Trades off against \
the door damping unless the door is seen to move at several speeds."""
_LATCH_FRICTION = """Dry friction of the latch: the torque below which it stays where it is, so it shows only while a \
hand turns the latch. Trades off against the latch damping unless the latch is seen to turn at several speeds."""
_DOOR_DAMPING = """Friction of the door hinge in proportion to its speed: how soon a swinging door stops. Trades off \
against the door friction loss."""
_LATCH_DAMPING = """Friction of the latch in proportion to its speed: how fast a hand can turn it and how soon it \
stops. Trades off against the latch friction loss, which hardly shows in a latch that coasts to rest under this \
damping."""
_BALL_MASS = """Mass and, with it, inertia of the ball: how it answers a push and how it loads the hand. \
Shows only while the hand touches it; trades off against the radius, which sets where that happens."""
_BALL_RADIUS = """Radius of the ball at an unchanged mass, its inertia with the square of it: how high it lies and \
where the fingers meet it. Trades off against the mass in how the ball turns."""


def door(latch_damping: float = 1.5) -> Door:
    """Door with the paper's seven parameters; latch_damping: its default in N m s/rad."""
    leaf, latch, hinge = "body:door.mass", "body:latch.mass", "joint:door_hinge"
    parameters = ParameterSpace(
        [
            scaled("frame_mass", 7.85398, ["body:frame.mass"], "kg", _FRAME_MASS),
            scaled("door_mass", 2.43455, [leaf], "kg", _DOOR_MASS),
            scaled("latch_mass", 3.53743, [latch], "kg", _LATCH_MASS),
            scaled("door_friction_loss", 2.0, [f"{hinge}.frictionloss"], "N m", _DOOR_FRICTION),
            scaled("latch_friction_loss", 5.0, ["joint:latch.frictionloss"], "N m", _LATCH_FRICTION),
            scaled("door_damping", 1.0, [f"{hinge}.damping"], "N m s/rad", _DOOR_DAMPING),
            scaled("latch_damping", latch_damping, ["joint:latch.damping"], "N m s/rad", _LATCH_DAMPING, 0.25, 1.75),
        ]
    )
    return Door(
        name="Door",
        parameters=parameters,
        summary="A 24-joint hand on an arm turns a latch and pulls a door open",
        episode_steps=200,
        solved=Solved("success", 0.9),
        reference=f"gymnasium-robotics AdroitHandDoor-v1, latch damping {latch_damping:g}",
        outside_sign=(1, -1, 1, -1, 1, 1, 1),  # of the latch's damping upwards: below theta = -1/6 it is negative
        latch_damping=latch_damping,
    )


def relocate() -> Relocate:
    """Relocate with the paper's two parameters."""
    parameters = ParameterSpace(
        [
            scaled("ball_mass", 0.179594, ["body:Object.mass"], "kg", _BALL_MASS),
            scaled("ball_radius", 0.035, ["ball:radius"], "m", _BALL_RADIUS),
        ]
    )
    return Relocate(
        name="Relocate",
        parameters=parameters,
        summary="A 24-joint hand on an arm takes a ball from the table to a target in the air",
        episode_steps=200,
        solved=Solved("success", 0.5),
        reference="gymnasium-robotics AdroitHandRelocate-v1",
    )
