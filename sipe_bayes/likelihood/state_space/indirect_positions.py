"""Positions that no channel measures but some tell: an angle of which cosine and sine are recorded.

Where fitted channels depend on the position of one hinge or slide that none of them measures directly, and on that of
no other such one, it is looked for sample by sample: the best of a grid over its range or the circle, then Gauss-Newton
steps, with the parameters in the middle of their ranges. It is a first guess for a search over states, so noise is left
to that. It is taken only where it is unique, unlike an angle of which the cosine alone is recorded, and fits. An
unlimited slide is not looked for, nor the turns of a ball or of a free body.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import mujoco
import numpy as np

from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray
from sipe_bayes.core.options import Options, option
from sipe_bayes.core.trajectory import Trajectory
from sipe_bayes.envs.poses import inertial_joints
from sipe_bayes.envs.task import Task
from sipe_bayes.simulation.simulator import Simulator

_STEP = 1e-5  # rad or m: finite differences
_HINGE, _SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)


@dataclass(frozen=True)
class IndirectOptions(Options):
    """How a position is looked for."""

    grid: int = option(32, "values tried: apart by less than a local minimum of cosine and sine is wide", least=4)
    steps: int = option(6, "Gauss-Newton steps, which converge quadratically", least=1)
    samples: int = option(16, "samples with which it is seen whether a position matters at all", least=1)
    values: int = option(4, "values with which it is seen whether a position matters at all", least=2)
    unique: float = option(0.9, "share of the samples at which the next best place must fit worse", above=0, most=1)
    clear: float = option(0.1, "by how much it must fit worse there", "squared spreads", above=0)
    over: float = option(0.3, "by which noise and soft limits let a position leave its range", "rad", least=0)
    whole: float = option(0.05, "share of the samples with all channels from which the others are bridged", above=0)
    fits: float = option(0.2, "root mean square of what may be left", "of a channel's spread", above=0)


OPTIONS = IndirectOptions()


class Sampled(Protocol):
    """K samples of logs, and what is predicted of them from states."""

    @property
    def simulator(self) -> Simulator:
        """Of the model."""

    @property
    def measured(self) -> FloatArray:
        """(K, C)."""

    @property
    def observed(self) -> BoolArray:
        """(K, C)."""

    @property
    def log(self) -> IntArray:
        """Which one a sample belongs to (K,)."""

    @property
    def dt(self) -> FloatArray:
        """(K,), s."""

    @property
    def least(self) -> tuple[FloatArray, FloatArray]:
        """Sizes (C,) and (D,) below which rounding rules."""

    def simulate(
        self, theta: FloatArray, states: FloatArray, at: IntArray | None = None
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Predictions (B, K, C), and two more, of theta (B, N) and states (B, K, S)."""


@dataclass(frozen=True, eq=False)
class LogSamples:
    """The samples of one log, predicted from the states where they are: no window, and no noise.

    What an environment reads a physics step late (``derived_late``) does not count.
    """

    simulator: Simulator
    trajectory: Trajectory

    @cached_property
    def _late(self) -> BoolArray:
        environment = self.simulator.environment
        columns = environment.state_columns(self.simulator.model)
        return np.array([environment.derived_late and column is None for column in columns])

    @property
    def measured(self) -> FloatArray:
        """(T+1, O)."""
        return self.trajectory.observations

    @cached_property
    def observed(self) -> BoolArray:
        """(T+1, O)."""
        return np.asarray(np.isfinite(self.measured) & ~self._late)

    @property
    def log(self) -> IntArray:
        """(T+1,)."""
        return np.zeros(len(self.measured), int)

    @property
    def dt(self) -> FloatArray:
        """(T+1,)."""
        return np.full(len(self.measured), self.trajectory.dt)

    @cached_property
    def least(self) -> tuple[FloatArray, FloatArray]:
        """A millionth of the channels' sizes (O,); of states nothing."""
        size = np.sqrt(np.square(np.where(self.observed, self.measured, 0.0)).mean(0))
        return np.maximum(1e-6 * size, 1e-12), np.zeros(0)

    def simulate(
        self, theta: FloatArray, states: FloatArray, at: IntArray | None = None
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Predictions (B, K, O) at theta (B, N) of states (B, K, S), which come back; and whether each is valid."""
        simulator, batch = self.simulator, len(theta)
        at = np.arange(len(self.measured)) if at is None else at
        whole = isinstance(simulator.environment, Task) or bool(simulator.engine.firmware)
        dt = self.trajectory.dt if whole else float(simulator.model.opt.timestep)
        goals = simulator.environment.recorded_goals(self.measured[:1])
        actions = self.trajectory.actions[np.minimum(at, len(self.trajectory) - 1)][:, None]
        result = simulator.rollout(
            np.repeat(theta, len(at), axis=0),
            np.tile(actions, (batch, 1, 1)),
            states.reshape(batch * len(at), -1),
            dt,
            [self.trajectory.name or None] * (batch * len(at)),
            goals=None if goals is None else np.repeat(goals, batch * len(at), axis=0),
        )
        shape = (batch, len(at))
        return result.observations[:, 0].reshape(*shape, -1), states, result.valid[:, 0].reshape(shape)


def indirect_positions(
    chain: Sampled, states: FloatArray, measured: BoolArray
) -> tuple[FloatArray, BoolArray, BoolArray]:
    """Look for positions that channels tell without measuring them.

    Args:
        chain: the logs, as a ``Chain`` has them or ``LogSamples``.
        states: (K, S), a first guess.
        measured: (D,), coordinates that a channel measures directly.

    Returns:
        The states with such positions where they fit best, velocities too where none is measured; which positions (nv,)
        these are; and on which (nv,) no fitted channel depends.
    """
    model, states = chain.simulator.model, states.copy()
    indirect, irrelevant = np.zeros(model.nv, bool), np.zeros(model.nv, bool)
    size, seen = chain.least[0].copy(), chain.observed.any(0)
    spread = np.nanstd(np.where(chain.observed, chain.measured, np.nan)[:, seen], axis=0)
    size[seen] = np.maximum(spread, size[seen])
    dependent: dict[int, BoolArray] = {}  # degree of freedom -> channels (C,) that depend on its position
    felt = inertial_joints(model, chain.simulator.environment.poses)
    for j in map(int, np.flatnonzero(~measured[: model.nv])):
        joint = int(model.dof_jntid[j])
        if joint in felt:
            indirect[j] = True
        elif int(model.jnt_type[joint]) in (_HINGE, _SLIDE):
            dependent[j] = _dependent(chain, states, int(model.jnt_qposadr[joint]), _values(model, joint), size)
            irrelevant[j] = not dependent[j].any()
        else:
            irrelevant[j] = True
    alone = np.sum(list(dependent.values()), axis=0) == 1
    for j, channels in dependent.items():
        joint = int(model.dof_jntid[j])
        endless = int(model.jnt_type[joint]) == _SLIDE and not model.jnt_limited[joint]
        if endless or not (channels & alone).any():
            continue
        column = 1 + int(model.jnt_qposadr[joint])
        position = _best(chain, states, column, _values(model, joint), np.where(channels & alone, size, np.inf))
        if position is not None:
            if model.jnt_limited[joint]:
                position = _within(chain, position, *map(float, model.jnt_range[joint]))
            states[:, column], indirect[j] = position, True
            if not measured[model.nv + j]:
                states[:, 1 + model.nq + j] = _velocities(chain, position)
    return states, indirect, irrelevant


def _values(model: mujoco.MjModel, joint: int) -> FloatArray:
    """What a position may be; of an unlimited slide something near by."""
    hinge, (low, high) = model.jnt_type[joint] == _HINGE, map(float, model.jnt_range[joint])
    if model.jnt_limited[joint] and not (hinge and high - low >= 2 * np.pi):
        return np.linspace(low, high, OPTIONS.grid)
    middle, reach = 0.5 * (low + high) * bool(model.jnt_limited[joint]), np.pi if hinge else 1.0
    return middle + np.linspace(-reach, reach, OPTIONS.grid, endpoint=False)


def _predicted(
    chain: Sampled,
    states: FloatArray,
    column: int,
    values: FloatArray,
    at: IntArray | None = None,
    theta: FloatArray | None = None,
) -> FloatArray:
    """Predictions (B, K, C) with values (B, K) in a column of the states (K, S), NaN where they diverge.

    theta: (N,), by default in the middle.
    """
    many = np.repeat(states[None], len(values), axis=0)
    many[..., column] = values
    middle = np.full(len(chain.simulator.space), 0.5) if theta is None else theta
    predicted, _, _ = chain.simulate(np.tile(middle, (len(values), 1)), many, at)
    return predicted


def _dependent(chain: Sampled, states: FloatArray, position: int, values: FloatArray, size: FloatArray) -> BoolArray:
    """Which channels (C,) depend on a position."""
    at = np.unique(np.linspace(0, len(states) - 1, OPTIONS.samples).astype(int))
    tried = values[np.linspace(0, len(values) - 1, OPTIONS.values).astype(int)]
    predicted = _predicted(chain, states[at], 1 + position, np.repeat(tried[:, None], len(at), axis=1), at)
    spread = np.where(chain.observed[at], np.nan_to_num(np.ptp(predicted, axis=0) / size), 0.0)
    return np.asarray((spread > 1e-6).any(0))  # less is rounding


def _best(chain: Sampled, states: FloatArray, column: int, values: FloatArray, size: FloatArray) -> FloatArray | None:
    """Position (K,) of every sample; None where it is not unique, or fits neither in the middle nor as published.

    size (C,): infinite of channels that do not count.
    """
    space = chain.simulator.space
    thetas = np.full(len(space), 0.5), np.clip(space.default_theta, 0.0, 1.0)
    tried = (_best_at(chain, states, column, values, size, theta) for theta in thetas)
    return next((position for position in tried if position is not None), None)


def _best_at(
    chain: Sampled, states: FloatArray, column: int, values: FloatArray, size: FloatArray, theta: FloatArray
) -> FloatArray | None:
    """The same at theta (N,)."""
    # the grid, and whether one place of it is clearly ahead
    tried = np.repeat(values[:, None], len(states), axis=1)
    residual = _residual(chain, _predicted(chain, states, column, tried, theta=theta), size)
    misfit = np.where(np.isnan(residual), np.inf, residual**2).sum(-1)
    spacing = float(values[1] - values[0])
    circle = bool(np.isclose(spacing * OPTIONS.grid, 2 * np.pi))
    seen = np.ptp(np.where(np.isfinite(misfit), misfit, 0.0), axis=0) > 1e-6
    count = np.isfinite(size) & chain.observed.any(0)
    whole = seen & chain.observed[:, count].all(1)
    if whole.mean() >= OPTIONS.whole:  # channels of several rates
        seen = whole
    if not seen.any() or (_lead(misfit[:, seen], circle) > OPTIONS.clear).mean() < OPTIONS.unique:
        return None
    # Gauss-Newton from there
    position = values[misfit.argmin(0)]
    for k in range(OPTIONS.steps):
        tried = np.stack([position, position + _STEP])
        at, moved = _residual(chain, _predicted(chain, states, column, tried, theta=theta), size)
        slope = np.nan_to_num((at - moved) / _STEP)
        steepness = (slope**2).sum(-1)
        step = (slope * np.nan_to_num(at)).sum(-1) / np.maximum(steepness, 1e-12)
        position = position + np.where(seen, np.clip(step, -spacing, spacing) / (1 + (k == 0)), 0.0)
    # whether what is left is small
    left = _residual(chain, _predicted(chain, states, column, position[None], theta=theta), size)[0]
    counted = chain.observed & np.isfinite(size) & seen[:, None]
    if not float(np.sqrt((left[counted] ** 2).mean())) < OPTIONS.fits:
        return None
    return _joined(chain, position, ~seen, circle)


def _lead(misfit: FloatArray, circle: bool) -> FloatArray:
    """By how much (K,) the best local minimum of the grid (G, K) is ahead of the next, infinite where it is alone."""
    edge = np.full_like(misfit[:1], np.inf)
    before, after = (misfit[-1:], misfit[:1]) if circle else (edge, edge)
    minimum = (misfit <= np.concatenate([before, misfit[:-1]])) & (misfit < np.concatenate([misfit[1:], after]))
    values = np.sort(np.where(minimum, misfit, np.inf), axis=0)
    return np.asarray(np.where(np.isfinite(values[1]), values[1] - values[0], np.inf))


def _residual(chain: Sampled, predicted: FloatArray, size: FloatArray) -> FloatArray:
    """Residuals (B, K, C) in units of the channels' spread, zero where nothing was observed."""
    return np.where(chain.observed, (chain.measured - predicted) / size, 0.0)


def _joined(chain: Sampled, position: FloatArray, blind: BoolArray, circle: bool) -> FloatArray:
    """Log by log without jumps round the circle, and between the samples that tell."""
    joined = position.copy()
    for log in np.unique(chain.log):
        mine = np.flatnonzero(chain.log == log)
        seen = mine[~blind[mine]]
        if len(seen):
            along = np.unwrap(position[seen]) if circle else position[seen]
            joined[mine] = np.interp(mine, seen, along)
    return joined


def _within(chain: Sampled, positions: FloatArray, low: float, high: float) -> FloatArray:
    """Positions (K,), those of a log that leaves a range of more than a turn by whole turns back into it."""
    out = positions.copy()
    for log in np.unique(chain.log) if high - low >= 2 * np.pi else ():
        mine = chain.log == log
        above, below = float(positions[mine].max()) - high, low - float(positions[mine].min())
        turns = [max(0.0, np.ceil((beyond - OPTIONS.over) / (2 * np.pi))) for beyond in (above, below)]
        out[mine] -= 2 * np.pi * (turns[0] - turns[1])
    return out


def _velocities(chain: Sampled, positions: FloatArray) -> FloatArray:
    """Velocities (K,) of positions (K,)."""
    velocities = np.zeros_like(positions)
    for log in np.unique(chain.log):
        mine = chain.log == log
        if mine.sum() > 1:
            velocities[mine] = np.gradient(positions[mine]) / chain.dt[mine]
    return velocities
