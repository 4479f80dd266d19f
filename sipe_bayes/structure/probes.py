"""What extensions would do to the predictions of a fit: the rows of score tests.

Every extension is simulated a small step away from the plain model, from the same starts. Where a parameter of the
model does about the same (its ``imitators``: a delay beside a lag), a probe instead goes as far as it can take from the
parameter what it adds, and what that changes grows about with the square of how far it goes: a trade.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.checkpoint import NOTHING_KEPT, Kept
from sipe_bayes.core.parameters import ParameterSpace
from sipe_bayes.core.telling import Tell, silent
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.likelihood import BoundLikelihood
from sipe_bayes.simulation.simulator import Simulator
from sipe_bayes.structure.extension import Placed, extended, imitating, members, placements
from sipe_bayes.structure.internal_starts import carried_starts, mapped_starts
from sipe_bayes.structure.machine import machine_of
from sipe_bayes.structure.registry import EXTENSIONS, get_extension

_ROWS = 32  # simulated at once: all the states of a batch are in memory
_Change = tuple[int, FloatArray, FloatArray, FloatArray]  # an ``Effect`` with the number of what it is of


@dataclass(frozen=True)
class Probe:
    """A cause that a model may lack: one direction of an extension, at size 1 with an effect of root-mean-square one.

    Args:
        placed: the extension.
        whole: its size where the number that it changes is off by all that a tolerance is a share of; nan where logs
            alone tell that number.
        trade: (N,) by which it changes theta itself at size 1, and with the root of any other.
    """

    placed: Placed
    whole: float
    trade: FloatArray

    @property
    def name(self) -> str:
        """In words."""
        return self.placed.sentence

    @property
    def is_step(self) -> bool:
        """Whether it is what the simulation's physics step does, which no machine takes."""
        return self.placed.extension.name == "physics_step"


@dataclass(frozen=True)
class Effect:
    """What an extension of one shape does: the change (W, L, C, K) of predictions along its probes, theta (K, P).

    By ``trades`` (K, N) they change theta itself: a trade's size then goes with the root of its share.
    """

    placed: Placed
    change: FloatArray
    probes: FloatArray
    trades: FloatArray

    @property
    def size(self) -> FloatArray:
        """(K,) root-mean-squares of the changes."""
        return np.asarray(np.sqrt((self.change**2).mean((0, 1, 2))))

    def named(self) -> list[Probe]:
        """Its K probes."""
        placed, size = self.placed, self.size
        wholes = np.full(len(size), math.nan)
        if not placed.parameters:
            wholes = size
        elif placed.wholes and not self.trades.any():
            ranges = np.array([parameter.high - parameter.low for parameter in placed.parameters])
            wholes = size / ((self.probes - placed.plain) * ranges / np.array(placed.wholes)).sum(-1)
        rows = zip(wholes.tolist(), self.trades / np.sqrt(size)[:, None], strict=True)
        return [Probe(placed, whole, trade) for whole, trade in rows]


def bounds(plain: FloatArray, tried: FloatArray) -> tuple[FloatArray, FloatArray]:
    """How far probes (K, P) can be followed from the plain model (P,) within the cube, backwards and forwards: (K,)."""
    if not len(plain):  # an extension without parameters is there or not
        return np.zeros(len(tried)), np.ones(len(tried))
    direction = tried - plain
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.stack([-plain / direction, (1 - plain) / direction])  # of the cube, along each axis
    down = np.where(direction == 0, -np.inf, ends.min(0)).max(1)
    return np.minimum(down, 0.0), np.maximum(np.where(direction == 0, np.inf, ends.max(0)).min(1), 0.0)


def place_extensions(windows: BoundLikelihood, theta: FloatArray, starts: FloatArray) -> list[Placed]:
    """The registry's extensions, but those tried by name alone, where they have a place: none but in a user's MJCF."""
    if not isinstance(windows.simulator.environment, MjcfEnvironment):
        return []
    machine = machine_of(windows, theta, starts)
    every = (get_extension(name) for name in EXTENSIONS)
    return [p for extension in every if not extension.by_name for p in placements(extension, machine)]


def probes_cost(windows: BoundLikelihood, placed: Sequence[Placed]) -> int:
    """Rollouts that ``effects`` takes, but for extensions that do not go together; at this theta at most."""
    groups = _groups(placed)
    each = (1 + sum(one.probes.shape[0] * one.probes.shape[1] for one in group) for group in groups)
    return sum(each) * len(windows.trajectories)


def effects(
    windows: BoundLikelihood,
    theta: FloatArray,
    starts: FloatArray,
    placed: Sequence[Placed],
    tell: Tell = silent,
    kept: Kept = NOTHING_KEPT,
) -> list[Effect]:
    """The effects of extensions that change what is observed of W windows, at theta (N,) and starts (W, D).

    ``tell`` is called with what is being done; ``kept`` keeps it by group.
    """

    def changes(group: list[Placed], kept: Kept) -> tuple[_Change, ...]:
        seen, number = _of_group(windows, theta, starts, group), {id(one): k for k, one in enumerate(group)}
        return tuple((number[id(one.placed)], one.change, one.probes, one.trades) for one in seen)

    out: list[Effect] = []
    groups = _groups(placed)
    for number, group in enumerate(groups):
        tell(f"simulating what extensions would do, {number + 1} of {len(groups)}")
        made = kept.of(f"extensions-{number}", tuple[_Change, ...], partial(changes, group))
        out += [Effect(group[k], *change) for k, *change in made]
    return out


def _groups(placed: Sequence[Placed]) -> list[list[Placed]]:
    """What is simulated in one batch."""
    groups: dict[str, list[Placed]] = {}
    for one in placed:
        # a law costs steps of its own, an edit makes another model: a law goes with its like, an edit by itself
        single = one.edit is None and len(members(one.site)) == 1
        key = ("" if one.extension.native else one.extension.name) if single else one.label
        # of one log: which writes what others write for all
        groups.setdefault(key or "by log" * one.by_log, []).append(one)
    return list(groups.values())


def _of_group(windows: BoundLikelihood, theta: FloatArray, starts: FloatArray, group: list[Placed]) -> list[Effect]:
    """Of all in one batch, or where two of them write the same number each by itself."""
    if (whole := _extended(windows, group)) is not None:
        return _simulated(windows, theta, starts, group, whole)
    alone = ((one, _extended(windows, [one])) for one in group)
    return [e for one, own in alone if own is not None for e in _simulated(windows, theta, starts, [one], own)]


def _extended(windows: BoundLikelihood, group: list[Placed]) -> BoundLikelihood | None:
    """The logs bound to the model with them all; None where it can not have them, or states that logs do not record."""
    environment = windows.simulator.environment
    assert isinstance(environment, MjcfEnvironment)
    try:
        simulator = Simulator(extended(environment, group), windows.simulator.num_threads)
        bound = BoundLikelihood(windows.settings, simulator, windows.trajectories, windows)
    except ValueError:
        return None
    sizes = [(model.nq, model.nv, model.na, model.nhistory) for model in (windows.simulator.model, simulator.model)]
    return bound if windows.settings.starts == "estimated" or sizes[0] == sizes[1] else None


def _simulated(
    windows: BoundLikelihood, theta: FloatArray, starts: FloatArray, group: list[Placed], bound: BoundLikelihood
) -> list[Effect]:
    """Effects of extensions that the model has to which the logs are ``bound``."""
    bound.budget, bound.deadline = windows.budget - windows.rollouts, windows.deadline
    before, after = windows.simulator.model, bound.simulator.model
    if (before.nq, before.nv, before.na) == (after.nq, after.nv, after.na):  # whatever history of commands it has
        own = slice(1 + before.nq + before.nv + before.na)
        bound.reference[:, own] = windows.reference[:, own]
    plain = np.concatenate([theta, *(one.plain for one in group)])
    fixed = any(one.extension.fixed for one in group)  # there are no values at which it is the plain model
    rows, first = [] if fixed else [plain], len(theta)
    tried = [_traded(windows.simulator.space, theta, one) for one in group]
    for probes, trade in tried:
        last = first + probes.shape[-1]
        rows += [
            np.concatenate([theta + trade, plain[len(theta) : first], probe, plain[last:]])
            for probe in np.concatenate(probes)
        ]
        first = last
    mapped, runs = mapped_starts(before, after, starts), []
    try:
        for piece in np.array_split(np.stack(rows), math.ceil(len(rows) / _ROWS)):
            begun = carried_starts(before, bound, piece, np.tile(mapped, (len(piece), 1, 1)))
            runs.append(bound.predict(piece, begun))
    finally:
        windows.rollouts += bound.rollouts
    predicted, valid = (np.concatenate(parts) for parts in zip(*runs, strict=True))
    if fixed:
        here, good = windows.predict(theta[None], starts[None], in_float64=True)
        predicted, valid = np.concatenate([here, predicted]), np.concatenate([good, valid])
    out, at = [], 1
    for one, (probes, trade) in zip(group, tried, strict=True):
        for shape in probes:
            mine = np.arange(at, at + len(shape))
            at += len(shape)
            with np.errstate(invalid="ignore"):
                change = np.where(windows.observed, predicted[mine] - predicted[0], 0.0)
            moves = (np.abs(change) > 1e-9 * windows.spread).any((1, 2, 3))  # and not by rounding alone
            use = valid[mine] & np.isfinite(change).all((1, 2, 3)) & moves
            if valid[0] and use.any():
                out.append(Effect(one, np.moveaxis(change[use], 0, -1), shape[use], np.tile(trade, (use.sum(), 1))))
    return out


def _traded(space: ParameterSpace, theta: FloatArray, one: Placed) -> tuple[FloatArray, FloatArray]:
    """An extension's probes (G, K, P) and what they take from theta (N,): of a trade one, as far as it can go."""
    trade, k = np.zeros_like(theta), imitating(one.extension, one.site, tuple(space))
    if k is None or len(one.parameters) != 1 or space[k].scale != "linear":  # a root of a size is a share of SI
        return one.probes, trade
    (own,), value = one.parameters, float(space[k].value(theta[k]))
    begin = float(own.value(one.plain[0]))
    step = min(value - space[k].low, own.high - begin)
    if step < float(own.value(one.probes.flat[0])) - begin:
        return one.probes, trade
    trade[k] = float(space[k].normalise(value - step)) - theta[k]
    return np.array([[[float(own.normalise(begin + step))]]]), trade
