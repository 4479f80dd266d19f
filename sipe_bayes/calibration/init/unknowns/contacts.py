"""Friction and bounce that may be unknown: of what touches what stands still."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import takewhile

import mujoco

from sipe_bayes.calibration.init.draft import Unknown, rounded_up
from sipe_bayes.calibration.machine import counts, friction_of, own_friction, top_of, touched_by

_SLIPPERY = 0.02  # the least friction


def contacts(model: mujoco.MjModel, tops: set[int]) -> list[Unknown]:
    """Friction and bounce of bodies, and of what moves with them, with what stands still.

    Geoms whose friction with it is one number share a parameter: wheels, feet.
    """
    touching = {g: s for g in range(model.ngeom) if top_of(model, g, tops) and (s := touched_by(model, g))}
    groups: dict[tuple[float, ...], list[int]] = {}
    for geom, still in touching.items():
        groups.setdefault(tuple(friction_of(model, geom, s) for s in still), []).append(geom)
    leaning: list[set[int]] = [
        {s for g in group for s in touching[g] if counts(model, s, g)} for group in groups.values()
    ]
    out: list[Unknown] = []
    taken: set[int] = set()
    for k, group in enumerate(groups.values()):
        others = taken.union(*leaning[:k], *leaning[k + 1 :])
        decides = {s for s in leaning[k] - taken if friction_of(model, group[0], s) <= own_friction(model, s)}
        still = sorted(decides | (leaning[k] - others))
        taken |= {*still}
        own = [g for g in group if any(counts(model, g, s) for s in touching[g])]
        least = max((own_friction(model, s) for s in leaning[k] - {*still}), default=_SLIPPERY)
        bodies = {int(model.geom_bodyid[g]) for g in group}
        above = [top_of(model, g, tops) for g in group] if bodies & tops or len(groups) == 1 else sorted(bodies)
        name = f"{_shared(model, above)}_friction"
        name += f"_{k + 1}" * any(unknown.name == name for unknown in out)
        given, what = [own_friction(model, g) for g in (*own, *still)], _mixed(own, still, least)
        span = min([least, *given]), max([1.5, 2 * least, *given])  # what the model has lies within
        out += _of_geoms(model, name, "friction", (own, still), span, what)
    if touching:
        every = (sorted(touching), sorted({s for still in touching.values() for s in still}))
        word, step = _shared(model, [top_of(model, g, tops) for g in touching]), float(model.opt.timestep)
        spans = {"timeconst": (rounded_up(2 * step), max(0.05, rounded_up(10 * step))), "dampratio": (0.1, 1.5)}
        says = {
            "timeconst": "of the contact: the shorter the harder",
            "dampratio": "of the contact: below 1 it bounces",
        }
        for key, span in spans.items():
            out += _of_geoms(model, f"{word}_solref_{key}", f"solref_{key}", every, span, says[key])
    return out


def nameless(model: mujoco.MjModel, tops: set[int]) -> list[str]:
    """What is to be said of bodies of which no geom that may touch what stands still has a name."""
    named: dict[int, bool] = {}
    for geom in range(model.ngeom):
        if (top := top_of(model, geom, tops)) and touched_by(model, geom):
            named[top] = named.get(top, False) or bool(model.geom(geom).name)
    names = ", ".join(model.body(top).name for top, any_named in named.items() if not any_named)
    return [f"friction of {names} is not asked for: no geom of it that may touch something has a name"] if names else []


def _of_geoms(
    model: mujoco.MjModel,
    name: str,
    field: str,
    geoms: tuple[Sequence[int], Sequence[int]],
    span: tuple[float, float],
    what: str,
) -> list[Unknown]:
    """One number of geoms that move and of those that stand still; nothing where all of one sort have no name.

    That of the largest friction is first: what the model has of the parameter is what its first target has.
    """
    named = [[g for g in part if model.geom(g).name] for part in geoms]
    if any(part and not with_name for part, with_name in zip(geoms, named, strict=True)):
        return []
    missing = sum(map(len, geoms)) - sum(map(len, named))
    what += f"; {missing} geoms are left out that have no name" if missing else ""
    ordered = sorted((g for part in named for g in part), key=lambda g: -own_friction(model, g))
    return [Unknown(name, tuple(f"geom:{model.geom(g).name}.{field}" for g in ordered), *span, False, what)]


def _mixed(own: Sequence[int], still: Sequence[int], least: float) -> str:
    """Whose friction MuJoCo takes of geoms that touch: that of the higher priority, else the larger."""
    if own and still:
        return "sliding friction; both sides are named: MuJoCo takes the larger one where their priority is the same"
    if own and least > _SLIPPERY:
        return (
            f"sliding friction, of which MuJoCo takes the larger one: no less than the {least:g} of what stands still"
        )
    return "sliding friction; the other side has a lower priority and does not count"


def _shared(model: mujoco.MjModel, bodies: Sequence[int]) -> str:
    """What the names of bodies begin with, or the first of them."""
    names = [model.body(body).name for body in bodies]
    begin = "".join(letters[0] for letters in takewhile(lambda x: len(set(x)) == 1, zip(*names, strict=False)))
    return word_of((begin.rstrip("_-. 0123456789") if len(set(names)) > 1 else begin) or next(filter(None, names), ""))


def word_of(name: str) -> str:
    """A name as part of a parameter's."""
    return re.sub(r"\W+", "_", name).strip("_") or "unknown"
