"""The one batch engine: many parameter values, many lanes, native threads, on ``mujoco.rollout``.

Every model runs with MuJoCo's warm start disabled, so the state is Markov: a lane's bits depend on its own
theta, start and actions alone, whatever the threads, the batch or what ran before. A rollout that diverges is
data: MuJoCo resets such a lane and ``mujoco.rollout`` repeats its last state, which shows as a time that is
not t0 + k dt; ``valid`` is False from the first such sample on. A step that raised any other warning (out of
contact memory, singular inertia) is the one before the first repeated state. MuJoCo's own messages are held
back meanwhile: nothing on the terminal, no MUJOCO_LOG.TXT; ``Simulator.diverged`` counts the lanes.
"""

from __future__ import annotations

import copy
import hashlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import mujoco
import numpy as np
from numpy.typing import NDArray

from sipe_bayes.core.parameters import ParameterSpace
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.core.validation import cores, whole
from sipe_bayes.envs.base import Environment
from sipe_bayes.envs.task import Task
from sipe_bayes.simulation.engine import HUGE, Engine, quiet
from sipe_bayes.simulation.episodes import Episodes, Step

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_CHUNK = 2**24  # numbers of state and sensor output held at once, 128 MiB
_POOL = 2**29  # bytes of models held at once


class Simulator:
    """Simulates an Environment for batches of theta.

    num_threads: native threads; default the processor's cores. ``control_steps`` counts what was simulated,
    ``diverged`` the lanes that are not valid to their end. Not for two Python threads at a time.
    """

    failure: ClassVar[str] = "diverged"  # what is said of simulations that are not valid to their end

    def __init__(self, environment: Environment, num_threads: int | None = None) -> None:
        if not isinstance(environment, Environment):
            hint = f"sipe.make_task({environment!r})" if isinstance(environment, str) else "one of sipe.make_task(name)"
            raise ValueError(f"environment: expected an Environment, got {environment!r}; give {hint}")
        self.environment = environment
        self.num_threads = cores() if num_threads is None else whole("num_threads", num_threads)
        self.model = environment.compile()
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_WARMSTART
        self.model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)  # divergence must show
        self.engine = Engine(environment, self.model, self.num_threads)
        self.diverged = 0
        self.control_steps = 0
        self._pool: list[Any] = []
        self._keys: list[bytes] = []
        self._scratch = mujoco.MjData(self.model)
        self._physical: list[bool] = []
        self._biases: list[FloatArray] = []
        self.episodes: Episodes | None = None

    def __reduce__(self) -> Any:
        return Simulator, (self.environment, self.num_threads)

    @property
    def space(self) -> ParameterSpace:
        return self.environment.space

    @property
    def state_size(self) -> int:
        """S: the numbers of MuJoCo's full physics state, and of a stepwise environment's memory."""
        return self.engine.physics_size + self.environment.memory_size

    def checksum(self) -> str:
        """SHA-256 of the compiled default model, with whatever files its MJCF includes."""
        buffer = np.empty(mujoco.mj_sizeModel(self.model), np.uint8)
        mujoco.mj_saveModel(self.model, None, buffer)
        return hashlib.sha256(buffer.tobytes()).hexdigest()

    def default_state(self) -> FloatArray:
        """State (S,) after a reset of the default model."""
        data, state = mujoco.MjData(self.model), np.empty(self.engine.physics_size)
        mujoco.mj_getState(self.model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        if not self.environment.memory_size:
            return state
        memory = self.environment.remember(self.engine.sensors([self.model], state[None]))
        return np.concatenate([state, memory[0]])

    @property
    def dt(self) -> float:
        """Seconds of a control step where none are given."""
        return float(self.environment.frame_skip * self.model.opt.timestep)

    def physics_steps(self, dt: float) -> tuple[int, float]:
        """How many physics steps make one control step of ``dt`` seconds, and how long each is; never longer
        than the model's own."""
        steps = max(1, math.ceil(dt / self.model.opt.timestep - 1e-3))
        own = float(self.model.opt.timestep)
        return steps, own if math.isclose(dt, steps * own, rel_tol=1e-12) else dt / steps

    def rollout(
        self,
        theta: FloatArray,
        actions: FloatArray,
        initial_state: FloatArray,
        dt: FloatArray | float | None = None,
        logs: Sequence[str | None] | None = None,
        allow_outside: bool = False,
        goals: FloatArray | None = None,
    ) -> Trajectories:
        """Open loop, whole horizon.

        theta (B, N), actions (B, T, A) and initial_state (B, S), each also with B = 1 for all lanes; dt:
        seconds per control step, (B,) or one number, default the environment's; goals (B, G) of a task that has them; logs: the log that each
        lane belongs to, for parameters that differ between logs. Returns Trajectories with observations,
        states and ``valid``. A lane whose parameters are unphysical or whose start is not finite is never
        simulated: NaN, and not valid from sample 0. Raises ValueError for shapes that do not fit, theta
        outside the unit cube, or actions that are not finite.
        """
        theta, actions, initial_state = self._check(theta, actions, initial_state, allow_outside)
        batch = max(len(theta), len(actions), len(initial_state))
        goals = self._check_goals(batch, goals)
        dts, names = self._check_lanes(batch, dt, logs)
        theta, actions, initial_state = (
            np.broadcast_to(a, (batch, *a.shape[1:])) for a in (theta, actions, initial_state)
        )
        distinct, which = np.unique(dts, return_inverse=True)
        found = [self.physics_steps(d) for d in distinct.tolist()]
        steps, timesteps = (np.array(x)[which] for x in zip(*found, strict=True))
        horizon = actions.shape[1]
        whole = _Motion.empty(batch, horizon, self)
        with quiet():
            for skip, chunk in self._chunks(steps, horizon):
                lanes = self._models(theta[chunk], timesteps[chunk], [names[i] for i in chunk])
                targets = None if goals is None else goals[chunk]
                part = self._run(skip, lanes, timesteps[chunk], actions[chunk], initial_state[chunk], targets)
                whole.states[chunk], whole.observations[chunk], whole.sound[chunk] = (
                    part.states,
                    part.observations,
                    part.sound,
                )
                if whole.derived is not None:
                    whole.derived[chunk] = part.derived
        valid = np.logical_and.accumulate(whole.sound, axis=1)
        self.diverged += int((~valid[:, -1]).sum())
        self.control_steps += batch * horizon
        length = np.full(batch, horizon)
        rewards = self.environment.rewards(whole.states, whole.derived, actions, goals)
        rewards = None if rewards is None else np.where(valid[:, 1:], rewards, 0.0)
        channels = self.environment.channels
        return Trajectories(whole.observations, actions, dts, length, valid, whole.states, (), channels, rewards)

    def replay(self, theta: FloatArray, trajectories: Trajectories, starts: FloatArray | None = None) -> Trajectories:
        """The recorded actions from the recorded starting states, for every theta (B, N): B * R trajectories, of theta 0 with
        each of the R recorded ones, then of theta 1 ..., each as long as the recorded one.

        starts (R, S), or (B * R, S) where they differ between thetas: starting states to use instead. Raises ValueError where nothing
        tells the starting states."""
        theta, count = np.atleast_2d(theta), len(trajectories)
        if starts is None and trajectories.states is None:
            raise ValueError("trajectories: they hold no states to start from; record them or pass starts (R, S)")
        first = trajectories.states[:, 0] if starts is None else np.asarray(starts, float)  # type: ignore[index]
        first = np.concatenate([np.zeros((len(first), 1)), first[:, 1:]], axis=1)
        batch, goals = len(theta), self.environment.recorded_goals(trajectories.observations[:, 0])
        result = self.rollout(
            np.repeat(theta, count, axis=0),
            np.tile(trajectories.actions, (batch, 1, 1)),
            first if len(first) == batch * count else np.tile(first, (batch, 1)),
            np.tile(trajectories.dt, batch),
            list(trajectories.names or [None] * count) * batch,
            goals=None if goals is None else np.tile(goals, (batch, 1)),
        )
        length = np.tile(trajectories.length, batch)
        inside = np.arange(result.valid.shape[1]) <= length[:, None]
        return replace(
            result,
            observations=np.where(inside[..., None], result.observations, np.nan),
            valid=result.valid & inside,
            length=length,
            names=tuple(trajectories.names) * batch,
        )

    def _check(
        self, theta: FloatArray, actions: FloatArray, initial_state: FloatArray, allow_outside: bool
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        theta = self.check_theta(np.atleast_2d(theta), allow_outside)
        actions = np.ascontiguousarray(actions, float)
        if actions.ndim == 2:
            actions = actions[None]
        if actions.ndim != 3 or actions.shape[-1] != self.environment.num_actions or not actions.shape[0]:
            raise ValueError(f"actions: expected (B, T, {self.environment.num_actions}), got {actions.shape}")
        if not actions.shape[1]:
            raise ValueError("actions: expected at least one control step, got none")
        if not (np.abs(actions) <= HUGE).all():
            raise ValueError(
                "actions: expected finite numbers up to 1e10, got NaN, infinity or more; mask or hold them first"
            )
        initial_state = np.atleast_2d(np.asarray(initial_state, float))
        if initial_state.shape[-1] != self.state_size:
            raise ValueError(f"initial_state: expected (B, {self.state_size}), got {initial_state.shape}")
        sizes = {len(theta), len(actions), len(initial_state)} - {1}
        if len(sizes) > 1:
            raise ValueError(
                f"batch sizes differ: theta {len(theta)}, actions {len(actions)}, initial_state {len(initial_state)}"
            )
        return theta, actions, initial_state

    def check_theta(self, theta: FloatArray, allow_outside: bool, lanes: int | None = None) -> FloatArray:
        """theta (B, N), a copy, or for a number of lanes (lanes, N) of theta (lanes, N) or (N,); raises ValueError for
        another shape, NaN, or values outside [0, 1] that are not allowed."""
        theta, n = np.array(theta, float), len(self.space)
        if theta.shape not in ((n,), (lanes, n)) if lanes is not None else theta.shape[-1:] != (n,):
            expected = f"({n},)" if lanes in (None, 1) else f"({lanes}, {n}) or ({n},)"
            raise ValueError(
                f"theta: expected {n} parameters, shape {expected}, got {theta.shape}; see the space's names"
            )
        if lanes is not None:
            theta = np.tile(theta, (lanes, 1)) if theta.ndim == 1 else theta
        if not np.isfinite(theta).all():
            raise ValueError("theta: expected finite numbers, got NaN or infinity")
        if not allow_outside and not ((theta >= 0) & (theta <= 1)).all():
            raise ValueError(
                f"theta: expected values in [0, 1], got {theta.min():.4g} to {theta.max():.4g}; "
                "clip them, or pass allow_outside=True"
            )
        return theta

    def _check_goals(self, batch: int, goals: FloatArray | None) -> FloatArray | None:
        size = self.environment.goal_size
        if not size and goals is None:
            return None
        given = np.atleast_2d(np.asarray(np.empty((1, 0)) if goals is None else goals, float))
        if given.shape not in ((1, size), (batch, size)):
            raise ValueError(f"goals: expected ({batch}, {size}), got {given.shape if goals is not None else None}")
        return np.broadcast_to(given, (batch, size))

    def _check_lanes(
        self, batch: int, dt: FloatArray | float | None, logs: Sequence[str | None] | None
    ) -> tuple[FloatArray, list[str | None]]:
        dts = np.asarray(self.dt if dt is None else dt, float)
        if isinstance(self.environment, Task) and not np.allclose(dts, self.dt, rtol=1e-9, atol=0):
            raise ValueError(
                f"dt: {self.environment.name} has control steps of {self.dt:g} s, got {dts.min():g}; leave it out"
            )
        if dts.shape not in ((), (1,), (batch,)):
            raise ValueError(f"dt: expected one number or ({batch},), one for each lane, got shape {dts.shape}")
        if not (np.isfinite(dts) & (dts > 0)).all():
            raise ValueError(f"dt: expected seconds above zero, got {float(dts.min()):g}")
        names: list[str | None] = [None] * batch if logs is None else list(logs)
        if len(names) != batch:
            raise ValueError(f"logs: expected {batch} names, one for each lane, got {len(names)}")
        return np.broadcast_to(dts, (batch,)), names

    def _chunks(self, steps: NDArray[np.int64], horizon: int) -> Iterator[tuple[int, NDArray[np.int64]]]:
        """Lanes with as many physics ``steps`` (B,) per control step, no more than the memory holds."""
        for skip in np.unique(steps).tolist():
            group = np.flatnonzero(steps == skip)
            rows = horizon * (1 if self.environment.data_fields else skip) + 1
            width = rows * (self.state_size + self.engine.derived_size + self.model.nu)
            most = max(self.num_threads, min(_CHUNK // width, _POOL // mujoco.mj_sizeModel(self.model)))
            for chunk in np.array_split(group, math.ceil(len(group) / most)):
                yield skip, chunk

    def _models(self, theta: FloatArray, timesteps: FloatArray, logs: list[str | None]) -> NDArray[np.int64]:
        """Which pooled model each lane uses, written in place; lanes that follow their like cost nothing."""
        named = np.array(logs, object)
        differs = (theta[1:] != theta[:-1]).any(1) | (timesteps[1:] != timesteps[:-1]) | (named[1:] != named[:-1])
        first = np.flatnonzero(np.concatenate([[True], differs]))
        index: dict[bytes, int] = {}
        slots = np.empty(len(first), int)
        for i, lane in enumerate(first):
            timestep, log = float(timesteps[lane]), logs[lane]
            key = theta[lane].tobytes() + timestep.hex().encode() + str(log).encode()
            if key not in index:
                index[key] = len(index)
                self._write(index[key], key, theta[lane], timestep, log)
            slots[i] = index[key]
        return np.repeat(slots, np.diff(first, append=len(theta)))

    def _write(self, slot: int, key: bytes, theta: FloatArray, timestep: float, log: str | None) -> None:
        if slot == len(self._pool):
            self._pool.append(copy.copy(self.model))
            self._keys.append(b"")
            self._physical.append(False)
            self._biases.append(np.zeros(len(self.environment.channels)))
        if self._keys[slot] == key:
            return
        self._keys[slot] = b""
        self._physical[slot] = self._write_into(self._pool[slot], theta, timestep, log)
        self._biases[slot] = self.environment.bias(self._values(theta), log)
        self._keys[slot] = key

    def _values(self, theta: FloatArray) -> FloatArray:
        # a number at a time: the last bit of a vectorised exponential may depend on the length of the batch
        return np.array([p.value(t) for p, t in zip(self.space, theta.tolist(), strict=True)])

    def _write_into(self, model: Any, theta: FloatArray, timestep: float, log: str | None) -> bool:
        """Write theta (N,) and return whether it is physical."""
        physical = self.environment.write(model, self._values(theta), log)
        model.opt.timestep = timestep
        if physical and self.environment.needs_constants:
            mujoco.mj_setConst(model, self._scratch)
        return physical

    def _run(
        self,
        skip: int,
        lanes: NDArray[np.int64],
        timesteps: FloatArray,
        actions: FloatArray,
        initial_state: FloatArray,
        goals: FloatArray | None,
    ) -> _Motion:
        """Lanes that all take ``skip`` physics steps a control step."""
        environment, (batch, horizon, _) = self.environment, actions.shape
        motion = _Motion.empty(batch, horizon, self)
        run = np.array(self._physical)[lanes] & np.isfinite(initial_state).all(1)
        if not run.any():
            return motion
        models = [self._pool[k] for k in lanes[run]]
        states, derived, sound = self.engine.advance(skip, models, timesteps[run], actions[run], initial_state[run])
        targets = None if goals is None else goals[run, None]
        observations = environment.observe(self.model, states, derived, targets)
        biases = np.stack([self._biases[k] for k in lanes[run]])[:, None]
        motion.states[run], motion.observations[run], motion.sound[run] = states, observations + biases, sound
        if derived is not None and motion.derived is not None:
            motion.derived[run] = derived
        return motion

    def check_physical(self, theta: FloatArray) -> None:
        """Raises ValueError for theta (N,) that no model can have."""
        if not self.environment.write(self._trial, self._values(theta), None):
            named = ", ".join(f"{p.name} = {p.value(t):.4g} {p.unit}" for p, t in zip(self.space, theta, strict=True))
            raise ValueError(f"theta: unphysical parameters ({named}); choose values within the bounds")

    def written(self, theta: FloatArray, model: Any = None) -> Any:
        """A mujoco.MjModel of one's own with theta (N,) written in, or ``model``, an earlier one, written anew; raises
        ValueError for an unphysical theta, and leaves ``model`` as it was."""
        self.check_physical(theta)
        model = copy.copy(self.model) if model is None else model
        self._write_into(model, theta, float(self.model.opt.timestep), None)
        return model

    @cached_property
    def _trial(self) -> Any:
        """A model that is only written to, to see whether a theta is physical."""
        return copy.copy(self.model)

    def reset(
        self,
        theta: FloatArray | None = None,
        seed: int = 0,
        count: int | None = None,
        allow_outside: bool = False,
    ) -> Step:
        """Begin episodes in closed loop: theta (B, N) or (N,), default the published model's; count: lanes B where theta
        does not say. Lane i is seeded with seed + i. Go on with ``step``; ``rollout`` may be used in between."""
        space = self.space
        given = space.default_theta if theta is None else space.check_shape(theta)
        lanes = (1 if given.ndim == 1 else len(given)) if count is None else count
        if given.ndim == 2 and len(given) != lanes:
            raise ValueError(f"count: got {lanes} for theta {given.shape}; leave it out or give theta ({len(space)},)")
        generators = [np.random.default_rng(seed + i) for i in range(lanes)]
        self.episodes = Episodes(self, given, generators, allow_outside)
        return self.episodes.first()

    def step(self, actions: FloatArray) -> Step:
        """One control step of all lanes with actions (B, A); see ``sipe_bayes.simulation.episodes``."""
        if self.episodes is None:
            raise ValueError("step: nothing has begun yet; call reset first")
        return self.episodes.step(actions)


@dataclass(frozen=True)
class _Motion:
    """states (B, T+1, S), observations (B, T+1, O), sound (B, T+1), derived (B, T+1, D) or None; NaN and not sound
    where a lane was never simulated."""

    states: FloatArray
    observations: FloatArray
    sound: BoolArray
    derived: FloatArray | None

    @classmethod
    def empty(cls, batch: int, horizon: int, simulator: Simulator) -> _Motion:
        environment = simulator.environment
        shape = (batch, horizon + 1)
        derived = np.full((*shape, simulator.engine.derived_size), np.nan) if environment.needs_derived else None
        return cls(
            np.full((*shape, simulator.state_size), np.nan),
            np.full((*shape, len(environment.channels)), np.nan),
            np.zeros(shape, bool),
            derived,
        )
