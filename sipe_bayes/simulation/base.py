"""What open and closed loop share: the compiled model, its engine and its written copies."""

from __future__ import annotations

import hashlib
import math
from functools import cached_property
from typing import ClassVar, Self

import mujoco
import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import ParameterSpace
from sipe_bayes.core.validation import cores, most_threads, whole
from sipe_bayes.envs.base import Environment
from sipe_bayes.envs.task import Task
from sipe_bayes.simulation.device import Device, Processor
from sipe_bayes.simulation.engine import Engine

MOST_STEPS = 10_000
"""Physics steps of a control step: beyond, nobody waits for a fit."""


class Simulated:
    """An environment, compiled; see ``Simulator``, which is what it is made for."""

    total_steps: ClassVar[int] = 0  # control steps of all rollouts of this process, whichever simulator's
    failure: ClassVar[str] = "diverged"  # what is said of simulations that are not valid to their end

    def __init__(self, environment: Environment, num_threads: int | None = None, device: str = "cpu") -> None:
        if not isinstance(environment, Environment):
            hint = f"sipe.make_task({environment!r})" if isinstance(environment, str) else "one of sipe.make_task(name)"
            raise ValueError(f"environment: expected an Environment, got {environment!r}; give {hint}")
        self.environment = environment
        self.num_threads = cores() if num_threads is None else whole("num_threads", num_threads, most=most_threads())
        self.model = environment.compile()
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_WARMSTART
        self.model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)  # divergence must show
        self.engine = Engine(environment, self.model, self.num_threads)
        self.device = device
        self.runs: Device = Processor(self.engine) if device == "cpu" else on_gpu(self.engine, device)
        self.pool = self.runs.pool()
        self.diverged = 0
        self.control_steps = 0

    def __reduce__(self) -> tuple[type[Self], tuple[object, ...]]:
        return type(self), (self.environment, self.num_threads, self.device)

    @property
    def task(self) -> Task:
        """The benchmark's task that is simulated; raises ValueError for another environment."""
        if not isinstance(self.environment, Task):
            raise ValueError(
                f"reset: {type(self.environment).__name__} has no starting states and no rewards; use rollout, or a "
                "task of `sipe envs`"
            )
        return self.environment

    @property
    def space(self) -> ParameterSpace:
        """The environment's parameters."""
        return self.environment.space

    @property
    def state_size(self) -> int:
        """S: the numbers of MuJoCo's full physics state, and of a stepwise environment's memory."""
        return self.engine.physics_size + self.environment.memory_size

    @property
    def dt(self) -> float:
        """Seconds of a control step where none are given."""
        return float(self.environment.frame_skip * self.model.opt.timestep)

    def checksum(self) -> str:
        """SHA-256 of the compiled default model, with whatever files its MJCF includes."""
        buffer = np.empty(mujoco.mj_sizeModel(self.model), np.uint8)
        mujoco.mj_saveModel(self.model, None, buffer)
        return hashlib.sha256(buffer.tobytes()).hexdigest()

    def default_state(self) -> FloatArray:
        """State (S,) after a reset of the default model."""
        return self._default_state.copy()

    @cached_property
    def _default_state(self) -> FloatArray:
        data, state = mujoco.MjData(self.model), np.empty(self.engine.physics_size)
        mujoco.mj_getState(self.model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        if not self.environment.memory_size:
            return state
        memory = self.environment.remember(self.engine.sensors([self.model], state[None]))
        return np.concatenate([state, memory[0]])

    def physics_steps(self, dt: float) -> tuple[int, float]:
        """How a control step of ``dt`` seconds is divided.

        Returns:
            How many physics steps it has, and the seconds of each: never longer than the model's own.
        """
        own = float(self.model.opt.timestep)
        if not dt / own < MOST_STEPS:
            raise ValueError(
                f"dt: a control step of {dt:g} s has more than {MOST_STEPS} physics steps of {own:g} s; raise the "
                "model's timestep, or the logs' rate"
            )
        steps = max(1, math.ceil(dt / own - 1e-3))
        return steps, own if math.isclose(dt, steps * own, rel_tol=1e-12) else dt / steps

    def check_theta(self, theta: FloatArray, allow_outside: bool, num_envs: int | None = None) -> FloatArray:
        """Checked parameters.

        Args:
            theta: (..., N); with ``num_envs`` (num_envs, N) or (N,).
            allow_outside: whether it may leave [0, 1].
            num_envs: how many simulations it is for.

        Returns:
            A copy; (num_envs, N) where that is given.

        Raises:
            ValueError: for another shape, NaN, or values outside [0, 1] that are not allowed.
        """
        theta, n = np.array(theta, float), len(self.space)
        if theta.shape not in ((n,), (num_envs, n)) if num_envs is not None else theta.shape[-1:] != (n,):
            expected = f"({n},)" if num_envs in (None, 1) else f"({num_envs}, {n}) or ({n},)"
            raise ValueError(
                f"theta: expected {n} parameters, shape {expected}, got {theta.shape}; see the space's names"
            )
        if num_envs is not None:
            theta = np.tile(theta, (num_envs, 1)) if theta.ndim == 1 else theta
        if not np.isfinite(theta).all():
            raise ValueError("theta: expected finite numbers, got NaN or infinity")
        if not allow_outside and not ((theta >= 0) & (theta <= 1)).all():
            raise ValueError(
                f"theta: expected values in [0, 1], got {theta.min():.4g} to {theta.max():.4g}; "
                "clip them, or pass allow_outside=True"
            )
        return theta

    def check_physical(self, theta: FloatArray) -> None:
        """Raises ValueError for theta (N,) that no model can have."""
        self.pool.check_physical(theta)

    def written(self, theta: FloatArray, model: mujoco.MjModel | None = None) -> mujoco.MjModel:
        """A model of one's own with theta (N,) written in; see ``ModelPool.written``."""
        return self.pool.written(theta, model)


def on_gpu(engine: Engine, device: str) -> Device:
    """The engine of a GPU; raises ValueError without the packages, the device or what the model needs."""
    try:
        from sipe_bayes.simulation.gpu.devices import warp_name

        name = warp_name(device)
        from sipe_bayes.simulation.gpu.engine import GpuEngine
    except ModuleNotFoundError as error:
        raise ValueError(f"device: {error.name} is not installed; `pip install 'sipe-bayes[gpu]'`") from None
    return GpuEngine(engine, name)
