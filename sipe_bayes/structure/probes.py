"""What extensions would do to the predictions of a fit: the rows of score tests.

Every extension is simulated a small step away from the plain model, from the same starts. Those that need no more than
parameters are simulated in one batch, laws and those that change the model's states each by itself.

Where a parameter of the model does about the same as an extension (its ``imitators``: a delay beside a lag), a small
step shows nothing but what that parameter explains. A probe then goes as far as it can take from the parameter what it
adds, and what that changes grows about with the square of how far it goes: a trade.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from sipe_bayes.core.arrays import BoolArray, FloatArray
from sipe_bayes.core.checkpoint import NOTHING_KEPT, Kept
from sipe_bayes.core.parameters import ParameterSpace
from sipe_bayes.core.telling import Tell, silent
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.likelihood import BoundLikelihood
from sipe_bayes.simulation.simulator import Simulator
from sipe_bayes.structure.extension import Extension, Placed, extended, imitating, members, placements
from sipe_bayes.structure.internal_starts import carried_starts, mapped_starts
from sipe_bayes.structure.machine import machine_of
from sipe_bayes.structure.registry import EXTENSIONS, get_extension

_ROWS = 32  # simulated at once: all the states of a batch are in memory


@dataclass(frozen=True)
class Effect:
    """What an extension of one shape does to the predictions.

    Args:
        placed: which.
        change: (W, L, C, K) of the predictions along each of its probes; a share of one gives a share of it.
        probes: theta (K, P) of these probes.
        trades: (K, N) by which they change theta itself: a trade's size then goes with the root of its share.
    """

    placed: Placed
    change: FloatArray
    probes: FloatArray
    trades: FloatArray


@dataclass(frozen=True)
class Probe:
    """A cause that a model may lack.

    Args:
        name: what it is, in words.
        remedy: what to do about it.
        by_log: whether it is of one log alone.
        site: where it is.
        extension: that it is of.
        whole: its size where the number that it changes is off by all that a tolerance is a share of; nan where logs
            alone tell that number.
        trade: (N,) by which it changes theta itself at size 1, and with the root of any other; none where not at all.
        size: root-mean-square of its effect where it was simulated.
    """

    name: str
    remedy: str
    by_log: bool = False
    site: str = ""
    extension: Extension | None = None
    whole: float = math.nan
    trade: tuple[float, ...] = ()
    size: float = math.nan


@dataclass(frozen=True)
class Probes:
    """Causes that a model may lack, K of which change what is observed.

    Args:
        named: the K.
        change: (W, L, C, K) of the predictions, of a root-mean-square of one.
        one_sided: (K,) whether the size of each may not be negative.
        effects: of extensions, whose probes stand first in this order.
    """

    named: list[Probe]
    change: FloatArray
    one_sided: BoolArray
    effects: list[Effect]


@dataclass(frozen=True)
class _Change:
    """An ``Effect`` without what it is of: the number of that in its group."""

    number: int
    change: FloatArray
    probes: FloatArray
    trades: FloatArray


def probes_cost(windows: BoundLikelihood, placed: Sequence[Placed]) -> int:
    """Rollouts that ``probes`` takes, but for extensions that do not go together; at this theta at most."""
    groups = _groups(placed)
    each = (1 + sum(one.probes.shape[0] * one.probes.shape[1] for one in group) for group in groups)
    return sum(each) * len(windows.trajectories)


def probes(
    windows: BoundLikelihood,
    theta: FloatArray,
    starts: FloatArray,
    placed: Sequence[Placed],
    tell: Tell = silent,
    kept: Kept = NOTHING_KEPT,
) -> Probes:
    """Probes of extensions; none where the environment is no user's MJCF.

    Args:
        windows: the logs, W windows of L samples and C channels.
        theta: (N,) where the model stands.
        starts: (W, D) of the windows.
        placed: the extensions.
        tell: called with what is being done.
        kept: keeps what extensions do, group by group.
    """
    if not isinstance(windows.simulator.environment, MjcfEnvironment):
        return Probes([], np.zeros((*windows.observed.shape, 0)), np.zeros(0, bool), [])
    seen = effects(windows, theta, starts, placed, tell, kept)
    named = [probe for effect in seen for probe in _named(effect)]
    one_sided = [bounds(effect.placed.plain, effect.probes)[0] >= 0 for effect in seen]
    changes = [np.zeros((*windows.observed.shape, 0)), *(_unit(effect.change) for effect in seen)]
    return Probes(named, np.concatenate(changes, axis=-1), np.concatenate([np.zeros(0, bool), *one_sided]), seen)


def place_extensions(
    windows: BoundLikelihood, theta: FloatArray, starts: FloatArray, extensions: Sequence[Extension] | None = None
) -> list[Placed]:
    """Extensions, by default all that the registry has, but those tried by name alone, where they have a place.

    Nowhere in an environment that is no user's MJCF.
    """
    if not isinstance(windows.simulator.environment, MjcfEnvironment):
        return []
    machine = machine_of(windows, theta, starts)
    usual = (get_extension(name) for name in EXTENSIONS)
    chosen = [extension for extension in usual if not extension.by_name] if extensions is None else extensions
    return [p for extension in chosen for p in placements(extension, machine)]


def _unit(change: FloatArray) -> FloatArray:
    """Changes (W, L, C, K) in units of their root-mean-square."""
    return change / _size(change)


def _size(change: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt((change**2).mean((0, 1, 2))))


def _named(effect: Effect) -> list[Probe]:
    placed = effect.placed
    targets = [target for parameter in placed.parameters for target in parameter.targets]
    what = "as a parameter (or widen its bounds)" if len(targets) == 1 else "as parameters (or widen their bounds)"
    by_log = any(parameter.log is not None for parameter in placed.parameters)
    remedy = f"add {' and '.join(targets)} {what}"
    if placed.edit is not None:  # the model has no such part yet
        remedy = f"let `sipe discover` put it in (--only {placed.extension.name})"
    probe = Probe(placed.sentence, remedy, by_log, placed.site, placed.extension)
    size, away = _size(effect.change), effect.probes - placed.plain
    named = [replace(probe, size=own) for own in size.tolist()]
    if effect.trades.any():
        sized = effect.trades / np.sqrt(size)[:, None]
        return [replace(one, trade=tuple(row)) for one, row in zip(named, sized.tolist(), strict=True)]
    if not placed.parameters:
        return [replace(one, whole=own) for one, own in zip(named, size.tolist(), strict=True)]
    if not placed.wholes:
        return named
    ranges = np.array([parameter.high - parameter.low for parameter in placed.parameters])
    wholes = size / (away * ranges / np.array(placed.wholes)).sum(-1)
    return [replace(one, whole=whole) for one, whole in zip(named, wholes.tolist(), strict=True)]


def bounds(plain: FloatArray, tried: FloatArray) -> tuple[FloatArray, FloatArray]:
    """How far probes (K, P) can be followed from the plain model (P,) within the cube, backwards and forwards: (K,).

    Where there are no parameters an extension is there or not.
    """
    if not len(plain):
        return np.zeros(len(tried)), np.ones(len(tried))
    direction = tried - plain
    with np.errstate(divide="ignore", invalid="ignore"):
        up = np.where(direction > 0, (1 - plain) / direction, np.where(direction < 0, -plain / direction, np.inf))
        down = np.where(direction > 0, -plain / direction, np.where(direction < 0, (1 - plain) / direction, -np.inf))
    return np.minimum(down.max(1), 0.0), np.maximum(up.min(1), 0.0)


def effects(
    windows: BoundLikelihood,
    theta: FloatArray,
    starts: FloatArray,
    placed: Sequence[Placed],
    tell: Tell = silent,
    kept: Kept = NOTHING_KEPT,
) -> list[Effect]:
    """The effects of extensions that change what is observed.

    Args:
        windows: the logs, of an ``MjcfEnvironment``.
        theta: (N,), the estimate.
        starts: (W, D).
        placed: the extensions.
        tell: called with what is being done.
        kept: keeps what they do, group by group.
    """

    def changes(group: list[Placed], kept: Kept) -> tuple[_Change, ...]:
        seen = _of_group(windows, theta, starts, group)
        number = {id(one): k for k, one in enumerate(group)}
        return tuple(_Change(number[id(e.placed)], e.change, e.probes, e.trades) for e in seen)

    out: list[Effect] = []
    groups = _groups(placed)
    for number, group in enumerate(groups):
        tell(f"simulating what extensions would do, {number + 1} of {len(groups)}")
        made = kept.of(f"extensions-{number}", tuple[_Change, ...], partial(changes, group))
        out += [Effect(group[one.number], one.change, one.probes, one.trades) for one in made]
    return out


def _groups(placed: Sequence[Placed]) -> list[list[Placed]]:
    """What is simulated in one batch."""
    groups: dict[str, list[Placed]] = {}
    for one in placed:
        # a law costs steps of its own, an edit makes another model: a law goes with its like, an edit by itself
        single = one.edit is None and len(members(one.site)) == 1
        key = ("" if one.extension.native else one.extension.name) if single else one.label
        if any(parameter.log is not None for parameter in one.parameters):
            key = key or "by log"  # which writes what others write for all logs
        groups.setdefault(key, []).append(one)
    return list(groups.values())


def _of_group(windows: BoundLikelihood, theta: FloatArray, starts: FloatArray, group: list[Placed]) -> list[Effect]:
    environment = windows.simulator.environment
    assert isinstance(environment, MjcfEnvironment)
    whole = _extended(windows, environment, group)
    if whole is not None:
        return _simulated(windows, theta, starts, group, whole)
    alone = ((one, _extended(windows, environment, [one])) for one in group)  # two of them write the same number
    return [e for one, own in alone if own is not None for e in _simulated(windows, theta, starts, [one], own)]


def _extended(windows: BoundLikelihood, environment: MjcfEnvironment, group: list[Placed]) -> BoundLikelihood | None:
    """The logs bound to the model with them all, beside the extensions that it has; None where it can not have them.

    None either of what has states of its own, where the logs' recorded states are to be held to.
    """
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
        own = 1 + before.nq + before.nv + before.na
        bound.reference[:, :own] = windows.reference[:, :own]
    plain = np.concatenate([theta, *(one.plain for one in group)])
    fixed = any(one.extension.fixed for one in group)  # there are no values at which it is the plain model
    rows, first = [] if fixed else [plain], len(theta)
    tried = [_traded(windows.simulator.space, theta, one) for one in group]
    for probes, trade in tried:
        for probe in (probe for shape in probes for probe in shape):
            row = plain.copy()
            row[: len(theta)] += trade
            row[first : first + len(probe)] = probe
            rows.append(row)
        first += probes.shape[-1]
    mapped = mapped_starts(before, after, starts)
    pieces = np.array_split(np.stack(rows), math.ceil(len(rows) / _ROWS))
    runs = []
    try:
        for piece in pieces:
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
                trades = np.tile(trade, (int(use.sum()), 1))
                out.append(Effect(one, np.moveaxis(change[use], 0, -1), shape[use], trades))
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
