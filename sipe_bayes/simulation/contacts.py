"""Whether something is struck or let go along a log: there simulations jump, and slopes say little."""

from __future__ import annotations

import copy
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray
from sipe_bayes.core.trajectory import Trajectory
from sipe_bayes.simulation.callable_simulator import CallableSimulator
from sipe_bayes.simulation.simulator import Simulator

_LOOKS = 2000  # samples that are looked at, spread evenly
_APART = 0.05  # of the smaller geom's size, that two are apart beyond what noise makes of one that rests on the other
_SHORT, _WIDE, _JUMPS = 1e-5, 0.02, 3.0  # of the cube; how many times as steep the short way tells jumps
_BEGINNINGS, _DIRECTIONS, _SECONDS = 32, 3, 0.5  # of simulations that are compared


@dataclass(frozen=True)
class Contacts:
    """What the states along logs have of contact.

    Args:
        touch: whether any two geoms touch, or may do so in states that are not known.
        change: whether two touch in some of the states and are clearly apart in others.
        rough: whether what touches all along slips and sticks, as a cart's wheels may: simulations jump by parameters.
    """

    touch: bool = False
    change: bool = False
    rough: bool = False


def contacts_along(
    simulator: Simulator | CallableSimulator, logs: Sequence[FloatArray], sampled: Sequence[FloatArray] | None = None
) -> Contacts:
    """Of the states (T+1, S) along logs.

    A body that bounces is seldom seen to touch: between two samples it comes down and goes up again. So two geoms touch
    as well where they would by the next sample if they went on as they came since the last one.

    Args:
        simulator: of the model.
        logs: states by which bodies are apart, smoothed.
        sampled: the same states not smoothed, by which they touch: smoothing lifts a bounce off the floor.
    """
    if isinstance(simulator, CallableSimulator) or not may_touch(simulator.model):
        return Contacts()
    model, data = simulator.model, mujoco.MjData(simulator.model)
    looks = np.concatenate(list(logs))
    looks = looks[_spread(len(looks))]
    looks = looks[np.isfinite(looks).all(1)]
    seen, count, all_known = _touching(model, logs if sampled is None else sampled)
    change = any(_part(model, data, pair, looks) for pair, number in seen.items() if number < count)
    return Contacts(bool(seen) or not all_known, change)


def jumps(simulator: Simulator, logs: Sequence[Trajectory], states: Sequence[FloatArray]) -> bool:
    """Whether simulations are steeper over short changes of the parameters than over wide ones, as none that is smooth.

    At beginnings spread over the logs, at the model as given and in directions into the cube, all squares together: it
    is what the normal equations of a search would be made of.

    Args:
        simulator: of the model.
        logs: whose commands it follows.
        states: (T+1, S) along each, where it begins.
    """
    theta, rng = simulator.space.default_theta, np.random.default_rng(0)
    ways = np.where(theta > 0.5, -1, 1) * rng.uniform(0.3, 1.0, (_DIRECTIONS, len(theta)))
    moved = np.concatenate([theta[None], *(theta + size * ways for size in (_SHORT, _WIDE))])
    slopes, total = [], sum(len(log) for log in logs)
    for log, own in zip(logs, states, strict=True):
        steps, count = max(1, min(round(_SECONDS / log.dt), len(log))), math.ceil(_BEGINNINGS * len(log) / total)
        first = np.unique(((np.arange(count) + 0.5) / count * (len(log) - steps)).astype(int))
        each = np.repeat(first, len(moved))
        runs = simulator.on_processor.rollout(
            np.tile(moved, (len(first), 1)),
            np.stack([log.actions[k : k + steps] for k in each]),
            own[each],
            dt=log.dt,
            logs=[log.name] * len(each),
            goals=simulator.environment.recorded_goals(log.observations[each]),
        )
        seen = runs.observations.reshape(len(first), len(moved), steps + 1, -1) / _scales(log)
        change = (seen[:, 1:] - seen[:, :1]).reshape(len(first), 2, -1)
        slopes.append(np.sqrt((change**2).mean(-1)) / [_SHORT, _WIDE])
    short, wide = np.concatenate(slopes).T
    finite = np.isfinite(short) & np.isfinite(wide)
    return bool(np.sum(short[finite] ** 2) > _JUMPS**2 * np.sum(wide[finite] ** 2))


def _scales(log: Trajectory) -> FloatArray:
    """Standard deviations (O,) of a log's channels; infinite of those that do not move or have no sample."""
    out, has = np.full(log.observations.shape[1], np.inf), np.isfinite(log.observations).any(0)
    out[has] = np.nanstd(log.observations[:, has], axis=0)
    return np.where(out > 0, out, np.inf)


def _spread(count: int) -> IntArray:
    """Numbers of the samples that are looked at, of ``count``."""
    return np.linspace(0, count - 1, min(_LOOKS, count)).astype(int)


def _touching(model: mujoco.MjModel, logs: Sequence[FloatArray]) -> tuple[Counter[tuple[int, int]], int, bool]:
    """In how many states each pair of geoms touches, of how many, and whether all of these are known."""
    states, lengths = np.concatenate(list(logs))[:, 1 : 1 + model.nq], [len(own) for own in logs]
    first = np.repeat(np.cumsum(lengths) - lengths, lengths)  # of each state's log
    now = _spread(len(states))
    before = np.maximum(now - 1, first[now])
    finite = np.isfinite(states[now]).all(1) & np.isfinite(states[before]).all(1)
    pairs = _pairs(model, states, before[finite], now[finite])
    return Counter(pair for own in pairs for pair in own), int(finite.sum()), bool(finite.all())


def apart_along(simulator: Simulator | CallableSimulator, log: FloatArray) -> BoolArray:
    """At which of the states (T+1, S) along a log nothing touches or may do so, as in those that are not known."""
    if isinstance(simulator, CallableSimulator) or not may_touch(simulator.model):
        return np.ones(len(log), bool)
    states = log[:, 1 : 1 + simulator.model.nq]
    now = np.arange(len(log))
    before = np.maximum(now - 1, 0)
    finite = np.isfinite(states[now]).all(1) & np.isfinite(states[before]).all(1)
    out = np.zeros(len(log), bool)
    out[finite] = [not pairs for pairs in _pairs(simulator.model, states, before[finite], now[finite])]
    return out


def _pairs(model: mujoco.MjModel, states: FloatArray, before: IntArray, now: IntArray) -> list[set[tuple[int, int]]]:
    """The geoms that touch at some of the positions (n, nq) along logs, given the numbers of those before."""
    near, data = copy.copy(model), mujoco.MjData(model)
    reach = 2 * max((_step(model, data, states[b], states[n]) for b, n in zip(before, now, strict=True)), default=0.0)
    near.geom_margin[:], near.geom_gap[:] = model.geom_margin + reach, 0.0
    near.pair_margin[:], near.pair_gap[:] = model.pair_margin + reach, 0.0
    out, last, distances = list[set[tuple[int, int]]](), -1, dict[tuple[int, int], float]()
    for b, n in zip(before.tolist(), now.tolist(), strict=True):
        earlier = distances if b == last else _distances(near, data, states[b])
        last, distances = n, _distances(near, data, states[n])
        seen = set[tuple[int, int]]()
        for pair, distance in distances.items():
            margin = float(model.geom_margin[list(pair)].max())
            ahead = 2 * distance - earlier.get(pair, math.inf) if b < n else distance
            if distance <= margin or (math.isfinite(ahead) and ahead <= 0):
                seen.add(pair)
        out.append(seen)
    return out


def _step(model: mujoco.MjModel, data: mujoco.MjData, before: FloatArray, now: FloatArray) -> float:
    """How far any geom's surface moves between two positions (nq,), at most."""
    places, turns = [], []
    for position in (before, now):
        data.qpos[:] = position
        mujoco.mj_kinematics(model, data)
        places.append(data.geom_xpos.copy())
        turns.append(data.geom_xmat.copy())
    moved = np.linalg.norm(places[1] - places[0], axis=1)
    turned = np.linalg.norm(turns[1] - turns[0], axis=1) / math.sqrt(2)  # a small angle; of a large one, less
    return float((moved + turned * model.geom_rbound).max(initial=0.0))


def _distances(near: mujoco.MjModel, data: mujoco.MjData, position: FloatArray) -> dict[tuple[int, int], float]:
    """Least distance of each pair of geoms that is nearer than the model's margins, at positions (nq,)."""
    data.qpos[:] = position
    mujoco.mj_kinematics(near, data)
    mujoco.mj_collision(near, data)
    out: dict[tuple[int, int], float] = {}
    for (a, b), distance in zip(data.contact.geom.tolist(), data.contact.dist.tolist(), strict=True):
        out[a, b] = min(distance, out.get((a, b), math.inf))
    return out


def _part(model: mujoco.MjModel, data: mujoco.MjData, pair: tuple[int, int], looks: FloatArray) -> bool:
    """Whether two geoms are apart by more than noise in any of the states (n, S)."""
    sizes = [float(size) for size in model.geom_rbound[list(pair)] if size > 0]  # a plane has none
    least = _APART * min(sizes, default=0.0)
    for state in looks:
        data.qpos[:] = state[1 : 1 + model.nq]
        mujoco.mj_kinematics(model, data)
        if mujoco.mj_geomDistance(model, data, *pair, 2 * least, None) > least:
            return True
    return False


def may_touch(model: mujoco.MjModel) -> bool:
    """Whether any two geoms of a model may touch: on bodies that move against each other, and not parent and child."""
    if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT:
        return False
    weld = model.body_weldid[model.geom_bodyid]
    above = model.body_weldid[model.body_parentid[weld]]
    kin = (above[:, None] == weld) & (weld != 0)
    if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_FILTERPARENT:
        kin[:] = False
    types = (model.geom_contype[:, None] & model.geom_conaffinity) != 0
    apart = weld[:, None] != weld
    return bool(model.npair or ((types | types.T) & apart & ~(kin | kin.T)).any())
