"""The Environment contract: what a simulator needs to know about a robot, and nothing that it does.

An Environment is an immutable, picklable description. It compiles a MuJoCo model, says how theta is written into it
in place, how actions become controls and how states become observations. The engine
(``sipe_bayes.simulation.simulator``) owns batching, threads, model pools and the flagging of diverged rollouts.

To add one: subclass, set ``space``, ``channels`` and ``num_actions``, and define the abstract methods below as pure
functions of their arguments. ``derived`` is MuJoCo's sensordata, aligned by the engine with the state it belongs to;
an environment that reproduces a published one may have it ``late``. The benchmark's tasks add rewards, goals and
starting states (``sipe_bayes.envs.task``).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import ParameterSpace
from sipe_bayes.envs.sensing import Sensing

if TYPE_CHECKING:
    import mujoco

    from sipe_bayes.envs.poses import PoseReading

START_SD = (10.0, 100.0, 10.0)  # position, velocity, activation: far wider than any measurement
_CONTROL = 1 << 6  # mjSTATE_CTRL, without importing mujoco here


class Environment(ABC):
    """A robot to simulate: a model, its unknown parameters, what is commanded and what is observed."""

    space: ParameterSpace
    channels: tuple[str, ...]
    num_actions: int
    needs_derived: bool = False
    sensed: tuple[int, ...] = ()  # channels of whose sensor a parameter changes something
    data_fields: tuple[str, ...] = ()  # MjData arrays derived in place of sensordata, for what no sensor returns
    derived_late: bool = False  # derived belongs to the state before the last physics step, as Gymnasium reads it
    frame_skip: int = 1  # physics steps of a control step where no dt is given
    stepwise: bool = False  # control needs the state: control steps are simulated one by one
    kinematic: bool = False  # a stepwise environment's sensors feel no forces: read without contacts and constraints
    memory_size: int = 0  # M, columns of a stepwise environment's states behind MuJoCo's own
    goal_size: int = 0  # G
    rotations: tuple[tuple[int, int, int], ...] = ()  # channels that are together a rotation vector (rad)
    added: tuple[object, ...] = ()  # what single logs have more than the model
    poses: tuple[PoseReading, ...] = ()  # what the channels tell of free and ball joints

    @property
    def control_spec(self) -> int:
        """MuJoCo's mjtState bits of what ``control`` returns."""
        return _CONTROL

    @abstractmethod
    def compile(self) -> mujoco.MjModel:
        """A fresh mujoco.MjModel at the default parameters."""

    @abstractmethod
    def write(self, model: mujoco.MjModel, values: FloatArray, log: str | None = None) -> bool:
        """Write parameters into a model in place. The engine refreshes derived constants where ``needs_constants``.

        Args:
            model: a copy of the compiled one.
            values: (N,), in physical units.
            log: the log that they are to hold in.

        Returns:
            Whether they are physical; an unphysical model is never simulated.
        """

    def start_sd(self, model: mujoco.MjModel) -> FloatArray:
        """Prior sds (2 nv + na,) of where windows start about their reference: positions, velocities, activations."""
        return np.repeat(START_SD, [model.nv, model.nv, model.na])

    @property
    def remembers(self) -> FloatArray:
        """Seconds (O,) after a window's beginning in which a channel tells of what was before, which is not known."""
        return np.zeros(len(self.channels))

    def least_steps(self, theta: FloatArray) -> FloatArray:
        """Least changes (N,) of theta (N,) that finite differences can be taken over; zero for all that is smooth."""
        return np.zeros(len(self.space))

    @property
    def by_log(self) -> bool:
        """Whether logs differ in their model: in a parameter of one log alone. If not, they share their models."""
        return any(parameter.log is not None for parameter in self.space)

    @property
    def needs_constants(self) -> bool:
        """Whether mj_setConst must follow ``write``."""
        return True

    @abstractmethod
    def control(self, model: mujoco.MjModel, states: FloatArray, actions: FloatArray) -> FloatArray:
        """Controls (..., U) of actions (..., A), and of states (..., S) where the environment is ``stepwise``."""

    @abstractmethod
    def observe(
        self, model: mujoco.MjModel, states: FloatArray, derived: FloatArray | None, goals: FloatArray | None = None
    ) -> FloatArray:
        """What is observed, without sensor bias.

        Args:
            model: the compiled one.
            states: (..., S).
            derived: (..., D), where the environment ``needs_derived``.
            goals: (..., G), of a task that has them.

        Returns:
            Observations (..., O).
        """

    def recorded_goals(self, observations: FloatArray) -> FloatArray | None:
        """Goals (..., G) that observations (..., O) were made with; None of an environment without goals."""
        return None

    def rewards(
        self, states: FloatArray, derived: FloatArray | None, actions: FloatArray, goals: FloatArray | None
    ) -> FloatArray | None:
        """What whole rollouts earn; by default nothing.

        Args:
            states: (B, T+1, S).
            derived: (B, T+1, D) or None.
            actions: (B, T, A).
            goals: (B, G) or None.

        Returns:
            Rewards (B, T), or None without any.
        """
        return None

    def settle(self, model: mujoco.MjModel, states: FloatArray) -> FloatArray:
        """States (B, S) as a stepwise environment edits them after each control step."""
        return states

    def probe(self, model: mujoco.MjModel, before: FloatArray, states: FloatArray) -> FloatArray:
        """The states whose sensordata a stepwise environment reads after a control step.

        Args:
            model: the compiled one.
            before: states (B, S) one physics step before its end.
            states: (B, S) at its end.

        Returns:
            States (B, S).
        """
        return states

    def remember(self, derived: FloatArray) -> FloatArray:
        """What a stepwise environment keeps of the sensordata (B, D) for its next control: (B, M)."""
        return derived[:, :0]

    def bias(self, values: FloatArray, log: str | None = None) -> FloatArray:
        """Sensor bias (O,) added to every observation, of parameters (N,) in physical units as they hold in ``log``."""
        return np.zeros(len(self.channels))

    def sensing(self, values: FloatArray, log: str | None = None) -> Sensing:
        """What sensors make of what is observed, of parameters (N,) in physical units as they hold in ``log``.

        A pure function of a rollout's observations; one that remembers earlier samples is not Markov, and takes the
        first two samples of a window to go on what came before.
        """
        bias = self.bias(values, log)
        return Sensing.of_bias(bias) if bias.any() else self.exact_sensing

    @cached_property
    def exact_sensing(self) -> Sensing:
        """Sensors that observe what is there, one object for all rollouts."""
        return Sensing.of_bias(np.zeros(len(self.channels)))

    @abstractmethod
    def state_columns(self, model: mujoco.MjModel) -> tuple[int | None, ...]:
        """For each channel the column of the physics state that it measures directly, if it does."""

    def history(
        self, model: mujoco.MjModel, states: FloatArray, actions: Sequence[FloatArray], timestep: FloatArray
    ) -> FloatArray:
        """Fill the command history, which is part of the state; without delayed actuators there is none.

        Args:
            model: the compiled one.
            states: (B, S).
            actions: for each state those that came before it, (n, A), one row a physics step, the newest last.
            timestep: (B,) seconds of a physics step.

        Returns:
            States (B, S).
        """
        return states
