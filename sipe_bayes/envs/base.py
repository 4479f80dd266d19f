"""The Environment contract: what a simulator needs to know about a robot, and nothing that it does.

An Environment is an immutable, picklable description. It compiles a MuJoCo model, says how theta is written into it
in place, how actions become controls and how states become observations. The engine (``sipe_bayes.simulator``) owns
batching, threads, model pools and the flagging of diverged rollouts.

To add one: subclass, set ``space``, ``channels`` and ``num_actions``, and define the abstract methods below as pure
functions of their arguments. ``derived`` is MuJoCo's sensordata, aligned by the engine with the state it belongs to.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sipe_bayes.parameters import ParameterSpace

FloatArray = NDArray[np.float64]


class Environment(ABC):
    """A robot to simulate: a model, its unknown parameters, what is commanded and what is observed."""

    space: ParameterSpace
    channels: tuple[str, ...]
    num_actions: int
    needs_derived: bool = False

    @abstractmethod
    def compile(self) -> Any:
        """A fresh mujoco.MjModel at the default parameters."""

    @abstractmethod
    def write(self, model: Any, values: FloatArray, log: str | None = None) -> bool:
        """Write ``values`` (N,) in physical units into a model in place, as they hold in the log ``log``.

        Returns whether they are physical; an unphysical model is never simulated. Derived constants are refreshed by
        the engine when ``needs_constants``."""

    @property
    def needs_constants(self) -> bool:
        """Whether mj_setConst must follow ``write``."""
        return True

    @abstractmethod
    def control(self, model: Any, states: FloatArray, actions: FloatArray) -> FloatArray:
        """Controls (..., nu) of actions (..., A)."""

    @abstractmethod
    def observe(self, model: Any, states: FloatArray, derived: FloatArray | None) -> FloatArray:
        """Observations (..., O) of states (..., S) and sensordata (..., D), without sensor bias."""

    def bias(self, values: FloatArray, log: str | None = None) -> FloatArray:
        """Sensor bias (O,) added to every observation."""
        return np.zeros(len(self.channels))

    @abstractmethod
    def state_columns(self, model: Any) -> tuple[int | None, ...]:
        """For each channel the column of the physics state that it measures directly, if it does."""

    def history(
        self, model: Any, states: FloatArray, actions: Sequence[FloatArray], timestep: FloatArray
    ) -> FloatArray:
        """States (L, S) whose command history holds the ``actions`` ((n, A), one row a physics step, newest last)
        that came before each of them. Without delayed actuators the states are returned as they are."""
        return states
