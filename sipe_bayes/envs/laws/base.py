r"""What a law is: a force at a joint that MJCF has no element for, written before every physics step.

Letters of the laws: tau_t the torque that a joint passes on to the body it carries (gravity and inertia included, the
armature's not), v the joint's velocity, q its position, u the command and f the actuator's force. A law that remembers
has numbers of its own that go on with the motion; they are part of the physics state, as activations of an actuator
without force, so that a simulation can be cut anywhere.

Deviations:

- The torque that a joint passes on is that of the step without the laws' own friction.
- The actuator's force is the one that it has without the laws.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import mujoco
import numpy as np

from sipe_bayes.core.arrays import FloatArray

SINGLE = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
"""Kinds of joints with one position: hinges and slides."""


class LawError(ValueError):
    """A law where it cannot act."""


@dataclass(frozen=True)
class Number:
    """One number of a law.

    Args:
        attribute: of the target that writes it.
        unit: of its value.
        neutral: where the law does nothing; of a shape, where a model has it until a parameter writes it.
        minimum: the smallest value.
        shape: whether it is the shape of a force, not its size: then no value of it stands for the plain model.
    """

    attribute: str
    unit: str
    neutral: float = 0.0
    minimum: float = -np.inf
    shape: bool = False


@dataclass(frozen=True)
class Now:
    """What B simulations are at before a physics step.

    Args:
        numbers: (B, K), the law's.
        position: (B,), of the joint, rad or m.
        velocity: (B,).
        command: (B,), of the actuator; zero where none drives the joint.
        sensed: (B,), the torque that the joint passes on, or the actuator's force; zero where the law asks for neither.
        total: (B,), sizes of the forces of all actuators that have this law, added up.
        memory: (B, M), what the law remembers.
    """

    numbers: FloatArray
    position: FloatArray
    velocity: FloatArray
    command: FloatArray
    sensed: FloatArray
    total: FloatArray
    memory: FloatArray


class Law(ABC):
    """A force at a joint that MJCF has no element for.

    ``kind`` says what it is declared at; ``senses`` whether it needs the transmitted torque or the actuator's force. A
    law gives a force or friction. Adding one takes a class, and an extension that writes its numbers.
    """

    name: ClassVar[str]
    kind: ClassVar[str] = "joint"
    senses: ClassVar[str] = ""  # "torque" of a joint, "force" of an actuator
    friction: ClassVar[bool] = True  # whether ``value`` is dry friction or a force
    memory: ClassVar[int] = 0  # M, numbers that it remembers, each from -1 to 1
    numbers: ClassVar[tuple[Number, ...]]

    @abstractmethod
    def value(self, now: Now) -> FloatArray:
        """Dry friction (B,) to add to the joint's, N m or N; or a force (B,), of an actuator before its gear."""

    def remembered(self, now: Now, shift: FloatArray) -> FloatArray:
        """What it remembers (B, M) after a step in which the joint moved by ``shift`` (B,)."""
        return now.memory

    def moving(self, direction: FloatArray) -> FloatArray:
        """What it remembers (B, M) of long motion in a direction (B,) from -1 to 1."""
        return np.repeat(direction[:, None], self.memory, axis=1)
