"""The one batch engine: many parameter values, many simulations at a time, native threads.

Every model runs with MuJoCo's warm start disabled, so the state is Markov: the bits of a simulation depend on its own
theta, start and actions alone, whatever the threads, the batch or what ran before. A rollout that diverges is data:
MuJoCo resets such a simulation and ``mujoco.rollout`` repeats its last state, which shows as a time that is not
t0 + k dt; ``valid`` is False from the first such sample on. A step that raised any other warning (out of contact
memory, singular inertia) is the one before the first repeated state. MuJoCo's own messages are held back meanwhile:
nothing on the terminal, no MUJOCO_LOG.TXT; ``Simulator.diverged`` counts.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray
from sipe_bayes.core.html import html_table
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.envs.base import Environment
from sipe_bayes.envs.foreign.quiet import quiet
from sipe_bayes.envs.task import Task
from sipe_bayes.simulation.audit import Audit
from sipe_bayes.simulation.base import Simulated
from sipe_bayes.simulation.device import Batch
from sipe_bayes.simulation.engine import HUGE
from sipe_bayes.simulation.episodes import Episodes, Step

_WAVE_NUMBERS = 2**26  # of states and observations that are asked for at once, 512 MiB


class Simulator(Simulated):
    """Simulates an Environment for batches of theta. Not for two Python threads at a time.

    ``control_steps`` counts what was simulated, ``diverged`` the simulations that are not valid to their end.

    Args:
        environment: what is simulated.
        num_threads: native threads; default the processor's cores.
        device: "cpu" for MuJoCo itself, in float64; "cuda" or "cuda:1" for a GPU, in float32 by mujoco-warp (``docs/
            gpu.md``); "warp:cpu" runs the GPU's code on the processor, slowly, for tests.

    Raises:
        ValueError: for anything but an Environment, no whole number of threads, another device, or a model that the
            device can not simulate.
    """

    episodes: Episodes | None = None

    def __init__(self, environment: Environment, num_threads: int | None = None, device: str = "cpu") -> None:
        super().__init__(environment, num_threads, device)
        self.audit = None if device == "cpu" else Audit()

    @cached_property
    def on_processor(self) -> Simulator:
        """The same in float64 on the processor."""
        return self if self.device == "cpu" else Simulator(self.environment, self.num_threads)

    def wave(self, horizon: int) -> int:
        """How many rollouts of ``horizon`` control steps it is best asked for at once; 1 where that does not matter."""
        width = (horizon + 1) * (self.state_size + len(self.environment.channels))
        return max(1, min(self.runs.wave, _WAVE_NUMBERS // width))

    def checksum(self) -> str:
        """That of the compiled default model, of what logs have more, and of the device if not the processor."""
        parts, kind = [super().checksum()], self.device.partition(":")[0]
        parts += [repr(self.environment.added)] if self.environment.added else []
        parts += [kind] if kind != "cpu" else []
        return parts[0] if len(parts) == 1 else hashlib.sha256(" ".join(parts).encode()).hexdigest()

    def _repr_html_(self) -> str:
        model = self.model
        rows = [(p.name, f"{p.low:g} to {p.high:g}", p.unit, ", ".join(p.targets)) for p in self.space]
        what = f"{model.nv} degrees of freedom, {model.nu} actuators, control step {self.dt:g} s"
        seen = f"observes {', '.join(self.environment.channels)}"
        return html_table("Simulator", ("parameter", "bounds", "unit", "writes"), rows, [what, seen])

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
        """Open loop, whole horizon, of B simulations.

        One whose parameters are unphysical or whose start is not finite is never simulated: NaN, and not valid from
        sample 0.

        Args:
            theta: (B, N), or (1, N) for all.
            actions: (B, T, A), or (1, T, A) for all.
            initial_state: (B, S), or (1, S) for all.
            dt: seconds of a control step, (B,) or one number; default the environment's.
            logs: the log that each belongs to, for parameters that differ between logs.
            allow_outside: whether theta may leave [0, 1].
            goals: (B, G), of a task that has them.

        Returns:
            Trajectories with observations, states and ``valid``.

        Raises:
            ValueError: for shapes that do not fit, theta outside the unit cube, or actions that are not finite.
        """
        theta, actions, initial_state = self._check(theta, actions, initial_state, allow_outside)
        batch = max(len(theta), len(actions), len(initial_state))
        goals = self._check_goals(batch, goals)
        dts, names = self._check_times(batch, dt, logs)
        theta, actions, initial_state = (
            np.broadcast_to(a, (batch, *a.shape[1:])) for a in (theta, actions, initial_state)
        )
        distinct, which = np.unique(dts, return_inverse=True)
        divided = [self.physics_steps(d) for d in distinct.tolist()]
        steps, timesteps = (np.array(x)[which] for x in zip(*divided, strict=True))
        horizon = actions.shape[1]
        motion = _Recorded.empty(batch, horizon, self)
        with quiet:
            for skip, chunk in self._chunks(steps, horizon):
                slots = self.pool.take(theta[chunk], timesteps[chunk], [names[i] for i in chunk], self.runs.own_slots)
                targets = None if goals is None else goals[chunk]
                given = Batch(self.pool, slots, skip, timesteps[chunk], actions[chunk], initial_state[chunk])
                self._run(motion, chunk, given, targets)
        valid = np.logical_and.accumulate(motion.valid, axis=1)
        self.count(batch * horizon, int((~valid[:, -1]).sum()))
        length = np.full(batch, horizon)
        rewards = self.environment.rewards(motion.states, motion.derived, actions, goals)
        rewards = None if rewards is None else np.where(valid[:, 1:], rewards, 0.0)
        channels = self.environment.channels
        made = Trajectories(motion.observations, actions, dts, length, valid, motion.states, (), channels, rewards)
        if self.audit is not None and len(again := self.audit.chosen(batch)):
            named = [names[i] for i in again]
            aims = None if goals is None else goals[again]
            exact = self.on_processor.rollout(
                theta[again], actions[again], initial_state[again], dts[again], named, True, aims
            )
            self.audit.compare(made, again, exact)
        return made

    @property
    def recorded_size(self) -> int:
        """Numbers of the states that a rollout returns."""
        return self.state_size

    def count(self, steps: int, diverged: int) -> None:
        """Count control steps and diverged simulations."""
        self.control_steps += steps
        Simulated.total_steps += steps
        self.diverged += diverged

    def replay(self, theta: FloatArray, trajectories: Trajectories, starts: FloatArray | None = None) -> Trajectories:
        """The recorded actions from the recorded starting states, for every theta.

        Args:
            theta: (B, N).
            trajectories: R recorded ones.
            starts: starting states to use instead, (R, S), or (B * R, S) where they differ between thetas.

        Returns:
            B * R trajectories: of theta 0 with each of the recorded ones, then of theta 1 ..., each as long as the
            recorded one.

        Raises:
            ValueError: where nothing tells the starting states.
        """
        theta, count = np.atleast_2d(theta), len(trajectories)
        if starts is None:
            if trajectories.states is None:
                raise ValueError("trajectories: they hold no states to start from; record them or pass starts (R, S)")
            starts = trajectories.states[:, 0]
        first = np.asarray(starts, float)
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

    def reset(
        self,
        theta: FloatArray | None = None,
        seed: int = 0,
        count: int | None = None,
        allow_outside: bool = False,
    ) -> Step:
        """Begin episodes in closed loop. Go on with ``step``; ``rollout`` may be used in between.

        Args:
            theta: (B, N) or (N,); default the published model's.
            seed: simulation i is seeded with seed + i.
            count: how many simulations, where theta does not say.
            allow_outside: whether theta may leave [0, 1].

        Raises:
            ValueError: for a count that is not theta's, more than a GPU has room for, or wrong theta.
        """
        space = self.space
        given = space.default_theta if theta is None else space.check_shape(theta)
        num_envs = (1 if given.ndim == 1 else len(given)) if count is None else count
        if given.ndim == 2 and len(given) != num_envs:
            raise ValueError(
                f"count: got {num_envs} for theta {given.shape}; leave it out or give theta ({len(space)},)"
            )
        generators = [np.random.default_rng(seed + i) for i in range(num_envs)]
        self.episodes = Episodes(self, given, generators, allow_outside)
        return self.episodes.first()

    def step(self, actions: FloatArray) -> Step:
        """One control step of all simulations with actions (B, A); see ``sipe_bayes.simulation.episodes``."""
        if self.episodes is None:
            raise ValueError("step: nothing has begun yet; call reset first")
        return self.episodes.step(actions)

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

    def _check_goals(self, batch: int, goals: FloatArray | None) -> FloatArray | None:
        size = self.environment.goal_size
        if not size and goals is None:
            return None
        given = np.atleast_2d(np.asarray(np.empty((1, 0)) if goals is None else goals, float))
        if given.shape not in ((1, size), (batch, size)):
            raise ValueError(f"goals: expected ({batch}, {size}), got {given.shape if goals is not None else None}")
        return np.broadcast_to(given, (batch, size))

    def _check_times(
        self, batch: int, dt: FloatArray | float | None, logs: Sequence[str | None] | None
    ) -> tuple[FloatArray, list[str | None]]:
        dts = np.asarray(self.dt if dt is None else dt, float)
        if isinstance(self.environment, Task) and not np.allclose(dts, self.dt, rtol=1e-9, atol=0):
            raise ValueError(
                f"dt: {self.environment.name} has control steps of {self.dt:g} s, got {dts.min():g}; leave it out"
            )
        if dts.shape not in ((), (1,), (batch,)):
            raise ValueError(f"dt: expected one number or ({batch},), one for each simulation, got shape {dts.shape}")
        if not (np.isfinite(dts) & (dts > 0)).all():
            raise ValueError(f"dt: expected seconds above zero, got {float(dts.min()):g}")
        names: list[str | None] = [None] * batch if logs is None else list(logs)
        if len(names) != batch:
            raise ValueError(f"logs: expected {batch} names, one for each simulation, got {len(names)}")
        return np.broadcast_to(dts, (batch,)), names

    def _chunks(self, steps: IntArray, horizon: int) -> Iterator[tuple[int, IntArray]]:
        """Simulations with as many physics ``steps`` (B,) per control step, no more than the memory holds."""
        for skip in np.unique(steps).tolist():
            group = np.flatnonzero(steps == skip)
            for chunk in np.array_split(group, math.ceil(len(group) / self.runs.most(horizon, skip))):
                yield skip, chunk

    def _run(self, motion: _Recorded, chunk: IntArray, batch: Batch, goals: FloatArray | None) -> None:
        """Simulate ``chunk`` into ``motion``."""
        pool = batch.pool
        run = pool.physical(batch.slots) & np.isfinite(batch.start).all(1)
        if not run.any():
            return
        at, skip, slots, timesteps = chunk[run], batch.skip, batch.slots[run], batch.timesteps[run]
        given = Batch(pool, slots, skip, timesteps, batch.actions[run], batch.start[run])
        states, derived, valid = self.runs.advance(given)
        targets = None if goals is None else goals[run, None]
        observations = self.environment.observe(self.model, states, derived, targets)
        seen = pool.sensing(slots).seen(observations, skip * timesteps, self.environment.rotations)
        motion.states[at], motion.observations[at], motion.valid[at] = states, seen, valid
        if derived is not None and motion.derived is not None:
            motion.derived[at] = derived


@dataclass(frozen=True)
class _Recorded:
    """A rollout; NaN and not valid where nothing was simulated."""

    states: FloatArray  # (B, T+1, S)
    observations: FloatArray  # (B, T+1, O)
    valid: BoolArray  # (B, T+1)
    derived: FloatArray | None  # (B, T+1, D)

    @classmethod
    def empty(cls, batch: int, horizon: int, simulator: Simulator) -> _Recorded:
        """Nothing simulated yet."""
        environment = simulator.environment
        shape = (batch, horizon + 1)
        derived = np.full((*shape, simulator.engine.derived_size), np.nan) if environment.needs_derived else None
        return cls(
            np.full((*shape, simulator.recorded_size), np.nan),
            np.full((*shape, len(environment.channels)), np.nan),
            np.zeros(shape, bool),
            derived,
        )
