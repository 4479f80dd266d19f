"""Recorded or simulated motion: one ``Trajectory``, or a padded batch ``Trajectories``.

Shapes: observations (T+1, O), actions (T, A), states (T+1, S: MuJoCo's full physics state), rewards (T,); dt in
seconds. Action t is held from sample t to sample t+1. A sample that is missing from a log is NaN in ``observations``:
masked, never invented.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, overload

import numpy as np

from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray
from sipe_bayes.core.files import read_arrays, reading, replacing
from sipe_bayes.core.html import html_table


@dataclass(frozen=True, eq=False)
class Trajectory:
    """One trajectory of T control steps, ``dt`` seconds apart.

    Args:
        observations: (T+1, O), NaN where there is no measurement.
        actions: (T, A), finite.
        dt: seconds between samples.
        states: (T+1, S), if known.
        name: of the log.
        channels: names of the O observed quantities.
        rewards: (T,), if known.

    Raises:
        ValueError: for shapes that do not fit together, and for actions that are not finite.
    """

    observations: FloatArray
    actions: FloatArray
    dt: float
    states: FloatArray | None = None
    name: str = ""
    channels: tuple[str, ...] = ()
    rewards: FloatArray | None = None

    def __post_init__(self) -> None:
        label = f"trajectory {self.name!r}"
        observations = np.atleast_2d(np.asarray(self.observations, dtype=np.float64))
        actions = np.asarray(self.actions, dtype=np.float64)
        if observations.ndim != 2 or actions.ndim != 2 or len(observations) != len(actions) + 1:
            raise ValueError(
                f"{label}: expected observations (T+1, O) and actions (T, A), "
                f"got {observations.shape} and {actions.shape}"
            )
        if not len(actions):
            raise ValueError(f"{label}: expected at least one control step, got none")
        if not 0 < self.dt < np.inf:
            raise ValueError(f"{label}: dt must be positive, got {self.dt}")
        if not np.isfinite(actions).all():
            raise ValueError(f"{label}: actions must be finite, got {int((~np.isfinite(actions)).sum())} that are not")
        states = None if self.states is None else np.asarray(self.states, dtype=np.float64)
        if states is not None and (states.ndim != 2 or len(states) != len(observations)):
            raise ValueError(f"{label}: expected states ({len(observations)}, S), got {states.shape}")
        rewards = None if self.rewards is None else np.asarray(self.rewards, dtype=np.float64)
        if rewards is not None and rewards.shape != (len(actions),):
            raise ValueError(f"{label}: expected rewards ({len(actions)},), one for each step, got {rewards.shape}")
        if self.channels and len(self.channels) != observations.shape[1]:
            raise ValueError(f"{label}: {len(self.channels)} channel names for {observations.shape[1]} channels")
        object.__setattr__(self, "observations", observations)
        object.__setattr__(self, "actions", actions)
        object.__setattr__(self, "states", states)
        object.__setattr__(self, "rewards", rewards)

    def __len__(self) -> int:
        """Control steps T."""
        return len(self.actions)

    @property
    def time(self) -> FloatArray:
        """Sample times (T+1,) in seconds from the start."""
        return np.arange(len(self) + 1, dtype=np.float64) * self.dt

    def slice(self, start: int, stop: int) -> Trajectory:
        """Control steps start..stop, with both end samples; 0 <= start < stop <= T."""
        if not 0 <= start < stop <= len(self):
            raise ValueError(
                f"trajectory {self.name!r}: expected 0 <= start < stop <= {len(self)}, got {start} and {stop}"
            )
        samples, steps = slice(start, stop + 1), slice(start, stop)
        return replace(
            self,
            observations=self.observations[samples],
            actions=self.actions[steps],
            states=_part(self.states, samples),
            rewards=_part(self.rewards, steps),
        )

    def _repr_html_(self) -> str:
        names = self.channels or [f"channel {k}" for k in range(self.observations.shape[1])]
        rows = [_channel_row(name, series) for name, series in zip(names, self.observations.T, strict=True)]
        what = f"{len(self)} control steps of {self.dt:g} s, {self.actions.shape[1]} actions"
        return html_table(f"Trajectory {self.name}", ("channel", "range", "missing"), rows, [what])


def _channel_row(name: str, values: FloatArray) -> tuple[object, ...]:
    """Name, range and samples that are missing of a channel's values (...)."""
    there = values[np.isfinite(values)]
    span = f"{there.min():.4g} to {there.max():.4g}" if there.size else "nothing measured"
    return name, span, values.size - there.size


def _part(array: FloatArray | None, rows: Any) -> FloatArray | None:
    return None if array is None else array[rows]


@dataclass(frozen=True, eq=False)
class Trajectories(Sequence[Trajectory]):
    """A padded batch: an integer index gives a Trajectory, a slice or an array of them Trajectories.

    Args:
        observations: (B, T+1, O), NaN on padding.
        actions: (B, T, A), zero on padding.
        dt: seconds between samples (B,).
        length: control steps (B,).
        valid: (B, T+1), False from the first sample of a diverged simulation on, and on padding; all True on recorded
            samples.
        states: (B, T+1, S), NaN on padding, if all of them are known.
        names: of the B logs.
        channels: names of the O observed quantities.
        rewards: (B, T), if known: of simulated tasks, zero where a step was not valid, going on after a task's end.
    """

    observations: FloatArray
    actions: FloatArray
    dt: FloatArray
    length: IntArray
    valid: BoolArray
    states: FloatArray | None = None
    names: tuple[str, ...] = ()
    channels: tuple[str, ...] = ()
    rewards: FloatArray | None = None

    @classmethod
    def stack(cls, trajectories: Trajectory | Iterable[Trajectory] | Trajectories) -> Trajectories:
        """A batch of one or several trajectories, which may differ in length and dt.

        States and rewards are kept where all of them have them.

        Raises:
            ValueError: for none, or for channels, actions or states of different sizes.
        """
        if isinstance(trajectories, Trajectories):
            return trajectories
        items = [trajectories] if isinstance(trajectories, Trajectory) else list(trajectories)
        if not items:
            raise ValueError("trajectories: expected at least one, got none")
        sizes = {(t.observations.shape[1], t.actions.shape[1]) for t in items}
        if len(sizes) > 1:
            raise ValueError(f"trajectories differ in (observation, action) sizes: {sorted(sizes)}")
        channels = {t.channels for t in items if t.channels}
        if len(channels) > 1:
            raise ValueError(f"trajectories differ in their channels: {sorted(channels)}")
        state_sizes = {t.states.shape[1] for t in items if t.states is not None}
        if len(state_sizes) > 1:
            raise ValueError(f"trajectories differ in the size of their states: {sorted(state_sizes)}")
        batch, steps = len(items), max(len(t) for t in items)
        (n_obs, n_act), with_states = sizes.pop(), all(t.states is not None for t in items)
        observations = np.full((batch, steps + 1, n_obs), np.nan)
        actions = np.zeros((batch, steps, n_act))
        states = None
        if with_states:
            states = np.full((batch, steps + 1, items[0].states.shape[1]), np.nan)  # type: ignore[union-attr]
        rewards = np.zeros((batch, steps)) if all(t.rewards is not None for t in items) else None
        for i, t in enumerate(items):
            observations[i, : len(t) + 1], actions[i, : len(t)] = t.observations, t.actions
            if states is not None and t.states is not None:
                states[i, : len(t) + 1] = t.states
            if rewards is not None and t.rewards is not None:
                rewards[i, : len(t)] = t.rewards
        length = np.array([len(t) for t in items])
        valid = np.arange(steps + 1)[None] <= length[:, None]
        names = tuple(t.name or str(i) for i, t in enumerate(items))
        dt = np.array([t.dt for t in items])
        names_of_channels = channels.pop() if channels else ()
        return cls(observations, actions, dt, length, valid, states, names, names_of_channels, rewards)

    @property
    def longest(self) -> float:
        """Seconds of the longest; of the correlation times of its noise, the longest that can be told."""
        return float((self.length * self.dt).max())

    @property
    def states_throughout(self) -> bool:
        """Whether the state of every sample is recorded, and not of none or the first alone."""
        states = self.states
        return states is not None and int(np.isfinite(states[..., 0]).sum()) == int((self.length + 1).sum())

    def __len__(self) -> int:
        return len(self.actions)

    @overload
    def __getitem__(self, key: int | np.integer) -> Trajectory: ...

    @overload
    def __getitem__(self, key: slice | Sequence[int] | IntArray | BoolArray) -> Trajectories: ...

    def __getitem__(
        self, key: int | np.integer | slice | Sequence[int] | IntArray | BoolArray
    ) -> Trajectory | Trajectories:
        """One trajectory, cut to its own length, or a batch of those that are chosen."""
        if isinstance(key, (slice, Sequence, np.ndarray)):
            return self._subset(np.arange(len(self))[key])
        n, name = int(self.length[key]), self.names[key] if self.names else ""
        samples, steps = (key, slice(n + 1)), (key, slice(n))
        parts = self.observations[samples], self.actions[steps], float(self.dt[key]), _part(self.states, samples)
        return Trajectory(*parts, name, self.channels, _part(self.rewards, steps))

    def _subset(self, chosen: IntArray) -> Trajectories:
        if not len(chosen):
            raise ValueError(f"trajectories: expected to choose at least one of {len(self)}, got none")
        length = self.length[chosen]
        samples, steps = (chosen, slice(length.max() + 1)), (chosen, slice(length.max()))
        return replace(
            self,
            observations=self.observations[samples],
            actions=self.actions[steps],
            dt=self.dt[chosen],
            length=length,
            valid=self.valid[samples],
            states=_part(self.states, samples),
            names=tuple(self.names[i] for i in chosen) if self.names else (),
            rewards=_part(self.rewards, steps),
        )

    def __iter__(self) -> Iterator[Trajectory]:
        return (self[i] for i in range(len(self)))

    def save(self, path: str | Path) -> None:
        """Write to an npz file, under exactly this name and atomically."""
        arrays: dict[str, Any] = {name: value for name, value in vars(self).items() if value is not None}
        for name in ("names", "channels"):
            arrays[name] = np.array(arrays[name], dtype=np.str_)
        with replacing(Path(path)) as temporary, temporary.open("wb") as file:
            np.savez_compressed(file, **arrays)

    @classmethod
    def load(cls, path: str | Path) -> Trajectories:
        """Read what ``save`` wrote; runs no code from the file. Raises ValueError for another file."""
        needed = {f.name for f in fields(cls)} - {"states", "rewards"}
        if not os.path.exists(path):  # False where the system does not take the name
            raise FileNotFoundError(f"{path}: no such file; expected trajectories")
        with reading(path, "trajectories", "write them again with Trajectories.save"):
            arrays: dict[str, Any] = read_arrays(Path(path))
            if arrays.keys() - {"states", "rewards"} != needed:
                raise ValueError(f"expected the arrays {sorted(needed)}, got {sorted(arrays)}")
            names, channels = (tuple(str(s) for s in arrays.pop(key)) for key in ("names", "channels"))
            batch = cls(**arrays, names=names, channels=channels)
            batch.check()
        return batch

    def check(self) -> None:
        """Raises ValueError for arrays whose shapes or types do not fit together, as those of a file may not."""
        batch, samples, _ = self.observations.shape
        expected = {
            "actions": (batch, samples - 1, self.actions.shape[-1]),
            "dt": (batch,),
            "length": (batch,),
            "valid": (batch, samples),
            "states": None if self.states is None else (batch, samples, self.states.shape[-1]),
            "rewards": None if self.rewards is None else (batch, samples - 1),
        }
        for name, shape in expected.items():
            array = getattr(self, name)
            if shape is not None and (array.shape != shape or array.dtype.kind not in "fiub"):
                raise ValueError(f"{name}: expected numbers of shape {shape}, got {array.dtype} of {array.shape}")
        if not ((self.length >= 1) & (self.length < samples)).all() or self.length.dtype.kind != "i":
            raise ValueError(f"length: expected whole numbers from 1 to {samples - 1}, got others")
        if len(self.names) not in (0, batch) or len(self.channels) not in (0, self.observations.shape[2]):
            raise ValueError("names, channels: expected one for each trajectory and channel, or none")
        for _ in self:  # each of which checks itself
            pass
