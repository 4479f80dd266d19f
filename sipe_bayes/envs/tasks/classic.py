"""Two small tasks for tutorials and quick tests: a pendulum to swing up and a pole to balance on a cart.

Both are rigid uniform rods with the masses, lengths, torques and time steps of Gymnasium's Pendulum-v1 and CartPole-v1
(Barto, Sutton and Anderson, Neuronlike Adaptive Elements That Can Solve Difficult Learning Control Problems, 1983,
https://doi.org/10.1109/TSMC.1983.6313077), as MuJoCo models, one physics step a control step. What differs, on purpose:

- There is friction: viscous damping at the pendulum's hinge and between cart and track. Without it the motion is the
  published one.
- MuJoCo steps velocity first (semi-implicit Euler): so does Pendulum-v1, and CartPole-v1 where its
  ``kinematics_integrator`` is set so; by default that one steps forward (explicit Euler).
- The pendulum's speed has no limit; Pendulum-v1's is 8 rad/s.
- The cart's action is a force between -10 and 10 N in units of 10 N; CartPole-v1 knows the two ends only.

A length changes where the rod's mass is, not how much there is: mass and length are independent parameters.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import ClassVar

import mujoco
import numpy as np

from sipe_bayes.core.arrays import BoolArray, FloatArray
from sipe_bayes.core.parameters import ParameterSpace
from sipe_bayes.envs.target import Target, TargetError, named
from sipe_bayes.envs.task import Solved, Task, Transition, scaled

PENDULUM = """
<mujoco model="pendulum">
  <option timestep="0.05" gravity="0 0 -10"/>
  <worldbody>
    <body name="rod" pos="0 0 1.2">
      <joint name="hinge" axis="0 1 0" damping="0.1"/>
      <inertial pos="0 0 0.5" mass="1" diaginertia="0.08333333333333333 0.08333333333333333 0.0001"/>
      <geom name="rod" type="capsule" pos="0 0 0.5" size="0.05 0.5" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <actuator><motor name="hinge" joint="hinge" ctrllimited="true" ctrlrange="-2 2"/></actuator>
</mujoco>
"""
CART_POLE = """
<mujoco model="cart_pole">
  <option timestep="0.02" gravity="0 0 -9.8"/>
  <worldbody>
    <body name="cart">
      <joint name="slider" type="slide" axis="1 0 0" damping="0.5"/>
      <inertial pos="0 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>
      <geom name="cart" type="box" size="0.25 0.15 0.1" contype="0" conaffinity="0"/>
      <body name="pole">
        <joint name="hinge" axis="0 1 0"/>
        <inertial pos="0 0 0.5" mass="0.1" diaginertia="0.008333333333333333 0.008333333333333333 0.00001"/>
        <geom name="pole" type="capsule" pos="0 0 0.5" size="0.03 0.5" contype="0" conaffinity="0"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="slider" joint="slider" gear="10" ctrllimited="true" ctrlrange="-1 1"/></actuator>
</mujoco>
"""
_ROD = re.compile(r"^rod:(.+)\.length$")


@dataclass(frozen=True)
class _Published:
    """Pendulum-v1's and CartPole-v1's numbers."""

    torque: float = 2.0  # N m
    hanging: tuple[float, float] = (np.pi, 1.0)  # the pendulum starts anywhere, at up to 1 rad/s
    balanced: float = 0.05  # half-width of the cart's and the pole's starting states
    track: float = 2.4  # m, beyond which an episode ends
    fallen: float = float(np.radians(12.0))  # likewise


_PUBLISHED = _Published()


def rod_length(model: mujoco.MjModel, spec: str) -> Target:
    """The target ``rod:NAME.length`` (m) of a uniform rod along z from its joint, drawn as the capsule of that name.

    The rod's mass stays. Raises TargetError for another form, or a name that the model does not have.
    """
    match = _ROD.match(spec)
    if not match:
        raise TargetError(f"target {spec!r}: expected rod:BODY.length")
    body, geom = (named(model, kind, match.group(1), f"target {spec!r}") for kind in ("body", "geom"))
    length, per_mass = 2 * float(model.body_ipos[body, 2]), model.body_inertia[body] / model.body_mass[body]

    def write(other: mujoco.MjModel, value: float) -> None:
        other.body_ipos[body, 2] = other.geom_pos[geom, 2] = other.geom_size[geom, 1] = value / 2
        other.body_inertia[body] = per_mass * other.body_mass[body] * (value / length) ** 2

    return Target(spec, "m", length, write, order=1, constants=True, minimum=1e-6)


@dataclass(frozen=True, eq=False)
class Classic(Task):
    """States: time, positions, velocities."""

    frame_skip = 1
    num_actions = 1
    source: ClassVar[str]

    def compile(self) -> mujoco.MjModel:
        """The model of ``source``."""
        return mujoco.MjModel.from_xml_string(self.source)

    def bind(self, target: str) -> Target:
        """As every task's, and ``rod:NAME.length``."""
        return rod_length(self.published, target) if target.startswith("rod:") else super().bind(target)


@dataclass(frozen=True, eq=False)
class Pendulum(Classic):
    """Angle 0 is upright. Actions in [-2, 2] N m."""

    source = PENDULUM
    channels = ("cos_angle", "sin_angle", "angular_velocity")

    def observe(
        self, model: mujoco.MjModel, states: FloatArray, derived: FloatArray | None, goals: FloatArray | None = None
    ) -> FloatArray:
        """Cosine and sine of the angle, and the speed."""
        angle = states[..., 1]
        return np.stack([np.cos(angle), np.sin(angle), states[..., 2]], axis=-1)

    def state_columns(self, model: mujoco.MjModel) -> tuple[int | None, ...]:
        """The speed is measured directly."""
        return (None, None, 2)

    def reward(self, step: Transition) -> FloatArray:
        """Minus the squared angle from upright, with less for speed and torque, of the state that was acted in."""
        angle = (step.states[..., 1] + np.pi) % (2 * np.pi) - np.pi
        torque = np.clip(step.actions[..., 0], -_PUBLISHED.torque, _PUBLISHED.torque)
        return np.asarray(-(angle**2 + 0.1 * step.states[..., 2] ** 2 + 0.001 * torque**2))

    def initial_states(self, rng: np.random.Generator, count: int) -> tuple[FloatArray, None]:
        """Uniform, about hanging and upright alike."""
        start = rng.uniform(-np.array(_PUBLISHED.hanging), _PUBLISHED.hanging, (count, 2))
        return self.states(start[:, :1], start[:, 1:]), None


@dataclass(frozen=True, eq=False)
class CartPole(Classic):
    """Angle 0 is upright. Actions in [-1, 1], times 10 N on the cart."""

    source = CART_POLE
    channels = ("cart_position", "cart_velocity", "pole_angle", "pole_velocity")

    def observe(
        self, model: mujoco.MjModel, states: FloatArray, derived: FloatArray | None, goals: FloatArray | None = None
    ) -> FloatArray:
        """Positions and velocities, of the cart and the pole."""
        return states[..., (1, 3, 2, 4)]

    def state_columns(self, model: mujoco.MjModel) -> tuple[int | None, ...]:
        """All of them."""
        return (1, 3, 2, 4)

    def reward(self, step: Transition) -> FloatArray:
        """1 for every step, the last included."""
        return np.ones(step.actions.shape[:-1])

    def terminated(self, step: Transition) -> BoolArray:
        """Off the track, or fallen."""
        position, angle = step.next_states[..., 1], step.next_states[..., 2]
        return np.asarray((np.abs(position) > _PUBLISHED.track) | (np.abs(angle) > _PUBLISHED.fallen))

    def initial_states(self, rng: np.random.Generator, count: int) -> tuple[FloatArray, None]:
        """Uniform, nearly balanced."""
        start = rng.uniform(-_PUBLISHED.balanced, _PUBLISHED.balanced, (count, 4))
        return self.states(start[:, :2], start[:, 2:]), None


def pendulum() -> Pendulum:
    """Pendulum: mass and length of the rod, damping of its hinge."""
    return Pendulum(
        name="Pendulum",
        parameters=ParameterSpace(
            [
                scaled(
                    *("mass", 1.0, ["body:rod.mass"], "kg"),
                    "Weight and inertia of the rod, against which the motor works: without damping or torque it "
                    "changes nothing. It trades off against the length.",
                ),
                scaled(
                    *("length", 1.0, ["rod:rod.length"], "m"),
                    "A longer rod swings more slowly and is harder to lift; it trades off against the mass.",
                ),
                scaled(
                    *("damping", 0.1, ["joint:hinge.damping"], "N m s/rad"),
                    "Torque against the speed, which takes energy from every swing; a heavier rod loses it more "
                    "slowly.",
                ),
            ]
        ),
        summary="A rod is swung up and held by a weak motor; mass, length and damping are unknown.",
        episode_steps=200,
        solved=Solved("return", -200.0),
        reference="gymnasium Pendulum-v1, damped",
        action_low=-_PUBLISHED.torque,
        action_high=_PUBLISHED.torque,
    )


def cart_pole() -> CartPole:
    """CartPole: mass and length of the pole, friction of the cart."""
    return CartPole(
        name="CartPole",
        parameters=ParameterSpace(
            [
                scaled(
                    *("pole_mass", 0.1, ["body:pole.mass"], "kg"),
                    "How hard the pole pushes the cart about; a light one falls the same way whatever its mass, and it "
                    "trades off against the friction.",
                ),
                scaled(
                    *("pole_length", 1.0, ["rod:pole.length"], "m"),
                    "A longer pole falls more slowly and turns less as the cart is pushed; nothing trades off against "
                    "it fully.",
                ),
                scaled(
                    *("cart_friction", 0.5, ["joint:slider.damping"], "N s/m"),
                    "Force against the speed of the cart, small on short drives; it trades off against the pole's "
                    "mass.",
                ),
            ]
        ),
        summary="A pole is balanced on a cart that is pushed; mass and length of the pole and friction are unknown.",
        episode_steps=500,
        solved=Solved("return", 475.0),
        reference="gymnasium CartPole-v1, with friction and a continuous force",
    )
