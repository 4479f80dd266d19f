"""Targets of contacts: how soft and how springy they are, of a geom or of a pair of geoms that the MJCF lists.

``solref_timeconst`` and ``solref_dampratio`` are a contact's spring and damper (MuJoCo's positive solref): the shorter
the time the harder, and the smaller the ratio the more of a fall comes back as a bounce; a ratio of one gives none. A
time below two physics steps is taken for two. The ``solimp_`` numbers say how much of the force holds at which depth.
Two geoms that touch share theirs, halves of each unless ``solmix`` or ``priority`` says otherwise, so name both.
"""

from __future__ import annotations

import mujoco
import numpy as np

from sipe_bayes.core.validation import nearest_name
from sipe_bayes.envs.target import Maker, Target, TargetError, entry

_SOLIMP = (("dmin", "1"), ("dmax", "1"), ("width", "m"), ("midpoint", "1"), ("power", "1"))
_LEAST_TIME = 1e-6  # s: zero and less mean another kind of solref
_LEAST = {"power": 1.0, "width": 1e-9}


def _solref(field: str, slot: int, unit: str) -> Maker:
    plain = entry(field, unit, slot, minimum=_LEAST_TIME)

    def make(model: mujoco.MjModel, spec: str, index: int) -> Target:
        if not (getattr(model, field)[index] > 0).all():
            raise TargetError(
                f"target {spec!r}: the model's solref is {getattr(model, field)[index].tolist()}, a stiffness and a "
                "damping; write it as a time constant and a damping ratio above zero"
            )
        return plain(model, spec, index)

    return make


def _contacts(of: str) -> dict[str, Maker]:
    """The targets of ``geom`` or ``pair``."""
    solimp = {
        f"solimp_{name}": entry(f"{of}_solimp", unit, slot, minimum=_LEAST.get(name, 0.0))
        for slot, (name, unit) in enumerate(_SOLIMP)
    }
    times = {
        "solref_timeconst": _solref(f"{of}_solref", 0, "s"),
        "solref_dampratio": _solref(f"{of}_solref", 1, "1"),
    }
    return {**times, **solimp}


def _geom_margin(model: mujoco.MjModel, spec: str, geom: int) -> Target:
    """The body's own margin, by which contacts are looked for, follows the largest of its geoms."""
    body = int(model.geom_bodyid[geom])
    mine = np.flatnonzero(model.geom_bodyid == body)

    def write(other: mujoco.MjModel, value: float) -> None:
        other.geom_margin[geom] = value
        other.body_margin[body] = other.geom_margin[mine].max()

    return Target(spec, "m", float(model.geom_margin[geom]), write, minimum=0.0)


def _pair_friction(slots: tuple[int, ...], unit: str) -> Maker:
    def make(model: mujoco.MjModel, spec: str, pair: int) -> Target:
        def write(other: mujoco.MjModel, value: float) -> None:
            other.pair_friction[pair, slots] = value

        return Target(spec, unit, float(model.pair_friction[pair, slots[0]]), write, minimum=0.0)

    return make


def pair_index(model: mujoco.MjModel, name: str, spec: str) -> int:
    """Id of a listed pair by its name or as GEOM/GEOM; raises TargetError that lists what there is."""
    for index in range(model.npair):
        geoms = [model.geom(int(g[index])).name for g in (model.pair_geom1, model.pair_geom2)]
        if name in (model.pair(index).name, "/".join(geoms), "/".join(geoms[::-1])):
            return index
    one, _, two = name.partition("/")
    known = [
        f"{model.geom(int(a)).name}/{model.geom(int(b)).name}"
        for a, b in zip(model.pair_geom1, model.pair_geom2, strict=True)
    ]
    add = f'; list it in the MJCF: <contact><pair geom1="{one}" geom2="{two or "..."}"/></contact>'
    raise TargetError(f"target {spec!r}: the model lists no contact pair {name!r}{nearest_name(name, known) or add}")


GEOM_CONTACTS: dict[str, Maker] = {**_contacts("geom"), "margin": _geom_margin}
PAIR_CONTACTS: dict[str, Maker] = {
    "friction": _pair_friction((0, 1), "1"),
    "friction_torsional": _pair_friction((2,), "m"),
    "friction_rolling": _pair_friction((3, 4), "m"),
    **_contacts("pair"),
    "margin": entry("pair_margin", "m", minimum=0.0),
}
